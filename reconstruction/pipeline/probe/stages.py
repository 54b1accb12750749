"""Stages of the fiber probe: exposure series to profiles, coefficients and translucency."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from capture.calibration.fiber.darks import CameraNoise
from capture.calibration.fiber.probe_calibration import FiberCalibration
from capture.calibration.fiber.readings import sum_spots
from capture.calibration.sensor import SensorCalibration
from capture.rig import Probe
from capture.session import Session
from model.checks import Checks
from model.fresnel import ETA_SKIN
from model.skin import SkinMap
from reconstruction.anisotropy import estimation as anisotropy
from reconstruction.anisotropy.direction_harmonics import MIN_DIRECTIONS
from reconstruction.anisotropy.estimation import estimate_single_direction_bias
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.inputs import Inputs, InputsError
from reconstruction.pipeline.probe.images import Measurement, ProbeImages
from reconstruction.pipeline.probe.profile_fits import (
    METHOD_NAMES,
    MeasuredProfile,
    ProfileFit,
    SiteValue,
    fit_profiles,
    profile_groups,
    site_values,
)
from reconstruction.subsurface import probe_sites, translucency

STAGE_REVISION = 7
"""Grows when the code of a stage changes its result, so that older results are recomputed."""

MAP_NAMES = ("profiles", "subsurface", "anisotropy", "translucency")
"""Products of a fiber probe's session; `products` maps each name to its maps and files."""
PROFILE_FILE, SUBSURFACE_FILE = "profiles.json", "subsurface.json"
ANISOTROPY_FILE = "anisotropy.json"
FILE_NAMES = (PROFILE_FILE, SUBSURFACE_FILE, ANISOTROPY_FILE)

CHANNEL_NAMES = ("red", "green", "blue")
MAP_SHAPE = (256, 256)
FALSE_ALARM_RATE = 0.01
"""Probability that isotropic tissue is reported as anisotropic, per site and channel."""


def products(_: Session) -> Mapping[str, tuple[str, ...]]:
    """Return the maps and files that each name of :data:`MAP_NAMES` means."""
    return {
        "profiles": (PROFILE_FILE,),
        "subsurface": (SUBSURFACE_FILE,),
        "anisotropy": (ANISOTROPY_FILE,),
        "translucency": ("translucency",),
    }


def graph(inputs: Inputs) -> list[stages.PipelineStage]:
    """Return the stages of a fiber probe's session.

    Raises
    ------
    InputsError
        When the session's rig has no probe, or the table of landmarks cannot be read.
    """
    probe = inputs.session.rig.probe
    if probe is None:
        got = "its rig has no probe, expected one with fibers"
        raise InputsError(f"{inputs.session.path}: {got}; give a session of the probe")
    view = inputs.session.rig.views[0]
    nominal = "the camera's gain and read noise are those of the rig file"
    sensor = inputs.load("sensor", [view.serial], nominal)
    fibers = _fibers(inputs)
    places = _places(inputs)
    stage = inputs.stage_maker(STAGE_REVISION)
    noise = CameraNoise.from_view(view)
    if sensor is not None:
        noise = CameraNoise.from_sensor(SensorCalibration.from_calibration(sensor, view.serial))
    uncalibrated = (
        "the fibers are not calibrated: capture a phantom of known optics (`--target phantom`), "
        "and give the folder that `skinrig calibrate fiber` makes of it as --calibration "
        "[SR-REC-019]"
    )
    profiles = partial(_profiles, inputs, fibers, noise)
    refused = "" if fibers is not None else uncalibrated
    fitted = f"_fits _sites {SUBSURFACE_FILE}"
    return [
        stage("profiles", "", f"_profiles {PROFILE_FILE}", profiles, refused),
        stage("subsurface", "_profiles", fitted, partial(_subsurface, probe)),
        stage("anisotropy", "_fits", ANISOTROPY_FILE, _anisotropy),
        stage("translucency", "_sites", "translucency", partial(_translucency, places, inputs)),
    ]


def _fibers(inputs: Inputs) -> FiberCalibration | None:
    rig = inputs.session.rig
    serial = rig.views[0].serial
    found = inputs.load("fiber", [serial], "nothing of the fibers")
    if found is None:
        inputs.assumed.remove("nothing of the fibers")
        return None
    return FiberCalibration.from_calibration(found, rig, serial)


