"""Which lights tell most of a surface's normals: Fisher information, and a greedy choice by it.

A Lambertian sample s = rho E cos(theta) of a light in direction l tells of the logarithm of its
signal, with g the derivatives of log cos(theta) by the normal's two tilts and of log rho by itself,

    I = w g g^T,    g = (l.t1 / l.n, l.t2 / l.n, 1),    w = s^2 / var(s)

Its inverse, summed over the lights that reach a point, bounds the covariance of tilts and albedo.
Lights are chosen one after the other, each the one that lowers the mean squared error of the points
most, and those that later ones made superfluous are taken off again (an A-optimal exchange).

References
----------
Fedorov 1972, Theory of Optimal Experiments (exchange); Pukelsheim 2006,
doi:10.1137/1.9780898719109 (A-optimality).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.checks import Checks
from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float64Array

UNKNOWN_ERROR_RAD = np.radians(10.0)
"""Error that a point without an estimate counts as: about what a scan's normals are off."""
_PRIOR_INFORMATION = 1e-6
"""Information held before the first light: tilts and log albedo known to a thousand."""


class SelectionError(ValueError):
    """Lights that nothing can be chosen of."""


@dataclass(frozen=True, slots=True, eq=False)
class FisherInformation:
    """What each of L lights tells of each of P points.

    Attributes
    ----------
    tilt : ndarray of float64, shape (P, L, 2)
        l.t / l.n for two tangents.
    weight : ndarray of float64, shape (P, L)
        Inverse variance of the logarithm of the sample; 0 where the light tells nothing.
    reaches : ndarray of bool, shape (P, L)
        The light shows the point, be it too obliquely, or in a highlight, to tell of its normal.
    importance : ndarray of float64, shape (P,)
        How much a point counts, e.g. its area.
    systematic_rad : ndarray of float64, shape (P,)
        Error of each tilt that no light removes.
    """

    tilt: Float64Array
    weight: Float64Array
    reaches: BoolArray
    importance: Float64Array
    systematic_rad: Float64Array

    def __post_init__(self) -> None:
        """Check shapes and values."""
        Checks(SelectionError).shape("weight", self.weight, ("P", "L"))
        points, lights = self.weight.shape
        for name, shape in (
            ("tilt", (points, lights, 2)),
            ("reaches", (points, lights)),
            ("importance", (points,)),
            ("systematic_rad", (points,)),
        ):
            Checks(SelectionError).shape(name, getattr(self, name), shape)
        for name in ("tilt", "systematic_rad"):
            Checks(SelectionError).within(name, getattr(self, name))
        for name in ("weight", "importance"):
            Checks(SelectionError).within(name, getattr(self, name), "[0, inf)")


@dataclass(frozen=True, slots=True, eq=False)
class ErrorPrediction:
    """Errors that a set of lights leaves.

    Attributes
    ----------
    tilt_rad : ndarray of float64, shape (P,)
        Standard error of each of two tilts (their root mean square), the systematic part included.
    log_albedo : ndarray of float64, shape (P,)
        Standard error of log rho.
    valid : ndarray of bool, shape (P,)
        At least `least` lights reach the point.
    valid_fraction : float
        By importance.
    median_rad : float
        Median angle between estimate and truth over the valid points: where half of the angles,
        Rayleigh distributed at each point, lie below. pi / 2 where no point is valid.
    """

    tilt_rad: Float64Array
    log_albedo: Float64Array
    valid: BoolArray
    valid_fraction: float
    median_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class LightSelection:
    """Lights in the order of their choice, and what each further one buys.

    Attributes
    ----------
    lights : tuple of int
        Those kept, in the order of choice.
    path : tuple of (int, float, float)
        After each light that was taken: how many, predicted median error in rad, share valid.
    prediction : Prediction
        Of the lights kept.
    reached : bool
        Whether what was wanted is predicted.
    """

    lights: tuple[int, ...]
    path: tuple[tuple[int, float, float], ...]
    prediction: ErrorPrediction
    reached: bool


