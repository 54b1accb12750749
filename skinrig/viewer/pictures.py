"""Build the scene of images with normals: the page lights them, without a mesh of a face."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from model.facial_color.coarse_maps import CoarseGrid
from model.skin import SkinAppearance, SkinMap
from rigsim.geometry.mesh import build_mesh
from skinrig import consent
from skinrig.arrays import Float64Array, FloatArray
from skinrig.viewer.map_filling import fill_holes
from skinrig.viewer.scene import SceneError, Texture, ViewerScene

PICTURE_PX: Final = 1024
"""Default side of a picture's textures, texels."""
DEFAULT_ROUGHNESS: Final = 0.3
"""GGX alpha of maps without a measured one; it was 0.27 on a simulated forehead."""
COLOR_MAPS: Final = ("albedo", "crossed")
"""Maps of diffuse color, in order of preference."""
BRIGHT_PERCENTILE: Final = 99.0
"""Percentile of the color that is displayed as white where the scale of the color is unknown."""

_NORMALS_NAME: Final = re.compile(r"normals(?:_(\w+))?")


def find_states(appearance: SkinAppearance) -> tuple[str, ...]:
    """Return the states that have normals in a camera's image, "" for one without a name.

    Examples
    --------
    >>> normals = SkinMap(np.zeros((2, 2, 3), np.float32), "1")
    >>> maps = {"normals_n0": normals, "normals_p1": normals}
    >>> find_states(SkinAppearance(maps, "measured", {}, {}))
    ('n0', 'p1')
    """
    found = [
        match[1] or ""
        for name, one in appearance.maps.items()
        if (match := _NORMALS_NAME.fullmatch(name)) and one.values.ndim == 3
    ]
    listed: Any = appearance.parameters.get("states", ())
    ranks = {str(name): rank for rank, name in enumerate(listed)}
    return tuple(sorted(found, key=lambda name: (ranks.get(name, len(ranks)), name)))


def build_picture_scene(
    path: Path,
    appearance: SkinAppearance,
    *,
    size: int = PICTURE_PX,
    progress: Callable[[str], None] = lambda _content: None,
) -> ViewerScene:
    """Build the scene of normals and color in a camera's image.

    Parameters
    ----------
    path
        APPEARANCE/ folder, named in the page.
    appearance
        Its content: `normals`, or `normals_STATE` of several states of one size, in the camera's
        frame (x right, y up, z towards the camera); albedo, heights and uncertainties if it has
        them.
    size
        Largest side of the textures, texels; larger maps are averaged.
    progress
        Called with each content before it is made.

    Raises
    ------
    SceneError
        If normals are missing or invalid everywhere, or the states differ in size.
    """
    states = find_states(appearance)
    maps = [appearance.maps["_".join(filter(None, ("normals", state)))] for state in states]
    if not maps:
        raise SceneError(f"{path}: got no map of normals, expected `normals` or `normals_STATE`")
    shape = maps[0].values.shape[:2]
    if any(one.values.shape[:2] != shape for one in maps):
        raise SceneError(f"{path}: got normals of several sizes, expected one; show each alone")
    if not any(one.mask.any() for one in maps):
        raise SceneError(f"{path}: no pixel of the normals is valid; reconstruct them again")
    progress("content 0/2: normals")
    packed = [np.dstack([_reduce(one, size), _valid_fraction(one, size)]) for one in maps]
    textures = {
        "picture_normals": Texture(
            np.stack([_unit_slopes(one) for one in packed]).astype(np.float32), "u16"
        )
    }
    facts: dict[str, Any] = {"states": list(states), "aspect": shape[1] / shape[0]}
    roughness = _roughness(appearance)
    progress("content 1/2: color and uncertainty")
    left_out = [("shadows and interreflection", "a picture has normals, not a surface")]
    color = _stack_maps(appearance, states, COLOR_MAPS, shape)
    if color is None:
        left_out.append(("color", "the folder has no albedo; gray is displayed"))
    else:
        name, found = color
        values = np.stack(
            [
                np.broadcast_to(red, (*red.shape[:2], 3))
                for red in (_reduce(one, size) for one in found)
            ]
        )
        white = float(np.percentile(values, BRIGHT_PERCENTILE)) or 1.0
        # square roots: eight bits are finer in the dark, where the eye is
        shown = np.sqrt(np.clip(values / white, 0.0, 1.0))
        textures["picture_color"] = Texture(shown.astype(np.float32), "u8")
        facts["color_map"] = name
    extra = _layers_of(appearance, states, maps, size, shape)
    if extra:
        facts["layers"] = {name: [float(v.min()), float(v.max())] for name, v in extra.items()}
        textures |= {
            f"picture_{name}": Texture(values[..., None].astype(np.float32), "u16")
            for name, values in extra.items()
        }
    if roughness is None:
        left_out.append(("roughness", f"not measured; {DEFAULT_ROUGHNESS:g} is the first setting"))
    provenance = {"source": appearance.source, "kind": "picture", "appearances": [path.name]}
    agreed = consent.merge_consent(appearance)
    if agreed:
        provenance[consent.CONSENT_KEY] = consent.format_consent(agreed)
    return ViewerScene(
        mesh=build_mesh(
            np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32),
            np.array([[0, 1, 2]], np.int32),
            np.array([[0, 0], [1, 0], [0, 1]], np.float32),
        ),
        textures=textures,
        params={"picture_roughness": DEFAULT_ROUGHNESS if roughness is None else roughness},
        facts={"picture": facts},
        provenance=provenance,
        left_out=tuple(left_out),
        page="picture",
    )


