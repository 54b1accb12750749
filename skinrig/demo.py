"""The demo: simulate, capture, calibrate, reconstruct, measure and report, in one go."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from model import store
from reconstruction import pipeline
from skinrig import (
    evaluation,
    microrelief_evaluation,
    reflection_evaluation,
    surface_evaluation,
)
from skinrig.calibrating import calibrate
from skinrig.console import Console, plain
from skinrig.simulation import Simulated, simulate_session, truth_folder

FLASH_SUBJECTS = ("II", "IV")
"""Skin types of the flash rig's faces: one light, one dark, so that errors by melanin show."""
FLASH_WANT = (
    "melanin", "hemoglobin", "shading", "residual", "diffuse", "picture", "specular_picture",
    "tsumura_melanin", "tsumura_hemoglobin",
)  # fmt: skip
DOME_SUBJECT = "III"
DOME_WANT = (
    "half_vector_normals", "normals", "normals_refined", "r_d", "lobe_residual", "samples",
)  # fmt: skip
DOME_WIDTH_PX = 320
"""Pixels across each of the dome's cameras, unless said otherwise."""


GRADIENT_SITE = "forehead"
GRADIENT_WANT = ("normals", "height", "crossed", "strain", "histograms", "kernels")


class DemoError(ValueError):
    """A demo that cannot run as asked."""


@dataclass(slots=True)
class Findings:
    """What the rigs of a demo leave for its tables."""

    errors: list[list[Any]] = field(default_factory=list)
    """Subject, map, error, coverage, share masked."""
    tables: list[dict[str, Any]] = field(default_factory=list)
    next: str = ""


Share = Callable[[str], AbstractContextManager[None]]


def truth_beside(session: Path) -> Path | None:
    """Return the truth folder beside a session, or None."""
    folder = truth_folder(session)
    return folder if (folder / store.DOCUMENT).is_file() else None


def _flash(out: Path, seed: int, share: Share, width_px: int | None, found: Findings) -> None:
    """Capture targets and two faces with the flash rig, down to melanin and hemoglobin."""
    calibration = out / "calibration-flash"
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
        for subject in FLASH_SUBJECTS:
            captures.append(
                simulate_session(
                    "flash",
                    out / f"session-flash-{subject}",
                    subject=subject,
                    seed=seed,
                    width_px=width_px,
                )
            )
    with share("flash: reconstruct melanin and hemoglobin"):
        for capture in captures:
            name = capture.session.name.removeprefix("session-")
            truth = capture.truth
            pipeline.reconstruct(
                capture.session, want=FLASH_WANT, out=out / f"appearance-{name}",
                calibration=calibration, truth=truth.name if truth else "",
            )  # fmt: skip
            found.errors += _chromophore_rows(out / f"appearance-{name}", truth)
    found.tables.append(
        {
            "title": "Resolution lost as light spreads in the skin, 10 to 90 % of an edge, mm",
            "head": ["subject", "red", "green", "blue"],
            "rows": [[c.session.name, *(round(mm, 3) for mm in c.blur_mm)] for c in captures],
        }
    )
    found.tables.append(_left_out("flash rig", captures[0]))
    found.next = (
        f"skinrig reconstruct {captures[0].session} --calibration {calibration} --want melanin "
        "--out maps"
    )


