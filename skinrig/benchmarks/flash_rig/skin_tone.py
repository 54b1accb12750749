"""Benchmark of the typology angle through cameras of the flash rig and of the dome.

A chart calibrates the flash rig's camera. Those of the dome have the lights' white alone, and their
albedo has an error that the channels share. Skin is that of the simulator with varied properties,
on which no color matrix and no correction was fitted. Cameras differ from their nominal
sensitivities: channels are shifted and widened.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from capture.calibration.color import ColorMatrix, chart_reference, fit_matrix, neutral_white
from model import skin_tone, spectra
from model.skin import SkinMap
from reconstruction.pipeline.skin_tone.maps import ToneCamera, reflectance_of_albedo
from rigsim.subject.pigment import MELANIN_PRESETS, typical_blood
from rigsim.subject.skin_tone import typology_angle_deg
from rigsim.targets.flat import chart_reflectances
from rigsim.tissue.skin_layers import TYPICAL_SKIN, TissueProperties
from rigsim.tissue.skin_table import WAVELENGTH_NM, SkinTable
from skinrig.arrays import Float64Array, UInt8Array
from skinrig.benchmarks.resampling import median_error
from skinrig.benchmarks.results import ErrorEstimate, Knobs
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.evaluating.skin_bands import MelaninBand

CHART_LIGHT: Final = "D55"
DOME_LIGHT: Final = "LED-B3"
DOME_ERROR_PERCENT: Final = (2.0, 0.5)
"""Errors of the dome's albedo: common to the channels, and of each."""
NOISE_PERCENT: Final = (0.2, 1.0)
"""Noise per channel: the mean of 25 pixels, and a pixel."""
BOUNDARY_TRANSMITTANCE: Final = 0.89755
"""Into smooth skin of index 1.4 at normal incidence times out of it, diffuse: 0.97222 * 0.92320."""
CHART_NOISE: Final = 0.002
CENTER_SD_NM: Final = 1.5
"""Standard deviation of the center of a channel, as in a batch of cameras."""
WIDTH_SD: Final = 0.02
"""Relative standard deviation of a channel's width."""
CAMERA_WHITE: Final = (0.4, 0.8, 0.55)
"""Camera RGB of white, fraction of full scale."""
_SEED: Final = 71


@dataclass(frozen=True, slots=True, eq=False)
class SkinSample:
    """Spectra of skin with their true typology angle."""

    reflectance: Float64Array
    """(n, 31), diffuse."""
    ita_deg: Float64Array
    band: UInt8Array
    """1 to 6."""


@dataclass(frozen=True, slots=True, eq=False)
class ToneErrors:
    """Errors of the typology angle over draws of cameras and skin."""

    error_deg: Float64Array
    stderr_deg: Float64Array
    band: UInt8Array
    chart_error_deg: Float64Array
    """Error by the color matrix alone."""

    def medians(self, errors_deg: Float64Array) -> Float64Array:
        """Return the median absolute error per band, (6,)."""
        bands = range(1, 7)
        return np.array([np.median(np.abs(errors_deg[self.band == band])) for band in bands])

    def coverage(self) -> Float64Array:
        """Return the coverage of 68 % intervals per band, (6,)."""
        inside = np.abs(self.error_deg) <= self.stderr_deg
        return np.array([inside[self.band == band].mean() for band in range(1, 7)])


