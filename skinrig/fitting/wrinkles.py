"""Fit wrinkle maps to normals of a neutral face and its expressions: `skinrig fit wrinkles`."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from model import metrics, store
from model.skin import SkinAppearance
from model.wrinkles.evaluation import WRINKLE_FILE as WRINKLE_FILE
from model.wrinkles.evaluation import WrinkleModel
from reconstruction.normal_maps import NormalMaps
from reconstruction.pipeline.dome.stages import MESH_FILE
from reconstruction.surface.tangent_space import SMOOTHING_MM, tangent_normals
from reconstruction.wrinkles.fit import WrinkleFit, fit_wrinkle_map
from reconstruction.wrinkles.normal_differences import fit_difference_map
from reconstruction.wrinkles.zones import ZoneFit, estimate_amplitudes, fit_zones
from skinrig.appearances import dynamic as dynamic_appearance
from skinrig.appearances.contents import derive_appearance, hash_document, intersect_valid
from skinrig.appearances.dynamic import WRINKLES
from skinrig.arrays import BoolArray, Float32Array, FloatArray

Method: TypeAlias = Literal["derivatives", "differences"]

STATE_PATTERN = re.compile(r"[a-z][a-z0-9_]{0,31}")
NORMAL_MAPS = ("normals_refined", "normals")
"""Maps of normals in order of preference."""
N_ZONES = 8
"""Number of wrinkle zones: the channels of two RGBA masks (Jimenez2011)."""


class WrinkleInputError(ValueError):
    """Folders whose normals are not comparable."""


@dataclass(frozen=True, slots=True)
class FittedWrinkles:
    """Result of a wrinkle fit."""

    fit: WrinkleFit
    zones: ZoneFit | None
    """Fit of the zones; None if masks were given."""
    model: WrinkleModel
    """The face with its wrinkles."""
    angle_deg: float
    """Mean angle between measured and modeled normals of the expressions."""
    neutral_angle_deg: float
    """Mean angle between the normals of the expressions and of the neutral face."""
    clamped_fraction: float
    """Fraction of texels of a difference beyond [-1, 1]; 0 for derivatives."""


def fit_wrinkles(
    appearances: Sequence[Path],
    *,
    out: Path,
    masks: Sequence[Path] | None = None,
    size: int = 256,
    mask_size: int = 64,
    seed: int = 0,
    method: Method = "derivatives",
) -> FittedWrinkles:
    """Fit the wrinkle part of a dynamic appearance and write it to `out`.

    Parameters
    ----------
    appearances
        APPEARANCE/ folders of dome sessions of one subject, with normals and positions on one
        texture: the neutral and at least one expression. ``STATE=FOLDER`` names the expression, by
        default the folder's document.
    out
        Folder of the dynamic appearance; its other parts are kept.
    masks
        Two RGBA images of the zones; None: zones are estimated from the normals.
    size, mask_size
        Width and height of wrinkle map and masks, texels.
    seed
        Random seed of the zone search.
    method
        Combination with the neutral normals: partial derivatives, or differences of normals.

    Raises
    ------
    WrinkleInputError, WrinkleError, DynamicAppearanceError
        If a folder lacks a map; the message names both.
    """
    dynamic_appearance.check_target(out)
    read: dict[str, tuple[Path, SkinAppearance]] = {}
    for given in appearances:
        state, folder = _parse_state(given)
        if state in read:
            raise WrinkleInputError(
                f"{folder}: got expression {state!r} twice, also {read[state][0]}; give one of them"
            )
        read[state] = (folder, store.read(folder))
    if "neutral" not in read or len(read) < 2:
        raise WrinkleInputError(
            f"appearances: got {', '.join(read) or 'none'}, expected neutral and at least one"
            " expression; add folders, or name them as STATE=FOLDER"
        )
    unchecked = _check_textures({state: one for state, (_, one) in read.items()})
    measured = {state: _normals(folder, one) for state, (folder, one) in read.items()}
    shapes = {state: one.normals.shape for state, one in measured.items()}
    if len(set(shapes.values())) > 1:
        sizes = ", ".join(f"{state} {shape[:2]}" for state, shape in shapes.items())
        raise WrinkleInputError(f"appearances: got textures of sizes {sizes}, expected one size")
    neutral = measured.pop("neutral")
    side = min(neutral.normals.shape[:2])
    zones = None
    stack: Any
    if masks is None:
        small = min(mask_size, side)
        height = estimate_amplitudes(neutral, measured, size=(small, small))
        zones = fit_zones(height, zones=N_ZONES, rng=np.random.default_rng(seed))
        stack = zones.masks
    else:
        stack = _read_masks(masks)
    found = fit_wrinkle_map(neutral, measured, stack, size=(min(size, side), min(size, side)))
    model, clamped = found.model(), 0.0
    if method == "differences":
        difference = fit_difference_map(found, neutral, measured)
        model, clamped = replace(model, difference=difference.values), difference.clamped_fraction
    maps, document = model.to_maps()
    angle = _mean_angle_deg(measured, lambda state: model.evaluate({state: 1.0}).normals)
    neutral_angle = _mean_angle_deg(measured, lambda _: neutral.normals)
    why = "texture layout not compared with the others, since the mesh is missing"
    part = derive_appearance(
        *(one for _, one in read.values()),
        maps=maps,
        files={WRINKLE_FILE: document},
        parameters={
            "expressions": list(measured),
            "appearances": [folder.name for folder, _ in read.values()],
            "explained": found.explained,
            "rounds": found.outcome.iterations,
            "method": method,
            "mean_angle_deg": angle,
            "mean_angle_of_neutral_deg": neutral_angle,
            "zones": "given" if zones is None else "found in the data",
            "rank_one_share": None if zones is None else zones.rank_one_fraction,
            "distinct_zones": None if zones is None else zones.distinct,
            "smoothing_mm": SMOOTHING_MM,
            "truth": {state: one.parameters.get("truth", "") for state, (_, one) in read.items()},
        },
        inputs={state: hash_document(folder) for state, (folder, _) in read.items()},
        left_out=tuple((state, why) for state in unchecked),
        seed=read["neutral"][1].seed,
    )
    dynamic_appearance.add(out, WRINKLES, part)
    return FittedWrinkles(found, zones, model, angle, neutral_angle, clamped)


def _mean_angle_deg(measured: Mapping[str, NormalMaps], show: Callable[[str], FloatArray]) -> float:
    """Return the mean angle between normals of the expressions and those shown, degrees."""
    angles = []
    for state, one in measured.items():
        shown = show(state)
        good = one.valid & np.isfinite(shown).all(axis=2) & (shown != 0).any(axis=2)
        angles.append(metrics.angular_error_rad(one.normals[good], shown[good]))
    return float(np.degrees(np.mean(np.concatenate(angles)))) if angles else 0.0


def _parse_state(appearance: Path) -> tuple[str, Path]:
    state, equals, path = str(appearance).partition("=")
    if equals and STATE_PATTERN.fullmatch(state):
        return state, Path(path)
    recorded = store.read_document(appearance).parameters.get("state")
    if not isinstance(recorded, str) or not recorded:
        raise WrinkleInputError(
            f"{appearance}: expression is not recorded; name it as STATE={appearance}"
        )
    return recorded, appearance


def _check_textures(appearances: Mapping[str, SkinAppearance]) -> list[str]:
    """Raise if faces have different texture layouts; return the faces without a mesh.

    With different layouts, one texel is different skin in each face. Faces of one layout need not
    share all triangles, as each scan is cropped individually.
    """
    places = {
        state: _texture_triangles(appearance.files[MESH_FILE])
        for state, appearance in appearances.items()
        if MESH_FILE in appearance.files
    }
    first = next(iter(places.values()), set())
    if any(len(first & one) < 0.5 * min(len(first), len(one)) for one in places.values()):
        raise WrinkleInputError(
            f"appearances: {', '.join(places)} have different texture layouts, expected one; "
            "wrap the same template onto each session's scan (`skinrig fit template`) and "
            "reconstruct with it (`skinrig reconstruct --scan`)"
        )
    return [state for state in appearances if state not in places]


def _texture_triangles(mesh: bytes) -> set[tuple[float, float]]:
    """Return the centers of a Wavefront mesh's triangles in texture coordinates."""
    corners: list[tuple[float, float]] = []
    found = set()
    for line in mesh.split(b"\n"):
        if line.startswith(b"vt "):
            u, v = line.split()[1:3]
            corners.append((float(u), float(v)))
        elif line.startswith(b"f "):
            used = [corners[int(corner.split(b"/")[1]) - 1] for corner in line.split()[1:4]]
            found.add((round(sum(u for u, _ in used), 4), round(sum(v for _, v in used), 4)))
    return found


