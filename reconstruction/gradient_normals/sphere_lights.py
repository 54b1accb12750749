"""Describe the lights of a gradient sphere, and map normals to positions on a disc."""

from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from reconstruction.arrays import Float64Array


class SphereLightsError(ValueError):
    """Lights outside the ranges of a gradient sphere."""


_none = partial(np.zeros, 0)


@dataclass(frozen=True, slots=True, eq=False)
class SphereLights:
    """Lights of a gradient sphere with their polarizers, as measured.

    Attributes
    ----------
    directions : ndarray, shape (L, 3)
        Unit vectors from the middle of the patch to the lights, rig frame, at least four.
    intensities : ndarray, shape (L,)
        Light of each source at the patch, relative, >= 0; any scale. Default: all 1.
    leakage : ndarray, shape (L,)
        Crossed transmission of the specular reflection into the camera over the parallel one,
        >= 0; below 1 for most lights. Default: 0.
    polarizers : ndarray, shape (L, 3)
        Unit vectors of the electric field that each light sends to the patch. Default (0, 3):
        polarizers under which a facet reflects light polarized along the analyzer.
    analyzer : tuple of float
        Passing axis of the analyzer in its parallel state.
    programmed : ndarray, shape (L, 3)
        The vectors whose coordinates the patterns were made of; default: `directions`.
    distance_mm : float
        Distance of the lights from the patch's middle; inf: a point's position does not matter.
    intensity_stderr : ndarray, shape (L,)
        Standard error of `intensities`. Default: 0.
    leakage_stderr : ndarray, shape (L,)
        Standard error of `leakage`. Default: 0.

    Examples
    --------
    >>> axes = np.concatenate([np.eye(3), -np.eye(3)])
    >>> SphereLights(axes).intensities.tolist()
    [1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    """

    directions: Float64Array
    intensities: Float64Array = field(default_factory=_none)
    leakage: Float64Array = field(default_factory=_none)
    polarizers: Float64Array = field(default_factory=_none)
    analyzer: tuple[float, float, float] = (0.0, 1.0, 0.0)
    programmed: Float64Array = field(default_factory=_none)
    distance_mm: float = np.inf
    intensity_stderr: Float64Array = field(default_factory=_none)
    leakage_stderr: Float64Array = field(default_factory=_none)

    def __post_init__(self) -> None:
        """Check shapes and ranges, and keep copies that cannot be written to."""
        check = Checks(SphereLightsError)
        ways = require_unit_vectors("directions", self.directions)
        count = len(ways)
        check.require(count >= 4, "directions", f"{count} light(s)", "at least 4")
        axis = require_unit_vectors("analyzer", np.asarray(self.analyzer, np.float64)[None])[0]
        # not given: stay empty, so that a later replace() of directions does not meet old ones
        for name in ("intensities", "leakage", "intensity_stderr", "leakage_stderr"):
            given = np.asarray(getattr(self, name), np.float64)
            values = given.copy() if given.size else np.full(count, float(name == "intensities"))
            _keep(self, name, check.numbers(name, values, (count,), interval="[0, inf)"))
        check.require(self.intensities.any(), "intensities", "0 for every light", "some light")
        # a few may exceed 1, by a polarizer mounted crosswise or where the surface hardly reflects
        # the parallel state: their parallel less crossed light is negative and counts as such
        middle = float(np.median(self.leakage[self.intensities > 0]))
        got = f"{middle:g} in the middle of the lights"
        expected = "crossed over parallel below 1; are the two states exchanged?"
        check.require(middle < 1.0, "leakage", got, expected)
        for name in ("polarizers", "programmed"):
            given = np.asarray(getattr(self, name), np.float64)
            vectors = np.zeros((0, 3)) if given.size == 0 else require_unit_vectors(name, given)
            check.shape(name, vectors, (0, 3), (count, 3))
            _keep(self, name, vectors)
        if len(self.polarizers):
            along = np.abs(np.sum(self.polarizers * ways, axis=1))
            where = f"polarizers[{along.argmax()}]"
            check.require(along.max() <= 0.05, where, "a field along its own ray", "one across it")
        check.within("distance_mm", self.distance_mm, "(0, inf]")
        _keep(self, "directions", ways)
        object.__setattr__(self, "analyzer", tuple(float(a) for a in axis))

    def _contents(self) -> tuple[object, ...]:
        values = (getattr(self, name) for name in self.__slots__)
        return tuple(v.tobytes() if isinstance(v, np.ndarray) else v for v in values)

    def __eq__(self, other: object) -> bool:
        """Compare by numbers, so that equal lights share a cached table."""
        return isinstance(other, SphereLights) and self._contents() == other._contents()

    def __hash__(self) -> int:
        """Hash the numbers."""
        return hash(self._contents())


def _keep(lights: SphereLights, name: str, values: Float64Array) -> None:
    values.flags.writeable = False
    object.__setattr__(lights, name, values)


def require_unit_vectors(name: str, vectors: ArrayLike) -> Float64Array:
    """Return vectors as unit vectors (L, 3); refuse lengths more than 1 % off."""
    array = np.array(vectors, np.float64)
    Checks(SphereLightsError).shape(name, array, ("L", 3))
    length = np.linalg.norm(array, axis=1)
    good = np.abs(length - 1.0) < 0.01
    first = int(np.argmin(good))
    where, got = f"{name}[{first}]", array[first].tolist()
    Checks(SphereLightsError).require(good.all(), where, got, "a unit vector")
    return np.asarray(array / length[:, None])


def view_frame(view: ArrayLike) -> Float64Array:
    """Return the orthonormal frame about a view, rows right, up, view; identity for +z.

    Parameters
    ----------
    view : array_like, shape (3,)
        Of any length above 0.

    Raises
    ------
    SphereLightsError
        For a view that points nowhere.
    """
    v = np.asarray(view, np.float64)
    most = float(np.abs(v).max()) if v.shape == (3,) else np.nan
    Checks(SphereLightsError).within("view", most, "(0, inf)")
    v = v / most
    v /= np.linalg.norm(v)
    up = np.array([0.0, 1.0, 0.0]) if abs(v[1]) < 0.99 else np.array([0.0, 0.0, -1.0])
    right = np.cross(up, v)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(v, right), v])


def normal_from_disc(position: Float64Array) -> Float64Array:
    """Return the unit normals (..., 3) at positions (..., 2), in the frame of the view.

    The horizon is at a length of sqrt(2); positions beyond it have the normal of the horizon there.

    Raises
    ------
    SphereLightsError
        For positions that are not finite.

    Examples
    --------
    >>> normal_from_disc(np.array([1.0, 0.0])).round(4).tolist()
    [0.866, 0.0, 0.5]
    """
    Checks(SphereLightsError).within("position", position)
    length = np.hypot(position[..., :1], position[..., 1:])
    seen = position * np.minimum(1.0, np.sqrt(2.0) / np.maximum(length, 1e-9))
    square = np.minimum(length, np.sqrt(2.0)) ** 2
    return np.concatenate([seen * np.sqrt(1.0 - square / 4.0), 1.0 - square / 2.0], axis=-1)


def disc_from_normal(normal: Float64Array) -> Float64Array:
    """Return the positions (..., 2) of unit normals (..., 3), in the frame of the view.

    Raises
    ------
    SphereLightsError
        For normals that are not finite.
    """
    Checks(SphereLightsError).within("normal", normal)
    return np.asarray(normal[..., :2] * np.sqrt(2.0 / np.maximum(1.0 + normal[..., 2:], 1e-9)))
