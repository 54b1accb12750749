"""Evaluate the skin reflectance model: compare its renderings with held-out photographs.

    python tools/judge_reflectance.py OUT WIDTH_PX SEED [SUBJECT ...]

Five faces, lightest to darkest, are simulated with lateral scattering and interreflection. Each is
captured with the dome's targets, calibrated, reconstructed without every twelfth of 48 lights and
one of 6 cameras, fitted, and rendered for 24 of the held-out photographs. Existing folders in OUT
are reused. At 320 pixels across, a face takes some two minutes of processor time.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from reconstruction.pipeline import recipes as pipeline
from reconstruction.pipeline.inputs import DomeOptions
from skinrig.calibrating.calibrate import calibrate
from skinrig.fitting.reflectance import fit_reflectance
from skinrig.rendering.photographs.errors import FULL_MODEL
from skinrig.rendering.photographs.evaluation import EvaluationSettings, evaluate_folders
from skinrig.simulating.simulation import simulate_session

SUBJECTS = ("palest", "II", "III", "V", "darkest")
WANT = ("normals", "normals_refined", "r_d", "basis_weight_0")
HOLD_OUT = "lights=3,15,27,39,views=2"
PHOTOGRAPHS = 24
DOME: dict[str, Any] = {"lights": 48, "views": 6}


def main(arguments: list[str]) -> int:
    """Return 0 if all subjects are within the limit."""
    out, width, seed = Path(arguments[0]), int(arguments[1]), int(arguments[2])
    subjects = arguments[3:] or SUBJECTS
    out.mkdir(parents=True, exist_ok=True)
    common = {**DOME, "width_px": width, "seed": seed}
    for target in ("charuco", "mirror", "white"):
        if not (out / f"session-{target}").exists():
            simulate_session("dome", out / f"session-{target}", target=target, **common)
    calibration = out / "calibration"
    if not calibration.exists():
        calibrate("geometry", [out / "session-charuco"], calibration)
        calibrate("lights", [out / "session-mirror", out / "session-white"], calibration)
    records = []
    for subject in subjects:
        begun = time.perf_counter()
        if not (out / f"truth-{subject}").exists():
            simulate_session(
                "dome",
                out / f"session-{subject}",
                subject=subject,
                subsurface=True,
                interreflections=True,
                **common,
            )
        pipeline.reconstruct(
            out / f"session-{subject}",
            want=WANT,
            out=out / f"appearance-{subject}",
            calibration=calibration,
            dome=DomeOptions(hold_out=HOLD_OUT),
            truth=f"truth-{subject}",
        )
        fit_reflectance(out / f"appearance-{subject}", out=out / f"model-{subject}")
        record = evaluate_folders(
            out / f"model-{subject}",
            out / f"session-{subject}",
            out / f"judged-{subject}",
            EvaluationSettings(count=PHOTOGRAPHS),
            calibration=calibration,
        )
        records.append(record)
        print(f"{subject}: {time.perf_counter() - begun:.0f} s", file=sys.stderr, flush=True)
        show(subject, record)
    (out / "reflectance.json").write_text(json.dumps(records, indent=1) + "\n", encoding="utf-8")
    return 0 if all(record["passed"] for record in records) else 1


def show(subject: str, record: dict[str, Any]) -> None:
    """Print one subject's rows."""
    full = record[FULL_MODEL]
    print(
        f"{subject:8} ITA {record['typology_angle_deg']:6.1f} ({record['band']}): median "
        f"{100 * full['median']:.2f} % [{100 * full['interval'][0]:.2f}, "
        f"{100 * full['interval'][1]:.2f}] of {full['pixels']} lit pixels in {full['pairs']} "
        f"photographs, 95th {100 * full['p95']:.1f} %, bias {100 * full['bias']:+.2f} %, noise "
        f"{100 * full['noise']:.2f} %, SSIM {full['ssim']:.4f}: "
        + ("kept" if record["passed"] else "MISSED")
    )
    for name, row in (*record["by_kind"].items(), *record["ablation"].items()):
        print(
            f"    {name:28} {100 * row['median']:6.2f} %  all skin {100 * row['total_error']:6.2f}"
            f" %  SSIM {row['ssim']:.4f}"
        )
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
