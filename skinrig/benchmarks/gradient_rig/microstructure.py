"""Benchmarks of reliefs under strain: against skin in equilibrium, and of the convolution."""

import math
import tempfile
import tracemalloc
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from model.microstructure import FOREHEAD, KernelTable, kernel_parameters
from model.microstructure.convolution import (
    LineKernels,
    Sampling,
    convolve,
    convolve_tiled,
    list_tiles,
)
from model.microstructure.map_windows import MapWindow
from model.microstructure.mesh_strain import strain
from model.microstructure.strain_fields import rasterize
from reconstruction import kernel_fit, normal_histogram
from reconstruction.kernel_fit import table as kernel_table
from reconstruction.normal_histogram import relief_slopes
from rigsim.skin_patch.microrelief import MicroSkin, make_micro_skin
from rigsim.skin_patch.stretch import StretchedSkin, stretch_skin
from skinrig.arrays import Float32Array, Float64Array, FloatArray
from skinrig.benchmarks.measurement import LIMIT_CORES, measure_processor_seconds
from skinrig.benchmarks.resampling import mean_error
from skinrig.benchmarks.results import Knobs
from skinrig.benchmarks.stage import BenchmarkStage, LimitValues
from skinrig.extremes.inputs import sheet_faces

TEXEL_UM = 10.0
FITTED_STRETCHES = (0.76, 0.82, 0.88, 0.94, 1.06, 1.12, 1.18, 1.25)
"""Stretch ratios to which the table is fitted, on other patches than the evaluated ones."""
EVALUATED_STRETCHES = (0.8, 0.9, 1.1, 1.2)
SEARCHED_ALPHAS = np.round(np.arange(-2.0, 1.001, 0.05), 2)
SEARCHED_SIGMAS_UM = np.arange(4.0, 101.0, 4.0)
JAW_CONDITIONS: tuple[tuple[float, Literal["none", "volume"]], ...] = (
    (0.0, "none"),
    (30.0, "none"),
    (30.0, "volume"),
)
"""Direction of the jaws, deg, and strain across them. Kernels are fitted at constant width; with
transverse strain both passes act."""
FULL_SIDE_PX = 4096
PEER_ROWS = 256
"""Rows of the full map on which the NumPy convolution is timed."""
TILED_SIDE_PX = 16_384
GRADUAL_CHANGE_PER_SIGMA = 0.02
"""Rotation of axes, rad, and relative change of sigma, per sigma, that count as gradual."""
N_WAVES = 60


def strained_slopes(
    height: NDArray[Any], state: StretchedSkin
) -> tuple[Float64Array, Float64Array]:
    """Return slopes along and across the jaws of a relief in texels that deform with the skin."""
    dx, dy, known = relief_slopes.slopes(height, pixel=TEXEL_UM)
    # chain rule: a gradient in deformed coordinates is F^-T times that in texel coordinates
    inverse = np.linalg.inv(state.gradient)
    along_x = dx[known] * inverse[0, 0] + dy[known] * inverse[1, 0]
    along_y = dx[known] * inverse[0, 1] + dy[known] * inverse[1, 1]
    return relief_slopes.rotate_components(along_x, along_y, math.radians(state.angle_deg))


def fit_kernel_table(
    skins: list[MicroSkin], states: tuple[float, ...], *, every: int = 1
) -> KernelTable:
    """Fit a kernel table as from caliper sessions: each state's kernel, then lines through them.

    Parameters
    ----------
    skins, states
        Patches with texels of `TEXEL_UM`, and the stretch ratios of each.
    every
        Step of the searched grid of kernels.
    """
    found = []
    for skin in skins:
        for r in states:
            settled = stretch_skin(skin, stretch=r, angle_deg=0.0, compensation="none")
            target = normal_histogram.histogram(
                settled.height_um, pixel=(TEXEL_UM, TEXEL_UM * settled.stretch_s)
            )
            fit = kernel_fit.fit_kernel(
                skin.height_um,
                target,
                stretch=r,
                axis="x",
                pixel_um=TEXEL_UM,
                grid=(SEARCHED_ALPHAS[::every], SEARCHED_SIGMAS_UM[::every]),
            )
            found.append((r, fit.alpha, fit.sigma_um))
    r, alpha, sigma = np.array(found).T
    return kernel_table.fit_table(r, alpha, sigma, source="fitted to settled skin").table


