"""Form wrinkles where an expression shortens the skin, by buckling along fixed lines.

Skin is a stiff layer on a soft one and rests under tension. Shortening first relaxes the tension;
beyond that the layer buckles across the shortening, and the excess length goes into the wrinkle:
the length along a wrinkled line stays the skin's slack length. The positions of possible wrinkles
are drawn once per person, so every expression that shortens a zone raises the same lines.

Zones are areas of a face in which the skin wrinkles along one family of lines, with their
wavelengths.

Notes
-----
The wavelength of the buckles is 2 pi h (E / 3 E_s)^(1/3) for a layer of thickness h and modulus E
on a base of modulus E_s (Genzer and Groenewold 2006, doi:10.1039/b516741h). `MODULUS_RATIO` and the
zones' thicknesses are chosen to give the distances between grooves that faces show, 2.5 mm next to
the eyes to 8 mm on the forehead; the grooves are narrower than the ridges between them.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigsim.arrays import BoolArray, Float32Array, Float64Array
from rigsim.geometry.atlas import Atlas
from rigsim.geometry.surface_noise import smooth_noise
from rigsim.subject.face_regions import soft_step
from rigsim.subject.tissue_pressure import draw_tension

GROOVE_NARROWING: Final = 1.2
"""Narrowing of grooves relative to ridges; 0 is a cosine."""

MIN_TEXELS_PER_WAVE: Final = 3.0
"""Texels per wave; finer wrinkles are omitted."""

SEAM_STEPS: Final = 6.0
"""Neighboring texels farther apart than this number of usual distances are across a seam."""

_PHASE_STEPS: Final = 2048


MODULUS_RATIO: Final = 100.0
"""Stiffness of the buckling layer over that of the base below."""


@dataclass(frozen=True, slots=True)
class WrinkleZone:
    """An area of the face whose wrinkles follow one family of lines."""

    name: str
    thickness_mm: float
    """Thickness of the buckling layer."""
    across_mm: Callable[[Float64Array], Float64Array]
    """Distance across the lines, of points on the mean head with x >= 0, mm."""
    wrinkling_fraction: Callable[[Float64Array], Float64Array]
    """Fraction of the shortening beyond the tension that goes into wrinkles, 0 to 1."""
    mirrored: bool = True
    """Whether both halves of the face have their own lines; otherwise lines cross the midline."""
    tension: float = 1.0
    """Fraction of the person's tension to be relaxed first; tethered folds need little."""
    single: bool = False
    """Whether there is one groove, where ``across_mm`` is 0, instead of a family."""

    @property
    def wavelength_mm(self) -> float:
        """Distance between grooves at rest, mm."""
        return 2.0 * math.pi * self.thickness_mm * (MODULUS_RATIO / 3.0) ** (1.0 / 3.0)


def _plateau(
    center: tuple[float, ...], reach: tuple[float, ...], height: float = 1.0
) -> Callable[[Float64Array], Float64Array]:
    """Return a function that is ``height`` well inside an ellipsoid, and 0 well outside."""

    def share(points: Float64Array) -> Float64Array:
        q = (points - np.array(center)) / np.array(reach)
        return np.asarray(height * soft_step((1.0 - np.sqrt(np.sum(q * q, axis=-1))) / 0.22))

    return share


def _x(p: Float64Array) -> Float64Array:
    return np.asarray(p[..., 0])


def _y(p: Float64Array) -> Float64Array:
    return np.asarray(p[..., 1])


_FOLD_ENDS_MM = (np.array([17.0, -10.0]), np.array([31.0, -41.0]))
"""Ends of the fold between nose and cheek, mm on the mean head."""


_FOLD_WAY = (_FOLD_ENDS_MM[1] - _FOLD_ENDS_MM[0]) / np.linalg.norm(
    _FOLD_ENDS_MM[1] - _FOLD_ENDS_MM[0]
)


def _off_fold(p: Float64Array) -> Float64Array:
    along = (p[..., :2] - _FOLD_ENDS_MM[0]) @ _FOLD_WAY
    # a slight bow toward the cheek
    side = (p[..., :2] - _FOLD_ENDS_MM[0]) @ np.array([-_FOLD_WAY[1], _FOLD_WAY[0]])
    return np.asarray(side - 2.5 * np.sin(np.pi * np.clip(along / 34.0, 0.0, 1.0)))


