"""Samples of curves with linear levels, and the step between the poses of a moving face.

A curve is a level, plus a gap times a shape, plus a step in samples of a moved face. The step has a
normal prior and is integrated out, which adds a term of rank one to the samples' covariance. The
inverse is that of independent samples after a fraction of the moved samples' mean is subtracted
from them: 1 for a free step, 0 without a step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.facial_color.perfusion_curves import CurveError


@dataclass(frozen=True, slots=True, eq=False)
class PoseStep:
    """Prior of the step that a moved face adds to curves."""

    moved: BoolArray
    """(N,): samples in which the face has moved."""
    stderr: Float64Array
    """(P,): standard error of the level of those samples relative to the others, >= 0."""


@dataclass(frozen=True, slots=True, eq=False)
class CurveSamples:
    """Curves (P, N) with weights that sum to the number of samples of each; 0 where missing."""

    values: Float64Array
    weights: Float64Array
    variance: Float64Array
    """(P,): mean variance by the given errors; NaN without."""
    moved: Float64Array
    """(N,): 1 where the face has moved, else 0."""
    stderr_of_pose: Float64Array
    """(P,): prior of the step; 0 without a step, and where all samples are of one pose."""
    removed_fraction: Float64Array
    """(P,): fraction of the moved samples' mean that is subtracted from them, 0 to 1."""

    @staticmethod
    def of(
        at: Float64Array, values: ArrayLike, stderr: ArrayLike | None, pose: PoseStep | None = None
    ) -> CurveSamples:
        """Return the samples of curves, before steps are applied.

        Parameters
        ----------
        at : ndarray, shape (N,)
            Time or phase, s.
        values : array_like, shape (N,) or (P, N)
            NaN is omitted.
        stderr : array_like, optional
            Standard errors, the values' shape.
        pose : PoseStep, optional

        Raises
        ------
        CurveError
            For fewer than 5 samples of a curve, or a mismatched shape.
        """
        shown = np.atleast_2d(np.asarray(values, np.float64))
        check = Checks(CurveError)
        check.shape("values", shown, (len(shown), at.size))
        good = np.isfinite(shown) & np.isfinite(at)
        variance = np.full(shown.shape, np.nan)
        if stderr is not None:
            variance = np.square(np.atleast_2d(np.asarray(stderr, np.float64)))
            check.shape("stderr", variance, shown.shape)
            good &= np.isfinite(variance) & (variance > 0)
        usable = int(good.sum(axis=1).min(initial=at.size))
        check.require(usable >= 5, "values", f"{usable} usable", ">= 5; record more samples")
        inverse = np.where(good, 1.0 if stderr is None else 1.0 / variance, 0.0)
        count = good.sum(axis=1, keepdims=True)
        scale = count / inverse.sum(axis=1, keepdims=True)
        known = scale[:, 0] if stderr is not None else np.full(len(shown), np.nan)
        moved, of_pose = _steps(pose, good)
        none = np.zeros(len(shown))
        return CurveSamples(
            np.where(good, shown, 0.0), inverse * scale, known, moved, of_pose, none
        )

    @property
    def has_steps(self) -> bool:
        """Whether any curve has a step."""
        return bool((self.stderr_of_pose > 0).any())

    def pose_change_interval(
        self, phase: Float64Array, middle: float, longest: float
    ) -> tuple[float, float]:
        """Return the range of the movement's delay: last sample before it, and first after it.

        Parameters
        ----------
        phase : ndarray, shape (N,)
            Phase since the prompt of the expression, in [0, cycle), s.
        middle
            Time of the prompt of rest, s.
        longest
            Longest delay that is considered, s.
        """
        since = np.where(phase < middle, phase, phase - middle)
        done = (self.moved > 0.0) == (phase < middle)  # the face follows the last prompt
        soon = since <= longest
        not_yet = float(since[soon & ~done].max(initial=0.0))
        already = float(since[soon & done].min(initial=longest))
        # reaction times vary: where the ranges overlap, between the earliest sample after the
        # movement and the latest before it
        low, high = min(not_yet, already), max(not_yet, already)
        return (low, high) if high > low else (0.0, longest)

    def with_free_step(self) -> CurveSamples:
        """Return the samples with free steps, where any step exists."""
        return replace(self, removed_fraction=np.where(self.stderr_of_pose > 0, 1.0, 0.0))

    def with_prior(self, noise2: Float64Array) -> CurveSamples:
        """Return the samples with steps under their prior, for noise variances (P,)."""
        # a step of prior variance t^2 in samples of total weight M has the fraction
        # held = M t^2 / (noise2 + M t^2) of its estimate
        many = (self.weights * self.moved).sum(axis=-1) * self.stderr_of_pose**2
        held = many / np.maximum(noise2 + many, 1e-300)
        # with m = moved: B = 1 - c m m'W / m'Wm has B'WB = W - (2c - c^2) W m m'W / m'Wm, so that
        # held = 2c - c^2 and c = 1 - sqrt(1 - held)
        return replace(self, removed_fraction=1.0 - np.sqrt(np.maximum(1.0 - held, 0.0)))

    def residual(self, shape: Float64Array) -> Float64Array:
        """Return the weighted square sum at the best levels, (..., P), of shapes (..., N)."""
        ones, values, curve = self._without_step(shape)
        level, gap = self._best_levels(ones, values, curve)
        left = values - level[..., None] * ones - gap[..., None] * curve
        return np.asarray((self.weights * left**2).sum(axis=-1))

    def levels(self, shape: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return the best start and gap of each curve, (..., P)."""
        return self._best_levels(*self._without_step(shape))

    def _best_levels(
        self, ones: Float64Array, values: Float64Array, b: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        w = self.weights
        total = (w * ones**2).sum(axis=-1)
        b_mean = (w * ones * b).sum(axis=-1) / total
        v_mean = (w * ones * values).sum(axis=-1) / total
        b_off, v_off = b - b_mean[..., None] * ones, values - v_mean[:, None] * ones
        square = (w * b_off**2).sum(axis=-1)
        product = (w * b_off * v_off).sum(axis=-1)
        gap = np.where(square > 1e-12 * total, product / np.maximum(square, 1e-300), 0.0)
        return v_mean - gap * b_mean, gap

    def step(self, shape: Float64Array) -> Float64Array:
        """Return the best step of each curve, (..., P), of shapes (..., N)."""
        level, gap = self.levels(shape)
        left = self.values - level[..., None] - gap[..., None] * shape[..., None, :]
        return np.asarray((1.0 - (1.0 - self.removed_fraction) ** 2) * self._of_moved(left))

    def _without_step(self, shape: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Return ones, values and shape with the step's part of the moved samples subtracted."""
        curve = shape[..., None, :]
        if not self.removed_fraction.any():
            return np.ones_like(self.values), self.values, curve

        def shed(part: Float64Array) -> Float64Array:
            off = self.removed_fraction * self._of_moved(part)
            return np.asarray(part - off[..., None] * self.moved)

        return shed(np.ones_like(self.values)), shed(self.values), shed(curve)

    def _of_moved(self, part: Float64Array) -> Float64Array:
        """Return the mean over the moved samples, (..., P); 0 without any."""
        weights = self.weights * self.moved
        total = weights.sum(axis=-1)
        return np.asarray((weights * part).sum(axis=-1) / np.where(total > 0, total, 1.0))


def _steps(pose: PoseStep | None, good: BoolArray) -> tuple[Float64Array, Float64Array]:
    curves, samples = good.shape
    if pose is None:
        return np.zeros(samples), np.zeros(curves)
    moved = np.asarray(pose.moved, bool)
    stderr = np.atleast_1d(np.asarray(pose.stderr, np.float64))
    check = Checks(CurveError)
    check.shape("pose, samples that have moved", moved, (samples,))
    check.numbers("pose, standard errors", stderr, (curves,), interval="[0, inf)")
    both = (good & moved).any(axis=1) & (good & ~moved).any(axis=1)
    return moved.astype(np.float64), np.where(both, stderr, 0.0)
