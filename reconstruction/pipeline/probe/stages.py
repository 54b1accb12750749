"""The fibre probe's stages: series of exposures to profiles, coefficients and translucency."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture.calibration.fiber.darks import CameraNoise
from capture.calibration.fiber.gains import FibreCalibration, FibreReflectance
from capture.calibration.fiber.readings import sum_spots
from capture.calibration.sensor import SensorCalibration
from capture.rig import Probe
from capture.session import Session
from model.fresnel import ETA_SKIN
from model.skin import SkinMap
from reconstruction import subsurface
from reconstruction.anisotropy import estimation as anisotropy
from reconstruction.anisotropy.direction_harmonics import LEAST_DIRECTIONS
from reconstruction.anisotropy.one_direction_bias import one_direction_bias
from reconstruction.arrays import BoolArray, Float64Array, Int64Array
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.evidence import Evidence, EvidenceError
from reconstruction.pipeline.probe.images import Measurement, ProbeImages
from reconstruction.subsurface import SubsurfaceFit, translucency
from reconstruction.subsurface import nearest as nearest_medium

STAGE_REVISION = 7
"""Grows when the code of a stage changes its result, so that older results are computed again."""

MAP_NAMES = ("profiles", "subsurface", "anisotropy", "translucency")
"""What can be made of a session of the fibre probe; see `products` for what it stands for."""
PROFILE_FILE, SUBSURFACE_FILE = "profiles.json", "subsurface.json"
ANISOTROPY_FILE = "anisotropy.json"
FILE_NAMES = (PROFILE_FILE, SUBSURFACE_FILE, ANISOTROPY_FILE)

CHANNEL_NAMES = ("red", "green", "blue")
METHOD_NAMES = ("photon_table", "diffusion", "dipole")
"""The first is the recommended one; the others stand beside it."""
MAP_SHAPE = (256, 256)
FALSE_ALARMS = 0.01
"""Chance at which isotropic tissue is called anisotropic, per site and channel."""

MAX_HOMOGENEOUS_MISFIT = 0.03
"""Relative misfit from which a bent profile is that of no homogeneous medium, but of layered
tissue. What each fibre has off by itself, as by dirt on it, bends none."""


def products(_: Session) -> Mapping[str, tuple[str, ...]]:
    """Return the maps and files that each name of :data:`MAP_NAMES` stands for."""
    return {
        "profiles": (PROFILE_FILE,),
        "subsurface": (SUBSURFACE_FILE,),
        "anisotropy": (ANISOTROPY_FILE,),
        "translucency": ("translucency",),
    }


@dataclass(frozen=True, slots=True)
class Profile:
    """What the fibres took at one placement."""

    measurement: Measurement
    reflectance: FibreReflectance


@dataclass(frozen=True, slots=True)
class ProfileFit:
    """Coefficients that one method finds for one profile, in every channel.

    Attributes
    ----------
    profile : Profile
    fit : SubsurfaceFit
        Leading axis the channels.
    log_stderr : ndarray, shape (C,)
        Standard error of log sigma_tr by the readings, the single fibres and the model.
    log_common : ndarray, shape (T, C)
        Change of log sigma_tr for one standard uncertainty of each cause that all fibres and all
        measurements share: what the phantom's certificate leaves uncertain.
    log_coefficients : ndarray, shape (2, C)
        Root sum square of such changes of log sigma_a and log sigma_s'.
    """

    profile: Profile
    fit: SubsurfaceFit
    log_stderr: Float64Array
    log_common: Float64Array
    log_coefficients: Float64Array

    @property
    def log_total(self) -> Float64Array:
        """Standard error of log sigma_tr by all causes, shape (C,)."""
        return np.asarray(np.sqrt(self.log_stderr**2 + (self.log_common**2).sum(axis=0)))


@dataclass(frozen=True, slots=True)
class SiteValue:
    """sigma_tr of a site over its placements, by the recommended method.

    Attributes
    ----------
    site : str
    measurements : ndarray of int, shape (C,)
        Fits it rests on.
    sigma_tr_per_mm, stderr_per_mm : ndarray, shape (C,)
        Mean of the logarithms; NaN and infinite where no fit is valid.
    """

    site: str
    measurements: Int64Array
    sigma_tr_per_mm: Float64Array
    stderr_per_mm: Float64Array


def graph(evidence: Evidence) -> list[stages.Stage]:
    """Return the stages that a session of the fibre probe can go through.

    Raises
    ------
    EvidenceError
        When the session's rig has no probe, or the table of landmarks cannot be read.
    """
    probe = evidence.session.rig.probe
    if probe is None:
        raise EvidenceError(
            f"{evidence.session.path}: its rig has no probe, expected one with fibres"
        )
    serial = evidence.session.rig.views[0].serial
    nominal = "the camera's gain and read noise are those of the rig file"
    sensor = evidence.load("sensor", [serial], nominal)
    fibres = _fibres(evidence)
    places = _places(evidence)
    base = {"revision": STAGE_REVISION, "inputs": dict(sorted(evidence.hashes.items()))}
    return [
        stages.Stage(
            "profiles",
            (),
            ("_profiles", PROFILE_FILE),
            lambda: _profiles(evidence, fibres, sensor),
            base,
            refused=""
            if fibres is not None
            else (
                "the fibres are not calibrated: capture a phantom of known optics "
                "(`--target phantom`), and give the folder that `skinrig calibrate fibre` makes of "
                "it as --calibration"
            ),
        ),
        stages.Stage(
            "subsurface",
            ("_profiles",),
            ("_fits", "_sites", SUBSURFACE_FILE),
            lambda _profiles: _subsurface(_profiles, probe),
            base,
        ),
        stages.Stage(
            "anisotropy",
            ("_fits",),
            (ANISOTROPY_FILE,),
            lambda _fits: {ANISOTROPY_FILE: _anisotropy(_fits)},
            base,
        ),
        stages.Stage(
            "translucency",
            ("_sites",),
            ("translucency",),
            lambda _sites: _translucency(_sites, places, evidence),
            base,
        ),
    ]


def _fibres(evidence: Evidence) -> FibreCalibration | None:
    rig = evidence.session.rig
    serial = rig.views[0].serial
    found = evidence.load("fibre", [serial], "nothing of the fibres")
    if found is None:
        evidence.assumed.remove("nothing of the fibres")
        return None
    return FibreCalibration.from_calibration(found, rig, serial)


def _profiles(
    evidence: Evidence, fibres: FibreCalibration | None, sensor: Any
) -> Mapping[str, Any]:
    if fibres is None:
        raise EvidenceError("the fibres are not calibrated")
    view = evidence.session.rig.views[0]
    noise = CameraNoise.of_view(view)
    if sensor is not None:
        noise = CameraNoise.of_sensor(SensorCalibration.from_calibration(sensor, view.serial))
    images = ProbeImages(evidence.session, noise=noise)
    found = []
    for number, measurement in enumerate(images.measurements):
        evidence.tell("profiles", number / len(images.measurements))
        merged = images.merged(measurement)
        # the camera may have moved against the fibres since they were calibrated
        spots, _ = fibres.spots.moved(merged, noise.pattern)
        readings = sum_spots(merged, spots, noise=noise)
        found.append(Profile(measurement, fibres.reflectance(readings, level=measurement.level)))
    return {"_profiles": found, PROFILE_FILE: stages.document_bytes(_profile_document(found))}


def _profile_document(profiles: Sequence[Profile]) -> dict[str, Any]:
    return {
        "schema": "skinrig.profiles/1",
        "unit": "1/mm^2, reflectance in the fibre",
        "radius_mm": profiles[0].reflectance.radius_mm,
        "fibres": profiles[0].reflectance.names,
        "measurements": [
            {
                **_head(profile.measurement),
                "brackets": profile.measurement.brackets,
                "suction_mbar": profile.measurement.suction_mbar,
                "camera_c": profile.measurement.camera_c,
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


def _subsurface(profiles: Sequence[Profile], probe: Probe) -> Mapping[str, Any]:
    fits = {method: fit_profiles(profiles, probe, method) for method in METHOD_NAMES}
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
            for number, profile in enumerate(profiles)
        ],
        "sites": [_site_document(site, c) for site in sites for c in range(len(CHANNEL_NAMES))],
    }
    return {
        "_fits": fits[METHOD_NAMES[0]],
        "_sites": sites,
        SUBSURFACE_FILE: stages.document_bytes(document),
    }


def fit_profiles(
    profiles: Sequence[Profile], probe: Probe, method: Any = METHOD_NAMES[0]
) -> list[ProfileFit]:
    """Fit all profiles and channels, also with each common error at its uncertainty."""
    first = profiles[0].reflectance
    causes = len(first.common_per_mm2)
    # (1 + T, M, C, F): as measured, then with one standard uncertainty of each cause
    value = np.stack([p.reflectance.reflectance_per_mm2.T for p in profiles])
    common = np.stack([p.reflectance.common_per_mm2.transpose(0, 2, 1) for p in profiles], axis=1)
    every = np.concatenate([value[None], value[None] + common])

    told: dict[str, Any] = {
        "variance": np.stack([p.reflectance.variance.T for p in profiles]),
        "valid": np.stack([p.reflectance.valid.T for p in profiles]),
        "collection": "fibre",
        "core_mm": probe.fibres[0].core_mm,
        "source_core_mm": probe.source_core_mm,
    }
    fit = subsurface.invert(first.radius_mm, every, method=method, **told)
    if np.any(unlike := fit.bent[0] & (fit.model_error[0] > MAX_HOMOGENEOUS_MISFIT)):
        if method == METHOD_NAMES[0]:
            other = subsurface.nearest_medium(first.radius_mm, every, **told)
        else:
            other = subsurface.invert(
                first.radius_mm, every, method=method, common_error=nearest_medium.DIMMING, **told
            )
        unlike = _layered(profiles, unlike, other.scale[0])
        fit = _either(fit, other, np.broadcast_to(unlike, fit.valid.shape))

    def change_of(coefficient: Float64Array) -> Float64Array:
        logs = np.log(coefficient)
        return np.asarray(np.nan_to_num(logs[1:] - logs[0]))

    change = change_of(fit.sigma_tr_per_mm)
    pair = [change_of(fit.sigma_a_per_mm), change_of(fit.sigma_s_prime_per_mm)]
    shared = np.sqrt(np.square(pair).sum(axis=1))  # (2, M, C)
    log_stderr = fit.sigma_tr_stderr[0] / fit.sigma_tr_per_mm[0]
    return [
        ProfileFit(
            profile,
            _one(fit, (0, number)),
            log_stderr[number],
            change[:, number].reshape(causes, -1),
            shared[:, number],
        )
        for number, profile in enumerate(profiles)
    ]


def _layered(profiles: Sequence[Profile], unlike: BoolArray, factor: Float64Array) -> BoolArray:
    """Return which profiles are fitted as those of layers, (M, C); a turn is of one tissue.

    A layer on top dims in all directions. Tissue that scatters by direction is unlike any medium,
    too, but the factors that it asks for lie on both sides of 1; fitted by some of its directions
    with a factor and by others without, its sigma_tr would jump between them.
    """
    found = np.array(unlike)
    for group in _turns(profiles).values():
        if len({profiles[k].measurement.placement.angle_deg for k in group}) >= LEAST_DIRECTIONS:
            dims = (factor[group] < 1.0).all(axis=0)
            found[group] = dims & (2 * unlike[group].sum(axis=0) > len(group))
    return found


def _turns(profiles: Sequence[Profile]) -> dict[tuple[str, int], list[int]]:
    """Return the numbers of profiles of each site and repeat, in all directions of the head."""
    groups: dict[tuple[str, int], list[int]] = {}
    for number, profile in enumerate(profiles):
        placement = profile.measurement.placement
        groups.setdefault((placement.site, placement.repeat), []).append(number)
    return groups


def _either(fit: SubsurfaceFit, other: SubsurfaceFit, there: BoolArray) -> SubsurfaceFit:
    """Return one batch's fits, but another's where told to."""
    merged = {}
    for name in (field.name for field in dataclasses.fields(fit) if field.name != "method"):
        own = getattr(fit, name)
        mask = there.reshape(there.shape + (1,) * (own.ndim - there.ndim))
        merged[name] = np.where(mask, getattr(other, name), own)
    return dataclasses.replace(fit, **merged)


def _one(fit: SubsurfaceFit, index: tuple[int, ...]) -> SubsurfaceFit:
    """Return some of a batch's fits."""
    names = [field.name for field in dataclasses.fields(fit) if field.name != "method"]
    return dataclasses.replace(fit, **{name: getattr(fit, name)[index] for name in names})