def _near_fold(p: Float64Array) -> Float64Array:
    along = (p[..., :2] - _FOLD_ENDS_MM[0]) @ _FOLD_WAY
    inside = soft_step((along - 1.0) / 3.0) * soft_step((32.0 - along) / 3.0)
    return np.asarray(inside * (p[..., 2] > -25.0))


def _fan(p: Float64Array) -> Float64Array:
    """Return the arc length on circles about the corner of the eye, measured at 12 mm from it."""
    return np.asarray(12.0 * np.arctan2(p[..., 1] - 24.0, np.maximum(p[..., 0] - 42.0, 1.0)))


WRINKLE_ZONES: Final = (
    WrinkleZone(
        "forehead",
        0.36,
        lambda p: _y(p) - 0.0035 * _x(p) ** 2,
        _plateau((0.0, 62.0, 0.0), (46.0, 20.0, 55.0)),
        mirrored=False,
    ),
    WrinkleZone(
        "glabella",
        0.34,
        lambda p: _x(p) * (1.0 + 0.008 * (_y(p) - 44.0)),
        _plateau((0.0, 43.0, 4.0), (14.0, 13.0, 40.0)),
        mirrored=False,
    ),
    WrinkleZone(
        "nasal root",
        0.22,
        lambda p: _y(p) - 0.03 * _x(p) ** 2,
        _plateau((0.0, 22.0, 9.0), (10.0, 8.0, 25.0)),
        mirrored=False,
    ),
    WrinkleZone(
        "nose sides",
        0.17,
        lambda p: 0.86 * _y(p) - 0.5 * _x(p),
        _plateau((9.0, 7.0, 11.0), (7.0, 9.0, 25.0)),
    ),
    WrinkleZone("crow's feet", 0.13, _fan, _plateau((55.0, 23.0, -26.0), (11.0, 15.0, 30.0))),
    WrinkleZone(
        "lower lids",
        0.13,
        lambda p: _y(p) - 0.012 * (_x(p) - 31.0) ** 2,
        _plateau((34.0, 9.0, -4.0), (15.0, 6.5, 30.0)),
        tension=0.6,
    ),
    WrinkleZone("nasolabial fold", 0.5, _off_fold, _near_fold, tension=0.2, single=True),
    WrinkleZone(
        "mouth corners",
        0.30,
        lambda p: np.hypot(_x(p) - 22.0, 0.8 * (_y(p) + 41.0)),
        _plateau((38.0, -42.0, -8.0), (8.0, 11.0, 30.0), 0.35),
    ),
    WrinkleZone(
        "chin",
        0.26,
        lambda p: _y(p) + 0.006 * _x(p) ** 2,
        _plateau((0.0, -57.0, 8.0), (15.0, 7.0, 25.0)),
        mirrored=False,
    ),
)
"""The zones of a face; overlapping zones share the shortening."""


@dataclass(frozen=True, slots=True, eq=False)
class ZoneLines:
    """Lines of possible buckling of a person's skin in one zone, at n texels of the texture."""

    zone: WrinkleZone
    texel: NDArray[np.intp]
    """Flat indices of the texels, shape (n,)."""
    phase_rad: Float64Array
    """2 pi times the number of waves across the lines, shape (n,); 0 in a groove."""
    slope: Float64Array
    """Gradient of the phase, rad per unit of u and v, shape (n, 2)."""
    wrinkling_fraction: Float64Array
    """Fraction of the excess length that goes into the zone's wrinkles, shape (n,)."""


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class WrinkleLines:
    """Lines of possible buckling of a person's skin."""

    zones: tuple[ZoneLines, ...]
    tension: float
    """Relative stretch of the skin at rest."""


@dataclass(frozen=True, slots=True, eq=False)
class Wrinkles:
    """Wrinkles of an expression; maps of shape (N, N), row 0 is the top."""

    height_um: Float32Array
    """Height added to the relief, um; zero on average over a wave."""
    excess: Float32Array
    """Excess length in the wrinkles, relative to the surface below; 0 where smooth."""
    omitted: tuple[str, ...]
    """Zones whose waves are too short for the texture."""


