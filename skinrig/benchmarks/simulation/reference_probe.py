"""Benchmark of the fiber probe's sigma_tr from readings on voxel skin.

The same people are also read on the simulator's flat layers, by its own photons. The difference of
both errors is what simulations gain when pigment and blood do not vary below the probe.
"""

import dataclasses
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from capture.calibration.fiber.darks import CameraNoise, DarkModel, measure_darks
from capture.calibration.fiber.merge import merge_series
from capture.calibration.fiber.probe_calibration import FiberCalibration, FiberReflectance
from capture.calibration.fiber.readings import sum_spots
from capture.plan.probe import exposure_series_s
from capture.plan.suction import HeadPlacement
from capture.rig import Rig, load_rig
from reconstruction.pipeline.probe.images import Measurement
from reconstruction.pipeline.probe.profile_fits import MeasuredProfile, fit_profiles, site_values
from reconstruction.pipeline.probe.stages import CHANNEL_NAMES
from rigsim.boxes.contact_probe.source_shutter import SourceLight
from rigsim.fiber.homogeneous_fit import fit_homogeneous_medium
from rigsim.fiber.probe_profile import BandProfile, ProfileCache, probe_fibers
from rigsim.fiber.probe_tissue import HomogeneousTissue, SkinTissue
from rigsim.scenes.probe.scene import DARK_CURRENT_REFERENCE_C, ProbeScene
from rigsim.scenes.reference.placed_paths import HeadPlace
from rigsim.scenes.reference.probe_skin import VoxelReadings, read_person
from rigsim.subject.person_skin import PersonSkin, draw_tissue
from rigsim.world.suction import HeadState
from skinrig.arrays import Float64Array
from skinrig.benchmarks.intervals.coverage import GAUSSIAN_95
from skinrig.benchmarks.intervals.probe import calibrate_with_own_block
from skinrig.benchmarks.measurement import measure_processor_time
from skinrig.benchmarks.resampling import median_error
from skinrig.benchmarks.results import Timing
from skinrig.benchmarks.stage import BenchmarkStage

NO_MEMORY_REASON = "photons, camera and fit share the process"
READ_PRESETS: Final = ("I", "II", "III", "IV", "V", "VI")
PROBED_SITE: Final = "cheek"
PERSON_SEED_OFFSET: Final = 600
DARK_STEPS: Final = (0, 16, 22)
"""Exposures of the series at whose times dark frames are taken, as in the probe's plan."""
DARKS_PER_STEP: Final = 2


@dataclass(frozen=True, slots=True)
class ProbeEffort:
    """Photons and places of one person."""

    places: int
    photons: int
    laid_paths: int
    flat_photons: int


FULL_EFFORT: Final = ProbeEffort(places=4, photons=10_000, laid_paths=100, flat_photons=60_000)
TOY_EFFORT: Final = ProbeEffort(places=1, photons=1_000, laid_paths=10, flat_photons=6_000)


@dataclass(frozen=True, slots=True, eq=False)
class FittedReading:
    """sigma_tr of one reading in each color, shape (3,)."""

    estimated: Float64Array
    """By the recommended fit, 1/mm."""
    log_stderr: Float64Array
    """Standard error of its logarithm, as the session states it."""
    valid: np.ndarray
    true: Float64Array
    """sigma_tr of the medium nearest to the noise-free reading, 1/mm."""


@dataclass(frozen=True, slots=True, eq=False)
class ReadPerson:
    """Fits of one person's readings."""

    voxels: tuple[FittedReading, ...]
    """At each place."""
    flat: FittedReading
    """On the simulator's flat layers."""
    site: Float64Array
    """True sigma_tr of flat layers, by the same photons as the voxels', 1/mm, shape (3,)."""
    site_estimated: Float64Array
    """sigma_tr of the site over all places, as the session states it, 1/mm, shape (3,)."""
    site_log_stderr: Float64Array
    """Standard error of its logarithm."""
    readings: VoxelReadings


class KnownReadings(ProbeScene):
    """The probe before skin of known noise-free readings."""

    def __init__(self, rig: Rig, reflectance_per_mm2: Float64Array, *, seed: int) -> None:
        super().__init__(rig, HomogeneousTissue(0.1, 1.0), seed=seed, photons=1)
        self.known = BandProfile(reflectance_per_mm2, np.zeros_like(reflectance_per_mm2))

    def profile(self, head: HeadState) -> BandProfile | None:
        """Return the known readings wherever the head touches skin."""
        return self.known if head.placed else None


