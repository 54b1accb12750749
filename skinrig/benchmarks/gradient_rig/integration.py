"""Benchmark of normal integration against Frankot-Chellappa, cosines and a sparse direct solve."""

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import fft, sparse
from scipy.sparse.linalg import splu

from reconstruction.normal_integration import (
    IntegrationSettings,
    integrate,
    integrate_map,
    slope_fields,
)
from reconstruction.normal_integration.discontinuities import integrate_with_discontinuities
from reconstruction.normal_integration.height_filters import high_pass
from reconstruction.normal_integration.relief_errors import expected_height_rms
from skinrig.arrays import BoolArray, Float64Array, FloatArray
from skinrig.benchmarks.measurement import (
    LIMIT_CORES,
    measure_processor_seconds,
    measure_processor_time,
)
from skinrig.benchmarks.resampling import bootstrap_rms, split_squares
from skinrig.benchmarks.results import ErrorEstimate, Knobs
from skinrig.benchmarks.stage import BenchmarkStage, LimitValues

PIXEL_UM = 6.0
CUTOFF_UM = 1000.0
NORMAL_NOISE_RAD = np.radians(1.5)
"""Root mean square angle of the normals' noise."""
RELIEF_RMS_UM = 12.0


def synthesize_relief(side: int, *, rng: np.random.Generator) -> tuple[Float64Array, Float64Array]:
    """Synthesize a periodic relief of ridged cells on a bulge, and its exact normals (y up).

    Wavelengths are 90 um to 1 mm. Slopes are spectral derivatives of the height.

    Returns
    -------
    tuple of ndarray
        height (side, side) in um, normals (side, side, 3).
    """
    theta_y = 2.0 * np.pi * np.fft.fftfreq(side)[:, None]
    theta_x = 2.0 * np.pi * np.fft.rfftfreq(side)[None, :]
    theta = np.hypot(theta_x, theta_y)
    low, high = (2.0 * np.pi * PIXEL_UM / length for length in (CUTOFF_UM, 90.0))
    band = (theta / low) ** 2 * np.exp(-((theta / (0.45 * high)) ** 2))
    smooth = fft.irfft2(fft.rfft2(rng.standard_normal((side, side))) * band, (side, side))
    ridged = -np.abs(smooth / smooth.std())
    waves = fft.rfft2(ridged - ridged.mean()) * np.exp(-((theta / high) ** 2))
    waves[0, 0] = 0.0
    waves *= RELIEF_RMS_UM / fft.irfft2(waves, (side, side)).std()
    waves[1, 1] += 0.25 * side * side * 60.0  # the bulge
    # the derivative of the Nyquist wave is undefined and set to 0
    odd_x = np.where(theta_x >= np.pi - 1e-9, 0.0, theta_x)
    odd_y = np.where(np.abs(theta_y) >= np.pi - 1e-9, 0.0, theta_y)
    height = fft.irfft2(waves, (side, side))
    right = fft.irfft2(1j * odd_x * waves, (side, side)) / PIXEL_UM
    down = fft.irfft2(1j * odd_y * waves, (side, side)) / PIXEL_UM
    n = np.stack([-right, down, np.ones_like(height)], axis=-1)
    return height, n / np.linalg.norm(n, axis=-1, keepdims=True)


def frankot_chellappa(normals: Float64Array, *, pixel: float) -> Float64Array:
    """Integrate the slopes of a periodic image by the Fourier transform.

    Frankot and Chellappa 1988, doi 10.1109/34.3909: Z = -i (u P + v Q) / (u^2 + v^2).
    """
    gx, gy = -normals[..., 0] / normals[..., 2], normals[..., 1] / normals[..., 2]
    v = 2.0 * np.pi * np.fft.fftfreq(gx.shape[0])[:, None]
    u = 2.0 * np.pi * np.fft.rfftfreq(gx.shape[1])[None, :]
    squared = u * u + v * v
    squared[0, 0] = np.inf
    waves = -1j * (fft.rfft2(gx) * u + fft.rfft2(gy) * v) / squared
    return np.asarray(pixel * fft.irfft2(waves, gx.shape))


