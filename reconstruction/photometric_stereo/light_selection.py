"""Choose lights for normals by Fisher information, greedily.

A Lambertian sample s = rho E cos(theta) of a light in direction l informs the logarithm of its
signal. With g the derivatives of log cos(theta) by the normal's two tilts and of log rho by itself,

    I = w g g^T,    g = (l.t1 / l.n, l.t2 / l.n, 1),    w = s^2 / var(s)

Its inverse, summed over the lights that reach a point, bounds the covariance of tilts and albedo.
Lights are chosen one by one, each the one that lowers the mean squared error of the points most;
those that later ones made superfluous are then removed (an A-optimal exchange).

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
"""Error assigned to a point without an estimate: about that of a scan's normals."""
MIN_INFORMATIVE_LIGHTS = 4
"""Least number of lights that inform a point's normal and albedo and can contradict each other."""
_PRIOR_INFORMATION = 1e-6
"""Information before the first light: standard deviations of 1000 of tilts and log albedo."""


class SelectionError(ValueError):
    """Lights or settings that do not allow a choice."""


@dataclass(frozen=True, slots=True, eq=False)
class FisherInformation:
    """Fisher information of each of L lights about each of P points.

    Attributes
    ----------
    tilt : ndarray of float64, shape (P, L, 2)
        l.t / l.n for two tangents.
    weight : ndarray of float64, shape (P, L)
        Inverse variance of the logarithm of the sample; 0 for a light without information.
    reaches : ndarray of bool, shape (P, L)
        The light illuminates the point, even if too obliquely, or in a highlight, to inform its
        normal.
    importance : ndarray of float64, shape (P,)
        Weight of a point, e.g. its area.
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
    """Predicted errors with a set of lights.

    Attributes
    ----------
    tilt_rad : ndarray of float64, shape (P,)
        Standard error of each of two tilts (their root mean square), the systematic part included.
    log_albedo : ndarray of float64, shape (P,)
        Standard error of log rho.
    valid : ndarray of bool, shape (P,)
        At least `min_lights` lights reach the point, and of them at least
        `MIN_INFORMATIVE_LIGHTS` or `min_lights`, whichever is less, inform it.
    valid_fraction : float
        Fraction of valid points by importance.
    median_rad : float
        Median angle between estimate and ground truth over the valid points, whose angles are
        Rayleigh distributed each. pi / 2 without a valid point.
    """

    tilt_rad: Float64Array
    log_albedo: Float64Array
    valid: BoolArray
    valid_fraction: float
    median_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class LightSelection:
    """Chosen lights in order, with the predicted errors after each.

    Attributes
    ----------
    lights : tuple of int
        Those kept, in the order of choice.
    path : tuple of (int, float, float)
        After each light: how many, predicted median error in rad, fraction valid.
    prediction : ErrorPrediction
        Of the lights kept.
    reached : bool
        Whether the prediction meets the targets.
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
    """Compute the Fisher information of lights about points.

    Parameters
    ----------
    normals : array_like, shape (P, 3)
        Unit normals.
    to_light : array_like, shape (P, L, 3) or (L, 3)
        Unit vectors from the points to the lights.
    relative_variance : array_like, shape (P, L)
        Variance of each sample over its square, > 0; infinite where there is none.
    reaches : array_like of bool, shape (P, L), optional
        Which lights illuminate a point; by default those with information.
    importance : array_like, shape (P,), optional
        Weight of a point; 1 by default.
    systematic_rad : array_like, shape (P,) or ()
        Error of each tilt that is independent of the lights.

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
    """Predict the errors with a set of lights.

    Parameters
    ----------
    information : FisherInformation
    lights : array_like of int
        Numbers along L.
    min_lights : int
        Fewest lights that must reach a point, at least 3.
    """
    chosen = np.asarray(list(lights), np.intp)  # type: ignore[arg-type]
    covariance = np.asarray(np.linalg.inv(_start(information, chosen)), np.float64)
    reached = np.count_nonzero(information.reaches[:, chosen], axis=1) >= min_lights
    informed = np.count_nonzero(information.weight[:, chosen], axis=1)
    valid = reached & (informed >= min(min_lights, MIN_INFORMATIVE_LIGHTS))
    return _evaluate_prediction(information, covariance, valid)


def select_lights(
    information: FisherInformation,
    *,
    median_rad: float,
    valid_fraction: float,
    min_lights: int,
    max_lights: int | None = None,
    fixed: tuple[int, ...] = (),
) -> LightSelection:
    """Choose as few lights as meet a median error and a fraction of valid points.

    Parameters
    ----------
    information : FisherInformation
    median_rad : float
        Target of the median angle, rad.
    valid_fraction : float
        Target of the fraction of points with an estimate, 0 to 1.
    min_lights : int
        Fewest lights that must reach a point, at least 3.
    max_lights : int, optional
        Largest number to choose; all by default.
    fixed : tuple of int
        Lights that are used in any case.

    Returns
    -------
    LightSelection
        `reached` is whether the prediction meets the targets; if not, the selection contains the
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
    """Return the decrease of the points' mean squared error by each light, (L,).

    A point that too few lights reach has an error of `UNKNOWN_ERROR_RAD` or more, which falls with
    each light that reaches it, so that a light has a gain before the point has an estimate.
    """
    at = np.asarray(chosen, np.intp)
    covariance = np.linalg.inv(_start(found, at))
    reached = np.count_nonzero(found.reaches[:, at], axis=1)
    g = np.concatenate([found.tilt, np.ones((*found.weight.shape, 1))], axis=-1)
    # Sherman and Morrison 1950: adding w g g' to A lowers A^-1 by w (A^-1 g)(A^-1 g)' over
    # 1 + w g' A^-1 g
    moved = np.einsum("pij,plj->pli", covariance, g)
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
    found: FisherInformation, covariance: Float64Array, valid: BoolArray
) -> ErrorPrediction:
    variance = 0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1]) + found.systematic_rad**2
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