def strain_relief(
    skin: MicroSkin, state: StretchedSkin, table: KernelTable, sampling: Sampling
) -> Float32Array:
    """Return the neutral relief convolved with the kernels of a table for a state of strain."""
    angle = math.radians(state.angle_deg)
    alpha, sigma_um = kernel_parameters([state.stretch_s, state.stretch_t], table)
    return convolve(
        skin.height_um,
        (math.cos(angle), -math.sin(angle)),
        (math.sin(angle), math.cos(angle)),  # rows increase downwards
        alpha[0],
        sigma_um[0] / TEXEL_UM,
        alpha[1],
        sigma_um[1] / TEXEL_UM,
        sampling=sampling,
    )


def _slope_errors(made: Float32Array, state: StretchedSkin) -> tuple[float, float]:
    """Return the distance of normal histograms from the equilibrium's, and |log variance ratio|."""
    there, ours = strained_slopes(state.height_um, state), strained_slopes(made, state)
    distance = normal_histogram.distance(
        normal_histogram.from_slopes(*there), normal_histogram.from_slopes(*ours)
    )
    return distance, abs(math.log(ours[0].var() / there[0].var()))


def measure_kernel_maps(stage: BenchmarkStage) -> None:
    """Measure convolved reliefs against the equilibrium of a stiff layer; time the convolution."""
    patch = partial(
        make_micro_skin, "forehead", size_mm=0.8 if stage.toy else 2.4, texel_um=TEXEL_UM
    )
    states = (0.82, 0.94, 1.06, 1.18) if stage.toy else FITTED_STRETCHES
    table = fit_kernel_table([patch(seed=1)], states, every=4 if stage.toy else 1)
    skins = [patch(seed=seed) for seed in ((7, 8) if stage.toy else (7, 8, 9))]
    methods: list[tuple[str, KernelTable | None, Sampling]] = [
        ("none", None, "cubic"),
        ("the paper's forehead", FOREHEAD, "cubic"),
        ("fitted", table, "cubic"),
        ("fitted", table, "linear"),
    ]
    found: dict[tuple[str, str, str], tuple[float, float]] = {}
    for angle, across in JAW_CONDITIONS[-1:] if stage.toy else JAW_CONDITIONS:
        pairs = [
            (skin, stretch_skin(skin, stretch=r, angle_deg=angle, compensation=across))
            for skin in skins
            for r in (EVALUATED_STRETCHES[::3] if stage.toy else EVALUATED_STRETCHES)
        ]
        for name, kernels, sampling in methods:
            if sampling == "linear" and across == "none":
                continue
            timing, made = stage.time(
                lambda: [
                    skin.height_um
                    if kernels is None
                    else strain_relief(skin, state, kernels, sampling)
                    for skin, state in pairs
                ],
                repeats=1,
                memory=False,
            )
            states_of = zip(made, pairs, strict=True)
            off, wrong = np.array([_slope_errors(one, state) for one, (_, state) in states_of]).T
            outcome = mean_error(off.reshape(len(skins), -1).mean(axis=1))
            variance = float(np.mean(wrong))
            found[name, across, sampling] = outcome.error, variance
            knobs: Knobs = {"kernels": name, "jaws_deg": angle}
            knobs |= {"across": across, "sampling": sampling}
            also = {"variance_error_percent": 100.0 * math.expm1(variance)}
            stage.add(knobs, timing, outcome, also)
    if stage.toy:
        return
    kept, by_volume = (
        np.divide(found["fitted", across, "cubic"], found["none", across, "cubic"]).tolist()
        for across in ("none", "volume")
    )
    names = ("normals", "variance", "normals_volume", "variance_volume")
    stage.limits |= zip(names, (*kept, *by_volume), strict=True)
    stage.limits |= _full_size()


