"""What stands beside color and normal deltas in a pack: cavity, scatter and micro normal maps.

Each is made of something that was measured, or left out: cavity of the neutral wrinkle normals,
scatter of the translucency of a fitted model, micro normals of relief from the gradient sphere.

References
----------
Max 1988, Horizon Mapping, doi 10.1007/BF01905562 (light that relief leaves).
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model import store, wrinkles
from model.skin import SkinAppearance
from reconstruction.normal_integration import integrate_map
from reconstruction.surface.texture_fill import push_pull
from skinrig.arrays import BoolArray, Float64Array
from skinrig.exporting.images import DATA_SPACE, Image, ImageFolder
from skinrig.exporting.options import Delivery
from skinrig.exporting.packs import color_deltas
from skinrig.exporting.packs.seamless import FADE_DIVISOR, periodic, periodic_normals

HORIZON_DIRECTIONS: Final = 16
HORIZON_REACH_PX: Final = 16
"""How far relief shades, texels of the measured map."""
SCATTER_SIZE: Final = 512
MAX_SCATTER_MM: Final = 16.0
"""Translucency of the PNG code 65535."""
MM_PER_UM: Final = 0.001


def cavity(
    slopes: Float64Array, valid: BoolArray, size: int, out: ImageFolder
) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Write the share of light from all around that relief leaves to its own hollows.

    Parameters
    ----------
    slopes
        n_x/n_z and n_y/n_z of the neutral relief, (H, W, 2), +Y up.
    valid
        (H, W), where they mean something.
    size
        Texels a side to write.
    out
        Where to.

    Returns
    -------
    told : dict
        JSON values.
    left_out : list of (str, str)
    """
    if not valid.any():
        return {}, [("cavity", "no wrinkle normal is valid")]
    found = integrate_map(wrinkles.decode(slopes), valid=valid)
    if not found.convergence.converged:
        return {}, [("cavity", "the normals could not be integrated to heights")]
    seen = visible_share(found.height, found.part)
    shown, known = color_deltas.sized(seen[..., None], found.valid, size)
    values = np.where(known, shown[..., 0], 1.0)
    what = (
        "share of light from all around that relief leaves at a place: 1 on ridges and flat "
        f"skin; horizons of {HORIZON_REACH_PX} measured texels in {HORIZON_DIRECTIONS} "
        "directions; 1 where nothing was measured"
    )
    out.both(Image("cavity", values, "1", DATA_SPACE, what, 0.0, 1.0, known))
    return {
        "cavity": {
            "of": "heights integrated from the neutral wrinkle normals",
            "reach_texels": HORIZON_REACH_PX,
            "measured_size": list(slopes.shape[:2]),
            "least": float(values[known].min()),
            "median": float(np.median(values[known])),
        }
    }, []


