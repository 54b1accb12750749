"""Draw freckles, moles and hair follicles: small spots with additional pigment.

A spot multiplies R_d by the transmittance of additional melanin per channel. The factor is read
from the table of skin colors at the face's own melanin and blood, so that a freckle is brown on
light skin and faint on dark skin. Spots are balls around points of the surface, in mm, so that
they are continuous over the islands of a texture.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage
from scipy.spatial import cKDTree

from model import color_table
from model.color_table import ColorTable
from model.tissue_optics.layers import ANISOTROPY_SKIN
from skinrig.arrays import BoolArray, Float32Array, Float64Array
from skinrig.errors import require_choice

DOME_CAMERA, DOME_ILLUMINANT = "Nikon 5100 (NPL)", "LED-B3"
"""Camera and illuminant of the dome's RGB."""
MAX_SPOT_MELANIN: Final = 0.45
"""Maximum melanosome volume fraction, just inside the table."""
MAX_SPOTS: Final = 50_000
_MIN_SPACING_RATIO: Final = 0.6
"""Minimum distance of spots, relative to their spacing on a square grid of the same density."""


class SpotError(ValueError):
    """Invalid settings of spots."""


@dataclass(frozen=True, slots=True)
class SpotKind:
    """Size, pigment and density of one kind of spots.

    Attributes
    ----------
    diameter_mm
        Median diameter, mm.
    log_diameter_std
        Standard deviation of the diameter's logarithm.
    melanin
        Additional melanosome volume fraction of the epidermis.
    edge
        Width of the soft edge as a fraction of the radius, in (0, 1].
    density_per_cm2
        Default density, 1/cm^2.
    range_mm
        Range of diameters that are detected when spots are removed, mm.
    """

    diameter_mm: float
    log_diameter_std: float
    melanin: float
    edge: float
    density_per_cm2: float
    range_mm: tuple[float, float]


SPOT_KINDS: Final[Mapping[str, SpotKind]] = MappingProxyType(
    {
        "freckles": SpotKind(2.2, 0.35, 0.02, 0.8, 2.0, (0.8, 6.0)),
        "moles": SpotKind(3.5, 0.3, 0.12, 0.35, 0.03, (1.5, 10.0)),
        "follicles": SpotKind(0.45, 0.2, 0.06, 0.6, 40.0, (0.2, 1.5)),
    }
)
"""Rounded, assumed values: ephelides of 1 to 3 mm, common nevi of 2 to 6 mm, some tens of beard
hairs per cm^2."""


@dataclass(frozen=True, slots=True, eq=False)
class DrawnSpots:
    """Drawn spots with their factor of R_d.

    Attributes
    ----------
    gain
        (H, W, 3) factor of R_d, in (0, 1]; exactly 1 outside the spots and the mask.
    center_mm
        (n, 3) centers, mm, rig frame.
    diameter_mm
        (n,) diameters, mm.
    transmitted
        (3,) factor of R_d at the center of a spot, per channel.
    """

    gain: Float32Array
    center_mm: Float64Array
    diameter_mm: Float64Array
    transmitted: Float64Array


def draw_spots(
    kind: str,
    r_d: ArrayLike,
    position_mm: ArrayLike,
    surface: ArrayLike,
    mask: ArrayLike,
    *,
    amount: float = 1.0,
    density_per_cm2: float | None = None,
    rng: np.random.Generator,
    table: ColorTable | None = None,
) -> DrawnSpots:
    """Draw spots at random positions in a mask.

    Parameters
    ----------
    kind
        One of `SPOT_KINDS`.
    r_d
        (H, W, 3); its median color in the mask determines the chromophores of the skin.
    position_mm
        (H, W, 3), rig frame.
    surface
        (H, W) bool: texels of the surface.
    mask
        (H, W), 0 to 1: strength of the spots.
    amount
        Amount of pigment, at least 0; 1: that of `SPOT_KINDS`.
    density_per_cm2
        Density, at least 0; None: that of `SPOT_KINDS`.
    rng
        Generator of positions and diameters.
    table
        Table of skin colors; None: that of the dome's camera and light.

    Raises
    ------
    SpotError
        For an unknown kind, negative amounts, an empty mask, or more than `MAX_SPOTS` spots.
    """
    what = SPOT_KINDS[require_choice("spots", kind, SPOT_KINDS, SpotError)]
    density = what.density_per_cm2 if density_per_cm2 is None else float(density_per_cm2)
    for name, value in (("amount", amount), ("density_per_cm2", density)):
        if not (np.isfinite(value) and value >= 0):
            raise SpotError(f"{name} of {kind}: got {value}, expected at least 0; enter another")
    place = np.asarray(position_mm, np.float64)
    share = np.where(np.asarray(surface, np.bool_), np.asarray(mask, np.float64), 0.0)
    if not share.any():
        raise SpotError(
            f"mask of {kind}: got no texel of the surface, expected some; choose another mask"
        )
    if table is None:
        table = color_table.build(DOME_CAMERA, DOME_ILLUMINANT, anisotropy=ANISOTROPY_SKIN)
    colors = np.asarray(r_d, np.float64)[share > 0]
    transmitted = _transmitted(colors, what.melanin, amount, table)
    area = texel_area_mm2(place, np.asarray(surface, np.bool_))
    wanted = float((area * share).sum()) / 100.0 * density
    if wanted > MAX_SPOTS:
        raise SpotError(
            f"density of {kind}: got {wanted:.0f} spots, expected at most {MAX_SPOTS}; lower it"
        )
    number = int(np.floor(wanted + rng.random())) if amount > 0 else 0
    centers = _scatter(place[share > 0], (area * share)[share > 0], number, density, rng)
    diameter = what.diameter_mm * np.exp(what.log_diameter_std * rng.standard_normal(len(centers)))
    depth = _profile(place, share > 0, centers, diameter, area, what.edge, rng) * share
    gain = np.exp(depth[..., None] * np.log(transmitted)).astype(np.float32)
    return DrawnSpots(gain, centers, diameter, transmitted)