def site_values(fits: Sequence[ProfileFit]) -> list[SiteValue]:
    """Average the placements of each site; what they share is not averaged away.

    Placements differ by more than their fits know of, as contact does: where their scatter is
    larger than their standard errors, it is what counts.
    """
    found = []
    for site in dict.fromkeys(fit.profile.measurement.placement.site for fit in fits):
        own = [fit for fit in fits if fit.profile.measurement.placement.site == site]
        valid = np.stack([fit.fit.valid for fit in own])  # (M, C)
        log_tr = np.stack([np.log(fit.fit.sigma_tr_per_mm) for fit in own])
        spread = np.stack([fit.log_stderr for fit in own])
        weight = np.where(valid, 1.0 / np.where(valid, spread, 1.0) ** 2, 0.0)
        total, count = weight.sum(axis=0), valid.sum(axis=0)
        known = count > 0
        mean = (weight * np.where(valid, log_tr, 0.0)).sum(axis=0) / np.where(known, total, 1.0)
        scatter = (weight * np.where(valid, log_tr - mean, 0.0) ** 2).sum(axis=0)
        inflation = np.maximum(scatter / np.maximum(count - 1, 1), 1.0)
        shared = np.mean([fit.log_common for fit in own], axis=0)
        with np.errstate(divide="ignore"):
            variance = inflation / total + (shared**2).sum(axis=0)
        sigma_tr = np.where(known, np.exp(mean), np.nan)
        found.append(
            SiteValue(site, count, sigma_tr, np.where(known, sigma_tr * np.sqrt(variance), np.inf))
        )
    return found