def _reduce(one: SkinMap, size: int, values: FloatArray | None = None) -> Float64Array:
    """Return averages of a map's valid pixels over cells, (h, w, C), with holes filled."""
    given = one.values if values is None else values
    height, width = one.values.shape[:2]
    factor = min(1.0, size / max(height, width))
    few = max(1, round(factor * height)), max(1, round(factor * width))
    cells = CoarseGrid((height, width), few)
    layers = np.moveaxis(np.atleast_3d(given).astype(np.float64), -1, 0)
    means = [cells.coarsen(layer, one.mask) for layer in layers]
    return np.stack([fill_holes(mean, held) for mean, held in means], axis=-1)


def _valid_fraction(one: SkinMap, size: int) -> Float64Array:
    """Return the fraction of valid pixels in each cell, (h, w, 1)."""
    return _reduce(SkinMap(one.mask.astype(np.float32), "1"), size)


def _unit_slopes(values: Float64Array) -> Float64Array:
    """Return x and y of unit normals and the valid fraction, (h, w, 3), of averaged normals."""
    length = np.linalg.norm(values[..., :3], axis=-1, keepdims=True)
    unit = values[..., :2] / np.where(length > 0.0, length, 1.0)
    return np.concatenate([unit, values[..., 3:]], axis=-1)


def _stack_maps(
    appearance: SkinAppearance,
    states: tuple[str, ...],
    names: tuple[str, ...],
    shape: tuple[int, int],
) -> tuple[str, list[SkinMap]] | None:
    """Return the first of the named maps that all states have in the given size."""
    for name in names:
        found = [
            appearance.maps.get("_".join(filter(None, (name, state))), appearance.maps.get(name))
            for state in states
        ]
        kept = [one for one in found if one is not None and one.values.shape[:2] == shape]
        if len(kept) == len(states):
            return name, kept
    return None


def _layers_of(
    appearance: SkinAppearance,
    states: tuple[str, ...],
    normals: list[SkinMap],
    size: int,
    shape: tuple[int, int],
) -> Mapping[str, Float64Array]:
    """Return heights, um, and standard errors of normals, degrees, (L, h, w), as far as known."""
    out: dict[str, Float64Array] = {}
    heights = _stack_maps(appearance, states, ("height",), shape)
    if heights is not None:
        out["height_um"] = np.stack([_reduce(one, size)[..., 0] for one in heights[1]])
    if all(one.stderr is not None for one in normals):
        out["normal_stderr_deg"] = np.stack(
            [
                np.degrees(_reduce(one, size, _angle_stderr_rad(one.values, one.stderr)))[..., 0]
                for one in normals
                if one.stderr is not None
            ]
        )
    return out


def _angle_stderr_rad(normals: FloatArray, stderr: FloatArray) -> Float64Array:
    """Return the standard error of the angle of unit normals, (H, W), rad.

    Channels hold the errors of the components, or three times that of a tangential axis.
    """
    squares = np.square(stderr, dtype=np.float64)
    repeated = (np.ptp(stderr, axis=-1) == 0.0)[..., None]
    # the direction of the normal has no error of its own
    axes = np.where(repeated, 1.0 - np.square(normals, dtype=np.float64), 1.0)
    return np.asarray(np.sqrt((squares * axes).sum(axis=-1)))


def _roughness(appearance: SkinAppearance) -> float | None:
    found: Any = appearance.parameters.get("alpha")
    value = found.get("value") if isinstance(found, Mapping) else None
    return float(value) if isinstance(value, int | float) else None
