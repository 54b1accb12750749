"""Estimate normals and albedo from images under many lights, robust to shadows and highlights.

The model is Lambertian: a sample under light ``l`` is ``albedo * e_l * max(n . d_l, 0)``, with
``e_l`` its irradiance at normal incidence (`light_intensity`, over the squared distance if
positions are given). Shadows, highlights and defects violate it; they are found by their residuals
and lose their weight.
"""

from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.checks import Checks
from reconstruction.arrays import BoolArray, FloatArray
from reconstruction.normal_maps import NormalMaps, PhotometricStereoError
from reconstruction.photometric_stereo import kernels
from reconstruction.photometric_stereo.solver_kernels import RobustFitLimits
from reconstruction.tiles import map_on_threads

TILE_POINTS = 8192
MIN_AGREEING_FRACTION = 0.5
"""Least fraction of the samples that are not dark which must agree with a robust fit."""
TIGHT_RESIDUAL = 0.02
"""Standard deviation of a robust fit's residuals, over a bright sample, up to which it is accepted
without further evidence: real matte surfaces deviate from Lambert's law by more."""
CLEAR_OUTLIER_RESIDUAL = 0.2
"""Residual over a bright sample from which a sample is a clear outlier."""
LOOSE_RESIDUAL = 0.15
"""Same standard deviation above which acceptance needs one more clear outlier as evidence."""
MIN_SINGULAR_RATIO = 3e-3
"""Ratio of the light directions' extreme singular values below which they count as coplanar."""


@dataclass(frozen=True, slots=True)
class Robustness:
    """Settings by which samples that are not Lambertian are rejected.

    Attributes
    ----------
    l1_iterations
        Largest number of steps of least absolute deviations at the start, >= 0.
    iterations
        Largest number of steps of the biweight at the end, >= 1.
    shadow
        Fraction of a bright sample below which a sample is not used at the start, [0, 1).
    grazing
        Cosine to the fitted normal below which a light does not count as lighting the point,
        [0, 1).
    tuning
        Residual, in standard deviations, above which a sample has weight 0; 4.685 has 95 % of
        the efficiency of least squares for normal errors.
    few
        A point with fewer samples than this, and no variance given, has the plain fit
        (``robust=False``) unless there is evidence for the robust one; 0: always the robust.
    """

    l1_iterations: int = 16
    iterations: int = 8
    shadow: float = 0.1
    grazing: float = 0.05
    tuning: float = 4.685
    few: int = 16

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        check = Checks(PhotometricStereoError)
        check.settings(self, l1_iterations="[0, inf)", iterations="[1, inf)", few="[0, inf)")
        check.settings(self, shadow="[0, 1)", grazing="[0, 1)", tuning="[1, inf)")

    def settings(self, kind: Any) -> RobustFitLimits:
        """Return the limits of a fit in the data's type."""
        limits = RobustFitLimits(
            shadow=self.shadow,
            grazing=self.grazing,
            tuning=self.tuning,
            tolerance=1e-3,
            floor=1e-6 if kind is np.float32 else 1e-13,
            l1_soft=0.01,
            min_spread=1e-5,
            bright_part=1 / 8,
            dark_sigmas=3.0,
            dark_fit=1.5,
            min_agreeing=MIN_AGREEING_FRACTION,
            few=self.few,
            tight=TIGHT_RESIDUAL,
            clear=CLEAR_OUTLIER_RESIDUAL,
            loose=LOOSE_RESIDUAL,
        )
        return RobustFitLimits(*(kind(limit) for limit in limits))


