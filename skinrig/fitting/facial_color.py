"""Fit a hemoglobin rig to flash sessions: `skinrig fit facial-color`."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from model import store
from model.facial_color import FacialColorError
from model.facial_color import document as facial_color_document
from model.skin import SkinAppearance
from reconstruction.correspondence import landmark_table
from reconstruction.pipeline.flash import facial_color as facial_color_fit
from reconstruction.pipeline.flash import state_images
from reconstruction.pipeline.flash.facial_color import FacialColorFit, UnknownBloodError
from reconstruction.pipeline.flash.state_images import Landmarks, SubjectImages
from skinrig.appearances import dynamic as dynamic_appearance
from skinrig.appearances.contents import intersect_valid
from skinrig.appearances.dynamic import FACIAL_COLOR
from skinrig.appearances.state_truth import find_state_truth
from skinrig.console import select_attributes


class FacialColorInputError(ValueError):
    """Unusable landmarks or sessions."""


def fit_facial_color(
    sessions: Sequence[Path],
    *,
    out: Path,
    calibration: Path | None = None,
    landmarks: Path | None = None,
    radius_px: float | None = None,
    stored_size: int | None = 256,
    progress: Callable[[str], None] | None = None,
) -> FacialColorFit:
    """Fit the facial-color part of a dynamic appearance and write it to `out`.

    Parameters
    ----------
    sessions
        SESSION/ folders of the flash rig, one subject, with a neutral expression.
    out
        Folder of the dynamic appearance; its other parts are kept.
    calibration
        CALIBRATION/ folder.
    landmarks
        Folder with a table ``STATE.csv`` (name, x, y) per expression; None: those of a simulation,
        else features are matched.
    radius_px
        Radius of the disc of local statistics, px of the maps; None: the fit's default.
    stored_size
        Side of the stored scale and bias maps, cells; None: that of the images.
    progress
        Called with one line per step.

    Raises
    ------
    FacialColorFitError, InputsError, LandmarkError, DynamicAppearanceError
        If an input is missing or inconsistent; the message names it.
    """
    if radius_px is not None and not 0.0 < radius_px < math.inf:
        raise FacialColorInputError(
            f"--radius: got {radius_px:g} px, expected above 0; enter another"
        )
    if stored_size is not None and stored_size < 1:
        raise FacialColorInputError(
            f"--stored-size: got {stored_size} cells, expected 1 or more; enter another"
        )
    dynamic_appearance.check_target(out)
    subject = state_images.reconstruct_states(sessions, calibration=calibration, progress=progress)
    marks, marked_by, unmarked = _landmarks(subject, sessions, landmarks)
    try:
        how: dict[str, Any] = {"radius_px": radius_px, "stored_size": stored_size}
        found = facial_color_fit.fit_facial_color(
            subject, landmarks=marks, progress=progress, **how
        )
    except (FacialColorError, UnknownBloodError) as error:
        if subject.has_white:
            raise
        raise FacialColorInputError(
            f"{error}; add a white calibration with --calibration, which "
            "separates illumination from blood"
        ) from error
    maps, document = facial_color_document.to_maps(found.rig)
    maps["melanin"] = found.melanin
    for state, change in found.changes.items():
        maps[f"change_{state}"] = change
        maps[f"hemoglobin_{state}"] = found.hemoglobin[state]
    truths = {state: at.name for state, at in _truths(subject, sessions).items() if at is not None}
    dynamic_appearance.add(
        out,
        FACIAL_COLOR,
        SkinAppearance(
            maps=maps,
            files={facial_color_document.RIG_DOCUMENT: document},
            parameters={
                "sessions": [path.name for path in sessions],
                "states": list(found.hemoglobin),
                "radius_px": found.rig.radius_px,
                "landmarks": marked_by,
                "alignment": facial_color_fit.alignment_document(found),
                "repeatability": facial_color_fit.repeats_document(found),
                "storage_error": {n: list(e) for n, e in found.rig.storage_error().items()},
                **select_attributes(subject, "camera", "illuminant"),
                "assumed": list(subject.assumed),
                "consent": [dict(one) for one in subject.consent],
                "truth": truths,
            },
            left_out=(*found.omitted, *unmarked),
            **select_attributes(subject, "inputs", "source", "seed"),
        ),
    )
    return found


def summarize_states(found: FacialColorFit) -> list[tuple[str, str, str, str, str]]:
    """Return rows of expression, mean change (%), relative change, scale, alignment error."""
    rows = []
    neutral = found.hemoglobin["neutral"]
    errors = {one.image.state: one.alignment for one in found.aligned if one.alignment is not None}
    for state, change in found.changes.items():
        both = intersect_valid(change, neutral)
        level = float(neutral.values[both].mean()) if both.any() else float("nan")
        mean = float(change.values[both].mean()) if both.any() else float("nan")
        scale = found.rig.states[state]
        alignment = errors.get(state)
        error = "" if alignment is None else f"{np.median(alignment.error_px[alignment.valid]):.2f}"
        by = f"{np.median(scale.scale[scale.valid]):.3f}"
        rows.append((state, f"{100 * mean:+.3f}", f"{100 * mean / level:+.1f}", by, error))
    return rows


def _landmarks(
    subject: SubjectImages, sessions: Sequence[Path], folder: Path | None
) -> tuple[Mapping[str, Landmarks] | None, str, list[tuple[str, str]]]:
    """Return the landmarks by expression, their source, and the expressions without landmarks."""
    found: dict[str, Landmarks] = {}
    if folder is not None:
        if not folder.is_dir():
            raise FacialColorInputError(
                f"--landmarks: got {folder}, expected a folder with a table STATE.csv per"
                f" expression"
            )
        found = {
            state: landmark_table.read_landmark_table(folder / f"{state}.csv")
            for state in subject.states
            if (folder / f"{state}.csv").is_file()
        }
        if "neutral" not in found:
            raise FacialColorInputError(f"--landmarks: {folder / 'neutral.csv'} is missing; add it")
        words = "tables"
    elif subject.source == "simulated":
        for state, place in _truths(subject, sessions).items():
            points = place and store.read_document(place).parameters.get("landmarks_px")
            if place is not None and isinstance(points, dict):
                found[state] = {n: _point(place, n, value) for n, value in points.items()}
        words = "the simulation's own"
    if "neutral" not in found or len(found) < 2:
        return None, "features matched", []
    missing = [state for state in subject.states if state not in found]
    return found, words, [(state, "landmarks: none, features were matched") for state in missing]


def _truths(subject: SubjectImages, sessions: Sequence[Path]) -> dict[str, Path | None]:
    """Return the ground truth folder by expression, next to the expression's first session."""
    return {
        state: find_state_truth(sessions[subject.images_of_state(state)[0].session], state)
        for state in subject.states
    }


def _point(table: Path, name: str, value: Any) -> tuple[float, float]:
    try:
        x, y = value
        return float(x), float(y)
    except (TypeError, ValueError) as error:
        raise FacialColorInputError(
            f"{table}: landmark {name!r} is {json.dumps(value)}, expected two numbers; correct"
            f" the table"
        ) from error