def _fit_document(one: ProfileFit, c: int) -> dict[str, Any]:
    fit = one.fit
    sigma_tr, total = float(fit.sigma_tr_per_mm[c]), float(one.log_total[c])
    shared = one.log_coefficients[:, c]
    # the interval of the readings, widened by what all fibres share
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
        "correlation": fit.correlation[c],
        "coefficients_identified": fit.coefficients_identified[c],
        "chi2": fit.chi2[c],
        "dof": fit.dof[c],
        "p_value": fit.p_value[c],
        "inflation": fit.inflation[c],
        "used": fit.used[c],
        "predicted_per_mm2": fit.predicted_per_mm2[c],
        "residual": fit.residual[c],
        "valid": fit.valid[c],
        "reason": fit.reason(c),
    }


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


def _anisotropy(fits: Sequence[ProfileFit]) -> bytes:
    """Tell the dependence on direction at every site and repeat with enough directions."""
    rows: list[dict[str, Any]] = []
    skipped: list[str] = []
    for (site, repeat), group in _turns([fit.profile for fit in fits]).items():
        own = [fits[number] for number in group]
        if len(own) < LEAST_DIRECTIONS:
            skipped.append(
                f"{site}, repeat {repeat}: {len(own)} directions, expected at least "
                f"{LEAST_DIRECTIONS}"
            )
            continue
        angle = np.radians([fit.profile.measurement.placement.angle_deg for fit in own])
        sigma_tr = np.stack([fit.fit.sigma_tr_per_mm for fit in own])
        valid = np.stack([fit.fit.valid for fit in own])
        stderr = sigma_tr * np.stack([fit.log_stderr for fit in own])
        found = anisotropy.estimate(
            angle, np.where(valid, sigma_tr, 1.0), np.where(valid, stderr, np.inf), valid=valid
        )
        bias = one_direction_bias(found, angle)
        off = np.maximum(np.abs(bias.lowest), np.abs(bias.highest))
        for c, channel in enumerate(CHANNEL_NAMES):
            rows.append(
                {
                    "site": site,
                    "repeat": repeat,
                    "channel": channel,
                    "directions": int(found.used[:, c].sum()),
                    "ratio": found.ratio[c],
                    "ratio_stderr": found.ratio_stderr[c],
                    "axis_deg": math.degrees(found.axis_rad[c]),
                    "axis_stderr_deg": math.degrees(found.axis_stderr_rad[c]),
                    "p_value": found.p_value[c],
                    "anisotropic": bool(found.valid[c] and found.p_value[c] < FALSE_ALARMS),
                    "mean_per_mm": found.mean_per_mm[c],
                    "mean_stderr_per_mm": found.mean_stderr_per_mm[c],
                    "tilt": found.tilt[c],
                    "tilt_p_value": found.tilt_p_value[c],
                    "worst_direction_percent": 100.0 * off[c],
                    "valid": found.valid[c],
                    "reason": str(found.reason[c]),
                }
            )
    return stages.document_bytes(
        {
            "schema": "skinrig.anisotropy/1",
            "false_alarm_rate": FALSE_ALARMS,
            "sites": rows,
            "left_out": skipped,
        }
    )