def synthesize_kernel_fields(
    side: int, rows: int, *, first_row: int = 0
) -> tuple[Float32Array, ...]:
    """Synthesize face-like fields of axes, strengths and sigmas with blurred and sharpened parts.

    Parameters
    ----------
    side, rows, first_row
        Side of the whole map, and number and first of the returned rows.

    Returns
    -------
    axis_s, axis_t, alpha_s, sigma_s, alpha_t, sigma_t
        float32, shapes (rows, side[, 2]).
    """
    y = (np.arange(first_row, first_row + rows, dtype=np.float32)[:, None] / side) * np.float32(9.0)
    x = (np.arange(side, dtype=np.float32)[None, :] / side) * np.float32(9.0)
    angle = 1.3 * np.sin(x) + 0.8 * np.cos(y)
    c, s = np.cos(angle), np.sin(angle)
    alpha = np.clip(1.2 * np.sin(x + 1.0) * np.cos(y), -2.0, 1.0)
    sigma = 1.5 * (1.0 + 0.6 * np.sin(x + y))
    return tuple(
        np.ascontiguousarray(values, np.float32)
        for values in (
            np.stack([c, s], -1),
            np.stack([-s, c], -1),
            alpha,
            sigma,
            np.minimum(-alpha, 1.0),
            0.9 * sigma,
        )
    )


def convolve_with_numpy(height: Float32Array, fields: tuple[Float32Array, ...]) -> Float32Array:
    """Convolve by eqs. (4)-(6) with vectorized NumPy and SciPy and bilinear samples."""
    axis_s, axis_t, alpha_s, sigma_s, alpha_t, sigma_t = fields
    y, x = np.mgrid[: height.shape[0], : height.shape[1]].astype(np.float32)
    for axis, alpha, sigma in ((axis_s, alpha_s, sigma_s), (axis_t, alpha_t, sigma_t)):
        total, norm = height.copy(), np.ones_like(height)
        radius = np.floor(4.0 * sigma + 0.5)
        for i in range(1, int(radius.max()) + 1):
            w = np.where(i <= radius, np.exp(-0.5 * (i / sigma) ** 2), 0.0)
            for step in (i, -i):
                at = (y + step * axis[..., 1], x + step * axis[..., 0])
                total += w * map_coordinates(height, at, order=1, mode="reflect")
            norm += 2.0 * w
        height = (1.0 - alpha) * height + alpha * total / norm
    return height


def _full_size() -> LimitValues:
    """Time 4096 x 4096 against NumPy on a strip, the fields of a texture, and tiles of 16K."""
    rng = np.random.default_rng(0)
    height = rng.standard_normal((FULL_SIDE_PX, FULL_SIDE_PX), np.float32)
    fields = synthesize_kernel_fields(FULL_SIDE_PX, FULL_SIDE_PX)
    own: dict[str, float] = {}
    both: tuple[Sampling, ...] = ("cubic", "linear")
    for sampling in both:
        run = partial(convolve, height, *fields, sampling=sampling)
        run()
        own[sampling] = measure_processor_seconds(run, 2) / LIMIT_CORES
    strip = height[:PEER_ROWS]
    own_strip = tuple(values[:PEER_ROWS] for values in fields)
    peer_s = (
        measure_processor_seconds(lambda: convolve_with_numpy(strip, own_strip))
        * FULL_SIDE_PX
        / PEER_ROWS
    )
    mismatch = np.abs(
        convolve_with_numpy(strip, own_strip) - convolve(strip, *own_strip, sampling="linear")
    ).max()
    del fields, height
    raster_s = measure_processor_seconds(_rasterized(FULL_SIDE_PX), 2) / LIMIT_CORES
    tile_s, peak_mb = _tiles_of_16k()
    return {
        "speed_up": peer_s / own["cubic"],
        "speed_up_linear": peer_s / own["linear"],
        "difference": float(mismatch),
        "seconds": own["cubic"],
        "strain_s": raster_s,
        "tiles_s": tile_s,
        "tiles_mb": peak_mb,
    }


