"""Judge directions of lights that are estimated from images alone.

Example: python tools/judge_unlisted_lights.py --seeds 6 --first 500

Heads, reliefs and balls with highlights, cast shadows and noise; strengths that differ by 3 % (one
standard deviation). The generator of the images shares no code with the estimate.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fixtures.faulty_stacks import SHAPES, dome, render

from reconstruction.normal_maps import PhotometricStereoError
from reconstruction.stack_diagnosis.unlisted_lights import HOLLOW_FACTORS, estimate_lights

COUNTS = (12, 24, 40)
SIDE_PX, MAX_TILT_DEG, STRENGTH_SPREAD = 96, 60.0, 0.03


def mean_angle_deg(found: np.ndarray, lights: np.ndarray) -> float:
    cosine = np.clip((found * lights).sum(axis=1), -1.0, 1.0)
    return float(np.degrees(np.arccos(cosine)).mean())


def judge(count: int, seeds: range) -> str:
    errors, stated, right, refused = [], [], 0, 0
    for shape in SHAPES:
        for seed in seeds:
            rng = np.random.default_rng(seed)
            lights = dome(count, rng, MAX_TILT_DEG)
            gloss = float(rng.uniform(0.0, 0.5))
            gains = rng.lognormal(0.0, STRENGTH_SPREAD, count)
            images, inside = render(
                shape, lights, rng, side=SIDE_PX, gloss=gloss, noise=0.01, gains=gains
            )
            try:
                found = estimate_lights(images, inside=inside, rng=np.random.default_rng(0))
            except PhotometricStereoError:
                refused += 1
                continue
            as_found, hollow = (
                mean_angle_deg(found.directions * sign, lights) for sign in (1.0, HOLLOW_FACTORS)
            )
            right += as_found < hollow
            errors.append(min(as_found, hollow))
            stated.append(float(np.median(found.stderr_deg)))
    ratio = np.array(errors) / np.array(stated)
    return (
        f"{count} lights, {len(errors)} sets: error {np.mean(errors):.2f} deg (largest "
        f"{np.max(errors):.2f}), stated {np.mean(stated):.2f}, error over stated "
        f"{np.median(ratio):.2f}, sign right {right}, refused {refused}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--first", type=int, default=500)
    given = parser.parse_args()
    for count in COUNTS:
        print(judge(count, range(given.first, given.first + given.seeds)), flush=True)


if __name__ == "__main__":
    main()