def _places(evidence: Evidence) -> Mapping[str, tuple[float, float]]:
    """Return where sites lie on a face's texture, u and v by name; a bad table is told at once."""
    places = dict(translucency.SITE_UV)
    if evidence.landmarks is None:
        return places
    try:
        return places | translucency.read_landmarks(evidence.landmarks, texture_px=MAP_SHAPE)
    except translucency.TranslucencyError as error:
        raise EvidenceError(f"landmarks: {error}") from error


def _translucency(
    sites: Sequence[SiteValue], places: Mapping[str, tuple[float, float]], evidence: Evidence
) -> Mapping[str, SkinMap]:
    """Spread 1/sigma_tr over a face's texture from the sites whose place is known."""
    placed = [site for site in sites if site.site in places]
    unplaced = [site.site for site in sites if site.site not in places]
    if not placed:
        raise EvidenceError(
            f"translucency: got measurements of {', '.join(unplaced)}, expected some of "
            f"{', '.join(places)}, whose places on a face are known; a table of landmarks may "
            "name others"
        )
    found = translucency.interpolate(
        [places[site.site] for site in placed],
        np.stack([np.nan_to_num(site.sigma_tr_per_mm, nan=1.0) for site in placed]),
        np.stack([site.stderr_per_mm for site in placed]),
        MAP_SHAPE,
        valid=np.stack([site.measurements > 0 for site in placed]),
        names=[site.site for site in placed],
    )
    left_out = [f"{site}: its place on a face is not known" for site in unplaced]
    left_out += [f"{site}: {why}" for site, why in found.left_out]
    evidence.noted["translucency_left_out"] = left_out
    evidence.assumed += [f"translucency goes without {text}" for text in left_out]
    evidence.noted["translucency_conflicts"] = [": ".join(pair) for pair in found.conflicts]
    return {
        "translucency": SkinMap(
            found.values,
            "mm",
            found.stderr,
            np.asarray(found.valid.all(axis=-1)),
            "1/sigma_tr of red, green and blue light, between measured sites by kriging",
        )
    }


def _head(measurement: Measurement) -> dict[str, Any]:
    placement = measurement.placement
    return {
        "name": measurement.name,
        "site": placement.site,
        "repeat": placement.repeat,
        "angle_deg": placement.angle_deg,
    }
