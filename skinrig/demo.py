"""The demo: simulate, capture, calibrate, reconstruct, measure and report, in one go."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from model import store
from reconstruction import pipeline
from skinrig import evaluation
from skinrig.calibrating import calibrate
from skinrig.console import Console, plain
from skinrig.simulation import Simulated, simulate_session, truth_folder

RIGS = ("flash",)
SUBJECTS = ("II", "IV")
"""Skin types of the demo: one light, one dark, so that errors by melanin band show."""
WANT = (
    "melanin", "hemoglobin", "shading", "residual", "diffuse", "picture", "specular_picture",
    "tsumura_melanin", "tsumura_hemoglobin",
)  # fmt: skip


class DemoError(ValueError):
    """A demo that cannot run as asked."""


def truth_beside(session: Path) -> Path | None:
    """Return the truth folder beside a session, or None."""
    folder = truth_folder(session)
    return folder if (folder / store.DOCUMENT).is_file() else None


def run_demo(
    out: Path, rigs: Sequence[str], *, seed: int = 0, console: Console, width_px: int | None = None
) -> Mapping[str, Any]:
    """Run the demo into ``out`` and return its document.

    Parameters
    ----------
    out
        A folder that is new, empty, or of an earlier demo, which is replaced.
    rigs
        Which rigs.
    seed
        Of all that is drawn.
    console
        Where progress goes.
    width_px
        Pixels across the simulated camera; None: the small size.
    """
    unknown = [rig for rig in rigs if rig not in RIGS]
    if unknown:
        raise DemoError(f"rigs: got {unknown[0]!r}, expected out of {', '.join(RIGS)}")
    _make_room(out)
    shares: dict[str, float] = {}

    @contextmanager
    def share(name: str) -> Any:
        console.progress(name)
        start = time.perf_counter()
        yield
        shares[name] = time.perf_counter() - start

    calibration = out / "calibration"
    with share("flash: capture the calibration targets"):
        for target in ("flat", "white", "chart", "malus"):
            simulate_session(
                "flash", out / f"session-flash-{target}", target=target, seed=seed,
                width_px=width_px,
            )  # fmt: skip
    with share("flash: calibrate"):
        for kind, target in (
            ("sensor", "flat"), ("white", "white"), ("color", "chart"), ("polarization", "malus"),
        ):  # fmt: skip
            calibrate(kind, [out / f"session-flash-{target}"], calibration)
    captures: list[Simulated] = []
    with share("flash: capture two faces"):
        for subject in SUBJECTS:
            captures.append(
                simulate_session(
                    "flash",
                    out / f"session-flash-{subject}",
                    subject=subject,
                    seed=seed,
                    width_px=width_px,
                )
            )
    rows: list[list[Any]] = []
    with share("flash: reconstruct melanin and hemoglobin"):
        for capture in captures:
            name = capture.session.name.removeprefix("session-")
            truth = capture.truth
            pipeline.reconstruct(
                capture.session, want=WANT, out=out / f"appearance-{name}",
                calibration=calibration, truth=truth.name if truth else "",
            )  # fmt: skip
            rows += _rows(out / f"appearance-{name}", truth)
    with share("measure error against run time"):
        from skinrig.bench_stages import run_stages

        bench = run_stages(None, budget_s=8.0, toy=True, out=out, console=console)
    document: dict[str, Any] = {
        "schema": "skinrig.demo/1",
        "title": "This demo",
        "tables": [
            {"title": "Seconds", "head": ["step", "seconds"],
             "rows": [[name, round(seconds, 2)] for name, seconds in shares.items()]},
            {
                "title": "Resolution lost as light spreads in the skin, 10 to 90 % of an edge, mm",
                "head": ["subject", "red", "green", "blue"],
                "rows": [[c.session.name, *(round(mm, 3) for mm in c.blur_mm)] for c in captures],
            },
            {"title": "Left out by the simulator", "head": ["what", "why"],
             "rows": [list(item) for item in captures[0].left_out]},
        ],
    }  # fmt: skip
    # seconds differ from run to run: they stand in a document of their own, not in the maps
    (out / "demo.json").write_text(json.dumps(plain(document), indent=1), encoding="utf-8")
    with share("report"):
        from skinrig.report import build

        (out / "report.html").write_text(build([out], title="skinrig demo"), encoding="utf-8")
    console.say("")
    console.rows(("subject", "map", "median error %", "68 % interval covers %", "masked %"), rows)
    console.say("")
    console.rows(("step", "seconds"), list(shares.items()))
    console.say(f"\nall of it: {sum(shares.values()):.1f} s; open {out / 'report.html'}")
    console.say(f"next: skinrig reconstruct {captures[0].session} --want melanin --out maps")
    return {
        "out": out, "seconds": shares, "errors": rows, "bench_passed": bench["passed"],
        "report": out / "report.html",
    }  # fmt: skip


def _rows(appearance: Path, truth: Path | None) -> list[list[Any]]:
    if truth is None:
        return []
    rows = evaluation.compare(
        store.read(appearance), store.read(truth), rng=np.random.default_rng(0)
    )
    return [
        [appearance.name.removeprefix("appearance-"), row.name, 100 * row.median_relative,
         100 * row.coverage.share, 100 * row.masked]
        for row in rows if row.band is None and row.against == "blurred"
    ]  # fmt: skip


def _make_room(out: Path) -> None:
    """Empty a folder that an earlier demo wrote; refuse any other that holds something."""
    import shutil

    mark = out / ".skinrig-demo"
    if not out.exists():
        out.mkdir(parents=True)
        mark.touch()
        return
    if not out.is_dir():
        raise DemoError(f"{out}: is a file, expected a folder; name another with --out")
    inside = list(out.iterdir())
    if inside and not mark.exists():
        raise DemoError(
            f"{out}: holds files that are not of an earlier demo; nothing was touched: "
            "name another folder with --out"
        )
    for entry in inside:
        if entry.is_dir():
            shutil.rmtree(entry)
        else:
            entry.unlink()
    mark.touch()