def measure_reference_probe(stage: BenchmarkStage) -> None:
    """Measure sigma_tr from readings on voxels, and on flat layers, through camera and fit."""
    presets = READ_PRESETS[2:3] if stage.toy else READ_PRESETS
    effort = TOY_EFFORT if stage.toy else FULL_EFFORT
    people: list[ReadPerson] = []
    seconds: dict[str, float] = defaultdict(float)
    with tempfile.TemporaryDirectory(prefix="skinrig-probe-") as name:
        for seed, preset in enumerate(presets):
            person = dataclasses.replace(
                PersonSkin.of_preset(preset, seed=seed),
                tissue=draw_tissue(PERSON_SEED_OFFSET + seed),
            )
            people.append(_read(Path(name), person, seed, effort, seconds))
    _add_results(stage, people, seconds)


def _read(
    folder: Path, person: PersonSkin, seed: int, effort: ProbeEffort, seconds: dict[str, float]
) -> ReadPerson:
    """Read one person on voxels and on flat layers, with a calibration of its own."""
    rig = load_rig("probe")
    places = tuple(HeadPlace(angle_deg=360.0 * k / effort.places) for k in range(effort.places))
    spent_s, readings = measure_processor_time(
        lambda: read_person(
            person,
            PROBED_SITE,
            rig,
            places,
            photons=effort.photons,
            laid_paths=effort.laid_paths,
            seed=seed,
        )
    )
    seconds["voxels"] += spent_s
    suction = 0.0 if rig.probe is None else rig.probe.suction_mbar
    cache = ProfileCache(rig, SkinTissue(person), photons=effort.flat_photons, seed=seed, threads=1)
    spent_s, flat = measure_processor_time(lambda: cache.profile(PROBED_SITE, 0.0, suction))
    seconds["flat layers"] += spent_s
    calibration = calibrate_with_own_block(folder, seed)
    camera = ProbeCamera(rig, calibration, seed=seed)
    every = [*readings.reflectance_per_mm2, flat.reflectance_per_mm2]
    angles = [place.angle_deg for place in places] + [0.0]
    measured = [
        camera.measure(known, angle, seed=k)
        for k, (known, angle) in enumerate(zip(every, angles, strict=True))
    ]
    fits = [fit_profiles([one], cache.probe)[0] for one in measured]
    found = [
        FittedReading(
            fit.fit.sigma_tr_per_mm, fit.log_total, fit.fit.valid, nearest_sigma_tr(rig, known)
        )
        for fit, known in zip(fits, every, strict=True)
    ]
    site = site_values(fits[:-1])[0]
    return ReadPerson(
        tuple(found[:-1]),
        found[-1],
        nearest_sigma_tr(rig, readings.even_per_mm2),
        site.sigma_tr_per_mm,
        site.stderr_per_mm / site.sigma_tr_per_mm,
        readings,
    )


class ProbeCamera:
    """Exposes series of known readings, and reads them as a session does.

    Parameters
    ----------
    rig
        The probe.
    calibration
        Folder of its calibration.
    seed
        Seed of the noise.
    """

    def __init__(self, rig: Rig, calibration: Path, *, seed: int) -> None:
        self._rig, self._seed = rig, seed
        self._noise = CameraNoise.from_view(rig.views[0])
        self._fibers = FiberCalibration.load(calibration, rig)
        self._times = exposure_series_s()
        self._darks = self._measure_darks()

    def _measure_darks(self) -> DarkModel:
        count = 0 if self._rig.probe is None else len(self._rig.probe.fibers)
        scene = KnownReadings(self._rig, np.zeros((count, 3)), seed=self._seed)
        times = [self._times[k] for k in DARK_STEPS for _ in range(DARKS_PER_STEP)]
        frames = [
            scene.exposure("cam", pops=[], exposure_s=t, seed=10_000 + k, head=_head(False, 0.0))
            for k, t in enumerate(times)
        ]
        return measure_darks(frames, times, noise=self._noise)

    def measure(
        self, reflectance_per_mm2: Float64Array, angle_deg: float, *, seed: int
    ) -> MeasuredProfile:
        """Return the calibrated profile of one series of exposures.

        Parameters
        ----------
        reflectance_per_mm2
            Noise-free R_f in 1/mm^2, shape (F, 3).
        angle_deg
            Direction of the head.
        seed
            Seed of the series.
        """
        scene = KnownReadings(self._rig, reflectance_per_mm2, seed=self._seed)
        frames = [
            scene.exposure(
                "cam",
                pops=[SourceLight(1.0, 0.0, t, None)],
                exposure_s=t,
                seed=100 * seed + k,
                head=_head(True, angle_deg),
            )
            for k, t in enumerate(self._times)
        ]
        merged = merge_series(frames, self._times, darks=self._darks.at(None), noise=self._noise)
        spots, _ = self._fibers.spots.track(merged, self._noise.pattern)
        found: FiberReflectance = self._fibers.reflectance(
            sum_spots(merged, spots, noise=self._noise)
        )
        place = HeadPlacement(PROBED_SITE, angle_deg, 0)
        about = Measurement(place, len(frames), 1.0, float("nan"), DARK_CURRENT_REFERENCE_C)
        return MeasuredProfile(about, found)