def draw_wrinkle_lines(points_mm: Float32Array, covered: BoolArray, *, seed: int) -> WrinkleLines:
    """Draw the lines along which a person's skin can buckle.

    Parameters
    ----------
    points_mm
        Points on the mean head under each texel, shape (N, N, 3).
    covered
        Texels with a surface, shape (N, N).
    seed
        Seed of the person, >= 0.

    Returns
    -------
    WrinkleLines
        The lines of `WRINKLE_ZONES`.
    """
    rng = np.random.default_rng([seed, 22])
    tension = draw_tension(rng)
    size = points_mm.shape[0]
    y, z = points_mm[..., 1], points_mm[..., 2]
    front = covered & (z > -60.0) & (y > -75.0) & (y < 90.0)  # no zone reaches farther
    front[[0, -1]] = front[:, [0, -1]] = False
    texel = np.flatnonzero(front)
    flat = points_mm.reshape(-1, 3)
    middle = flat[texel].astype(np.float64)
    folded = np.column_stack([np.abs(middle[:, 0]), middle[:, 1:]])
    step_mm = np.median(np.linalg.norm(flat[texel + 1] - flat[texel], axis=-1))
    drawn = []
    for zone in WRINKLE_ZONES:
        wave = zone.wavelength_mm * float(rng.uniform(0.88, 1.14))
        offset = rng.uniform(0.0, 2.0 * math.pi, 2)
        lifts = rng.uniform(0.8, 1.0, 2)
        share = zone.wrinkling_fraction(folded)
        near = np.flatnonzero(share > 0.01)
        share = share[near]
        # the texel, its neighbors at larger and smaller u, at larger and smaller v
        around = texel[near] + np.array([0, 1, -1, -size, size])[:, None]
        points = flat[around].astype(np.float64)
        away = np.linalg.norm(points[1:] - points[0], axis=-1)
        # texels beyond a seam have no skin, or skin from elsewhere
        known = covered.reshape(-1)[around[1:]] & (away < SEAM_STEPS * step_mm)
        steps = np.maximum(known[0::2].astype(np.float64) + known[1::2], 1.0)
        points[1:] = np.where(known[..., None], points[1:], points[0])
        wobble = smooth_noise(points.astype(np.float32), (24.0, 11.0), seed=seed + 95)
        right = (points[0, :, 0] > 0.0).astype(np.intp)
        if zone.mirrored:
            points[..., 0] = np.abs(points[..., 0])
        across = zone.across_mm(points) / wave + 0.07 * wobble
        phase = 2.0 * math.pi * across
        if zone.single:
            # one wave with its groove on the line; outside the skin is smooth
            lone = np.abs(across[0]) < 0.5
            share = share * np.where(lone, np.cos(math.pi * across[0]) ** 2, 0.0)
        elif zone.name == "glabella":
            phase -= 2.0 * math.pi * 0.55  # grooves on both sides of the midline, slightly off it
        else:
            phase += offset[right] if zone.mirrored else offset[0]
        slope = size * np.stack(
            [(phase[1] - phase[2]) / steps[0], (phase[3] - phase[4]) / steps[1]], axis=-1
        )
        share = share * (lifts[right] if zone.mirrored else lifts[0])
        drawn.append(ZoneLines(zone, texel[near], phase[0], slope, share))
    # overlapping zones share the shortening
    together = np.zeros(size * size)
    for lines in drawn:
        together[lines.texel] += lines.wrinkling_fraction
    crowd = np.maximum(together, 1.0)
    return WrinkleLines(
        tuple(
            dataclasses.replace(one, wrinkling_fraction=one.wrinkling_fraction / crowd[one.texel])
            for one in drawn
        ),
        tension,
    )


