"""Normals refined by rendering: turned until a fitted BRDF explains the samples best."""

from collections.abc import Callable
from concurrent.futures import Executor

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.checks import require_shapes
from reconstruction.normal_maps import NormalMaps, PhotometricStereoError
from reconstruction.tiles import map_on_threads

Predict = Callable[[Float64Array, Float64Array, Float64Array, NDArray[np.intp]], ArrayLike]
"""(normals (P, 3), light_dir (P, M, 3), view_dir (P, M, 3), points (P,)) -> f_r (P, M), 1/sr."""

TILE_SAMPLES = 500_000
TUKEY_CONSTANT = 4.685
TUKEY_EFFICIENCY = 0.95  # of the biweight with that constant
_NORMAL_MAD = 0.6744897501960817
_STEP_RAD = 1e-4  # of the one-sided difference quotients


def refine(
    values: FloatArray,
    light_dir: FloatArray,
    view_dir: FloatArray,
    normals: FloatArray,
    predict: Predict | FloatArray,
    *,
    variance: ArrayLike | None = None,
    valid: BoolArray | None = None,
    iterations: int = 6,
    free_scale: bool = True,
    most_rad: float = 0.35,
    grazing: float = 0.1,
    executor: Executor | None = None,
) -> NormalMaps:
    """Refine normals by Gauss-Newton steps on the difference between samples and rendering.

    Parameters
    ----------
    values : ndarray, shape (P, M)
        Radiance over the irradiance at normal incidence, f_r cos(theta), 1/sr. The cosine is in
        it on purpose: it tells most about the normal.
    light_dir, view_dir : ndarray, shape (P, M, 3)
        Unit vectors from the points to lights and cameras.
    normals : ndarray, shape (P, 3)
        Where to begin; a zero vector leaves a point out.
    predict : callable or ndarray, shape (P, M)
        The fitted BRDF: called with the normals (P, 3), light_dir, view_dir and the indices of the
        points, it returns f_r (P, M) in 1/sr; an array holds f_r as it is, which is then taken not
        to turn with the normal.
    variance : array_like, broadcastable to (P, M), optional
        Of `values`. Where None the noise is taken to be the same in all samples of a point.
    valid : ndarray of bool, shape (P, M), optional
        Samples to use.
    iterations : int
        Most Gauss-Newton steps.
    free_scale : bool
        Fit a factor of the whole BRDF too, so that an albedo that is off does not turn normals.
    most_rad : float
        Farthest a normal may turn from where it began, rad; farther means that it was not found.
    grazing : float
        Cosine of incidence or view below which a sample does not count.
    executor : Executor, optional
        Threads to map tiles over; default one thread a core, at most 8.

    Returns
    -------
    NormalMaps
        float64; `albedo` is the factor of the BRDF, `residual` in the unit of `values`.

    Raises
    ------
    PhotometricStereoError
        For shapes that do not fit.
    """
    samples = np.asarray(values)
    if samples.ndim != 2:
        raise PhotometricStereoError(f"values: got shape {samples.shape}, expected (P, M)")
    points, count = samples.shape
    require_shapes(
        PhotometricStereoError,
        ("light_dir", light_dir, (points, count, 3)),
        ("view_dir", view_dir, (points, count, 3)),
        ("normals", normals, (points, 3)),
        ("valid", valid, (points, count)),
        ("predict", None if callable(predict) else predict, (points, count)),
    )
    noise = None
    if variance is not None:
        try:
            noise = np.broadcast_to(np.asarray(variance), samples.shape)
        except ValueError as exc:
            raise PhotometricStereoError(
                f"variance: got shape {np.shape(variance)}, expected one like {samples.shape}"
            ) from exc

    def solve(chosen: NDArray[np.intp]) -> NormalMaps:
        fixed = None if callable(predict) else np.asarray(predict[chosen], np.float64)
        way = np.asarray(light_dir[chosen], np.float64)
        out = np.asarray(view_dir[chosen], np.float64)

        def render(n: Float64Array) -> Float64Array:
            f_r = fixed if fixed is not None else predict(n, way, out, chosen)  # type: ignore[operator]
            return np.asarray(f_r, np.float64) * np.maximum(_dots(way, n), 0.0)

        return _refine_tile(
            np.asarray(samples[chosen], np.float64),
            way,
            out,
            np.asarray(normals[chosen], np.float64),
            render,
            None if noise is None else np.asarray(noise[chosen], np.float64),
            None if valid is None else np.asarray(valid[chosen]),
            iterations,
            free_scale,
            most_rad,
            grazing,
        )

    size = max(1, TILE_SAMPLES // max(count, 1))
    tiles = [np.arange(a, min(a + size, points)) for a in range(0, points, size)]
    done = map_on_threads(solve, tiles, executor, window=4)
    names = ("normals", "albedo", "residual", "valid", "stderr_rad", "stderr_albedo", "used")
    if not done:
        return NormalMaps(np.zeros((0, 3)), *(np.zeros(0) for _ in names[1:]))  # type: ignore[arg-type]
    return NormalMaps(*(np.concatenate([getattr(tile, name) for tile in done]) for name in names))


def _dots(directions: Float64Array, normals: Float64Array) -> Float64Array:
    return np.asarray(np.einsum("pmk,pk->pm", directions, normals))


def _turned(
    normals: Float64Array, s: Float64Array, t: Float64Array, a: Float64Array, b: Float64Array
) -> Float64Array:
    return unit_vectors(normals + a[:, None] * s + b[:, None] * t)


def _tangents(normals: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return two unit vectors across each normal."""
    x, y, z = np.moveaxis(normals, -1, 0)
    sign = np.where(z >= 0, 1.0, -1.0)  # Duff et al. 2017, Building an orthonormal basis, revisited
    a = -1.0 / (sign + z)
    b = x * y * a
    s = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    return s, np.stack([b, sign + y * y * a, -y], axis=-1)


def _refine_tile(
    samples: Float64Array,
    light_dir: Float64Array,
    view_dir: Float64Array,
    start: Float64Array,
    render: Callable[[Float64Array], Float64Array],
    noise: Float64Array | None,
    valid: BoolArray | None,
    iterations: int,
    free_scale: bool,
    most_rad: float,
    grazing: float,
) -> NormalMaps:
    good = np.isfinite(samples) & np.isfinite(light_dir).all(-1) & np.isfinite(view_dir).all(-1)
    if valid is not None:
        good &= valid
    weight = np.ones_like(samples)
    if noise is not None:
        good &= np.isfinite(noise) & (noise > 0)
        weight = 1.0 / np.sqrt(np.where(good, noise, 1.0))
    samples = np.where(good, samples, 0.0)
    length = np.linalg.norm(start, axis=-1)
    begun = np.isfinite(length) & (length > 0)
    n = unit_vectors(np.where(begun[:, None], start, [0.0, 0.0, 1.0]))
    first, factor = n, np.ones(len(n))
    unknowns = 3 if free_scale else 2
    known = noise is not None
    for step in range(iterations + 1):
        seen = good & (_dots(light_dir, n) > grazing) & (_dots(view_dir, n) > grazing)
        model = np.where(seen, render(n), 0.0)
        seen &= np.isfinite(model)
        model = np.where(seen, model, 0.0)
        if step == 0 and free_scale:
            factor = _ratio(samples, model, weight * seen)
        r = np.where(seen, (samples - factor[:, None] * model) * weight, 0.0)
        scale = _scale(r, seen, unknowns, 1.0 if known else 0.0)
        u2 = np.square(r / (TUKEY_CONSTANT * scale[:, None]))
        w = np.where(seen & (u2 < 1), (1 - u2) ** 2, 0.0)
        s, t = _tangents(n)
        zero, h = np.zeros(len(n)), np.full(len(n), _STEP_RAD)
        columns = [
            (render(_turned(n, s, t, h, zero)) - model) / _STEP_RAD,
            (render(_turned(n, s, t, zero, h)) - model) / _STEP_RAD,
        ]
        columns = [factor[:, None] * c for c in columns]
        if free_scale:
            columns.append(model)
        J = np.stack(columns, axis=-1)
        J = np.where(np.isfinite(J) & seen[..., None], J, 0.0) * weight[..., None]
        A = np.einsum("pm,pmi,pmj->pij", w, J, J)
        if step == iterations:
            break
        g = np.einsum("pm,pmi,pm->pi", w, J, r)
        move = _solved(A, g)
        reach = np.hypot(move[:, 0], move[:, 1])
        shorter = np.minimum(1.0, 0.1 / np.maximum(reach, 1e-30))
        n = _turned(n, s, t, move[:, 0] * shorter, move[:, 1] * shorter)
        if free_scale:
            factor = np.maximum(factor + shorter * move[:, 2], 1e-3 * factor)
        if float(np.max(reach, initial=0.0)) < 1e-6:
            iterations = step + 1  # one more pass for the errors
    near = begun & (np.linalg.norm(n - first, axis=-1) < 2 * np.sin(most_rad / 2))
    return _judged(n, near, factor, r, seen & (w > 0), weight, J, u2, known)


def _ratio(samples: Float64Array, model: Float64Array, weight: Float64Array) -> Float64Array:
    """Return a first factor: the ratio of sums, which few outliers move little."""
    total = np.sum(model * weight, axis=-1)
    ratio = np.sum(samples * weight, axis=-1) / np.where(total > 0, total, 1.0)
    return np.where((total > 0) & (ratio > 0), ratio, 1.0)


def _scale(r: Float64Array, seen: BoolArray, unknowns: int, least: float) -> Float64Array:
    """Return the scale of residuals from their median, without those that any fit makes 0."""
    count = np.count_nonzero(seen, axis=-1)
    ordered = np.sort(np.where(seen, np.abs(r), np.inf), axis=-1)
    rank = np.clip(unknowns + (count - unknowns) // 2, 0, r.shape[1] - 1)
    middle = np.take_along_axis(ordered, rank[:, None], axis=-1)[:, 0]
    few = 1.0 + 5.0 / np.maximum(
        count - unknowns, 1
    )  # Rousseeuw and Leroy (1987), ch. 5, eq. (1.3)
    scale = np.where(np.isfinite(middle), middle / _NORMAL_MAD * few, 1.0)
    size = np.max(np.abs(r), axis=-1, initial=0.0)
    return np.maximum(np.maximum(scale, least), 1e-12 * size + 1e-300)


def _solved(A: Float64Array, g: Float64Array) -> Float64Array:
    """Solve with a ridge that bounds what the samples do not tell."""
    diagonal = np.einsum("pii->pi", A)
    ridge = 1e-6 * diagonal + 1e-9 * diagonal.max(axis=-1, initial=0.0, keepdims=True) + 1e-300
    return np.linalg.solve(A + ridge[..., None] * np.eye(A.shape[-1]), g[..., None])[..., 0]


def _judged(
    n: Float64Array,
    near: BoolArray,
    factor: Float64Array,
    r: Float64Array,
    used: BoolArray,
    weight: Float64Array,
    J: Float64Array,
    u2: Float64Array,
    known: bool,
) -> NormalMaps:
    unknowns = J.shape[-1]
    count = np.count_nonzero(used, axis=-1)
    free = np.maximum(count - unknowns, 1)
    psi = np.where(used, r * (1 - u2) ** 2, 0.0)
    slope = np.sum(np.where(used, (1 - u2) * (1 - 5 * u2), 0.0), axis=-1) / np.maximum(count, 1)
    slope = np.maximum(slope, 0.1)
    sigma2 = np.sum(psi**2, axis=-1) / free / slope**2  # Huber (1981), section 7.6
    if known:
        beyond = (1.0 + 3.0 * np.sqrt(2.0 / free)) / TUKEY_EFFICIENCY
        sigma2 = np.where(sigma2 > beyond, sigma2, 1.0 / TUKEY_EFFICIENCY)
    B = np.einsum("pm,pmi,pmj->pij", used.astype(np.float64), J, J)
    size = np.sqrt(np.maximum(np.einsum("pii->pi", B), 1e-300))
    correlation = B / (size[:, :, None] * size[:, None, :])
    told = np.linalg.eigvalsh(correlation)[:, 0] > 1e-6
    ok = near & told & (count > unknowns)
    safe = np.where(ok[:, None, None], correlation, np.eye(unknowns))
    covariance = np.linalg.inv(safe) / (size[:, :, None] * size[:, None, :])
    stderr = np.sqrt(sigma2 * (covariance[:, 0, 0] + covariance[:, 1, 1]))
    ok &= stderr < 1.0
    error = np.sqrt(sigma2 * covariance[:, 2, 2]) if unknowns == 3 else np.zeros(len(n))
    raw = np.where(used, r / weight, 0.0)
    rms = np.sqrt(np.sum(raw**2, axis=-1) / np.maximum(count, 1))
    return NormalMaps(
        normals=np.where(ok[:, None], n, 0.0),
        albedo=np.where(ok, factor, 0.0),
        residual=np.where(ok, rms, 0.0),
        valid=ok,
        stderr_rad=np.where(ok, stderr, np.pi),
        stderr_albedo=np.where(ok, error, np.inf),
        used=np.where(ok, count, 0).astype(np.int32),
    )
