"""What the demo does with each rig: simulate, capture, calibrate, reconstruct and measure.

Each rig runs in a process of its own, which compiles the kernels that it imports: what belongs to
one rig is imported in its function.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from model import store
from reconstruction.pipeline import recipes as pipeline
from reconstruction.pipeline.inputs import DomeOptions
from skinrig.appearances.dynamic import FACIAL_COLOR, parts_of
from skinrig.applying.expression import hemoglobin_rig
from skinrig.calibrating.calibrate import calibrate
from skinrig.capturing.light_safety import light_rows
from skinrig.evaluating import facial_color, flash, microrelief, subsurface
from skinrig.evaluating import surface as surface_evaluation
from skinrig.fitting.facial_color import fit_facial_color
from skinrig.fitting.microstructure import fit_microstructure
from skinrig.rendering.photographs.comparison import FULL_MODEL
from skinrig.reporting.map_names import state_words
from skinrig.simulating.orders import Simulated
from skinrig.simulating.simulation import simulate_session

FLASH_SUBJECTS = ("II", "IV")
"""Skin types of the flash rig's faces: one light, one dark, so that errors by melanin show."""
FLASH_STATES = ("neutral", "anger")
"""States of the first face: what a hemoglobin rig is fitted to."""
FLASH_WANT = (
    "melanin",
    "hemoglobin",
    "shading",
    "residual",
    "diffuse",
    "picture",
    "specular_picture",
    "tsumura_melanin",
    "tsumura_hemoglobin",
)
DOME_SUBJECT = "III"
DOME_WANT = (
    "half_vector_normals",
    "normals",
    "normals_refined",
    "r_d",
    "lobe_residual",
    "samples",
    "basis_weight_0",
    "basis_weight_1",
    "basis_weight_2",
    "basis_weight_3",
)
DOME_HELD_OUT = "lights=16,23"
"""Lights, by number, whose photographs no fit sees: renderings are compared with them."""
DOME_LEFT_OUT = ("subsurface",)
"""Light that spreads sideways takes half a minute, and blurs less than its pixels of 2 mm."""
DOME_COMPARED = 3
"""How many of their photographs are compared."""
DOME_WIDTH_PX = 320
"""Pixels across each of the dome's cameras, unless said otherwise."""

PROBE_SUBJECT = "III"
PROBE_MEDIUM = "homogeneous:0.08,1.2"
"""A medium whose sigma_tr is known, 0.55 per mm: layers have one by definition only."""
PROBE_WANT = ("profiles", "subsurface", "translucency")
GRADIENT_SITE = "forehead"
GRADIENT_WANT = ("normals", "height", "crossed", "strain", "histograms", "kernels")


@dataclass(slots=True)
class Findings:
    """What the rigs of a demo leave for its tables."""

    errors: list[list[Any]] = field(default_factory=list)
    """Subject, map, error, coverage, share masked."""
    tables: list[dict[str, Any]] = field(default_factory=list)


Share = Callable[[str], AbstractContextManager[None]]