def estimate_normals(
    intensity_nhw: FloatArray,
    light_directions_n3: ArrayLike,
    *,
    light_positions_mm: ArrayLike | None = None,
    points_mm: ArrayLike | None = None,
    light_intensity: ArrayLike | None = None,
    variance: ArrayLike | None = None,
    valid: BoolArray | None = None,
    robust: bool = True,
    robustness: Robustness | None = None,
    executor: Executor | None = None,
) -> NormalMaps:
    """Estimate normals and albedo from samples under N lights.

    Parameters
    ----------
    intensity_nhw : ndarray, shape (N, ...)
        Linear, black-subtracted samples of one channel under each light, any unit; points of any
        shape, images (N, H, W) or surface points (N, P). Whole numbers are read as they are.
    light_directions_n3 : array_like, shape (N, 3) or (N, ..., 3)
        Directions towards the lights, any length but zero; one per light, or one per light and
        point (then a zero vector omits the sample). Not read if positions are given.
    light_positions_mm : array_like, shape (N, 3), optional
        Positions of near lights, with `points_mm`; they give directions and the inverse square
        law.
    points_mm : array_like, shape (..., 3), optional
        Points of the surface, same frame.
    light_intensity : array_like, shape (N,) or (N, ...), optional
        Irradiance of a white surface by each light at normal incidence; with positions, times
        mm^2. Default: all equal, 1 (with positions: 1 at the median distance).
    variance : array_like, optional
        Of the samples: a number, (N,) or (N, ...). None: the same under all lights (relative to
        their intensity), estimated from the residuals; few lights give a poor estimate, see
        `Robustness.few`. Give the variance expected of a sample, not that of its own photon
        count: low counts would weigh most, see Notes.
    valid : ndarray of bool, shape (N, ...) or (...), optional
        Samples, or points, to use: not saturated, not occluded.
    robust : bool
        False: least squares of all valid samples, for matte surfaces under few lights. Without a
        variance, a sample's weight is then the square of its intensity, so that shadows have
        weight 0 and dark samples little.
    robustness : Robustness, optional
        Settings of the robust fit.
    executor : Executor, optional
        Threads to map tiles of points over; default one thread per core, at most 8.

    Returns
    -------
    NormalMaps
        float32, or float64 where `intensity_nhw` is float64.

    Raises
    ------
    PhotometricStereoError
        For shapes that do not fit, fewer than three lights, and directions that lie in a plane.

    Notes
    -----
    The robust fit begins with least absolute deviations by iteratively reweighted least squares
    over the samples that are not dark, and ends with Tukey's biweight over those that the fitted
    normal faces, with the noise from the median residual. Standard errors are those of an
    M-estimate (Huber 1981, doi 10.1002/0471725250, section 7.6); a given variance is trusted
    unless the residuals exceed it beyond chance.

    A variance from a sample's own photon count biases the albedo and its errors low: of 24 lights,
    3 photons per sample at normal incidence and half a photon of read noise the coverage of 68 %
    intervals of the albedo is 27 % (``robust=False``; 10 photons: 41, 100: 63). With the photons
    expected from a fit, the first one of equal variances and two from the fit before, it is 70 %
    (68, 69); at 1 photon it is 43 % in any case, as only the bright draws yield a normal.

    With few samples a median residual is weak evidence, and matte surfaces deviate from
    Lambert's law by a few percent, most where they are dark: rejected samples may be good.
    So below `Robustness.few` samples and without a variance, the fit of ``robust=False`` is kept
    unless the robust one leaves residuals of less than 2 % of a bright sample, or it makes at
    least one sample fewer a clear outlier; the more, the larger its own residuals are.

    Examples
    --------
    >>> lights = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [-0.6, 0, 0.8]])
    >>> image = 0.5 * (lights @ [0, 0, 1])[:, None, None] * np.ones((4, 2, 2))
    >>> found = estimate_normals(image, lights)
    >>> found.normals[0, 0].round(6).tolist(), found.albedo[0, 0].round(6).tolist()
    ([0.0, 0.0, 1.0], 0.5)
    """
    samples = np.asarray(intensity_nhw)
    check = Checks(PhotometricStereoError)
    check.choice("intensity", samples.dtype.kind, "fui")
    check.within("axes of intensity (N, ...)", samples.ndim, "[2, inf)")
    lights, shape = samples.shape[0], samples.shape[1:]
    check.within("lights of intensity", lights, "[3, inf)")
    kind: Any = np.float64 if samples.dtype == np.float64 else np.float32
    lit = _geometry(light_directions_n3, light_positions_mm, points_mm, lights, shape)
    strength = _strength(light_intensity, lit, lights, shape)
    chosen = robustness or Robustness()
    settings = chosen.settings(kind)
    count = int(np.prod(shape))
    flat = samples.reshape(lights, count)
    out = np.empty((count, kernels.RESULT_ROWS), kind)
    good = np.empty(count, bool)
    noise = _per_sample("variance", variance, lights, shape)
    mask = _usable(valid, lights, shape)
    # float32 keeps millimeters to 1e-4 at the size of a room
    shared, positions, points = (
        array.astype(kind, order="C") for array in (lit.shared, lit.positions, lit.points)
    )
    fit_points, near = kernels.fit_points(kind), lit.way == kernels.NEAR

    def solve(span: slice) -> None:
        each = lit.per_point[:, span] if lit.way == kernels.PER_POINT else lit.per_point
        fit_points(
            (
                *(_of_kind(array[:, span], kind) for array in (flat, noise)),
                mask[:, span],
                _of_kind(strength[:, span], kind),
            ),
            (shared, _of_kind(each, kind), positions, points[span] if near else points),
            lit.way,
            robust,
            variance is not None,
            chosen.l1_iterations,
            chosen.iterations,
            settings,
            out[span],
            good[span],
        )

    spans = [slice(a, min(a + TILE_POINTS, count)) for a in range(0, count, TILE_POINTS)]
    map_on_threads(solve, spans, executor)
    out[~good] = 0.0
    out[~good, kernels.STDERR] = np.pi
    out[~good, kernels.STDERR_ALBEDO] = np.inf
    maps = out.reshape(*shape, kernels.RESULT_ROWS)
    return NormalMaps(
        normals=np.ascontiguousarray(maps[..., :3]),
        albedo=maps[..., kernels.ALBEDO].copy(),
        residual=maps[..., kernels.RESIDUAL].copy(),
        valid=good.reshape(shape),
        stderr_rad=maps[..., kernels.STDERR].copy(),
        stderr_albedo=maps[..., kernels.STDERR_ALBEDO].copy(),
        used=maps[..., kernels.USED].astype(np.int32),
    )