def _dome(out: Path, seed: int, share: Share, width_px: int | None, found: Findings) -> None:
    """Capture targets and a face with the light dome, down to normals, albedo and lobes."""
    calibration = out / "calibration-dome"
    width = DOME_WIDTH_PX if width_px is None else min(width_px, DOME_WIDTH_PX)
    sessions = {name: out / f"session-dome-{name}" for name in ("charuco", "mirror", "white")}
    with share("dome: capture the calibration targets"):
        for target, session in sessions.items():
            simulate_session("dome", session, target=target, seed=seed, width_px=width)
    with share("dome: calibrate cameras and lights"):
        calibrate("geometry", [sessions["charuco"]], calibration)
        calibrate("lights", [sessions["mirror"], sessions["white"]], calibration)
    with share("dome: scan and capture a face"):
        capture = simulate_session(
            "dome", out / f"session-dome-{DOME_SUBJECT}", subject=DOME_SUBJECT, seed=seed,
            width_px=width,
        )  # fmt: skip
    with share("dome: reconstruct normals, albedo and lobes"):
        appearance = out / f"appearance-dome-{DOME_SUBJECT}"
        pipeline.reconstruct(
            capture.session, want=DOME_WANT, out=appearance, calibration=calibration,
            truth=capture.truth.name if capture.truth else "",
        )  # fmt: skip
        found.errors += _surface_rows(appearance, capture.truth)
    found.tables.append(
        {
            "title": "Light of the dome's capture",
            "head": ["figure", "value"],
            "rows": [[name, value] for name, value in capture.light.items()],
        }
    )
    found.tables.append(_left_out("dome", capture))
    found.next = (
        f"skinrig reconstruct {capture.session} --calibration {calibration} --want normals,r_d "
        "--out maps"
    )


def _gradient(out: Path, seed: int, share: Share, width_px: int | None, found: Findings) -> None:
    """Capture a glass ball and stretched skin in the gradient sphere, down to kernels."""
    calibration = out / "calibration-gradient"
    ball = out / "session-gradient-ball"
    with share("gradient: capture a ball of black glass"):
        simulate_session("gradient", ball, target="ball", seed=seed)
    with share("gradient: calibrate lights and films"):
        for kind in ("lights", "polarization"):
            calibrate(kind, [ball], calibration)
    with share("gradient: stretch and capture a patch of skin"):
        capture = simulate_session(
            "gradient", out / f"session-gradient-{GRADIENT_SITE}", site=GRADIENT_SITE, seed=seed,
            width_px=None if width_px is None else max(128, min(width_px, 256)),
        )  # fmt: skip
    with share("gradient: reconstruct normals, heights and kernels"):
        appearance = out / f"appearance-gradient-{GRADIENT_SITE}"
        pipeline.reconstruct(
            capture.session, want=GRADIENT_WANT, out=appearance, calibration=calibration,
            truth=capture.truth.name if capture.truth else "",
        )  # fmt: skip
        found.errors += _microrelief_rows(appearance, capture.truth)
    found.tables.append(
        {
            "title": "Light of a state's scan in the gradient sphere",
            "head": ["figure", "value"],
            "rows": [[name, value] for name, value in capture.light.items()],
        }
    )
    found.tables.append(_left_out("gradient sphere", capture))
    found.next = (
        f"skinrig reconstruct {capture.session} --calibration {calibration} "
        "--want height,kernels --out maps"
    )