def texel_area_mm2(position_mm: Float64Array, surface: BoolArray) -> Float64Array:
    """Return the surface area per texel, (H, W), mm^2; 0 off the surface.

    Texels at the rims of islands, which lack a neighbor, get the median.
    """
    both = [np.gradient(position_mm, axis=axis) for axis in (0, 1)]
    cross = ndimage.generate_binary_structure(2, 1)
    whole = ndimage.binary_erosion(surface, cross)
    area = np.linalg.norm(np.cross(both[0], both[1]), axis=-1)
    usual = float(np.median(area[whole])) if whole.any() else 1.0
    return np.where(surface, np.where(whole, np.minimum(area, 9.0 * usual), usual), 0.0)


def _transmitted(
    colors: Float64Array, added: float, amount: float, table: ColorTable
) -> Float64Array:
    """Return the factor of each channel of the median color by `added` melanin, (3,)."""
    usable = colors[(colors > 0).all(axis=1)]
    if not len(usable):
        raise SpotError("r_d: got 0 all over the mask, expected skin; choose another mask")
    color = np.median(usable, axis=0)
    size = table.size
    apart = np.abs(np.log(table.rgb) - np.log(color)).sum(axis=-1)
    i, j = np.unravel_index(int(np.argmin(apart)), apart.shape)
    c_m = table.c_m_max * (max(int(i), 1) / (size - 1)) ** 3
    c_hd = table.c_hd_max * (int(j) / (size - 1)) ** 3
    more = max(min(c_m + amount * added, MAX_SPOT_MELANIN), c_m)
    ratio = table.lookup(more, c_hd) / table.lookup(c_m, c_hd)
    return np.minimum(np.asarray(ratio, np.float64), 1.0)


def _scatter(
    points: Float64Array,
    weight: Float64Array,
    number: int,
    density: float,
    rng: np.random.Generator,
) -> Float64Array:
    """Sample points with a minimum distance (Poisson disc).

    Points are drawn in proportion to area; a point too near to an earlier one is rejected.
    """
    if number == 0:
        return np.empty((0, 3))
    least = _MIN_SPACING_RATIO * 10.0 / np.sqrt(density)
    drawn = rng.choice(
        len(points), size=min(12 * number + 64, 20 * MAX_SPOTS), p=weight / weight.sum()
    )
    cells: dict[tuple[int, int, int], list[Float64Array]] = {}
    kept: list[Float64Array] = []
    for k in drawn:
        at = points[k]
        x, y, z = (int(c) for c in np.floor(at / least))
        near = (
            other
            for dx in (-1, 0, 1)
            for dy in (-1, 0, 1)
            for dz in (-1, 0, 1)
            for other in cells.get((x + dx, y + dy, z + dz), ())
        )
        if any(((at - other) ** 2).sum() < least**2 for other in near):
            continue
        cells.setdefault((x, y, z), []).append(at)
        kept.append(at)
        if len(kept) == number:
            break
    return np.array(kept)


def _profile(
    position: Float64Array,
    mask: BoolArray,
    centers: Float64Array,
    diameter: Float64Array,
    area: Float64Array,
    edge: float,
    rng: np.random.Generator,
) -> Float64Array:
    """Return the strength of the spots per texel, (H, W), 0 to 1.

    A spot smaller than a texel darkens it by its fraction of the texel's area.
    """
    depth = np.zeros(mask.shape)
    if not len(centers):
        return depth
    points = position[mask]
    half_texel = 0.5 * np.sqrt(np.median(area[mask]))
    inside = np.zeros(len(points))
    tree = cKDTree(points)
    turn = rng.normal(0.0, 1.0, (len(centers), 3, 3))
    phase = rng.uniform(0.0, 2 * np.pi, (len(centers), 3))
    for center, d, way, start in zip(centers, diameter, turn, phase, strict=True):
        radius = 0.5 * d
        wide = np.hypot(radius, half_texel)
        near = np.asarray(tree.query_ball_point(center, 1.35 * wide), np.intp)
        away = points[near] - center
        # irregular outline: the radius is modulated by three plane waves of small amplitude
        waves = np.sin(away @ way.T * (2.0 / wide) + start).mean(axis=1)
        reach = np.linalg.norm(away, axis=1) / (wide * (1.0 + 0.25 * waves))
        soft = max(edge, half_texel / wide)
        rise = np.clip((1.0 - reach) / soft + 0.5 * min(soft, 1.0), 0.0, 1.0)
        profile = rise * rise * (3.0 - 2.0 * rise) * (radius / wide) ** 2
        inside[near] = np.maximum(inside[near], profile)
    depth[mask] = inside
    return depth
