"""Benchmark of the readings of a probe's fibers: errors over the number of exposures."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.calibration.fiber.darks import CameraNoise, DarkModel, measure_darks
from capture.calibration.fiber.merge import color_masks
from capture.calibration.fiber.readings import FiberReadings, read_fibers
from capture.calibration.fiber.spots import FiberSpots
from capture.plan.probe import exposure_series_s
from capture.rig import load_rig
from rigsim.as_built.probe import ProbeTolerances, build_probe
from rigsim.scenes.probe.detector import render_fiber_images
from rigsim.sensor import expose_sensor, fixed_pattern, make_sensor
from skinrig.arrays import Float64Array, UInt16Array
from skinrig.benchmarks.resampling import bootstrap_columns_median
from skinrig.benchmarks.stage import BenchmarkStage

PROBE_SEED = 5
LIGHT_DECADES = 7.0
EXPOSURE_COUNTS = (1, 2, 3, 5, 8, 12, 23)
N_NOISE_DRAWS = 6
"""Noise draws of the exposure series of one probe."""

Frames = list[UInt16Array]


@dataclass(frozen=True, slots=True, eq=False)
class _ProbeCamera:
    """Frames of a probe's camera with known light at each fiber."""

    frames: list[Frames]
    """All exposures of each draw."""
    times: Float64Array
    spots: FiberSpots
    darks: DarkModel
    noise: CameraNoise
    rate: Float64Array
    """Light of each pixel, full scales per second, (H, W)."""
    truth: Float64Array
    """Light of each fiber and color, summed over its aperture, (F, 3)."""


def measure_fiber_readings(stage: BenchmarkStage) -> None:
    """Measure readings of 28 fibers over seven decades of light with 1 to 23 exposures."""
    bench = _bench(draws=2 if stage.toy else N_NOISE_DRAWS)
    for count in (1, 3, 8, 23) if stage.toy else EXPOSURE_COUNTS:
        chosen = _select_exposures(len(bench.times), count)
        results = [_read(bench, chosen, draw) for draw in range(len(bench.frames))]
        valid, signal, stderr = (
            np.array([getattr(r, name) for r in results]) for name in ("valid", "signal", "stderr")
        )
        # fibers that saturate in every exposure count with an error of 100 %
        miss = 100 * np.where(valid, np.abs(signal / bench.truth - 1), 1.0)
        bound = np.sqrt(_minimum_variance(bench, chosen)) / bench.truth
        # median of |error| of a normal error: 0.6745 standard deviations
        least = 67.4 * float(np.median(np.where(np.isfinite(bound), bound, 1 / 0.674)))
        timing, _ = stage.time(lambda: _read(bench, chosen, 0))
        also = {
            "exposed_s": round(float(bench.times[chosen].sum()), 1),
            "measured_percent": round(float(100 * valid.mean()), 1),
        }
        outcome = bootstrap_columns_median(miss.reshape(len(miss), -1), least, draws=400)
        stage.add({"exposures": count}, timing, outcome, also)
        deviation = ((signal - bench.truth) / np.where(valid, stderr, np.inf))[valid]
        relative = (signal / bench.truth - 1).reshape(-1, bench.truth.size)
    near = bench.truth.ravel() > 1e-5 * bench.truth.max()
    worst = 100 * float(np.sqrt((relative[:, near] ** 2).mean(axis=0)).max())
    ratio = float(np.sqrt((relative**2 / bound.ravel() ** 2).mean()))
    inside = 100 * float((np.abs(deviation) < 1).mean())
    stage.limits |= {"rms": worst, "over_bound": ratio, "inside": inside, "inside_most": inside}


def _bench(*, draws: int) -> _ProbeCamera:
    rig = load_rig("probe")
    view = rig.views[0]
    build = build_probe(
        rig, seed=PROBE_SEED, tolerances=ProbeTolerances(crosstalk=0, wings=0, veil=0)
    )
    sensor = make_sensor(view, dark_e_per_s=0.3, vignetting=0.1)
    noise = CameraNoise.from_view(view)
    times = np.array(exposure_series_s())
    shape = (view.height_px, view.width_px)
    # the brightest fiber reaches half of full scale in the shortest exposure
    light = 0.5 / times[0] * np.geomspace(1, 10.0**-LIGHT_DECADES, len(build.gain))[:, None]
    light = light * np.array([0.6, 1.0, 0.5])
    images = render_fiber_images(build, view).astype(np.float64)
    colors = color_masks(shape, view.cfa)
    response = fixed_pattern(sensor, shape).response.astype(np.float64)
    rate = np.zeros(shape)
    for c, mask in enumerate(colors):
        rate[mask] = (np.tensordot(light[:, c], images, 1) * response)[mask]
    names = tuple(fiber.name for fiber in rig.probe.fibers) if rig.probe else ()
    count = np.full(len(names), 1.0)
    spots = FiberSpots(
        names,
        build.spot_px,
        np.zeros((len(names), 2)),
        build.radius_px,
        0 * count,
        build.edge_px * count,
        count > 0,
        float(build.radius_px.mean() + 3.0),
    )
    truth = np.array(
        [
            [
                (light[i, c] * images[i] * response)[spots.mask(i, shape) & mask].sum()
                for c, mask in enumerate(colors)
            ]
            for i in range(len(names))
        ]
    )
    rng = np.random.default_rng(PROBE_SEED)
    dark_s = [times[k] for k in (0, 16, 22) for _ in range(4)]
    nothing = np.zeros((*shape, 3), np.float32)
    darks = [expose_sensor(nothing, sensor=sensor, rng=rng, exposure_s=t) for t in dark_s]
    flat = np.divide(rate, response)[..., None] * np.ones(3)
    frames = [
        [
            expose_sensor((flat * t).astype(np.float32), sensor=sensor, rng=rng, exposure_s=t)
            for t in times
        ]
        for _ in range(draws)
    ]
    model = measure_darks(darks, dark_s, noise=noise)
    return _ProbeCamera(frames, times, spots, model, noise, rate, truth)


def _read(bench: _ProbeCamera, chosen: Sequence[int], draw: int) -> FiberReadings:
    frames = [bench.frames[draw][k] for k in chosen]
    return read_fibers(
        frames, bench.times[list(chosen)], spots=bench.spots, darks=bench.darks, noise=bench.noise
    )


def _minimum_variance(bench: _ProbeCamera, chosen: Sequence[int]) -> Float64Array:
    """Return the Cramér-Rao bound of each fiber's variance, infinite where a pixel saturates.

    Each pixel's light is estimated from its unsaturated frames, with known dark signal.
    """
    noise = bench.noise
    span, gain = noise.span_dn, noise.gain_e_per_dn
    information = np.zeros(bench.rate.shape)
    for t in bench.times[list(chosen)]:
        signal = bench.rate * t * span
        dark = bench.darks.mean_rate_dn_per_s * t
        variance = (signal + dark) / gain + noise.floor_dn2
        information += np.where(signal + dark < span, (t * span) ** 2 / variance, 0.0)
    with np.errstate(divide="ignore"):
        least = 1.0 / information
    colors = color_masks(bench.rate.shape, noise.pattern)
    return np.array(
        [
            [float(least[bench.spots.mask(i, least.shape) & mask].sum()) for mask in colors]
            for i in range(len(bench.spots.names))
        ]
    )


def _select_exposures(total: int, count: int) -> list[int]:
    """Return indices of exposures: the longest, or evenly from the shortest to the longest."""
    if count == 1:
        return [total - 1]
    return [round(k) for k in np.linspace(0, total - 1, count)]