def _normals(folder: Path, appearance: SkinAppearance) -> NormalMaps:
    """Return normals in the tangent space of the texture."""
    maps = appearance.maps
    if "normals_tangent" in maps:
        tangent = maps["normals_tangent"]
        return _build_normal_maps(tangent.values, tangent.stderr, intersect_valid(tangent))
    name = next((name for name in NORMAL_MAPS if name in maps), None)
    if name is None or "position" not in maps:
        raise WrinkleInputError(
            f"{folder}: normals with positions are missing, expected a dome session reconstructed "
            "with `skinrig reconstruct SESSION --maps normals_refined`"
        )
    normals, position = maps[name], maps["position"]
    valid = intersect_valid(normals, position)
    found = tangent_normals(normals.values, position.values, valid, stderr=normals.stderr)
    return _build_normal_maps(found.normals, found.stderr, found.valid)


def _build_normal_maps(
    normals: Float32Array, stderr: Float32Array | None, valid: BoolArray
) -> NormalMaps:
    """Return normals with angular standard uncertainties from those of their components."""
    shape = valid.shape
    error = np.zeros(shape) if stderr is None else np.sqrt((stderr.astype(float) ** 2).sum(axis=2))
    return NormalMaps(
        normals=normals.astype(np.float64),
        albedo=np.ones(shape),
        residual=np.zeros(shape),
        valid=valid,
        stderr_rad=error,
    )


