"""Benchmark of one person's skin: its color and its depth of light in the four simulated rigs."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from capture.calibration.color.colorimetry import delta_e_2000
from model import skin_tone
from rigsim.light.observed_skin import ObservedSkin
from rigsim.population.files import load_subject
from rigsim.skin_patch.microrelief import CAMERA_BAND_NM
from rigsim.subject.face_regions import from_mean_head
from rigsim.subject.head import LANDMARKS_MM
from rigsim.subject.person_skin import SITE_RADIUS_MM, layers
from rigsim.tissue.skin_layers import DERMIS_SCATTERING_RATIO, TissueProperties, skin_coefficients
from rigsim.tissue.skin_table import WAVELENGTH_NM, SkinTable
from rigsim.tissue.tissue_mc import trace_photons
from skinrig.arrays import Float64Array
from skinrig.benchmarks.results import ErrorEstimate
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.planning.camera_separability import TYPICAL_CAMERA

COMPARED_SITE: Final = "cheek"
PROBED_NM: Final = (440.0, 490.0, 540.0, 580.0, 620.0, 650.0)
"""Wavelengths of the light that is traced through the layers under the probe, nm."""
DEPTH_NM: Final = 540.0


@dataclass(frozen=True, slots=True)
class _SeenSkin:
    """Skin of the site in one rig."""

    spectrum: Float64Array
    """Diffuse reflectance at `WAVELENGTH_NM`."""
    sigma_tr_per_mm: float
    """Effective transport coefficient of the dermis at `DEPTH_NM`, 1/mm."""


def measure_one_person(stage: BenchmarkStage) -> None:
    """Measure the difference of each rig's skin from that of the flash rig."""
    presets = ("III",) if stage.toy else ("I", "III", "VI")
    photons = 20_000 if stage.toy else 400_000
    # Lightness falls by 0.4 per percent of reflectance, and photons are off by 1 / sqrt(n).
    noise = 40.0 / math.sqrt(photons)
    worst_color, worst_depth = 0.0, 0.0
    for preset in presets:
        reference = _face(preset)
        lab = _lab(reference.spectrum)
        for rig, make in (
            ("flash", lambda: _face(preset)),
            ("dome", lambda: _face(preset, size=256)),
            ("gradient", lambda: _patch(preset)),
            ("probe", lambda: _probed(preset, photons)),
        ):
            timing, seen = stage.time(make, repeats=1)
            difference = float(delta_e_2000(_lab(seen.spectrum), lab))
            depth = 100.0 * abs(seen.sigma_tr_per_mm / reference.sigma_tr_per_mm - 1.0)
            at = round(float(np.interp(DEPTH_NM, WAVELENGTH_NM, seen.spectrum)), 4)
            extra = {"R(540)": at, "sigma_tr, 1/mm": round(seen.sigma_tr_per_mm, 3)}
            stage.add(
                {"preset": preset, "rig": rig},
                timing,
                ErrorEstimate.nonnegative(difference, noise),
                extra,
            )
            worst_color, worst_depth = max(worst_color, difference), max(worst_depth, depth)
    stage.limits = {"color": worst_color, "depth": worst_depth}


def _lab(spectrum: Float64Array) -> Float64Array:
    return skin_tone.lab_of_spectra(spectrum + skin_tone.sphere_specular(), WAVELENGTH_NM)


def _sigma_tr(c_m: float, c_hd: float, tissue: TissueProperties) -> float:
    found = skin_coefficients(DEPTH_NM, c_m, c_hd, tissue)
    sigma_a, sigma_s = float(found.dermis), DERMIS_SCATTERING_RATIO * float(found.scattering)
    return math.sqrt(3.0 * sigma_a * (sigma_a + sigma_s))


def _face(preset: str, *, size: int = 512) -> _SeenSkin:
    """Return the mean skin of the maps that flash rig and dome render."""
    face = load_subject(preset).face(seed=0, size=size)
    center = from_mean_head(np.array(LANDMARKS_MM["cheek left"]), face.mesh)
    away = face.atlas.position_mm - center
    near = (np.hypot(away[..., 0], away[..., 1]) < SITE_RADIUS_MM) & (away[..., 2] > -30.0)
    there = near & face.atlas.covered
    c_m, c_hd = face.melanin[there], face.hemoglobin()[there]
    skin = ObservedSkin(face, "neutral", TYPICAL_CAMERA, "D55")
    return _SeenSkin(
        skin.spectra(c_m, c_hd, face.thickness_ratio[there]).mean(axis=0, dtype=np.float64),
        _sigma_tr(float(c_m.mean()), float(c_hd.mean()), face.tissue),
    )


def _patch(preset: str) -> _SeenSkin:
    """Return the mean skin of the gradient rig's patch, scaled by its monochrome albedo."""
    patch = load_subject(preset).patch(COMPARED_SITE, seed=0, size_mm=4.0)
    skin = patch.skin
    spectrum = SkinTable.load(skin.tissue).spectra(skin.c_m, skin.c_hd)
    band = (WAVELENGTH_NM >= CAMERA_BAND_NM[0]) & (WAVELENGTH_NM <= CAMERA_BAND_NM[1])
    scale = float(patch.albedo.mean()) / float(spectrum[band].mean())
    return _SeenSkin(scale * spectrum, _sigma_tr(skin.c_m, skin.c_hd, skin.tissue))


def _probed(preset: str, photons: int) -> _SeenSkin:
    """Return the skin under the probe without pressure, by photons through its layers."""
    tissue = load_subject(preset).tissue(seed=0)
    traced = [
        trace_photons(
            layers(tissue.person, COMPARED_SITE, "neutral", nm),
            photons=photons,
            rng=np.random.default_rng([round(nm)]),
        ).reflectance
        for nm in PROBED_NM
    ]
    skin = tissue.person.at(COMPARED_SITE)
    spectrum = SkinTable.load(skin.tissue).spectra(skin.c_m, skin.c_hd)
    tabulated = np.interp(PROBED_NM, WAVELENGTH_NM, spectrum)
    ratio = np.interp(WAVELENGTH_NM, PROBED_NM, np.array(traced) / tabulated)
    return _SeenSkin(ratio * spectrum, _sigma_tr(skin.c_m, skin.c_hd, skin.tissue))
