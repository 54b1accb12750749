"""Write cavity, scatter and micro normal maps of a pack.

Each is derived from measurements, or omitted: cavity from neutral wrinkle normals, scatter from the
translucency of a fitted model, micro normals from relief of the gradient sphere.

References
----------
Max 1988, Horizon Mapping, doi 10.1007/BF01905562 (shadowing by relief).
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model import store, wrinkles
from model.skin import SkinAppearance
from reconstruction.normal_integration import integrate_map
from reconstruction.surface.texture_fill import push_pull
from skinrig.appearances.contents import list_assumptions
from skinrig.arrays import BoolArray, Float64Array
from skinrig.exporting.images import DATA_SPACE, ExportImage, ImageFolder
from skinrig.exporting.packs import color_deltas

FADE_DIVISOR: Final = 8
"""A tile's side over the width of the cross-faded border."""


def make_periodic(image: ArrayLike) -> Float64Array:
    """Return a seamlessly repeating image by cross-fading its end into its beginning.

    The squares of the weights sum to 1, so that the variance of independent relief is kept.

    Parameters
    ----------
    image
        (H, W), finite, mean 0, at least 8 pixels per side.

    Returns
    -------
    ndarray
        Image that is smaller by an eighth per axis; outside of the faded eighth it is unchanged.

    Examples
    --------
    >>> image = np.random.default_rng(0).normal(size=(64, 80))
    >>> tile = make_periodic(image)
    >>> tile.shape, np.array_equal(tile[8:, 10:], image[8:56, 10:70])
    ((56, 70), True)
    """
    found = np.asarray(image, np.float64)
    for axis in (0, 1):
        found = np.moveaxis(found, axis, 0)
        band = len(found) // FADE_DIVISOR
        size = len(found) - band
        # 0 with a slope of 0 at the beginning, 1 with a slope of 0 at the end
        share = np.sin(0.5 * np.pi * np.sin(0.5 * np.pi * np.arange(band) / band) ** 2)
        rise, fall = share[:, None], np.sqrt(1.0 - share**2)[:, None]
        faded = rise * found[:band] + fall * found[size:]
        found = np.moveaxis(np.concatenate([faded, found[band:size]]), 0, axis)
    return found


def compute_periodic_normals(height_um: Float64Array, pixel_um: float) -> Float64Array:
    """Compute unit normals of periodic relief, (H, W, 3), +Y up, row 0 at the top.

    Examples
    --------
    >>> x = np.arange(64)
    >>> relief = np.sin(2 * np.pi * x / 64) * np.ones((4, 1))
    >>> normals = compute_periodic_normals(relief, 1.0)
    >>> round(float(-normals[0, 0, 0] / normals[0, 0, 2]), 3), float(normals[0, 16, 0].round(6))
    (0.098, -0.0)
    """
    along_x = (np.roll(height_um, -1, 1) - np.roll(height_um, 1, 1)) / (2.0 * pixel_um)
    along_y = (np.roll(height_um, 1, 0) - np.roll(height_um, -1, 0)) / (2.0 * pixel_um)
    normals = np.stack([-along_x, -along_y, np.ones(height_um.shape)], axis=-1)
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))


HORIZON_DIRECTIONS: Final = 16
HORIZON_REACH_PX: Final = 16
"""Maximum distance of shadowing relief, texels of the measured map."""
SCATTER_SIZE: Final = 512
MAX_SCATTER_MM: Final = 16.0
"""Diffuse mean free path of the PNG code 65535."""
MM_PER_UM: Final = 0.001


def write_cavity(
    slopes: Float64Array, valid: BoolArray, size: int, out: ImageFolder
) -> dict[str, Any]:
    """Write the fraction of uniform illumination that relief does not shadow.

    Parameters
    ----------
    slopes
        n_x/n_z and n_y/n_z of the neutral relief, (H, W, 2), +Y up.
    valid
        (H, W) valid slopes.
    size
        Width and height to write, texels.
    out
        Destination folder.

    Returns
    -------
    dict
        JSON values; empty if omitted.
    """
    if not valid.any():
        out.record_omission("cavity", "wrinkle normals have no valid texel")
        return {}
    found = integrate_map(wrinkles.decode(slopes), valid=valid)
    if not found.convergence.converged:
        out.record_omission("cavity", "the normals could not be integrated to heights")
        return {}
    seen = ambient_visibility(found.height, found.part)
    shown, known = color_deltas.resize_map(seen[..., None], found.valid, size)
    values = np.where(known, shown[..., 0], 1.0)
    what = (
        "fraction of uniform illumination that relief does not shadow: 1 on ridges and flat "
        f"skin; horizons within {HORIZON_REACH_PX} measured texels in {HORIZON_DIRECTIONS} "
        "directions; 1 without measurement"
    )
    out.write_exr_and_png(ExportImage("cavity", values, "1", DATA_SPACE, what, 0.0, 1.0, known))
    return {
        "cavity": {
            "of": "heights integrated from the neutral wrinkle normals",
            "reach_texels": HORIZON_REACH_PX,
            "measured_size": list(slopes.shape[:2]),
            "least": float(values[known].min()),
            "median": float(np.median(values[known])),
        }
    }