def sparse_direct(normals: Float64Array, valid: BoolArray, *, pixel: float) -> Float64Array:
    """Solve the same normal equations with SciPy's SuperLU, for one connected region."""
    ax, ay, dx, dy = slope_fields.edges(slope_fields.from_normals(normals, valid=valid), order=4)
    number = np.full(ax.shape, -1)
    inside = np.pad(valid, 1)
    number[inside] = np.arange(np.count_nonzero(inside))
    h, v = ax > 0, ay > 0
    begin = np.concatenate([number[h], number[v]])
    end = np.concatenate([number[np.roll(h, 1, axis=1)], number[np.roll(v, 1, axis=0)]])
    differences = np.concatenate([dx[h], dy[v]])
    ones, rows = np.ones(begin.size), np.arange(begin.size)
    D = sparse.csc_matrix(
        (np.concatenate([-ones, ones]), (np.tile(rows, 2), np.concatenate([begin, end]))),
        shape=(begin.size, int(number.max()) + 1),
    )
    A = (D.T @ D).tolil()
    A[0, 0] += 1.0  # fixes the free constant: the equations alone are singular
    x = splu(A.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(
        D.T @ differences
    )
    height = np.zeros(valid.shape)
    height[valid] = pixel * (x - x.mean())
    return height


def measure_integration(stage: BenchmarkStage) -> None:
    """Measure integration over tolerance, order, mask, noise and peers, then at full size."""
    rng = np.random.default_rng(0)
    side = 64 if stage.toy else 512
    truth, clean = synthesize_relief(side, rng=rng)
    noisy = clean + NORMAL_NOISE_RAD / np.sqrt(2.0) * rng.standard_normal(clean.shape)
    whole = np.ones((side, side), bool)
    disc = _disc(side)

    def add(
        method: str,
        call: Callable[[Float64Array], FloatArray],
        normals: Float64Array,
        valid: BoolArray,
        **effort: float,
    ) -> None:
        bound = None
        if normals is noisy:
            slope = NORMAL_NOISE_RAD / np.sqrt(2.0)
            bound = expected_height_rms(normals.shape[:2], slope, pixel=PIXEL_UM, cutoff=CUTOFF_UM)

        def error(height: FloatArray) -> ErrorEstimate:
            off = _high_passed(height - truth, valid)
            squares = [at for at in split_squares(len(off)) if valid[at].any()]
            tiles = [float(np.mean(off[at][valid[at]] ** 2)) for at in squares]
            low, high = bootstrap_rms(tiles, rng=rng).error_interval
            rms = float(np.sqrt(np.mean(off[valid] ** 2)))
            return ErrorEstimate(rms, (min(low, rms), max(high, rms)), bound)

        about: Knobs = {
            "noise": "1.5 deg" if normals is noisy else "none",
            "method": method,
            "mask": "none" if valid is whole else "disc",
        }
        stage.measure(about | effort, lambda: call(normals), error)

    def ours(valid: BoolArray, **options: object) -> Callable[[Float64Array], NDArray]:
        return lambda n: integrate(n, pixel=PIXEL_UM, valid=valid, **options)  # type: ignore[arg-type]

    for normals in (clean, noisy):
        for tolerance in (1e-2, 1e-5) if stage.toy else (1e-1, 1e-2, 1e-3, 1e-5, 1e-7):
            solve = ours(disc, settings=IntegrationSettings(tolerance=tolerance))
            add("multigrid", solve, normals, disc, tolerance=tolerance)
        add("multigrid", ours(disc, settings=IntegrationSettings(order=2)), normals, disc, order=2)
        add("cosines", ours(whole), normals, whole)
        by_fourier = partial(frankot_chellappa, pixel=PIXEL_UM)
        add("Frankot-Chellappa", by_fourier, normals, whole)
    denoised = ours(disc, stderr_rad=NORMAL_NOISE_RAD, denoise=1.0)
    bilateral = partial(integrate_with_discontinuities, pixel=PIXEL_UM, valid=disc)
    direct = partial(sparse_direct, valid=disc, pixel=PIXEL_UM)
    add("multigrid", denoised, noisy, disc, denoise=1)
    add("bilateral", lambda n: bilateral(n).height, noisy, disc)
    add("sparse direct", direct, clean, disc)
    if stage.toy:
        return
    error = _high_passed(integrate(noisy, pixel=PIXEL_UM, valid=disc) - truth, disc)
    size = np.std(_high_passed(truth, disc)[disc])
    stage.limits = {"relative_rms": float(np.std(error[disc]) / size), **_full_size(rng)}


def _high_passed(height: FloatArray, valid: BoolArray) -> FloatArray:
    return high_pass(np.where(valid, height, 0.0), pixel=PIXEL_UM, cutoff=CUTOFF_UM, valid=valid)


def _disc(side: int) -> BoolArray:
    y, x = np.mgrid[0:side, 0:side] - 0.5 * side
    holes = (x - 0.1 * side) ** 2 + (y + 0.2 * side) ** 2 < (0.05 * side) ** 2
    return np.asarray((x * x + y * y < (0.47 * side) ** 2) & ~holes)


def _full_size(rng: np.random.Generator) -> LimitValues:
    """Measure 2048 x 2048 with a mask, and 1024 x 1024 with discontinuities."""
    _, normals = synthesize_relief(2048, rng=rng)
    noisy = (normals + NORMAL_NOISE_RAD / np.sqrt(2.0) * rng.standard_normal(normals.shape)).astype(
        np.float32
    )
    disc = _disc(2048)
    integrate_map(noisy[:64, :64], method="multigrid")
    spent_s, found = measure_processor_time(
        lambda: integrate_map(noisy, pixel=PIXEL_UM, valid=disc), 3
    )
    small = np.ascontiguousarray(noisy[:1024, :1024])
    integrate_with_discontinuities(small[:64, :64])
    broken_s = measure_processor_seconds(
        lambda: integrate_with_discontinuities(small, pixel=PIXEL_UM), 3
    )
    part = _disc(512)
    flat = np.asarray(noisy[:512, :512], float)
    ours_s, mine = measure_processor_time(lambda: integrate(flat, pixel=PIXEL_UM, valid=part), 3)
    peer_s, theirs = measure_processor_time(lambda: sparse_direct(flat, part, pixel=PIXEL_UM))
    return {
        "seconds": spent_s / LIMIT_CORES,
        "residual": found.convergence.residual,
        "bilateral_s": broken_s / LIMIT_CORES,
        "speed_up": peer_s / ours_s,
        "difference": float(np.abs(mine - theirs)[part].max() / np.std(theirs[part])),
    }