def _rasterized(side: int) -> Callable[[], object]:
    """Return a function that rasterizes the strain of a sheet of 18,432 triangles."""
    n = 97
    at = np.linspace(0.0, 1.0, n)
    u, v = np.meshgrid(at, at)
    points = 200.0 * np.stack([u, v, 0.2 * np.sin(6.0 * u)], axis=-1).reshape(-1, 3)
    faces = sheet_faces(n)
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    moved = points + 4.0 * np.sin(points[:, [1, 2, 0]] / 20.0)
    found = strain(points, moved, faces, uv)
    return lambda: rasterize(found, faces, uv, (side, side))


def _tiles_of_16k() -> tuple[float, float]:
    """Return processor seconds per core for 16K, extrapolated from two tiles, and peak MB."""
    shape = (TILED_SIDE_PX, TILED_SIDE_PX)
    count = len(list_tiles(shape, 2048))
    chosen = (0, count // 2 + 3)

    def fields_at(window: MapWindow) -> tuple[LineKernels, LineKernels]:
        s, t, alpha_s, sigma_s, alpha_t, sigma_t = (
            np.ascontiguousarray(values[:, window.columns])
            for values in synthesize_kernel_fields(
                TILED_SIDE_PX, window.shape[0], first_row=window.top
            )
        )
        return LineKernels(s, alpha_s, sigma_s), LineKernels(t, alpha_t, sigma_t)

    with tempfile.TemporaryDirectory() as folder:
        source = np.memmap(Path(folder) / "neutral", np.float32, "w+", shape=shape)
        target = np.memmap(Path(folder) / "strained", np.float32, "w+", shape=shape)
        run = partial(
            convolve_tiled,
            source,
            target,
            fields_at,
            finished=[number for number in range(count) if number not in chosen],
        )
        spent = measure_processor_seconds(run)
        tracemalloc.start()
        try:
            run()
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        del source, target
    return spent / LIMIT_CORES * count / len(chosen), peak / 1e6


def synthesize_waves(
    side: int, sigma_px: float, *, rng: np.random.Generator
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Draw wave vectors (N, 2), rad per px, amplitudes and phases of a relief of N waves.

    Wavelengths are 4 to 12 sigmas, at least 5 px, where kernels have the largest effect.
    """
    length = sigma_px * rng.uniform(4.0, 12.0, N_WAVES)
    k = 2.0 * np.pi / np.maximum(length, 5.0)
    direction = rng.uniform(0.0, np.pi, N_WAVES)
    vectors = k[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    return vectors, np.full(N_WAVES, N_WAVES**-0.5), rng.uniform(0.0, 2.0 * np.pi, N_WAVES)


def measure_two_pass_error(
    *,
    rotation_rad: float,
    growth: float,
    sigma_px: float = 3.0,
    side: int = 160,
    sampling: Sampling = "cubic",
    rng: np.random.Generator,
) -> tuple[float, Callable[[], FloatArray]]:
    """Return the error of two passes against the exact convolution with a varying kernel.

    The exact result (eqs. 1 and 2, with the kernel of the output pixel) of a relief of waves has a
    closed form: each wave is scaled by the frequency response of the pixel's kernel.

    Parameters
    ----------
    rotation_rad, growth
        Rotation of the axes, rad, and largest relative change of sigma, per sigma.
    sigma_px
        Sigma in the middle of the map, px.
    side
        Side of the map, px.
    sampling
        Interpolation of samples.
    rng
        Generator of the waves.

    Returns
    -------
    error : float
        RMS of the difference over that of the change by the exact convolution.
    call : callable
        The convolution, for timing.
    """
    alpha = (0.8, -1.2)  # strengths along s and t
    margin = round(10.0 * sigma_px)
    whole = side + 2 * margin
    y, x = np.mgrid[:whole, :whole].astype(np.float64) - 0.5 * (whole - 1)
    vectors, amplitudes, phases = synthesize_waves(side, sigma_px, rng=rng)
    angle = 0.4 + rotation_rad / sigma_px * (x * np.cos(0.9) + y * np.sin(0.9))
    sigma = sigma_px * (1.0 + 0.5 * np.sin(2.0 * growth / sigma_px * (0.9 * x - 0.44 * y)))
    axis_s = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    axis_t = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    height, expected = np.zeros((2, whole, whole))
    for vector, amplitude, phase in zip(vectors, amplitudes, phases, strict=True):
        wave = amplitude * np.cos(vector[0] * x + vector[1] * y + phase)
        response = np.ones((whole, whole))
        for axis, strength in ((axis_s, alpha[0]), (axis_t, alpha[1])):
            # response of (1 - alpha) delta + alpha G: 1 - alpha + alpha exp(-(sigma k)^2 / 2)
            along = axis @ vector
            response *= 1.0 - strength + strength * np.exp(-0.5 * (sigma * along) ** 2)
        height += wave
        expected += response * wave
    inner = slice(margin, -margin), slice(margin, -margin)
    stored = height.astype(np.float32)

    def call() -> FloatArray:
        return convolve(stored, axis_s, axis_t, alpha[0], sigma, alpha[1], sigma, sampling=sampling)

    off = (call() - expected)[inner]
    change = (expected - height)[inner]
    return float(np.sqrt(np.mean(off**2) / np.mean(change**2))), call


def measure_two_passes(stage: BenchmarkStage) -> None:
    """Measure two passes against the exact convolution over rotation, growth, samples, sigma."""
    tried = [(0.0, 0.0), (0.1, 0.0), (0.0, 0.1)]
    if not stage.toy:
        values = (0.01, GRADUAL_CHANGE_PER_SIGMA, 0.05, 0.1, 0.2)
        tried = [(0.0, 0.0), *((v, 0.0) for v in values), *((0.0, v) for v in values)]
    efforts: dict[Sampling, list[tuple[float, float]]] = {"cubic": tried, "linear": tried[::5]}
    for sigma_px in (2.0,) if stage.toy else (1.5, 3.0):
        for sampling, rotation, growth in (
            (s, *pair) for s, pairs in efforts.items() for pair in pairs
        ):
            found = []
            for seed in range(2 if stage.toy else 3):
                error, call = measure_two_pass_error(
                    rotation_rad=rotation,
                    growth=growth,
                    sigma_px=sigma_px,
                    sampling=sampling,
                    side=48 if stage.toy else 160,
                    rng=np.random.default_rng(seed),
                )
                found.append(100.0 * error)
            knobs: Knobs = {"turn_rad_per_sigma": rotation, "growth_per_sigma": growth}
            knobs |= {"sigma_px": sigma_px, "sampling": sampling}
            stage.add(knobs, stage.time(call, repeats=1, memory=False)[0], mean_error(found))
    if not stage.toy:
        gradual = GRADUAL_CHANGE_PER_SIGMA
        for name, (rotation, growth) in {
            "constant": (0.0, 0.0),
            "turn": (gradual, 0.0),
            "growth": (0.0, gradual),
        }.items():
            varied = {"turn_rad_per_sigma": rotation, "growth_per_sigma": growth}
            stage.limits[name] = stage.find_point(sigma_px=3.0, sampling="cubic", **varied).error