def _of_kind(array: NDArray[Any], kind: Any) -> FloatArray:
    """Return an array of a type; one that repeats itself still does."""
    if array.dtype == kind:
        return array
    whole = tuple(slice(0, 1) if step == 0 else slice(None) for step in array.strides)
    return np.broadcast_to(array[whole].astype(kind), array.shape)


class _Geometry(NamedTuple):
    """Form of the light vectors, and the arrays of that form."""

    way: int
    shared: FloatArray = np.zeros((1, 3))
    per_point: FloatArray = np.zeros((1, 1, 3))
    positions: FloatArray = np.zeros((1, 3))
    points: FloatArray = np.zeros((1, 3))


def _geometry(
    directions: ArrayLike,
    positions: ArrayLike | None,
    points: ArrayLike | None,
    lights: int,
    shape: tuple[int, ...],
) -> _Geometry:
    if (positions is None) != (points is None):
        raise PhotometricStereoError(
            "light_positions_mm, points_mm: got one of the two, expected both or neither"
        )
    if positions is not None and points is not None:
        check = Checks(PhotometricStereoError)
        where = check.numbers("light_positions_mm", positions, (lights, 3))
        surface = np.asarray(points, np.float64)
        Checks(PhotometricStereoError).shape("points_mm", surface, (*shape, 3))
        return _Geometry(kernels.NEAR, positions=where, points=surface.reshape(-1, 3))
    towards = np.asarray(directions)
    if towards.shape == (lights, *shape, 3):
        return _Geometry(kernels.PER_POINT, per_point=towards.reshape(lights, -1, 3))
    towards = towards.astype(np.float64)
    Checks(PhotometricStereoError).shape(
        "light_directions", towards, (lights, 3), (lights, *shape, 3)
    )
    length = np.linalg.norm(towards, axis=1)
    wrong = np.flatnonzero(~np.isfinite(length) | (length == 0))
    if wrong.size:
        raise PhotometricStereoError(
            f"light_directions[{wrong[0]}]: got {towards[wrong[0]].tolist()}, expected a direction"
        )
    towards = towards / length[:, None]
    require_noncoplanar(towards)
    return _Geometry(kernels.SHARED, shared=towards)


def require_noncoplanar(directions: FloatArray) -> None:
    """Refuse unit vectors (N, 3) that lie in a plane through the surface point.

    Raises
    ------
    PhotometricStereoError
        Where no normal follows from lights in these directions.
    """
    *_, singular, axes = np.linalg.svd(np.asarray(directions, np.float64), full_matrices=True)
    least = MIN_SINGULAR_RATIO * singular[0]
    if len(singular) < 3 or singular[2] < least:
        unseen = axes[np.count_nonzero(singular >= least) :]
        ways = " and ".join(str(tuple(round(float(v), 2) + 0.0 for v in axis)) for axis in unseen)
        raise PhotometricStereoError(
            f"light_directions: got {len(directions)} lights in one line or plane with the surface"
            f" point, which show nothing of a normal along {ways}; expected directions that span"
            " space: move a light out of the plane"
        )


def _strength(
    intensity: ArrayLike | None, lit: _Geometry, lights: int, shape: tuple[int, ...]
) -> FloatArray:
    if intensity is None:
        level = 1.0
        if lit.way == kernels.NEAR:
            some = lit.points[:: max(1, len(lit.points) // 100)]
            distance = np.linalg.norm(lit.positions[:, None] - some[None], axis=-1)
            level = float(np.nanmedian(distance)) ** 2
        return np.broadcast_to(np.float32(level), (lights, int(np.prod(shape))))
    given = _per_sample("light_intensity", intensity, lights, shape)
    if given.strides[1] == 0 and not (np.isfinite(given).all() and (given >= 0).all()):
        raise PhotometricStereoError("light_intensity: expected finite numbers, 0 or more")
    return given


def _per_sample(
    name: str, values: ArrayLike | None, lights: int, shape: tuple[int, ...]
) -> FloatArray:
    """Return (N, P), as a view where it repeats itself."""
    count = int(np.prod(shape))
    if values is None:
        return np.broadcast_to(np.float32(1.0), (lights, count))
    given = np.asarray(values)
    if given.dtype not in (np.float32, np.float64):
        given = given.astype(np.float64)
    if given.shape == (lights, *shape):
        return given.reshape(lights, count)
    if given.shape in ((), (lights,)):
        return np.broadcast_to(given.reshape(-1, 1), (lights, count))
    raise PhotometricStereoError(
        f"{name}: got shape {given.shape}, expected (), {(lights,)} or {(lights, *shape)}"
    )


def _usable(valid: BoolArray | None, lights: int, shape: tuple[int, ...]) -> BoolArray:
    count = int(np.prod(shape))
    if valid is None:
        return np.broadcast_to(np.True_, (lights, count))
    mask = np.asarray(valid)
    Checks(PhotometricStereoError).mask("valid", mask, (lights, *shape), shape)
    if mask.shape == shape:
        return np.broadcast_to(mask.reshape(1, count), (lights, count))
    return mask.reshape(lights, count)