def _profiles(
    inputs: Inputs, fibers: FiberCalibration | None, noise: CameraNoise
) -> Mapping[str, Any]:
    if fibers is None:
        raise InputsError("the fibers are not calibrated; give their calibration")
    images = ProbeImages(inputs.session, noise=noise)

    def measure(measurement: Measurement) -> MeasuredProfile:
        merged = images.merged(measurement)
        # the camera may have moved relative to the fibers since the calibration
        spots, _ = fibers.spots.track(merged, noise.pattern)
        readings = sum_spots(merged, spots, noise=noise)
        return MeasuredProfile(measurement, fibers.reflectance(readings, level=measurement.level))

    found = list(inputs.compute_tiles("profiles", images.measurements, measure))
    return {"_profiles": found, PROFILE_FILE: stages.serialize_document(_profile_document(found))}


def _profile_document(profiles: Sequence[MeasuredProfile]) -> dict[str, Any]:
    return {
        "schema": "skinrig.profiles/2",
        "unit": "1/mm^2, reflectance in the fiber",
        "radius_mm": profiles[0].reflectance.radius_mm,
        "fibers": profiles[0].reflectance.names,
        "measurements": [
            {
                **_head(profile.measurement),
                **stages.select_attributes(profile.measurement, "brackets suction_mbar camera_c"),
                "left_out": dict(profile.reflectance.reasons),
                "channels": {
                    channel: {
                        "reflectance_per_mm2": profile.reflectance.reflectance_per_mm2[:, c],
                        "stderr": profile.reflectance.stderr[:, c],
                        "stderr_own": np.sqrt(profile.reflectance.variance[:, c]),
                        "valid": profile.reflectance.valid[:, c],
                    }
                    for c, channel in enumerate(CHANNEL_NAMES)
                },
            }
            for profile in profiles
        ],
    }


def _subsurface(probe: Probe, _profiles: Sequence[MeasuredProfile]) -> Mapping[str, Any]:
    fits = {method: fit_profiles(_profiles, probe, method) for method in METHOD_NAMES}
    sites = site_values(fits[METHOD_NAMES[0]])
    document = {
        "schema": "skinrig.subsurface/1",
        "unit": "1/mm",
        "eta": ETA_SKIN,
        "methods": METHOD_NAMES,
        "recommended": METHOD_NAMES[0],
        "measurements": [
            {
                **_head(profile.measurement),
                "fits": [
                    _fit_document(fits[method][number], c)
                    for c in range(len(CHANNEL_NAMES))
                    for method in METHOD_NAMES
                ],
            }
            for number, profile in enumerate(_profiles)
        ],
        "sites": [_site_document(site, c) for site in sites for c in range(len(CHANNEL_NAMES))],
    }
    made = {"_fits": fits[METHOD_NAMES[0]], "_sites": sites}
    return made | {SUBSURFACE_FILE: stages.serialize_document(document)}


def _fit_document(one: ProfileFit, c: int) -> dict[str, Any]:
    fit = one.fit
    sigma_tr, total = float(fit.sigma_tr_per_mm[c]), float(one.log_total[c])
    shared = one.log_coefficients[:, c]
    names = "correlation coefficients_identified chi2 dof p_value inflation used"
    names += " predicted_per_mm2 residual valid"
    # the interval by the readings, widened by the errors common to all fibers
    widen = total / float(one.log_stderr[c]) if one.log_stderr[c] > 0 else 1.0
    with np.errstate(invalid="ignore"):
        interval = sigma_tr * (fit.interval_per_mm[c] / sigma_tr) ** widen
    return {
        "channel": CHANNEL_NAMES[c],
        "method": fit.method,
        "sigma_tr_per_mm": sigma_tr,
        "sigma_tr_stderr": sigma_tr * total,
        "sigma_tr_stderr_readings": sigma_tr * float(one.log_stderr[c]),
        "interval_per_mm": interval,
        "factor": fit.scale[c],
        "model_error": fit.model_error[c],
        "sigma_a_per_mm": fit.sigma_a_per_mm[c],
        "sigma_a_stderr": np.hypot(fit.sigma_a_stderr[c], shared[0] * fit.sigma_a_per_mm[c]),
        "sigma_s_prime_per_mm": fit.sigma_s_prime_per_mm[c],
        "sigma_s_prime_stderr": np.hypot(
            fit.sigma_s_prime_stderr[c], shared[1] * fit.sigma_s_prime_per_mm[c]
        ),
        **_of_channel(fit, names, c),
        "reason": fit.reason(c),
    }


def _of_channel(record: Any, names: str, c: int) -> dict[str, Any]:
    """Return one channel of a record's attributes, by their names, separated by spaces."""
    return {name: values[c] for name, values in stages.select_attributes(record, names).items()}


def _site_document(site: SiteValue, c: int) -> dict[str, Any]:
    sigma_tr, stderr = float(site.sigma_tr_per_mm[c]), float(site.stderr_per_mm[c])
    return {
        "site": site.site,
        "channel": CHANNEL_NAMES[c],
        "measurements": site.measurements[c],
        "sigma_tr_per_mm": sigma_tr,
        "sigma_tr_stderr": stderr,
        "translucency_mm": 1.0 / sigma_tr,
        "translucency_stderr_mm": stderr / sigma_tr**2,
    }