def _flash(out: Path, seed: int, share: Share, width_px: int | None, found: Findings) -> None:
    """Capture targets and two faces with the flash rig, down to melanin, blood and its changes."""
    calibration = out / "calibration-flash"
    with share("flash: capture the calibration targets"):
        for target in ("flat", "white", "chart", "malus"):
            simulate_session(
                "flash",
                out / f"session-flash-{target}",
                target=target,
                seed=seed,
                width_px=width_px,
            )
    with share("flash: calibrate"):
        for kind, target in (
            ("sensor", "flat"),
            ("white", "white"),
            ("color", "chart"),
            ("polarization", "malus"),
        ):
            calibrate(kind, [out / f"session-flash-{target}"], calibration)
    captures: list[Simulated] = []
    with share("flash: capture two faces"):
        for number, subject in enumerate(FLASH_SUBJECTS):
            captures.append(
                simulate_session(
                    "flash",
                    out / f"session-flash-{subject}",
                    subject=subject,
                    seed=seed,
                    width_px=width_px,
                    states=FLASH_STATES if number == 0 else ("neutral",),
                )
            )
    with share("flash: reconstruct melanin and hemoglobin"):
        for capture in captures:
            name = capture.session.name.removeprefix("session-")
            truth = capture.truth
            pipeline.reconstruct(
                capture.session,
                want=FLASH_WANT,
                out=out / f"appearance-{name}",
                calibration=calibration,
                truth=truth.name if truth else "",
            )
            found.errors += _chromophore_rows(out / f"appearance-{name}", truth)
    with share("flash: fit the blood of a moving face"):
        moving = out / f"appearance-flash-moving-{FLASH_SUBJECTS[0]}"
        fit_facial_color([captures[0].session], out=moving, calibration=calibration)
        found.errors += _moving_rows(moving, out)
    found.tables.append(
        {
            "title": "Resolution lost as light spreads in the skin, 10 to 90 % of an edge, mm",
            "head": ["subject", "red", "green", "blue"],
            "rows": [[c.session.name, *(round(mm, 3) for mm in c.blur_mm)] for c in captures],
        }
    )
    found.tables.append(_left_out("flash rig", captures[0]))


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
            "dome",
            out / f"session-dome-{DOME_SUBJECT}",
            subject=DOME_SUBJECT,
            seed=seed,
            leave_out=DOME_LEFT_OUT,
            width_px=width,
        )
    with share("dome: reconstruct normals, albedo and lobes"):
        appearance = out / f"appearance-dome-{DOME_SUBJECT}"
        pipeline.reconstruct(
            capture.session,
            want=DOME_WANT,
            out=appearance,
            calibration=calibration,
            truth=capture.truth.name if capture.truth else "",
            dome=DomeOptions(hold_out=DOME_HELD_OUT),
        )
        found.errors += _surface_rows(appearance, capture.truth)
    with share("dome: render photographs that no fit has seen"):
        from skinrig.rendering.photographs.evaluation import evaluate_folders

        compared = evaluate_folders(
            appearance,
            capture.session,
            out / f"pictures-dome-{DOME_SUBJECT}",
            calibration=calibration,
            count=DOME_COMPARED,
            seed=seed,
        )
    found.tables.append(
        {
            "title": "Luminance of photographs that no fit has seen, on lit pixels",
            "head": ["model", "median error, %", "all skin, %"],
            "rows": [
                [name, 100 * row["median"], 100 * row["total_error"]]
                for name, row in ((FULL_MODEL, compared[FULL_MODEL]), *compared["ablation"].items())
            ],
        }
    )
    found.tables.append(
        {
            "title": "Light of the dome's capture",
            "head": ["figure", "value"],
            "rows": [list(row) for row in light_rows(capture.light)],
        }
    )
    found.tables.append(_left_out("dome", capture))


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
            "gradient",
            out / f"session-gradient-{GRADIENT_SITE}",
            site=GRADIENT_SITE,
            seed=seed,
            width_px=None if width_px is None else max(128, min(width_px, 256)),
        )
    with share("gradient: reconstruct normals, heights and kernels"):
        appearance = out / f"appearance-gradient-{GRADIENT_SITE}"
        pipeline.reconstruct(
            capture.session,
            want=GRADIENT_WANT,
            out=appearance,
            calibration=calibration,
            truth=capture.truth.name if capture.truth else "",
        )
        fit_microstructure(
            [appearance], out=out / f"appearance-gradient-moving-{GRADIENT_SITE}", paper_table=True
        )
        found.errors += _microrelief_rows(appearance, capture.truth)
    found.tables.append(
        {
            "title": "Light of a state's scan in the gradient sphere",
            "head": ["figure", "value"],
            "rows": [list(row) for row in light_rows(capture.light)],
        }
    )
    found.tables.append(_left_out("gradient sphere", capture))


def _probe(out: Path, seed: int, share: Share, width_px: int | None, found: Findings) -> None:
    """Calibrate a fibre probe, and measure a medium and three sites of a face."""
    del width_px  # its camera looks at the ends of fibres
    calibration, phantom = out / "calibration-probe", out / "session-probe-phantom"
    with share("probe: capture a phantom"):
        simulate_session("probe", phantom, target="phantom", seed=seed)
    with share("probe: calibrate its fibres"):
        calibrate("fibre", [phantom], calibration)
    with share("probe: capture a medium and three sites of a face"):
        captures = [
            simulate_session(
                "probe",
                out / "session-probe-medium",
                subject=PROBE_MEDIUM,
                sites=("cheek",),
                seed=seed,
            ),
            simulate_session(
                "probe", out / f"session-probe-{PROBE_SUBJECT}", subject=PROBE_SUBJECT, seed=seed
            ),
        ]
    with share("probe: reconstruct sigma_tr and translucency"):
        for capture in captures:
            appearance = out / capture.session.name.replace("session", "appearance")
            pipeline.reconstruct(
                capture.session,
                want=PROBE_WANT,
                out=appearance,
                calibration=calibration,
                truth=capture.truth.name if capture.truth else "",
            )
            found.errors += _subsurface_rows(appearance, capture.truth)
    found.tables.append(_left_out("fibre probe", captures[-1]))


