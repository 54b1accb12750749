"""Evaluate a dynamic appearance: blood, color, normals and displacement of an expression."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from model import color_table, store
from model.color_table import ColorTable
from model.color_table_file import read_color_table
from model.facial_color import FacialColorError, HemoglobinRig
from model.facial_color import rig as facial_color
from model.facial_color.document import RIG_DOCUMENT, from_maps_and_document
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from model.tissue_optics.layers import ANISOTROPY_SKIN
from model.wrinkles.evaluation import WRINKLE_FILE as WRINKLE_FILE
from model.wrinkles.evaluation import WrinkleModel
from model.wrinkles.expressions import ROW_OF_STATE, Clamp
from reconstruction.facial_color.rig_transfer import transfer_rig
from skinrig.appearances import dynamic as dynamic_appearance
from skinrig.appearances.contents import (
    derive_appearance,
    hash_document,
    hash_file,
    intersect_valid,
)
from skinrig.appearances.dynamic import DYNAMIC_PARTS, FACIAL_COLOR, WRINKLES
from skinrig.capturing.option_values import parse_amounts
from skinrig.console import select_attributes
from skinrig.errors import UsageError, require_choice

EXPRESSION_KIND = "expression"
MIN_WEIGHT_SUM = 1e-6
COLOR_OBSERVER, COLOR_ILLUMINANT = "linear sRGB", "D65"
"""Observer and illuminant of output colors: those of screens and textures, not of the camera."""


class ApplyError(ValueError):
    """Weights or outputs that are not applicable to the fitted parts."""


class WeightsError(ApplyError, UsageError):
    """Malformed weights."""


@dataclass(slots=True)
class AppliedExpression:
    """Result of an evaluation.

    Attributes
    ----------
    maps
        Maps by name.
    figures
        JSON values of each part: clipped fractions, clamped zones, seconds.
    left_out
        Omitted parts with reasons.
    inputs
        SHA-256 of inputs other than the folder.
    """

    maps: dict[str, SkinMap] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, str] = field(default_factory=dict)
    left_out: list[tuple[str, str]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class TargetFace:
    """A face to which a rig of another face is transferred.

    Attributes
    ----------
    appearance
        Appearance with a map ``hemoglobin`` and, for color, ``melanin``: measured, from
        imported photographs, or painted.
    landmarks, landmarks_rig
        Landmarks of this face and of the rig's face, px of their maps; None: both have the same
        framing or texture layout.
    hashes
        SHA-256 of the source files, by role.
    """

    appearance: SkinAppearance
    landmarks: Mapping[str, tuple[float, float]] | None = None
    landmarks_rig: Mapping[str, tuple[float, float]] | None = None
    hashes: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ExpressionRequest:
    """Weights and options of an evaluation.

    Attributes
    ----------
    weights
        Weight by expression; those of facial color sum to 1, including "neutral".
    normalize
        Divide the weights by their sum.
    clamp
        Range of a wrinkle zone's summed weight over blend shapes.
    target_face
        Target face to which the rig is transferred; None: the rig's own face.
    emotional
        Scale the blood of the whole face by the paper's factors for anger and fear.
    gain
        Additional factor of the blood volume fraction.
    color_table
        File of a table of skin color, see `model.color_table_file`; None: linear sRGB under D65.
    """

    weights: Mapping[str, float]
    normalize: bool = False
    clamp: Clamp = "unit"
    emotional: bool = False
    gain: float = 1.0
    target_face: TargetFace | None = None
    color_table: Path | None = None


def parse_weights(text: str) -> dict[str, float]:
    """Parse weights from ``smile=0.7,anger=0.3``.

    Raises
    ------
    WeightsError
        If a part is not ``NAME=NUMBER``, or a name occurs twice.

    Examples
    --------
    >>> parse_weights("smile=0.7, anger=0.3")
    {'smile': 0.7, 'anger': 0.3}
    """
    found = parse_amounts(text.split(","), "--weights", error=WeightsError)
    for name, weight in found.items():
        if not np.isfinite(weight):
            raise WeightsError(
                f"--weights: got {name}={weight}, expected a finite number; correct it"
            )
    return found


def apply_expression(
    path: Path,
    expression: ExpressionRequest,
    *,
    out: Path,
    parts: Sequence[str] = DYNAMIC_PARTS,
    relief: Callable[[SkinAppearance, dict[str, Any], AppliedExpression], None] | None = None,
    progress: Callable[[str], None] | None = None,
) -> AppliedExpression:
    """Evaluate the parts of a dynamic appearance and write their maps.

    Parameters
    ----------
    path
        Dynamic appearance written by `skinrig fit`.
    expression
        Weights and options.
    out
        APPEARANCE/ folder of the result.
    parts
        Parts to evaluate, if the folder has them.
    relief
        Evaluates the microstructure, which needs a mesh; None: it is omitted.
    progress
        Called with one line per part.

    Returns
    -------
    AppliedExpression

    Raises
    ------
    ApplyError, FacialColorError, WrinkleError, DynamicAppearanceError, StoreError
        If a part does not have a weight's expression, or the folder has none of the parts.
    """
    for name in parts:
        require_choice("parts", name, DYNAMIC_PARTS, ApplyError)
    appearance, found = dynamic_appearance.read(path, parts=parts)
    _check_target(out, path)
    expression = normalize_weights(expression)
    done = AppliedExpression()
    for name in DYNAMIC_PARTS:
        if name not in found or name not in parts:
            why = "omitted by option" if name in found else "not in the folder"
            done.left_out.append((name, why))
            continue
        if progress is not None:
            progress(name.replace("_", " "))
        start = time.perf_counter()
        if name == FACIAL_COLOR:
            _facial_color(appearance, expression, done)
        elif name == WRINKLES:
            _wrinkles(appearance, expression, done)
        elif relief is not None:
            relief(appearance, found[name], done)
        else:
            done.left_out.append((name, "requires the moving mesh; add --mesh"))
            continue
        done.figures.setdefault(name, {})["seconds"] = round(time.perf_counter() - start, 3)
    if not done.maps:
        reasons = "; ".join(f"{what}: {why}" for what, why in done.left_out)
        raise ApplyError(f"{path}: no part can be evaluated ({reasons})")
    # run times are not written, so that the same input gives the same bytes
    figures = {
        name: {key: value for key, value in part.items() if "seconds" not in key}
        for name, part in done.figures.items()
    }
    other = expression.target_face
    made = derive_appearance(
        *((appearance,) if other is None else (appearance, other.appearance)),
        maps=done.maps,
        parameters={
            "kind": EXPRESSION_KIND,
            "weights": dict(expression.weights),
            "figures": figures,
            **select_attributes(expression, "clamp", "emotional", "gain"),
        },
        inputs={
            "appearance": hash_document(path),
            **({} if other is None else other.hashes),
            **done.inputs,
        },
        left_out=tuple(done.left_out),
    )
    store.write(out, made)
    return done


def _check_target(out: Path, path: Path) -> None:
    """Raise if the result would replace its input, or a folder that is not a result."""
    if out.resolve() == path.resolve():
        raise ApplyError(f"{out}: is the fitted folder itself; name another with --out")
    if (out / store.DOCUMENT_FILE).is_file():
        kind = store.read_document(out).parameters.get("kind")
        if kind != EXPRESSION_KIND:
            raise ApplyError(
                f"{out}: holds maps of kind {kind!r}, expected a new folder or an older result; "
                "it was not changed; name another with --out"
            )


def normalize_weights(expression: ExpressionRequest) -> ExpressionRequest:
    """Normalize the weights if requested, as all parts use them."""
    if not expression.normalize:
        return expression
    total = sum(expression.weights.values())
    if abs(total) < MIN_WEIGHT_SUM:
        raise ApplyError(
            f"--weights: got a sum of {total:g}, expected another than 0; remove --normalize"
        )
    weights = {name: weight / total for name, weight in expression.weights.items()}
    return replace(expression, weights=weights, normalize=False)


def read_hemoglobin_rig(appearance: SkinAppearance) -> HemoglobinRig:
    """Read the hemoglobin rig of an appearance."""
    return from_maps_and_document(appearance.maps, appearance.files[RIG_DOCUMENT])


def _facial_color(
    appearance: SkinAppearance, expression: ExpressionRequest, done: AppliedExpression
) -> None:
    rig = read_hemoglobin_rig(appearance)
    maps = appearance.maps
    if expression.target_face is not None:
        rig = _transfer_rig(rig, expression.target_face, done)
        maps = expression.target_face.appearance.maps
    try:
        rig.check_weights(expression.weights)
    except FacialColorError as error:
        raise FacialColorError(f"--{error}") from error  # weights are those of the option
    blend = rig.evaluate(
        expression.weights,
        gains=facial_color.GLOBAL_GAINS if expression.emotional else None,
        gain=expression.gain,
    )
    good = blend.valid
    held = np.where(good, blend.hemoglobin, 0.0).astype(np.float32)
    unit, stderr = MAP_UNITS["hemoglobin"], np.where(good, blend.stderr, 0.0).astype(np.float32)
    done.maps["hemoglobin"] = SkinMap(held, unit, stderr, good, "blend of measured states")
    done.figures[FACIAL_COLOR] = {
        "clipped_fraction": blend.clipped_fraction,
        "valid_fraction": float(good.mean()),
        "mean_hemoglobin": float(held[good].mean()) if good.any() else None,
    }
    if "melanin" not in maps:
        done.left_out.append(("color", "requires a melanin map"))
        return
    melanin = maps["melanin"]
    seen = good & intersect_valid(melanin)
    done.maps["melanin"] = melanin
    table, source = _color_table(expression.color_table, done)
    note = f"diffuse reflectance as {table.camera} under {table.illuminant}, white = 1{source}"
    color = skin_reflectance(melanin.values, held, seen, table=table)
    done.maps["color"] = SkinMap(color, "1", None, seen, note)


def _transfer_rig(rig: HemoglobinRig, target: TargetFace, done: AppliedExpression) -> HemoglobinRig:
    """Transfer a rig to the blood volume fraction of another face."""
    if "hemoglobin" not in target.appearance.maps:
        names = ", ".join(target.appearance.maps) or "none"
        raise ApplyError(f"--target-face: got maps {names}, expected hemoglobin; reconstruct it")
    blood = target.appearance.maps["hemoglobin"]
    melanin = target.appearance.maps.get("melanin")
    if melanin is not None and melanin.values.shape != blood.values.shape:
        raise ApplyError(
            f"--target-face: got melanin of {melanin.values.shape} and hemoglobin of "
            f"{blood.values.shape} px, expected "
            "one size"
        )
    shape = (blood.values.shape[0], blood.values.shape[1])
    if target.landmarks is not None and target.landmarks_rig is not None:
        rig = transfer_rig(
            rig, shape, landmarks_rig=target.landmarks_rig, landmarks_onto=target.landmarks
        )
    else:
        done.left_out.append(
            ("landmarks", "none given; both faces are assumed to have the same framing")
        )
    return rig.transfer_to(blood.values, valid=blood.valid, stderr=blood.stderr)


def skin_reflectance(
    melanin: Any, hemoglobin: Any, valid: Any, *, table: ColorTable | None = None
) -> Any:
    """Return diffuse reflectance of skin, (H, W, 3), 0 outside; default: sRGB under D65."""
    if table is None:
        table = _default_table()
    color = np.zeros((*valid.shape, 3), np.float32)
    color[valid] = table.lookup(melanin[valid], hemoglobin[valid])
    return color


@cache
def _default_table() -> ColorTable:
    return color_table.build(COLOR_OBSERVER, COLOR_ILLUMINANT, anisotropy=ANISOTROPY_SKIN)


def _color_table(path: Path | None, done: AppliedExpression) -> tuple[ColorTable, str]:
    """Return the table of a file, with its name for notes; without a file, that of sRGB."""
    if path is None:
        return _default_table(), ""
    table = read_color_table(path)
    done.inputs["color_table"] = hash_file(path)
    return table, f", by the table {path.name}"


def _wrinkles(
    appearance: SkinAppearance, expression: ExpressionRequest, done: AppliedExpression
) -> None:
    model = WrinkleModel.from_maps(appearance.maps, appearance.files[WRINKLE_FILE])
    weights = wrinkle_weights(model, expression.weights)
    shown = replace(model, clamp=expression.clamp).evaluate(weights)
    note = "tangent space of the texture, +X right, +Y up"
    done.maps["normals"] = SkinMap(shown.normals, "1", None, shown.valid, note)
    done.figures[WRINKLES] = {
        "weights": weights,
        "zone_weights": [zones.tolist() for zones in shown.zone_weights],
        "clamped_fraction": shown.clamped_fraction,
    }


def wrinkle_weights(model: WrinkleModel, weights: Mapping[str, float]) -> dict[str, float]:
    """Map weights of expressions to weights of a wrinkle model's rows.

    An expression selects the row of its name, or the equivalent row of the paper. Conditions of the
    whole body have no wrinkles.

    Raises
    ------
    ApplyError
        If an expression has no row.
    """
    rows = {name for layer in model.layers for name in layer.table.rows}  # type: ignore[union-attr]
    found: dict[str, float] = {}
    for state, weight in weights.items():
        if state not in rows and state not in ROW_OF_STATE:
            require_choice("--weights", state, sorted(rows), ApplyError)
        row = state if state in rows else ROW_OF_STATE[state]
        if row is not None and row not in rows:
            raise ApplyError(
                f"--weights: got {state!r}, expected an expression with fitted wrinkles, one of "
                f"{', '.join(sorted(rows))}; or omit wrinkles with --parts "
                "facial_color,microstructure"
            )
        if row is not None:
            found[row] = found.get(row, 0.0) + weight
    return found
