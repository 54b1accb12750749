"""Fit the seconds of a rig's calibration and reconstruction to measured plans of one person.

    python tools/fit_run_times.py dome --width 200 --subject III --seed 750 --budget 45s --plans 5

Plans within the budget are chosen as far apart as possible in the pixels of cameras and frames.
The simulated rig captures them, then they are calibrated and reconstructed. Printed per plan:
pixels, seconds of the phases, and errors over their forecasts. Then the nonnegative least-squares
fit, the rows of `skinrig/data/run_times.toml`. Seconds of computation are processor seconds.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy.optimize import nnls

from skinrig.benchmarks.end_to_end import measure_choices
from skinrig.planning.plans import PlanChoice, PlanRequest, load_planner, load_sized_rig
from skinrig.planning.time_budget import (
    list_choices_within_budget,
    measure_megapixels,
    parse_budget,
)
from skinrig.simulating.dome import farthest_point_sample

CALIBRATION_SEED = 9300
"""Seed of the calibration targets; other calibrations validate the fit."""


def spread_choices(choices: list[PlanChoice], count: int) -> list[PlanChoice]:
    """Return plans with different numbers of cameras and frames."""
    sizes = np.log([measure_megapixels(one.rig, one.plan) for one in choices])
    low, high = sizes.min(axis=0), sizes.max(axis=0)
    angles = 0.25 * np.pi * (sizes - low) / np.maximum(high - low, 1e-9)
    # points of a sphere, because the sampling is one of directions
    place = np.stack([np.sin(angles[:, 0]), np.sin(angles[:, 1]), np.cos(angles[:, 0])], axis=-1)
    kept = farthest_point_sample(place, min(count, len(choices)))
    return [choices[k] for k in sorted(kept)]


def main() -> None:
    """Measure the plans, print one row per plan, and fit the seconds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rig")
    parser.add_argument("--width", type=int, help="image width, px; default: the rig's own")
    parser.add_argument("--subject", default="III")
    parser.add_argument("--seed", type=int, default=750)
    parser.add_argument("--budget", default="60s", help="largest forecast time of a plan")
    parser.add_argument("--plans", type=int, default=5)
    asked = parser.parse_args()
    rig = load_sized_rig(asked.rig, asked.width)
    request = PlanRequest(
        subject=asked.subject, seed=asked.seed, budget_s=parse_budget(asked.budget)
    )
    begun_s = time.process_time()
    choices = list_choices_within_budget(load_planner(rig.name).generate_choices, rig, request)
    plan_s = time.process_time() - begun_s
    print(f"plan_s = {plan_s:.1f}  # {len(choices)} plans")
    chosen = spread_choices(choices, asked.plans)
    sizes, calibrate_s, reconstruct_s = [], [], []
    found = measure_choices((asked.subject, asked.seed), chosen, plan_s, CALIBRATION_SEED)
    for choice, one in zip(chosen, found, strict=True):
        sizes.append([1.0, *measure_megapixels(choice.rig, choice.plan)])
        calibrate_s.append(one.times.calibrate_s)
        reconstruct_s.append(one.times.reconstruct_s)
        ratios = " ".join(
            f"{name} {one.errors[name][0]:.3g} / {median:.3g}, valid {one.errors[name][1]:.2f}"
            for name, median in choice.medians.items()
        )
        print(
            f"cameras {sizes[-1][1]:.3f} MP, frames {sizes[-1][2]:.2f} MP, capture "
            f"{one.times.capture_s:.2f} / {choice.seconds:.2f} s, calibrate "
            f"{calibrate_s[-1]:.2f} s, reconstruct {reconstruct_s[-1]:.2f} s; "
            f"measured / forecast {ratios}",
            flush=True,
        )
    for name, seconds in (("calibrate", calibrate_s), ("reconstruct", reconstruct_s)):
        # relative errors count: rows are divided by their seconds
        scale = 1.0 / np.asarray(seconds)
        terms = nnls(np.asarray(sizes) * scale[:, None], np.ones(len(seconds)))[0]
        off = np.asarray(sizes) @ terms * scale
        print(
            f"{name} = {{ fixed_s = {terms[0]:.2f}, camera_megapixel_s = {terms[1]:.2f}, "
            f"frame_megapixel_s = {terms[2]:.3f} }}  # fit over measured {off.min():.2f} to "
            f"{off.max():.2f}"
        )


if __name__ == "__main__":
    main()
