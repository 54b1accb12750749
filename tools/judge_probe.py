"""Evaluate the fiber probe on homogeneous media: capture, calibrate, reconstruct, compare sigma_tr.

    python tools/judge_probe.py OUT FIRST_SEED MEDIA [REPEATS]

Draws media with sigma_tr from 0.3 to 3.0 per mm and sigma_s' from 0.7 to 3.0 per mm, evenly in the
logarithm, and g from 0.7 to 0.9; simulates each as a session of REPEATS placements with all its
noise, and prints the error of sigma_tr by the three methods with the coverage of the 68 %
intervals. Each repeat is an independent placement. Existing folders in OUT are reused.
"""

from __future__ import annotations

import sys
from pathlib import Path

from model import store
from reconstruction.pipeline import recipes as pipeline
from skinrig.benchmarks.probe.session import draw_medium
from skinrig.calibrating.calibrate import calibrate
from skinrig.evaluating import subsurface as evaluation
from skinrig.simulating.orders import truth_folder
from skinrig.simulating.simulation import simulate_session


def main(arguments: list[str]) -> None:
    out, first, media = Path(arguments[0]), int(arguments[1]), int(arguments[2])
    repeats = int(arguments[3]) if len(arguments) > 3 else 1
    out.mkdir(parents=True, exist_ok=True)
    if not (out / "calibration").exists():
        simulate_session(
            "probe", out / "session-phantom", target="phantom", seed=first, size="full"
        )
        calibrate("fiber", [out / "session-phantom"], out / "calibration")
    rows: list[evaluation.FitAccuracy] = []
    for seed in range(first, first + media):
        sigma_a, sigma_s_prime, g = draw_medium(seed)
        session = out / f"session-{seed}"
        if not truth_folder(session).exists():
            simulate_session(
                "probe",
                session,
                subject=f"homogeneous:{sigma_a:.6g},{sigma_s_prime:.6g},{g:.3g}",
                sites=("cheek",),
                repeats=repeats,
                seed=seed,
                size="full",
            )
        pipeline.reconstruct(
            session,
            want=("profiles", "subsurface"),
            out=out / f"appearance-{seed}",
            calibration=out / "calibration",
            truth=truth_folder(session).name,
        )
        truth = store.read(truth_folder(session))
        own = evaluation.compare_fits(store.read(out / f"appearance-{seed}"), truth)
        rows += own
        fits = [
            f"{row.method} {row.channel} {100 * row.relative:+.2f} "
            f"({'in' if row.covered else 'out'}{'' if row.valid else ', not valid'})"
            for row in own
            if row.name == own[0].name and row.channel == "green"
        ]
        print(
            f"seed {seed}: sigma_a {sigma_a:.4f} sigma_s' {sigma_s_prime:.3f} g {g:.2f}; "
            f"{'; '.join(fits)}",
            flush=True,
        )
    print("method          fits  median %  worst %  bias %  68 % interval covers %")
    for each in evaluation.summarize_methods(rows):
        print(
            f"{each.method:15} {each.fits:4d}  {100 * each.median:8.2f}  {100 * each.worst:7.2f}  "
            f"{100 * each.bias:+6.2f}  {100 * each.coverage:6.1f}"
        )
    lost = sum(not row.valid for row in rows)
    print(f"not valid: {lost} of {len(rows)}")


if __name__ == "__main__":
    main(sys.argv[1:])