RIGS: Mapping[str, Callable[[Path, int, Share, int | None, Findings], None]] = {
    "flash": _flash,
    "dome": _dome,
    "gradient": _gradient,
}
"""What the demo does with each rig, in this order."""


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
    if unknown or not rigs:
        raise DemoError(f"rigs: got {(*unknown, 'none')[0]!r}, expected out of {', '.join(RIGS)}")
    _make_room(out)
    shares: dict[str, float] = {}

    @contextmanager
    def share(name: str) -> Iterator[None]:
        console.progress(name)
        start = time.perf_counter()
        yield
        shares[name] = time.perf_counter() - start

    found = Findings()
    for rig in RIGS:
        if rig in rigs:
            RIGS[rig](out, seed, share, width_px, found)
    with share("measure error against run time"):
        from skinrig.bench_stages import run_stages

        bench = run_stages(None, budget_s=8.0, toy=True, out=out, console=console)
    document: dict[str, Any] = {
        "schema": "skinrig.demo/1",
        "title": "This demo",
        "tables": [
            {"title": "Seconds", "head": ["step", "seconds"],
             "rows": [[name, round(seconds, 2)] for name, seconds in shares.items()]},
            *found.tables,
        ],
    }  # fmt: skip
    # seconds differ from run to run: they stand in a document of their own, not in the maps
    (out / "demo.json").write_text(json.dumps(plain(document), indent=1), encoding="utf-8")
    with share("report"):
        from skinrig.report import build

        (out / "report.html").write_text(build([out], title="skinrig demo"), encoding="utf-8")
    console.say("")
    console.rows(
        ("subject", "map", "error", "unit", "68 % interval covers %", "masked %"), found.errors
    )
    console.say("")
    by_rig = {rig: _sum_of(shares, f"{rig}: ") for rig in RIGS if rig in rigs}
    console.rows(
        ("step", "seconds"),
        [*shares.items(), *((f"all of {rig}", seconds) for rig, seconds in by_rig.items())],
    )
    console.say(f"\nall of it: {sum(shares.values()):.1f} s; open {out / 'report.html'}")
    console.say(f"next: {found.next}")
    return {
        "out": out, "seconds": shares, "errors": found.errors, "bench_passed": bench["passed"],
        "report": out / "report.html",
    }  # fmt: skip


def _sum_of(shares: Mapping[str, float], prefix: str) -> float:
    return sum(seconds for name, seconds in shares.items() if name.startswith(prefix))


def _left_out(rig: str, capture: Simulated) -> dict[str, Any]:
    return {
        "title": f"Left out by the simulator of the {rig}",
        "head": ["what", "why"],
        "rows": [list(item) for item in capture.left_out],
    }


def _chromophore_rows(appearance: Path, truth: Path | None) -> list[list[Any]]:
    if truth is None:
        return []
    rows = evaluation.compare(
        store.read(appearance), store.read(truth), rng=np.random.default_rng(0)
    )
    return [
        [appearance.name.removeprefix("appearance-"), row.name, 100 * row.median_relative, "%",
         100 * row.coverage.share, 100 * row.masked]
        for row in rows if row.band is None and row.against == "blurred"
    ]  # fmt: skip


def _surface_rows(appearance: Path, truth: Path | None) -> list[list[Any]]:
    if truth is None:
        return []
    found, true = store.read(appearance), store.read(truth)
    name = appearance.name.removeprefix("appearance-")
    rows: list[list[Any]] = [
        [name, row.name, row.judged[1], row.unit, 100 * row.coverage.share, 100 * row.masked]
        for row in surface_evaluation.compare(found, true, rng=np.random.default_rng(0))
    ]
    held_out = reflection_evaluation.compare(found, true, rng=np.random.default_rng(0))
    if held_out is not None:
        rows.append([name, "reflection, held out", 100 * held_out.median, "%", float("nan"), 0.0])
    return rows


def _microrelief_rows(appearance: Path, truth: Path | None) -> list[list[Any]]:
    if truth is None:
        return []
    found, true = store.read(appearance), store.read(truth)
    name = appearance.name.removeprefix("appearance-")
    rows: list[list[Any]] = []
    for row in microrelief_evaluation.compare(found, true, rng=np.random.default_rng(0)):
        if row.state.endswith("_n0"):
            rows.append([name, "normals, neutral", row.mean_deg, "deg", 100 * row.coverage,
                         100 * row.masked])  # fmt: skip
            rows.append([name, "height, neutral", 100 * row.height_relative, "%",
                         100 * row.height_coverage, 100 * row.masked])  # fmt: skip
    strain = microrelief_evaluation.compare_stretch(found, true)
    if strain:
        worst = max(strain, key=lambda row: abs(row.error))
        rows.append(
            [name, f"stretch, {worst.state}", 100 * abs(worst.error), "%", float("nan"), 0.0]
        )
    return rows


def _make_room(out: Path) -> None:
    """Empty a folder that an earlier demo wrote; refuse any other that holds something."""
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