def fisher_information(
    normals: ArrayLike,
    to_light: ArrayLike,
    relative_variance: ArrayLike,
    *,
    reaches: ArrayLike | None = None,
    importance: ArrayLike | None = None,
    systematic_rad: ArrayLike = 0.0,
) -> FisherInformation:
    """Return what lights tell of points.

    Parameters
    ----------
    normals : array_like, shape (P, 3)
        Unit normals.
    to_light : array_like, shape (P, L, 3) or (L, 3)
        Unit vectors from the points to the lights.
    relative_variance : array_like, shape (P, L)
        Variance of each sample over its square, > 0; infinite where there is none.
    reaches : array_like of bool, shape (P, L), optional
        Which lights show a point; those that tell of it by default.
    importance : array_like, shape (P,), optional
        How much a point counts; 1 by default.
    systematic_rad : array_like, shape (P,) or ()
        Error of each tilt that stays whatever the lights.

    Examples
    --------
    >>> up = [[0.0, 0.0, 1.0]]
    >>> ring = np.array([[0.6, 0, 0.8], [-0.6, 0, 0.8], [0, 0.6, 0.8], [0, -0.6, 0.8]])
    >>> found = fisher_information(up, ring, np.full((1, 4), 1e-4))
    >>> round(float(np.degrees(predict_errors(found, range(4), min_lights=3).tilt_rad[0])), 3)
    0.54
    """
    n = np.asarray(normals, np.float64)
    way = np.broadcast_to(np.asarray(to_light, np.float64), (len(n), *np.shape(to_light)[-2:]))
    helper = np.where(np.abs(n[:, [0]]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = unit_vectors(np.cross(n, helper))
    second = np.cross(n, first)
    cosine = np.einsum("plk,pk->pl", way, n)
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(cosine > 0, 1.0 / np.asarray(relative_variance, np.float64), 0.0)
        tilt = np.stack([np.einsum("plk,pk->pl", way, t) for t in (first, second)], -1)
        tilt = np.where(cosine[..., None] > 1e-9, tilt / cosine[..., None], 0.0)
    count = len(n)
    return FisherInformation(
        tilt,
        weight,
        weight > 0 if reaches is None else np.asarray(reaches, np.bool_),
        np.ones(count) if importance is None else np.asarray(importance, np.float64),
        np.array(np.broadcast_to(np.asarray(systematic_rad, np.float64), (count,))),
    )


def predict_errors(
    information: FisherInformation, lights: ArrayLike, *, min_lights: int
) -> ErrorPrediction:
    """Return the errors that these lights leave.

    Parameters
    ----------
    information : Information
    lights : array_like of int
        Numbers along L.
    min_lights : int
        Fewest lights that must reach a point, at least 3.
    """
    chosen = np.asarray(list(lights), np.intp)  # type: ignore[arg-type]
    covariance = np.asarray(np.linalg.inv(_start(information, chosen)), np.float64)
    reached = np.count_nonzero(information.reaches[:, chosen], axis=1)
    return _evaluate_prediction(information, covariance, reached, min_lights)


def select_lights(
    information: FisherInformation,
    *,
    median_rad: float,
    valid_fraction: float,
    min_lights: int,
    max_lights: int | None = None,
    fixed: tuple[int, ...] = (),
) -> LightSelection:
    """Choose as few lights as reach an error.

    Parameters
    ----------
    information : Information
    median_rad : float
        Wanted median angle, rad.
    valid_fraction : float
        Wanted share of the points that have an estimate, 0 to 1.
    min_lights : int
        Fewest lights that must reach a point, at least 3.
    max_lights : int, optional
        Largest number to choose; all by default.
    fixed : tuple of int
        Lights that are used anyway.

    Returns
    -------
    Selection
        `reached` says whether what is wanted is predicted; if not, the selection holds the
        `max_lights` best lights.
    """
    Checks(SelectionError).within("min_lights", min_lights, "[3, inf)")
    lights = information.weight.shape[1]
    max_lights = lights if max_lights is None else min(max_lights, lights)
    chosen = list(fixed)
    path: list[tuple[int, float, float]] = []
    prediction = predict_errors(information, chosen, min_lights=min_lights)
    while len(chosen) < max_lights and not _good(prediction, median_rad, valid_fraction):
        gain = _gains(information, chosen, min_lights)
        gain[chosen] = -np.inf
        chosen.append(int(np.argmax(gain)))
        prediction = predict_errors(information, chosen, min_lights=min_lights)
        path.append((len(chosen), prediction.median_rad, prediction.valid_fraction))
    if _good(prediction, median_rad, valid_fraction):
        for light in [light for light in chosen if light not in fixed]:
            without = [other for other in chosen if other != light]
            now = predict_errors(information, without, min_lights=min_lights)
            if _good(now, median_rad, valid_fraction):
                chosen, prediction = without, now
    reached = _good(prediction, median_rad, valid_fraction)
    return LightSelection(tuple(chosen), tuple(path), prediction, reached)


def _good(prediction: ErrorPrediction, median_rad: float, valid_share: float) -> bool:
    return prediction.median_rad <= median_rad and prediction.valid_fraction >= valid_share


def _start(found: FisherInformation, chosen: NDArray[np.intp]) -> Float64Array:
    """Return the information of these lights, (P, 3, 3)."""
    weight = found.weight[:, chosen]
    g = np.concatenate([found.tilt[:, chosen], np.ones((*weight.shape, 1))], axis=-1)
    return np.asarray(np.einsum("pl,pli,plj->pij", weight, g, g) + _PRIOR_INFORMATION * np.eye(3))


def _gains(found: FisherInformation, chosen: list[int], min_lights: int) -> Float64Array:
    """Return by how much each light would lower the mean squared error of the points, (L,).

    Points that too few lights reach count `UNKNOWN_ERROR_RAD` and more, the more the fewer reach
    them, so
    that a light towards them is worth something before the last one comes.
    """
    at = np.asarray(chosen, np.intp)
    covariance = np.linalg.inv(_start(found, at))
    reached = np.count_nonzero(found.reaches[:, at], axis=1)
    g = np.concatenate([found.tilt, np.ones((*found.weight.shape, 1))], axis=-1)
    moved = np.einsum("pij,plj->pli", covariance, g)  # Sherman and Morrison 1950
    bend = np.einsum("pli,pli->pl", moved, g)
    drop = found.weight * np.sum(moved[..., :2] ** 2, -1) / (1.0 + found.weight * bend)
    trace = covariance[:, 0, 0] + covariance[:, 1, 1]
    floor = np.square(found.systematic_rad)
    unknown = UNKNOWN_ERROR_RAD**2
    now = _loss(0.5 * trace + floor, reached, min_lights, unknown)
    then = _loss(
        0.5 * (trace[:, None] - drop) + floor[:, None],
        reached[:, None] + found.reaches,
        min_lights,
        unknown,
    )
    return np.asarray(found.importance @ (now[:, None] - then))


def _loss(
    variance: Float64Array, reached: NDArray[np.intp], min_lights: int, unknown: float
) -> Float64Array:
    missing = np.clip(min_lights - reached, 0, None) / min_lights
    return np.where(missing > 0, unknown * (1.0 + missing), np.minimum(variance, unknown))


def _evaluate_prediction(
    found: FisherInformation, covariance: Float64Array, reached: NDArray[np.intp], min_lights: int
) -> ErrorPrediction:
    variance = 0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1]) + found.systematic_rad**2
    valid = np.asarray(reached >= min_lights)
    total = float(found.importance.sum())
    share = float(found.importance[valid].sum()) / total if total > 0 else 0.0
    return ErrorPrediction(
        np.sqrt(variance),
        np.sqrt(covariance[:, 2, 2]),
        valid,
        share,
        rayleigh_mixture_median(np.sqrt(variance[valid]), found.importance[valid]),
    )


def rayleigh_mixture_median(scale: ArrayLike, weight: ArrayLike | None = None) -> float:
    """Return the median of a mixture of Rayleigh distributions; pi / 2 for none.

    Parameters
    ----------
    scale : array_like, shape (P,)
        Standard deviations of the two components.
    weight : array_like, shape (P,), optional

    Examples
    --------
    >>> round(rayleigh_mixture_median([1.0, 1.0]), 4)
    1.1774
    """
    s = np.asarray(scale, np.float64)
    w = np.ones(len(s)) if weight is None else np.asarray(weight, np.float64)
    if not len(s) or not w.sum() > 0:
        return float(np.pi / 2)
    low, high = 0.0, 2.0 * float(s.max()) + 1e-300
    for _ in range(60):
        middle = 0.5 * (low + high)
        with np.errstate(divide="ignore", over="ignore"):
            below = float(np.sum(w * -np.expm1(-0.5 * (middle / np.maximum(s, 1e-300)) ** 2)))
        low, high = (middle, high) if below < 0.5 * w.sum() else (low, middle)
    return 0.5 * (low + high)
