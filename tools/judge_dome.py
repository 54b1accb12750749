"""Evaluate the dome rig on simulated faces: capture, calibrate, reconstruct, compare.

    python tools/judge_dome.py OUT PRESET SEED [WIDTH_PX VIEWS LIGHTS]

By default all 150 lights and 16 cameras are used at half resolution (650 pixels across; about 10 GB
and half an hour on two cores). Existing folders in OUT are reused. The error table is printed for
the scanned geometry and for the ground-truth mesh, which separates the scanner's part of the error.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from model import store
from reconstruction.pipeline import recipes as pipeline
from reconstruction.pipeline.inputs import DomeOptions
from skinrig.calibrating.calibrate import calibrate
from skinrig.evaluating import reflection
from skinrig.evaluating import surface as surface_evaluation
from skinrig.simulating.simulation import simulate_session

WANT = ("half_vector_normals", "normals", "normals_refined", "r_d", "lobe_residual", "samples")


def main(arguments: list[str]) -> None:
    out, preset, seed = Path(arguments[0]), arguments[1], int(arguments[2])
    width, views, lights = (int(a) for a in (arguments[3:] or ("650", "16", "150")))
    size = {"width_px": width, "views": views, "lights": lights, "seed": seed}
    out.mkdir(parents=True, exist_ok=True)
    for target in ("charuco", "mirror", "white"):
        if not (out / f"session-{target}").exists():
            with timed(f"capture {target}"):
                simulate_session(
                    "dome", out / f"session-{target}", target=target, size="full", **size
                )
    if not (out / "calibration").exists():
        with timed("calibrate"):
            calibrate("geometry", [out / "session-charuco"], out / "calibration")
            sessions = [out / "session-mirror", out / "session-white"]
            calibrate("lights", sessions, out / "calibration")
    if not (out / "truth-dome").exists():
        with timed("capture the face"):
            simulate_session("dome", out / "session-dome", subject=preset, size="full", **size)
    truth = store.read(out / "truth-dome")
    for name, scan in (("scanned", None), ("true", out / "truth-dome" / "mesh.ply")):
        with timed(f"reconstruct with the {name} geometry"):
            pipeline.reconstruct(
                out / "session-dome",
                want=WANT,
                out=out / f"appearance-{name}",
                calibration=out / "calibration",
                dome=DomeOptions(scan=scan),
                truth="truth-dome",
                progress=lambda stage: print(f"  {stage}", file=sys.stderr, flush=True),
            )
        found = store.read(out / f"appearance-{name}")
        print(f"{preset}, seed {seed}, {name} geometry: {found.parameters.get('registration')}")
        for row in surface_evaluation.compare(found, truth, rng=np.random.default_rng(0)):
            print(
                f"  {row.name:20} {row.unit:3} points {row.points} masked {100 * row.masked:.0f} % "
                f"mean {row.mean:.3f} median {row.median:.3f} 95th {row.high:.2f} "
                f"bias {row.bias:.2f} covers {100 * row.coverage.fraction:.0f} % "
                f"stderr {row.median_stderr:.3f}"
            )
        print(f"  {reflection.compare(found, truth, rng=np.random.default_rng(0))}")


class timed:  # noqa: N801
    def __init__(self, name: str) -> None:
        self._name = name

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        print(f"{self._name}: {time.perf_counter() - self._start:.0f} s", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