def visible_share(height: ArrayLike, part: ArrayLike) -> Float64Array:
    """Return the share of cosine-weighted light from all around that reaches each texel.

    Parameters
    ----------
    height
        (H, W), texels.
    part
        (H, W), number of the connected part, -1 outside. Heights of other parts say nothing.

    Returns
    -------
    ndarray, shape (H, W)
        1 less the mean over directions of sin(horizon)^2, 0 to 1; 1 outside.

    Examples
    --------
    In an infinite groove of slopes of 1 the light that is left is 1 / sqrt(2):

    >>> walls = np.abs(np.arange(41) - 20.0)
    >>> groove = np.broadcast_to(walls, (41, 41))
    >>> float(visible_share(groove, np.zeros((41, 41), int))[20, 20].round(3))
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
            same = _among(number, at)
            slope = np.where(same, np.maximum(slope, (there - z) / step), slope)
        total += slope**2 / (1.0 + slope**2)
    return np.asarray(1.0 - total / HORIZON_DIRECTIONS)


def _among(number: NDArray[Any], at: Float64Array) -> BoolArray:
    """Return whether all four texels around places, (2, H, W), are of the part of their own."""
    last = np.array(number.shape)[:, None, None] - 1
    low = np.clip(np.floor(at).astype(int), 0, last)
    high = np.clip(low + 1, 0, last)
    same = ((at >= 0.0) & (at <= last)).all(axis=0) & (number >= 0)
    for row in (low[0], high[0]):
        for column in (low[1], high[1]):
            same &= number[row, column] == number
    return np.asarray(same)


def scatter(delivery: Delivery, out: ImageFolder) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Write how far light spreads below the surface, of the model that colors are put on.

    Parameters
    ----------
    delivery
        `onto`: a fitted model with a map ``translucency``.
    out
        Where to.

    Returns
    -------
    told : dict
        JSON values.
    left_out : list of (str, str)
    """

    def without(why: str) -> tuple[dict[str, Any], list[tuple[str, str]]]:
        return {}, [("scatter", why)]

    if delivery.onto is None:
        return without("it is of a model: name one of `skinrig fit reflectance` by --onto")
    other = store.read(delivery.onto)
    depth = other.maps.get("translucency")
    if depth is None:
        makes = "`skinrig fit reflectance` makes it"
        return without(f"{delivery.onto.name} holds no translucency: {makes}")
    values = np.asarray(depth.values, np.float64)
    known: BoolArray = np.asarray(np.isfinite(values).all(axis=-1), np.bool_)
    if depth.valid is not None:
        known &= depth.valid
    if not known.any():
        return without(f"no translucency of {delivery.onto.name} is known")
    shown, valid = color_deltas.sized(values, known, SCATTER_SIZE)
    usual = np.median(values[known], axis=0)
    what = "1/sigma_tr in red, green and blue; the median where it is not known"
    shown = np.where(valid[..., None], shown, usual)
    out.both(Image("scatter", shown, "mm", DATA_SPACE, what, 0.0, MAX_SCATTER_MM, valid))
    assumed = other.parameters.get("assumed", [])
    texts = [str(text) for text in assumed] if isinstance(assumed, list | tuple) else []
    return {
        "scatter": {
            "size": SCATTER_SIZE,
            "layout": f"the texture of {delivery.onto.name}",
            "median_mm": usual.tolist(),
            "assumed": [t for t in texts if "translucency" in t],
        }
    }, []


def micro_normals(
    appearance: SkinAppearance, part: Mapping[str, Any], out: ImageFolder, delivery: Delivery
) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Write the neutral relief of each site as a normal map that repeats without a seam.

    Parameters
    ----------
    appearance
        With the part microstructure.
    part
        What it says of its sites.
    out
        Where to.
    delivery
        Green of normals.

    Returns
    -------
    told : dict
        JSON values.
    left_out : list of (str, str)
        Sites whose relief is not known.
    """
    told: dict[str, Any] = {}
    left_out = []
    for site, entry in sorted(part.get("sites", {}).items()):
        relief = appearance.maps[entry["map"]]
        valid = np.isfinite(relief.values) & relief.mask
        if not valid.any():
            left_out.append((f"micro normals of {site}", "no height is valid"))
            continue
        filled = push_pull(np.nan_to_num(relief.values), valid.astype(np.float32)).values
        height = np.asarray(filled, np.float64).reshape(relief.values.shape)
        pixel_um = float(entry["pixel_um"])
        tile = periodic(height - height.mean())
        normals = periodic_normals(tile, pixel_um)
        name = f"micro_normal_{site}"
        what = f"relief of {site} at rest, tangent space, {delivery.green}, repeats without a seam"
        out.both(Image.of_normals(name, normals, delivery, what))
        slope = normals[..., :2] / normals[..., 2:]
        told[name] = {
            "site": site,
            "tile_mm": _size_mm(tile, pixel_um),
            "pixel_um": pixel_um,
            "slope_rms": float(np.sqrt(np.mean(np.sum(slope**2, axis=-1)))),
            "height_rms_um": float(tile.std()),
            "measured_mm": _size_mm(height, pixel_um),
            "faded_share": 1.0 - (1.0 - 1.0 / FADE_DIVISOR) ** 2,  # so that it repeats
            "valid_share": float(valid.mean()),
        }
    return ({"micro": told} if told else {}), left_out


def _size_mm(height: Float64Array, pixel_um: float) -> list[float]:
    """Return width and height of a map on the skin, mm."""
    rows, columns = height.shape
    return [MM_PER_UM * pixel_um * columns, MM_PER_UM * pixel_um * rows]