def _anisotropy(_fits: Sequence[ProfileFit]) -> bytes:
    """Estimate the anisotropy of every site and repeat with enough directions."""
    rows: list[dict[str, Any]] = []
    skipped: list[str] = []
    for (site, repeat), group in profile_groups([fit.profile for fit in _fits]).items():
        own = [_fits[number] for number in group]
        if len(own) < MIN_DIRECTIONS:
            why = f"{len(own)} directions, expected at least {MIN_DIRECTIONS}"
            skipped.append(f"{site}, repeat {repeat}: {why}")
            continue
        angle = np.radians([fit.profile.measurement.placement.angle_deg for fit in own])
        sigma_tr = np.stack([fit.fit.sigma_tr_per_mm for fit in own])
        valid = np.stack([fit.fit.valid for fit in own])
        stderr = sigma_tr * np.stack([fit.log_stderr for fit in own])
        found = anisotropy.estimate(
            angle, np.where(valid, sigma_tr, 1.0), np.where(valid, stderr, np.inf), valid=valid
        )
        bias = estimate_single_direction_bias(found, angle)
        off = np.maximum(np.abs(bias.lowest), np.abs(bias.highest))
        for c, channel in enumerate(CHANNEL_NAMES):
            rows.append(
                {
                    "site": site,
                    "repeat": repeat,
                    "channel": channel,
                    "directions": int(found.used[:, c].sum()),
                    **_of_channel(found, "ratio ratio_stderr", c),
                    "axis_deg": math.degrees(found.axis_rad[c]),
                    "axis_stderr_deg": math.degrees(found.axis_stderr_rad[c]),
                    "p_value": found.p_value[c],
                    "anisotropic": bool(found.valid[c] and found.p_value[c] < FALSE_ALARM_RATE),
                    **_of_channel(found, "mean_per_mm mean_stderr_per_mm tilt tilt_p_value", c),
                    "worst_direction_percent": 100.0 * off[c],
                    "valid": found.valid[c],
                    "reason": str(found.reason[c]),
                }
            )
    document = {"schema": "skinrig.anisotropy/1", "false_alarm_rate": FALSE_ALARM_RATE}
    return stages.serialize_document(document | {"sites": rows, "left_out": skipped})


def _places(inputs: Inputs) -> Mapping[str, tuple[float, float]]:
    """Return the sites' texture coordinates, u and v by name; a bad table is refused at once."""
    places = dict(probe_sites.SITE_UV)
    if inputs.landmarks is None:
        return places
    try:
        return places | probe_sites.read_landmarks(inputs.landmarks, texture_px=MAP_SHAPE)
    except translucency.TranslucencyError as error:
        raise InputsError(f"landmarks: {error}") from error


def _translucency(
    places: Mapping[str, tuple[float, float]], inputs: Inputs, _sites: Sequence[SiteValue]
) -> SkinMap:
    """Interpolate 1/sigma_tr over a face's texture from the sites with known positions."""
    placed = [site for site in _sites if site.site in places]
    unplaced = [site.site for site in _sites if site.site not in places]
    got = f"measurements of {', '.join(unplaced)}"
    known = f"some of {', '.join(places)}, whose positions on a face are known"
    expected = f"{known}; give a table of landmarks with the others"
    Checks(InputsError).require(placed, "translucency", got, expected)
    found = translucency.interpolate(
        [places[site.site] for site in placed],
        np.stack([np.nan_to_num(site.sigma_tr_per_mm, nan=1.0) for site in placed]),
        np.stack([site.stderr_per_mm for site in placed]),
        MAP_SHAPE,
        valid=np.stack([site.measurements > 0 for site in placed]),
        names=[site.site for site in placed],
    )
    left_out = [f"{site}: its position on a face is not known" for site in unplaced]
    left_out += [f"{site}: {why}" for site, why in found.omitted]
    inputs.noted["translucency_left_out"] = left_out
    inputs.assumed += [f"translucency omits {text}" for text in left_out]
    inputs.noted["translucency_conflicts"] = [": ".join(pair) for pair in found.conflicts]
    what = "1/sigma_tr of red, green and blue light, between measured sites by kriging"
    return SkinMap(found.values, "mm", found.stderr, np.asarray(found.valid.all(axis=-1)), what)


def _head(measurement: Measurement) -> dict[str, Any]:
    where = stages.select_attributes(measurement.placement, "site repeat angle_deg")
    return {"name": measurement.name} | where