def measure_skin_tone(stage: BenchmarkStage) -> None:
    """Measure errors and coverage per band of the typology angle, for each camera."""
    tissues, count = (2, 4) if stage.toy else (8, 24)
    skin = draw_skin(tissues)
    area = {}
    for camera in spectra.camera_names():
        drawn = draw_cameras(camera, count)
        for noise in NOISE_PERCENT:
            call = partial(measure_cameras, drawn, skin, noise / 100.0)
            timing, found = stage.time(call, repeats=1, memory=None)
            medians, coverage = found.medians(found.error_deg), found.coverage()
            by_chart = found.medians(found.chart_error_deg)
            extra: Knobs = {}
            for place, band in enumerate(skin_tone.ITA_BANDS):
                extra[f"median {band}"] = round(float(medians[place]), 2)
                extra[f"matrix alone {band}"] = round(float(by_chart[place]), 2)
                extra[f"coverage {band}, %"] = round(100.0 * float(coverage[place]))
            knobs: Knobs = {"camera": camera, "noise_percent": noise}
            stage.add(knobs, timing, median_error(np.abs(found.error_deg)), extra)
            if noise == NOISE_PERCENT[0]:
                area[camera] = found
        add_dome(stage, camera, count, skin)
    for camera, found in area.items():
        mean = 100.0 * float(found.coverage().mean())
        stage.limits["error", camera] = float(found.medians(found.error_deg).max())
        stage.limits["low", camera] = stage.limits["high", camera] = mean
    first = area[spectra.camera_names()[0]]
    stage.measure_bands(partial(_error_of_band, first))


def add_dome(stage: BenchmarkStage, camera: str, count: int, skin: SkinSample) -> None:
    """Add the row of a camera in the dome."""
    timing, found = stage.time(partial(measure_dome, camera, count, skin), repeats=1, memory=None)
    extra: Knobs = {}
    for name, median, inside in zip(
        skin_tone.ITA_BANDS, found.medians(found.error_deg), found.coverage(), strict=True
    ):
        extra[f"median {name}"] = round(float(median), 2)
        extra[f"coverage {name}, %"] = round(100.0 * float(inside))
    knobs: Knobs = {"camera": f"{camera}, dome", "noise_percent": DOME_ERROR_PERCENT[1]}
    stage.add(knobs, timing, median_error(np.abs(found.error_deg)), extra)


def measure_dome(camera: str, count: int, skin: SkinSample) -> ToneErrors:
    """Measure skin by its albedo in the dome, through cameras without a chart."""
    rng = np.random.default_rng([_SEED, 3])
    common, own = (percent / 100.0 for percent in DOME_ERROR_PERCENT)
    conversion = ToneCamera.of(camera, DOME_LIGHT, None, None)
    errors, stderrs = [], []
    for _ in range(count):
        exact = skin.reflectance @ draw_weights(camera, rng, light=DOME_LIGHT)
        shared = 1.0 + common * rng.normal(size=(len(exact), 1))
        # the albedo is a factor between the transmittances of the boundary
        r_d = exact * shared * (1.0 + own * rng.normal(size=exact.shape)) / BOUNDARY_TRANSMITTANCE
        stderr = np.hypot(common, own) * r_d
        good = np.ones((len(r_d), 1), np.bool_)
        albedo = SkinMap(
            r_d[:, None].astype(np.float32), "1", stderr[:, None].astype(np.float32), good
        )
        given = reflectance_of_albedo(albedo)
        lab, covariance = conversion.lab(
            given.rgb[:, 0], given.variance[:, 0], given.log_variance[:, 0]
        )
        errors.append(skin_tone.ita(lab) - skin.ita_deg)
        stderrs.append(skin_tone.ita_stderr(lab, covariance))
    found = np.concatenate(errors)
    return ToneErrors(found, np.concatenate(stderrs), np.tile(skin.band, count), found)


def _error_of_band(found: ToneErrors, band: MelaninBand) -> ErrorEstimate:
    """Return the error in the band of the typology angle of the melanin band's preset."""
    number = int(skin_tone.ita_band(typology_angle_deg(MELANIN_PRESETS[band.preset])))
    return median_error(np.abs(found.error_deg[found.band == number]))


