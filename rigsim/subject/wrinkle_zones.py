"""Zones of a face in which the skin wrinkles along one family of lines, with their wavelengths.

Notes
-----
The wavelength of the buckles is 2 pi h (E / 3 E_s)^(1/3) for a layer of thickness h and modulus E
on a base of modulus E_s (Genzer and Groenewold 2006, doi:10.1039/b516741h). `MODULUS_RATIO` and the
zones' thicknesses are chosen to give the distances between furrows that faces show, 2.5 mm beside
the eyes to 8 mm on the forehead; the furrows are narrower than the ridges between them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from rigsim.arrays import Float64Array
from rigsim.subject.face_regions import soft_step

MODULUS_RATIO: Final = 100.0
"""Stiffness of the layer that buckles over that of what lies below it."""


@dataclass(frozen=True, slots=True)
class Zone:
    """A part of the face whose wrinkles run along one family of lines."""

    name: str
    thickness_mm: float
    """Thickness of the layer that buckles."""
    across_mm: Callable[[Float64Array], Float64Array]
    """Distance across the lines, of points on the mean head with x >= 0, mm."""
    share: Callable[[Float64Array], Float64Array]
    """Part of the shortening beyond the tension that goes into wrinkles, 0 to 1."""
    mirrored: bool = True
    """Whether both halves of the face have lines of their own kind; else lines cross the middle."""
    tension: float = 1.0
    """Part of the person's tension that must be spent here; folds that are tethered need little."""
    single: bool = False
    """Whether there is one furrow, where ``across_mm`` is 0, instead of a family."""

    @property
    def wavelength_mm(self) -> float:
        """Distance from furrow to furrow at rest, mm."""
        return 2.0 * math.pi * self.thickness_mm * (MODULUS_RATIO / 3.0) ** (1.0 / 3.0)


def _plateau(
    points: Float64Array, center: tuple[float, ...], reach: tuple[float, ...]
) -> Float64Array:
    """Return 1 well inside a ball of unequal radii, 0 well outside."""
    q = (points - np.array(center)) / np.array(reach)
    return np.asarray(soft_step((1.0 - np.sqrt(np.sum(q * q, axis=-1))) / 0.22))


def _x(p: Float64Array) -> Float64Array:
    return np.asarray(p[..., 0])


def _y(p: Float64Array) -> Float64Array:
    return np.asarray(p[..., 1])


_FOLD_ENDS_MM = (np.array([17.0, -10.0]), np.array([31.0, -41.0]))
"""Ends of the fold between nose and cheek, mm on the mean head."""


def _off_fold(p: Float64Array) -> Float64Array:
    way = (_FOLD_ENDS_MM[1] - _FOLD_ENDS_MM[0]) / np.linalg.norm(
        _FOLD_ENDS_MM[1] - _FOLD_ENDS_MM[0]
    )
    along = (p[..., :2] - _FOLD_ENDS_MM[0]) @ way
    # a slight bow towards the cheek
    side = (p[..., :2] - _FOLD_ENDS_MM[0]) @ np.array([-way[1], way[0]])
    return np.asarray(side - 2.5 * np.sin(np.pi * np.clip(along / 34.0, 0.0, 1.0)))


def _near_fold(p: Float64Array) -> Float64Array:
    way = (_FOLD_ENDS_MM[1] - _FOLD_ENDS_MM[0]) / np.linalg.norm(
        _FOLD_ENDS_MM[1] - _FOLD_ENDS_MM[0]
    )
    along = (p[..., :2] - _FOLD_ENDS_MM[0]) @ way
    inside = soft_step((along - 1.0) / 3.0) * soft_step((32.0 - along) / 3.0)
    return np.asarray(inside * (p[..., 2] > -25.0))


def _fan(p: Float64Array) -> Float64Array:
    """Return the distance along circles about the corner of the eye, counted at 12 mm from it."""
    return np.asarray(12.0 * np.arctan2(p[..., 1] - 24.0, np.maximum(p[..., 0] - 42.0, 1.0)))


WRINKLE_ZONES: Final = (
    Zone(
        "forehead",
        0.36,
        lambda p: _y(p) - 0.0035 * _x(p) ** 2,
        lambda p: _plateau(p, (0.0, 62.0, 0.0), (46.0, 20.0, 55.0)),
        mirrored=False,
    ),
    Zone(
        "glabella",
        0.34,
        lambda p: _x(p) * (1.0 + 0.008 * (_y(p) - 44.0)),
        lambda p: _plateau(p, (0.0, 43.0, 4.0), (14.0, 13.0, 40.0)),
        mirrored=False,
    ),
    Zone(
        "nasal root",
        0.22,
        lambda p: _y(p) - 0.03 * _x(p) ** 2,
        lambda p: _plateau(p, (0.0, 22.0, 9.0), (10.0, 8.0, 25.0)),
        mirrored=False,
    ),
    Zone(
        "nose sides",
        0.17,
        lambda p: 0.86 * _y(p) - 0.5 * _x(p),
        lambda p: _plateau(p, (9.0, 7.0, 11.0), (7.0, 9.0, 25.0)),
    ),
    Zone("crow's feet", 0.13, _fan, lambda p: _plateau(p, (55.0, 23.0, -26.0), (11.0, 15.0, 30.0))),
    Zone(
        "lower lids",
        0.13,
        lambda p: _y(p) - 0.012 * (_x(p) - 31.0) ** 2,
        lambda p: _plateau(p, (34.0, 9.0, -4.0), (15.0, 6.5, 30.0)),
        tension=0.6,
    ),
    Zone("nasolabial fold", 0.5, _off_fold, _near_fold, tension=0.2, single=True),
    Zone(
        "mouth corners",
        0.30,
        lambda p: np.hypot(_x(p) - 22.0, 0.8 * (_y(p) + 41.0)),
        lambda p: 0.35 * _plateau(p, (38.0, -42.0, -8.0), (8.0, 11.0, 30.0)),
    ),
    Zone(
        "chin",
        0.26,
        lambda p: _y(p) + 0.006 * _x(p) ** 2,
        lambda p: _plateau(p, (0.0, -57.0, 8.0), (15.0, 7.0, 25.0)),
        mirrored=False,
    ),
)
"""The zones of a face; where they overlap they share the shortening."""