RIGS: Mapping[str, Callable[[Path, int, Share, int | None, Findings], None]] = {
    "flash": _flash,
    "dome": _dome,
    "gradient": _gradient,
    "probe": _probe,
}
"""What the demo does with each rig, in this order."""


def _left_out(rig: str, capture: Simulated) -> dict[str, Any]:
    return {
        "title": f"Left out by the simulator of the {rig}",
        "head": ["what", "why"],
        "rows": [list(item) for item in capture.left_out],
    }


def _chromophore_rows(appearance: Path, truth: Path | None) -> list[list[Any]]:

    if truth is None:
        return []
    rows = flash.compare(store.read(appearance), store.read(truth), rng=np.random.default_rng(0))
    return [
        [
            appearance.name.removeprefix("appearance-"),
            row.name,
            100 * row.median_relative,
            "%",
            100 * row.coverage.share,
            100 * row.masked,
        ]
        for row in rows
        if row.band is None and row.against == "blurred"
    ]


def _moving_rows(appearance: Path, out: Path) -> list[list[Any]]:

    found = store.read(appearance)
    named = parts_of(found)[FACIAL_COLOR]["truth"]
    truths = {state: store.read(out / folder) for state, folder in named.items()}
    states, _ = facial_color.compare(
        found, hemoglobin_rig(found), truths, rng=np.random.default_rng(0)
    )
    return [
        [
            appearance.name.removeprefix("appearance-"),
            f"blood of {row.state}, {row.way}",
            100 * row.median_relative,
            "%",
            100 * row.coverage,
            0.0,
        ]
        for row in states
        if row.way in (facial_color.PREDICTION_METHODS[1], facial_color.PREDICTION_METHODS[3])
    ]


def _surface_rows(appearance: Path, truth: Path | None) -> list[list[Any]]:
    from skinrig.evaluating import reflection

    if truth is None:
        return []
    found, true = store.read(appearance), store.read(truth)
    name = appearance.name.removeprefix("appearance-")
    rows: list[list[Any]] = [
        [name, row.name, row.judged[1], row.unit, 100 * row.coverage.share, 100 * row.masked]
        for row in surface_evaluation.compare(found, true, rng=np.random.default_rng(0))
    ]
    held_out = reflection.compare(found, true, rng=np.random.default_rng(0))
    if held_out is not None:
        rows.append([name, "reflection, held out", 100 * held_out.median, "%", float("nan"), 0.0])
    return rows


def _subsurface_rows(appearance: Path, truth: Path | None) -> list[list[Any]]:

    if truth is None:
        return []
    name = appearance.name.removeprefix("appearance-")
    fits = subsurface.compare_fits(store.read(appearance), store.read(truth))
    lost = {
        method: np.mean([not row.valid for row in fits if row.method == method])
        for method in dict.fromkeys(row.method for row in fits)
    }
    return [
        [
            name,
            f"sigma_tr, {row.method}",
            100 * row.median,
            "%",
            100 * row.coverage,
            100 * float(lost[row.method]),
        ]
        for row in subsurface.by_method(fits)
    ]


def _microrelief_rows(appearance: Path, truth: Path | None) -> list[list[Any]]:

    if truth is None:
        return []
    found, true = store.read(appearance), store.read(truth)
    name = appearance.name.removeprefix("appearance-")
    rows: list[list[Any]] = []
    for row in microrelief.compare(found, true, rng=np.random.default_rng(0)):
        if row.state.endswith("_n0"):
            rows.append(
                [
                    name,
                    "normals, neutral",
                    row.mean_deg,
                    "deg",
                    100 * row.coverage,
                    100 * row.masked,
                ]
            )
            rows.append(
                [
                    name,
                    "height, neutral",
                    100 * row.height_relative,
                    "%",
                    100 * row.height_coverage,
                    100 * row.masked,
                ]
            )
    strain = microrelief.compare_stretch(found, true)
    if strain:
        worst = max(strain, key=lambda row: abs(row.error))
        rows.append(
            [
                name,
                f"stretch, {state_words(worst.state)}",
                100 * abs(worst.error),
                "%",
                float("nan"),
                0.0,
            ]
        )
    return rows