def _head(placed: bool, angle_deg: float) -> HeadState:
    return HeadState(
        site=PROBED_SITE if placed else "cap",
        angle_deg=angle_deg,
        placed=placed,
        suction_mbar=0.0,
        camera_c=DARK_CURRENT_REFERENCE_C,
    )


def nearest_sigma_tr(rig: Rig, reflectance_per_mm2: Float64Array) -> Float64Array:
    """Return sigma_tr of the medium nearest to a noise-free reading, 1/mm, shape (3,).

    Parameters
    ----------
    rig
        The probe.
    reflectance_per_mm2
        R_f in 1/mm^2, shape (F, 3).
    """
    if rig.probe is None:
        raise ValueError(f"rig {rig.name!r}: got no probe, expected one; load the probe's rig")
    kind = probe_fibers(rig.probe)
    return np.array(
        [fit_homogeneous_medium(band, kind).sigma_tr_per_mm for band in reflectance_per_mm2.T]
    )


def _add_results(
    stage: BenchmarkStage, people: list[ReadPerson], seconds: dict[str, float]
) -> None:
    """Add one point per kind of reading and color, over people and places."""
    valid = np.array([[one.valid for one in person.voxels] for person in people])
    by_reading: dict[str, tuple[Float64Array, Float64Array]] = {}
    own = np.array([[one.true for one in person.voxels] for person in people])
    found = np.array([[one.estimated for one in person.voxels] for person in people])
    stderr = np.array([[one.log_stderr for one in person.voxels] for person in people])
    site = np.array([person.site for person in people])
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = [
            np.where(person.flat.valid, np.log(person.flat.estimated / person.flat.true), np.nan)
            for person in people
        ]
        by_reading["flat layers"] = np.array(flat), np.array([p.flat.log_stderr for p in people])
        by_reading["voxels"] = np.where(valid, np.log(found / own), np.nan), stderr
        by_reading["voxels, against the site"] = (
            np.where(valid, np.log(found / site[:, None]), np.nan),
            stderr,
        )
        by_reading["site of all voxels"] = (
            np.log(np.array([person.site_estimated for person in people]) / site),
            np.array([person.site_log_stderr for person in people]),
        )
    uneven = np.log(own / site[:, None])
    changes = np.array([person.readings.ratio for person in people])
    for reading, (errors, spread) in by_reading.items():
        part = "flat layers" if reading == "flat layers" else "voxels"
        timing = Timing.single(seconds[part] / len(people), no_memory_reason=NO_MEMORY_REASON)
        covered = np.abs(errors) <= spread
        known = np.isfinite(errors)
        stage.limits["coverage", reading] = float(covered[known].mean())
        for c, color in enumerate(CHANNEL_NAMES):
            use = known[..., c]
            one, width = errors[..., c][use], spread[..., c][use]
            extra: dict[str, float | int] = {
                "fits": int(use.sum()),
                "bias, %": round(100.0 * float(one.mean()), 2),
                "coverage of 68 % intervals": round(float((np.abs(one) <= width).mean()), 3),
                "coverage of 95 % intervals": round(
                    float((np.abs(one) <= GAUSSIAN_95 * width).mean()), 3
                ),
                "median half-width of 68 % intervals, %": round(100.0 * float(np.median(width)), 2),
            }
            if reading == "voxels":
                gains = _mean_size(errors[..., c]) - _mean_size(by_reading["flat layers"][0][:, c])
                gains = gains[np.isfinite(gains)]
                extra |= {
                    "error minus that of flat layers, points": round(float(gains.mean()), 2),
                    "its standard error": round(
                        float(gains.std(ddof=1) / np.sqrt(len(gains))) if len(gains) > 1 else 0.0, 2
                    ),
                    "change of sigma_tr by unevenness, rms, %": round(
                        100.0 * float(np.sqrt(np.mean(uneven[..., c] ** 2))), 2
                    ),
                    "largest, %": round(100.0 * float(np.abs(uneven[..., c]).max()), 2),
                    "change of a fiber's reading, rms, %": round(
                        100.0 * float(np.sqrt(np.mean(np.log(changes[..., c]) ** 2))), 2
                    ),
                }
            stage.add(
                {"reading": reading, "color": color},
                timing,
                median_error(100.0 * np.abs(np.expm1(one))),
                extra,
            )
    stage.limits["valid"] = float(valid.mean())


def _mean_size(errors: Float64Array) -> Float64Array:
    """Return the mean size of each person's errors in percent, shape (people,); NaN without any."""
    sizes = 100.0 * np.abs(errors.reshape(len(errors), -1))
    known = np.isfinite(sizes)
    total = np.where(known, sizes, 0.0).sum(axis=1)
    return np.asarray(np.where(known.any(axis=1), total / np.maximum(known.sum(axis=1), 1), np.nan))