def form_wrinkles(lines: WrinkleLines, rest: Atlas, posed: Atlas) -> Wrinkles:
    """Form the wrinkles of a face whose surface has moved.

    Parameters
    ----------
    lines
        Lines of possible buckling.
    rest, posed
        The surface before and after, on the same texture.

    Returns
    -------
    Wrinkles
        Smooth where the lines of a zone have not approached each other by more than the tension.
    """
    size = rest.size
    height = np.zeros(size * size)
    total = np.zeros(size * size)
    along_u, along_v = posed.texel_mm()
    texel_mm = np.maximum(along_u, along_v).reshape(-1)
    left_out = []
    for one in lines.zones:
        if not len(one.texel):
            continue
        # waves per mm across the lines, before and after
        before = _density(_metric(rest, one.texel), one.slope)
        after = _density(_metric(posed, one.texel), one.slope)
        steady = (before > 1e-6) & (after > 1e-6)
        # A length L at rest spans stretch L after the movement; its slack length is (1 - tension)
        # L. What exceeds the span goes into the wrinkle.
        stretch = np.where(steady, before / np.maximum(after, 1e-9), 1.0)
        slack = (1.0 - one.zone.tension * lines.tension) / np.maximum(stretch, 1e-3) - 1.0
        excess = one.wrinkling_fraction * np.maximum(slack, 0.0)
        wave_mm = 2.0 * math.pi / np.maximum(after, 1e-9)
        fine = soft_step((wave_mm / texel_mm[one.texel] - MIN_TEXELS_PER_WAVE) / 0.5)
        if (excess > 0.0).any() and float(np.median(fine)) < 0.5:
            left_out.append(one.zone.name)
        excess *= fine
        height[one.texel] += 1e3 * wave_mm * wave_depth(excess) * _profile(one.phase_rad)
        total[one.texel] += excess
    return Wrinkles(
        height.astype(np.float32).reshape(size, size),
        total.astype(np.float32).reshape(size, size),
        tuple(left_out),
    )


def wave_depth(excess: ArrayLike) -> Float64Array:
    """Return the depth of a wave from its excess length.

    Parameters
    ----------
    excess
        Length along the wave over its wavelength, minus one, 0 or more.

    Returns
    -------
    ndarray
        From groove to ridge, over the wavelength.

    Examples
    --------
    >>> bool(wave_depth(0.0) == 0.0)
    True
    """
    return np.interp(np.asarray(excess, np.float64), _WAVE_EXCESS, _WAVE_DEPTH)


def _profile(phase: Float64Array) -> Float64Array:
    """Return the height of a wave of depth 1, with zero mean and its groove at phase 0."""
    low, high = math.exp(-2.0 * GROOVE_NARROWING), 1.0
    return np.asarray(
        (_BELL_MEAN - np.exp(GROOVE_NARROWING * (np.cos(phase) - 1.0))) / (high - low)
    )


def _waves() -> tuple[float, Float64Array, Float64Array]:
    """Return the mean of the groove's bell, and the table of excess length against depth."""
    phase = 2.0 * math.pi * (np.arange(_PHASE_STEPS) + 0.5) / _PHASE_STEPS
    bell = np.exp(GROOVE_NARROWING * (np.cos(phase) - 1.0))
    slope = (
        2.0
        * math.pi
        * GROOVE_NARROWING
        * np.sin(phase)
        * bell
        / (1.0 - math.exp(-2.0 * GROOVE_NARROWING))
    )
    depth = np.concatenate([[0.0], np.geomspace(1e-4, 3.0, 400)])
    # Arc length of one period of unit wavelength: the mean of sqrt(1 + (depth h')^2).
    length = np.sqrt(1.0 + (depth[:, None] * slope) ** 2).mean(axis=1)
    return float(bell.mean()), length - 1.0, depth


_BELL_MEAN, _WAVE_EXCESS, _WAVE_DEPTH = _waves()


def _metric(atlas: Atlas, texel: NDArray[np.intp]) -> Float64Array:
    """Return the inverse metric of the texture, (n, 3): of du du, du dv, dv dv."""
    du = atlas.dp_du_mm.reshape(-1, 3)[texel].astype(np.float64)
    dv = atlas.dp_dv_mm.reshape(-1, 3)[texel].astype(np.float64)
    e, f = np.sum(du * du, axis=-1), np.sum(du * dv, axis=-1)
    g = np.sum(dv * dv, axis=-1)
    determinant = np.maximum(e * g - f * f, 1e-9 * np.maximum(e, g) ** 2 + 1e-30)
    return np.stack([g, -f, e], axis=-1) / determinant[:, None]


def _density(inverse: Float64Array, slope: Float64Array) -> Float64Array:
    """Return the length of a phase's gradient on the surface, rad/mm."""
    # |grad phase|^2 = g^ij d_i d_j with the inverse of the first fundamental form.
    u, v = slope[:, 0], slope[:, 1]
    squared = inverse[:, 0] * u * u + 2.0 * inverse[:, 1] * u * v + inverse[:, 2] * v * v
    return np.sqrt(np.maximum(squared, 0.0))