def ambient_visibility(height: ArrayLike, part: ArrayLike) -> Float64Array:
    """Return the fraction of cosine-weighted uniform illumination that reaches each texel.

    Parameters
    ----------
    height
        (H, W), texels.
    part
        (H, W), index of the connected part, -1 outside. Heights of different parts are unrelated.

    Returns
    -------
    ndarray, shape (H, W)
        1 less the mean over directions of sin(horizon)^2, 0 to 1; 1 outside.

    Examples
    --------
    At the bottom of an infinite groove of slope 1 the fraction is 1 / sqrt(2):

    >>> walls = np.abs(np.arange(41) - 20.0)
    >>> groove = np.broadcast_to(walls, (41, 41))
    >>> float(ambient_visibility(groove, np.zeros((41, 41), int))[20, 20].round(3))
    0.707
    """
    from scipy.ndimage import map_coordinates

    z, number = np.asarray(height, np.float64), np.asarray(part)
    rows, columns = np.mgrid[0 : z.shape[0], 0 : z.shape[1]].astype(np.float64)
    total = np.zeros(z.shape)
    for k in range(HORIZON_DIRECTIONS):
        angle = 2.0 * np.pi * (k + 0.5) / HORIZON_DIRECTIONS
        slope = np.zeros(z.shape)
        for step in range(1, HORIZON_REACH_PX + 1):
            at = np.stack([rows + step * np.sin(angle), columns + step * np.cos(angle)])
            there = map_coordinates(z, at, order=1, mode="nearest")
            same = _has_own_part(number, at)
            slope = np.where(same, np.maximum(slope, (there - z) / step), slope)
        total += slope**2 / (1.0 + slope**2)
    return np.asarray(1.0 - total / HORIZON_DIRECTIONS)


def _has_own_part(number: NDArray[Any], positions: Float64Array) -> BoolArray:
    """Return whether the four texels around positions, (2, H, W), are of the same part."""
    last = np.array(number.shape)[:, None, None] - 1
    low = np.clip(np.floor(positions).astype(int), 0, last)
    high = np.clip(low + 1, 0, last)
    same = ((positions >= 0.0) & (positions <= last)).all(axis=0) & (number >= 0)
    for row in (low[0], high[0]):
        for column in (low[1], high[1]):
            same &= number[row, column] == number
    return np.asarray(same)


def write_scatter(out: ImageFolder) -> dict[str, Any]:
    """Write the diffuse mean free path of the target face's model.

    Parameters
    ----------
    out
        Destination folder.

    Returns
    -------
    dict
        JSON values; empty if omitted.
    """
    onto = out.delivery.target_face
    if onto is None:
        why = "requires a model of `skinrig fit reflectance`; name it by --target-face"
        out.record_omission("scatter", why)
        return {}
    other = store.read(onto)
    depth = other.maps.get("translucency")
    if depth is None:
        makes = "create it by `skinrig fit reflectance`"
        out.record_omission("scatter", f"translucency is missing in {onto.name}; {makes}")
        return {}
    values = np.asarray(depth.values, np.float64)
    if not depth.mask.any():
        out.record_omission("scatter", f"translucency of {onto.name} has no valid texel")
        return {}
    shown, valid = color_deltas.resize_map(values, depth.mask, SCATTER_SIZE)
    usual = np.median(values[depth.mask], axis=0)
    what = "1/sigma_tr in red, green and blue; the median where it is unknown"
    shown = np.where(valid[..., None], shown, usual)
    out.write_exr_and_png(
        ExportImage("scatter", shown, "mm", DATA_SPACE, what, 0.0, MAX_SCATTER_MM, valid)
    )
    return {
        "scatter": {
            "size": SCATTER_SIZE,
            "layout": f"the texture of {onto.name}",
            "median_mm": usual.tolist(),
            "assumed": [t for t in list_assumptions(other) if "translucency" in t],
        }
    }


def write_micro_normals(
    appearance: SkinAppearance, part: Mapping[str, Any], out: ImageFolder
) -> dict[str, Any]:
    """Write the neutral relief of each site as a seamlessly repeating normal map.

    Parameters
    ----------
    appearance
        Appearance with the part microstructure.
    part
        Document of its sites.
    out
        Destination folder.

    Returns
    -------
    dict
        JSON values; sites without valid relief are omitted.
    """
    entries: dict[str, Any] = {}
    green = out.delivery.green_direction
    for site, entry in sorted(part.get("sites", {}).items()):
        relief = appearance.maps[entry["map"]]
        valid = relief.mask
        if not valid.any():
            out.record_omission(f"micro normals of {site}", "the height has no valid texel")
            continue
        filled = push_pull(np.nan_to_num(relief.values), valid.astype(np.float32)).values
        height = np.asarray(filled, np.float64).reshape(relief.values.shape)
        pixel_um = float(entry["pixel_um"])
        tile = make_periodic(height - height.mean())
        normals = compute_periodic_normals(tile, pixel_um)
        name = f"micro_normal_{site}"
        what = f"neutral relief of {site}, tangent space, {green}, repeats seamlessly"
        out.write_exr_and_png(ExportImage.from_normals(name, normals, out.delivery, what))
        slope = normals[..., :2] / normals[..., 2:]
        entries[name] = {
            "site": site,
            "tile_mm": _size_mm(tile, pixel_um),
            "pixel_um": pixel_um,
            "slope_rms": float(np.sqrt(np.mean(np.sum(slope**2, axis=-1)))),
            "height_rms_um": float(tile.std()),
            "measured_mm": _size_mm(height, pixel_um),
            "faded_share": 1.0 - (1.0 - 1.0 / FADE_DIVISOR) ** 2,  # so that it repeats
            "valid_share": float(valid.mean()),
        }
    return {"micro": entries} if entries else {}


def _size_mm(height: Float64Array, pixel_um: float) -> list[float]:
    """Return width and height of a map on the skin, mm."""
    rows, columns = height.shape
    return [MM_PER_UM * pixel_um * columns, MM_PER_UM * pixel_um * rows]