def _read_masks(paths: Sequence[Path]) -> Float32Array:
    """Read zones from RGBA images, (Z, h, w)."""
    import cv2

    planes: list[Float32Array] = []
    for path in paths:
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if picture is None:
            raise WrinkleInputError(f"{path}: not readable as an image; check the file")
        if picture.ndim != 3 or picture.shape[2] != 4:
            raise WrinkleInputError(
                f"{path}: got shape {picture.shape}, expected four channels, one zone per channel"
                f" of RGBA"
            )
        scale = float(np.iinfo(picture.dtype).max) if picture.dtype.kind == "u" else 1.0
        rgba = picture[..., [2, 1, 0, 3]].astype(np.float32) / scale
        planes += [rgba[..., k] for k in range(4)]
    if len({plane.shape for plane in planes}) > 1:
        raise WrinkleInputError(
            "--mask: got images of different sizes, expected one size; resize them"
        )
    return np.stack(planes)


def summarize_expressions(found: FittedWrinkles) -> list[tuple[str, ...]]:
    """Return a row per expression: its weights by zone with standard uncertainties, as text."""
    return [
        (
            name,
            *(
                f"{w:.2f}" + (f" ({e:.2f})" if np.isfinite(e) else " (?)")
                for w, e in zip(zones.weights, zones.stderr, strict=True)
            ),
        )
        for name, zones in found.fit.expressions.items()
    ]


def list_zone_names(found: FittedWrinkles) -> Mapping[int, str]:
    """Return the names of the zones, keyed by index."""
    return dict(enumerate(found.fit.layer.table.zones))  # type: ignore[union-attr]