def draw_skin(tissues: int, *, per_tissue: int = 40) -> SkinSample:
    """Draw skin of varied melanin, blood, thickness, oxygenation and scattering.

    Parameters
    ----------
    tissues
        Number of draws of thickness, oxygenation and scattering; a table takes 0.3 s.
    per_tissue
        Number of draws of melanin and blood for each.
    """
    rng = np.random.default_rng(_SEED)
    parts = []
    for _ in range(tissues):
        tissue = TissueProperties(
            epidermis_mm=rng.uniform(0.05, 0.12),
            oxygenation=rng.uniform(0.5, 0.95),
            scattering_slope=rng.uniform(0.8, 2.2),
            scattering_per_mm=rng.uniform(0.8, 1.2) * TYPICAL_SKIN.scattering_per_mm,
        )
        melanin = np.geomspace(0.006, 0.35, per_tissue)
        blood = np.array([typical_blood(float(value)) for value in melanin])
        blood *= np.exp(rng.normal(0.0, 0.4, per_tissue))
        parts.append(SkinTable.load(tissue).spectra(melanin, blood))
    found = np.concatenate(parts)
    lab = skin_tone.lab_of_spectra(found + skin_tone.sphere_specular(), WAVELENGTH_NM)
    angle = skin_tone.ita(lab)
    return SkinSample(found, angle, skin_tone.ita_band(angle))


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedCamera:
    """Drawn camera with its calibration by a chart."""

    nominal: str
    weights: Float64Array
    """(31, 3), white-balanced."""
    matrix: ColorMatrix
    neutral: Float64Array


def draw_cameras(camera: str, count: int) -> list[CalibratedCamera]:
    """Draw cameras like a nominal one, and calibrate each with a chart."""
    rng = np.random.default_rng([_SEED, 1])
    white = np.array(CAMERA_WHITE)
    found = []
    for _ in range(count):
        weights = draw_weights(camera, rng)
        patches = chart_reflectances() @ weights * white
        patches *= 1.0 + CHART_NOISE * rng.normal(size=patches.shape)
        neutral = neutral_white(patches).value
        matrix = fit_matrix(
            patches, chart_reference(CHART_LIGHT), white=neutral, illuminant=CHART_LIGHT
        )
        found.append(CalibratedCamera(camera, weights, matrix, neutral))
    return found


def measure_cameras(
    cameras: Sequence[CalibratedCamera], skin: SkinSample, noise: float
) -> ToneErrors:
    """Measure skin through each camera, with relative noise per channel."""
    rng = np.random.default_rng([_SEED, 2])
    errors, stderrs, by_chart = [], [], []
    for each in cameras:
        exact = skin.reflectance @ each.weights
        rgb = exact * (1.0 + noise * rng.normal(size=exact.shape))
        conversion = ToneCamera.of(each.nominal, CHART_LIGHT, each.matrix, each.neutral)
        lab, covariance = conversion.lab(rgb, np.square(noise * rgb))
        errors.append(skin_tone.ita(lab) - skin.ita_deg)
        stderrs.append(skin_tone.ita_stderr(lab, covariance))
        plain = each.matrix.to_linear_srgb((rgb + skin_tone.sphere_specular()) * each.neutral)
        by_chart.append(skin_tone.ita(skin_tone.lab(plain)) - skin.ita_deg)
    return ToneErrors(
        np.concatenate(errors),
        np.concatenate(stderrs),
        np.tile(skin.band, len(cameras)),
        np.concatenate(by_chart),
    )


def draw_weights(
    camera: str, rng: np.random.Generator, *, light: str = CHART_LIGHT
) -> Float64Array:
    """Draw a camera's band weights with shifted and widened channels, (31, 3)."""
    nm = np.arange(WAVELENGTH_NM[0], WAVELENGTH_NM[-1] + 1.0)
    power = spectra.illuminant(light, nm)
    nominal = spectra.camera_sensitivity(camera, nm)
    channels = []
    for channel, shift in enumerate(rng.normal(0.0, CENTER_SD_NM, 3)):
        center = float(np.average(nm, weights=np.abs(nominal[:, channel])))
        scale = 1.0 + WIDTH_SD * float(rng.normal())
        own = spectra.camera_sensitivity(camera, center + (nm - center - shift) / scale)
        channels.append(own[:, channel] * power)
    hats = np.stack([np.interp(nm, WAVELENGTH_NM, row) for row in np.eye(WAVELENGTH_NM.size)])
    found = hats @ np.stack(channels, axis=1)
    return np.asarray(found / found.sum(axis=0))
