"""Simulated observation of skin by the fiber probe: light per fiber, and camera noise."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture.plan.probe import PROBE_SITES
from capture.rig import Probe, Rig
from model import spectra
from rigsim.as_built.probe import SPOT_RADIUS_PX
from rigsim.fiber.homogeneous_fit import FitError, fit_homogeneous_medium
from rigsim.fiber.probe_profile import ProfileCache, probe_fibers
from rigsim.population import files as subject_file
from rigsim.scenes.probe.scene import DARK_CURRENT_E_PER_S, LENS_VIGNETTING, PROBE_METER_RATE_PER_S
from rigsim.sensor import make_sensor
from skinrig.arrays import Float64Array
from skinrig.calibrating.phantom_reflectance import expected_reflectance, packaged_certificate
from skinrig.planning.plans import PlanningError
from skinrig.simulating.probe import TRUTH_PHOTONS

MAX_READ_FRACTION = 0.95
"""Saturation limit, fraction of full scale; brighter readings are discarded."""


@dataclass(frozen=True, slots=True, eq=False)
class ProbeObservation:
    """Light of F fibers on S simulated skin sites, with the camera's gain and noise."""

    sites: tuple[str, ...]
    reflectance: Float64Array
    """(S, F, 3) radial reflectance of the skin, 1/mm^2."""
    sigma_tr: Float64Array
    """(S, 3) sigma_tr of the homogeneous medium nearest to it, the ground truth, 1/mm; NaN where
    too few fibers are bright."""
    phantom: Float64Array
    """(F, 3) radial reflectance of the calibration phantom, 1/mm^2."""
    phantom_error: Float64Array
    """(F, 3) relative error of the phantom's expected reflectance by the photon table, independent
    per fiber."""
    common: Float64Array
    """(T, F, 3) relative errors of the gains by the phantom's certificate, common to all fibers."""
    unit: Float64Array
    """(3,) signal rate at the center of a spot for 1/mm^2, full scales per second."""
    pixels: Float64Array
    """(3,) pixels per spot and color."""
    chip: Any
    """The sensor, see `rigsim.sensor.Sensor`."""
    probe: Any


def simulate_observation(
    rig: Rig, subject: str, *, seed: int = 0, sites: Sequence[str] = PROBE_SITES
) -> ProbeObservation:
    """Simulate the light of the fibers on skin and phantom.

    Parameters
    ----------
    rig
        The probe.
    subject, seed
        Tissue and its seed, see `rigsim.fiber.probe_tissue.parse_tissue`.
    sites
        Sites of the probe's head.
    """
    if rig.probe is None:
        raise PlanningError(
            f"rig: got {rig.name!r} without a probe, expected one with fibers;"
            f" choose a probe's rig file"
        )
    tissue = subject_file.load_tissue(subject, seed=seed)
    profiles = ProfileCache(rig, tissue, photons=TRUTH_PHOTONS["small"], seed=seed)
    made = [profiles.profile(site, 0.0, rig.probe.suction_mbar) for site in sites]
    reflectance = np.stack([one.reflectance_per_mm2 for one in made])
    block = expected_reflectance(packaged_certificate(), rig)
    view = rig.views[0]

    white = spectra.camera_white(view.spectral_sensitivity, rig.lights[0].illuminant)
    area = math.pi * SPOT_RADIUS_PX**2
    return ProbeObservation(
        tuple(sites),
        reflectance,
        np.array([[_nearest_sigma_tr(one, rig.probe) for one in each.T] for each in reflectance]),
        block.per_mm2,
        block.stderr / block.per_mm2,
        block.common,
        PROBE_METER_RATE_PER_S * np.asarray(white, np.float64),
        area * np.array([0.25, 0.5, 0.25]),
        make_sensor(view, dark_e_per_s=DARK_CURRENT_E_PER_S, vignetting=LENS_VIGNETTING),
        rig.probe,
    )


def _nearest_sigma_tr(profile: Float64Array, probe: Probe) -> float:
    try:
        return fit_homogeneous_medium(profile, probe_fibers(probe)).sigma_tr_per_mm
    except FitError:
        return math.nan


def reading_variance(
    observation: ProbeObservation,
    value: Float64Array,
    exposures_s: Sequence[float],
    darks: int,
    level: float,
) -> Float64Array:
    """Return the variance of readings in 1/mm^4, (F, 3); infinite where all are saturated.

    Parameters
    ----------
    observation
        Observation with gain and noise, see `simulate_observation`.
    value
        Reflectance at the fibers, 1/mm^2, (F, 3).
    exposures_s
        Exposure times of a series, s.
    darks
        Dark frames per exposure time.
    level
        Level of the light source, 0 to 1.
    """
    rate = level * observation.unit * value  # full scales per second
    # an unsaturated exposure t measures the rate as signal / t with variance var(signal) / t^2, so
    # that its information is t^2 / var(signal); averaging the dark frames adds floor / darks
    information = np.zeros(rate.shape)
    for seconds in exposures_s:
        gain, floor = observation.chip.noise_profile(seconds)
        light = rate * seconds
        spread = gain * np.maximum(light, 0.0) + floor * (1.0 + 1.0 / darks)
        information += np.where(light < MAX_READ_FRACTION, seconds**2 / spread, 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(
            1.0 / (information * observation.pixels * np.square(level * observation.unit))
        )
