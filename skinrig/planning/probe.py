"""Plans of the fibre probe: which exposures, placements and sites sigma_tr needs.

The forecast puts simulated skin under the fibres, tells how much light each of them gives to the
camera in each exposure, and asks the inversion itself what such readings are worth: Fisher's
information by the derivatives of the photon table, the misfit of layers, and the certificate of the
phantom, which no exposure removes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.plan import Plan, PlanError
from capture.plan.probe import BRACKETS, LONGEST_S, SITES, exposure_series_s, probe_plan
from capture.plan.suction import Placement, placement_of
from capture.rig import Rig
from skinrig.planning.plans import (
    Choice,
    Forecast,
    PlanningError,
    light_of,
    median_of_normals,
)

Floats = NDArray[np.float64]

SHORTEST_S = exposure_series_s()[0]
"""Of the rig's own series: the nearest fibre must not saturate in it."""
SERIES = (3, 4, 6, 8, 12, BRACKETS)
"""How many exposures a series may have."""
LONGEST = (0.5, 1.0, 2.0, 4.0, 8.0, 15.0, LONGEST_S)
"""Its longest one, s."""
REPEATS = (1, 2, 4)
DARKS = (1, 2)
SATURATED = 0.95
CROSSTALK_ERROR = (0.0, 8.5e-6, 6.3e-6, 9.3e-7, 2.5e-7)
"""Standard error of the share of a fibre's light in a spot so many places away, the last of all
farther ones: medians of twenty simulated calibrations of the shipped rig, seeds 0 to 19."""
FORECAST_SPREAD = 0.2
"""Relative deviation of standard errors that sessions state from those that were forecast: those
of three sessions were 0.7 to 1.5 times as large, about two of it either way."""
DRAWS = 40_000
"""Of calibrations and readings, for the interval of a median."""
MAP_PX = 32


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What the fibres take from simulated skin, and what the camera makes of it."""

    sites: tuple[str, ...]
    reflectance: Floats
    """(S, F, 3) in 1/mm^2."""
    phantom: Floats
    """(F, 3) of the block that the probe is calibrated with."""
    phantom_error: Floats
    """(F, 3) relative error of what the block is expected to give, each fibre's own: the photon
    table's."""
    common: Floats
    """(T, F, 3) relative errors of all gains together, by the certificate."""
    unit: Floats
    """(3,) full scales per second in the middle of a spot, for 1/mm^2."""
    pixels: Floats
    """(3,) of each color in a spot."""
    chip: Any
    """The sensor, see `rigsim.sensor.Sensor`."""
    probe: Any


@dataclass(frozen=True, slots=True)
class Setting:
    """What of a plan sigma_tr hangs on."""

    sites: tuple[str, ...]
    exposures_s: tuple[float, ...]
    repeats: int
    darks: int
    """Frames without light of each exposure time that has some."""
    level: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Relative errors of sigma_tr by site and color."""

    sites: tuple[str, ...]
    sigma: Floats
    """(S, 3) standard error: readings, misfit, certificate; of sites that are not measured what
    the others and people in general leave open. What a fit without noise is off on this skin is
    one draw of the misfit that this states, and not counted beside it."""
    shared: Floats
    """(T, S, 3) the calibration's part, certificate and far cross-talk: what each of its errors
    does to all sites and colors together, which no median averages out."""
    misfit: Floats
    """(S, 3) what stays without any noise."""
    valid: NDArray[np.bool_]
    """(S, 3)."""
    measured: NDArray[np.bool_]
    """(S,)."""

    @property
    def total(self) -> Floats:
        """Standard deviation of the error of what is measured and valid."""
        return np.asarray(self.sigma[self.valid & self.measured[:, None]])

    @property
    def median(self) -> float:
        """Predicted median relative error over measured sites and colors."""
        return median_of_normals(self.total)

    @property
    def common(self) -> Floats:
        """Standard error of the calibration's part, (S, 3)."""
        return np.asarray(np.sqrt(np.square(self.shared).sum(axis=0)))

    def interval(self) -> tuple[float, float]:
        """Return the interval that holds 68 % of the medians of a session's errors.

        Errors that all fits share move the median as a whole: nine fits of one calibration are
        hardly more than one.
        """
        good = self.valid & self.measured[:, None]
        if not good.any():
            return math.inf, math.inf
        shared = self.shared[:, good]
        own = np.sqrt(np.maximum(self.sigma[good] ** 2 - np.square(shared).sum(axis=0), 0.0))
        rng = np.random.default_rng(0)
        off = rng.standard_normal((DRAWS, len(shared))) @ shared
        off += own * rng.standard_normal((DRAWS, own.size))
        ends = np.quantile(np.median(np.abs(off), axis=1), (0.16, 0.84))
        # that, and how well a session's standard errors are known beforehand, as logarithms
        low, high = np.hypot(np.log(ends / self.median), math.log(1.0 + FORECAST_SPREAD))
        return self.median * math.exp(-low), self.median * math.exp(high)

    @property
    def valid_share(self) -> float:
        """Share of the fits at measured sites that will be valid."""
        return float(self.valid[self.measured].mean()) if self.measured.any() else 0.0


def sight(rig: Rig, subject: str, *, seed: int = 0, sites: Sequence[str] = SITES) -> Sight:
    """Look at simulated skin through the fibres.

    Parameters
    ----------
    rig
        The probe's.
    subject, seed
        The tissue, see `rigsim.probe_tissue.parse_subject`.
    sites
        Where the head may be placed.
    """
    from rigsim.probe_build import SPOT_RADIUS_PX
    from rigsim.probe_profile import Profiles
    from rigsim.probe_tissue import parse_subject
    from rigsim.scenes.probe import DARK_E_PER_S, METER_RATE_PER_S, VIGNETTING
    from rigsim.sensor import sensor_of
    from skinrig.phantom_reflectance import expected_reflectance, packaged_certificate
    from skinrig.simulating.probe import PHOTONS

    if rig.probe is None:
        raise PlanningError(f"rig: got {rig.name!r} without a probe, expected one with fibres")
    tissue = parse_subject(subject, seed=seed)
    profiles = Profiles(rig, tissue, photons=PHOTONS["small"], seed=seed)
    made = [profiles.profile(site, 0.0, rig.probe.suction_mbar) for site in sites]
    reflectance = np.stack([one.reflectance_per_mm2 for one in made])
    block = expected_reflectance(packaged_certificate(), rig)
    view = rig.views[0]
    from model import spectra

    white = spectra.camera_white(view.spectral_sensitivity, rig.lights[0].illuminant)
    area = math.pi * SPOT_RADIUS_PX**2
    return Sight(
        tuple(sites), reflectance, block.per_mm2, block.stderr / block.per_mm2, block.common,
        METER_RATE_PER_S * np.asarray(white, np.float64), area * np.array([0.25, 0.5, 0.25]),
        sensor_of(view, dark_e_per_s=DARK_E_PER_S, vignetting=VIGNETTING), rig.probe,
    )  # fmt: skip


Memory = dict[tuple[Any, ...], Sequence[Any]]
"""Fits of one `Sight` by what they hang on: plans that differ in placements alone share them, and
without noise nearly all do."""


def predict(look: Sight, setting: Setting, *, memory: Memory | None = None) -> Prediction:
    """Return the errors that a plan leaves.

    Placements lower what the readings' noise leaves, and neither the misfit of layers nor what the
    calibration leaves open.

    Parameters
    ----------
    look
        See `sight`.
    setting
        Sites, exposures, placements and darks.
    memory
        Fits of earlier plans of the same sight, which is added to; None: none are kept.
    """
    memory = {} if memory is None else memory
    shape = (len(look.sites), 3)
    sigma, shared = np.full(shape, np.inf), np.zeros((0, *shape))
    still, found = np.full(shape, np.inf), np.ones(shape)
    valid = np.zeros(shape, np.bool_)
    measured = np.zeros(len(look.sites), np.bool_)
    places = [k for k, site in enumerate(look.sites) if site in setting.sites]
    with_noise, without = (
        _fits(look, setting, places, noise=noise, memory=memory) for noise in (True, False)
    )
    for k, fit, quiet in zip(places, with_noise, without, strict=True):
        measured[k] = True
        valid[k] = fit.fit.valid
        found[k] = fit.fit.sigma_tr_per_mm
        if not len(shared):
            shared = np.zeros((len(fit.log_common), *shape))
        shared[:, k] = fit.log_common
        common = np.sqrt(np.square(fit.log_common).sum(axis=0))
        stays = np.minimum(quiet.log_stderr, fit.log_stderr)
        noise = np.where(np.isfinite(stays), fit.log_stderr**2, np.inf) / setting.repeats
        noise -= np.where(np.isfinite(stays), stays**2, 0.0) / setting.repeats
        still[k] = np.hypot(stays, common)
        sigma[k] = np.sqrt(still[k] ** 2 + noise)
    rest = _between(look, found, sigma, valid & measured[:, None])
    sigma[~measured] = rest[~measured]
    return Prediction(look.sites, sigma, shared, still, valid, measured)


def _fits(
    look: Sight, setting: Setting, places: Sequence[int], *, noise: bool, memory: Memory
) -> Sequence[Any]:
    """Return the fits of each site's profile as a plan would read it, or without its noise."""
    read = [
        _variance(look, look.reflectance[k], setting.exposures_s, setting.darks, setting.level)
        for k in places
    ]
    # of the readings' noise a fit without it asks only which fibres are read at all
    told = np.array(read) if noise else np.isfinite(read)
    count = len(setting.exposures_s)
    key = (noise, tuple(places), count, told.tobytes())
    if key not in memory:
        memory[key] = _fitted(look, read, places, count, noise=noise)
    return memory[key]


def _fitted(
    look: Sight, read: Sequence[Floats], places: Sequence[int], exposures: int, *, noise: bool
) -> Sequence[Any]:
    """Return the fits of profiles with these variances of their readings."""
    from capture.calibration.fibre import FibreReflectance
    from reconstruction.probe_images import Measurement
    from reconstruction.probe_stages import Profile, fit_profiles

    names = tuple(fibre.name for fibre in look.probe.fibres)
    radius = np.array(look.probe.radius_mm)
    # gains are known from a series of all exposures on the phantom, as far as its light is known
    gain = _variance(look, look.phantom, exposure_series_s(), 4, 1.0) / look.phantom**2
    gain += look.phantom_error**2
    mixed = _crosstalk(len(radius))
    profiles = []
    for k, own in zip(places, read, strict=True):
        value = look.reflectance[k]
        valid = np.isfinite(own)
        variance = np.where(valid, own, 0.0) if noise else np.zeros_like(own)
        told = (value, look.phantom, value / look.phantom)
        doubt, shared = mixed.matrix_variance(*told), mixed.shared_changes(*told)
        reflectance = FibreReflectance(
            names, radius, value, variance + gain * value**2 + doubt,
            np.concatenate([value * look.common, shared]), valid, ~valid,
        )  # fmt: skip
        head = Measurement(Placement(look.sites[k], 0.0, 0), exposures, 1.0, math.nan, 5.0)
        profiles.append(Profile(head, reflectance))
    return fit_profiles(profiles, look.probe) if profiles else []


def choose(
    rig: Rig, wants: Mapping[str, float], *, subject: str = "III", seed: int = 0,
    valid_share: float = 0.9,
) -> Choice:  # fmt: skip
    """Choose the quickest plan that reaches what is wanted.

    Parameters
    ----------
    rig
        The probe's.
    wants
        By name: "sigma_tr" in percent, the median of the relative error over sites and colors;
        empty: the forecast of the rig's own plan.
    subject, seed
        The skin that is forecast.
    valid_share
        Of the fits that the rig's own plan makes valid, so many must stay so.
    """
    look = sight(rig, subject, seed=seed)
    own = probe_plan(rig)
    if not wants:
        return _choice(rig, look, own, setting_of(own), wants)
    target = wants.get("sigma_tr", math.inf) / 100.0
    memory: Memory = {}
    whole = predict(look, setting_of(own), memory=memory)

    def good(found: Prediction) -> bool:
        left = found.sigma[~found.measured]
        return (
            found.valid_share >= valid_share * whole.valid_share
            and found.median <= target
            # a site that is left out must be told by the others as well as is wanted
            and (not left.size or median_of_normals(left) <= target)
        )

    tried: list[tuple[Setting, Plan, Prediction]] = []
    for setting, plan in candidates(rig, look):
        tried.append((setting, plan, predict(look, setting, memory=memory)))
        if good(tried[-1][2]):
            break
    path = tuple(
        {
            "exposures": float(len(one.exposures_s)), "longest_s": one.exposures_s[-1],
            "repeats": float(one.repeats), "seconds": plan.estimated_s(rig),
            "sigma_tr_percent": 100.0 * found.median, "valid_share": found.valid_share,
        }
        for one, plan, found in tried
    )  # fmt: skip
    setting, plan, found = tried[-1]
    reasons: tuple[str, ...] = ()
    if good(found):
        setting, plan = without_sites(look, setting, plan, good)
    else:
        reasons = (_why(look, whole, target),)
        least = valid_share * whole.valid_share
        best = min(one[2].median for one in tried if one[2].valid_share >= least)
        setting, plan, _ = next(
            one for one in tried if one[2].median <= 1.05 * best and one[2].valid_share >= least
        )
    return _choice(rig, look, plan, setting, wants, path=path, reasons=reasons)


def foresee(
    rig: Rig, plan: Plan, wants: Mapping[str, float], *, subject: str = "III", seed: int = 0
) -> Choice:
    """Return what a plan of the probe will give at its sites."""
    setting = setting_of(plan)
    look = sight(rig, subject, seed=seed, sites=setting.sites)
    return _choice(rig, look, plan, setting, wants)


def confirm(
    choice: Choice, out: Path, *, subject: str, seed: int, progress: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Simulate the skin of a choice and the phantom, reconstruct, compare with the truth."""
    from model import store
    from reconstruction import pipeline
    from reconstruction.probe_stages import METHODS
    from skinrig.calibrating.calibrate import calibrate
    from skinrig.evaluating import subsurface
    from skinrig.simulating.simulation import simulate_session

    progress("simulate phantom")
    simulate_session("probe", out / "session-phantom", target="phantom", seed=seed)
    calibrate("fibre", [out / "session-phantom"], out / "calibration")
    progress(f"simulate the skin {subject}")
    done = simulate_session(
        "probe", out / "session-face", subject=subject, seed=seed, plan=choice.plan
    )
    progress("reconstruct")
    pipeline.reconstruct(
        done.session, want=("subsurface",), out=out / "appearance",
        calibration=out / "calibration", truth=done.truth.name if done.truth else "",
    )  # fmt: skip
    rows = [
        row
        for row in subsurface.compare_fits(
            store.read(out / "appearance"), store.read(out / "truth-face")
        )
        if row.method == METHODS[0]
    ]
    good = [abs(row.relative) for row in rows if row.valid]
    median = 100.0 * float(np.median(good)) if good else math.inf
    one = choice.forecasts[0]
    return [
        {
            "name": one.name, "unit": one.unit, "median": median, "forecast": one.value,
            "within": one.interval[0] <= median <= one.interval[1],
            "valid_share": len(good) / max(len(rows), 1),
        }
    ]  # fmt: skip


def candidates(rig: Rig, look: Sight) -> Iterator[tuple[Setting, Plan]]:
    """Yield plans of all sites in one direction that the rig allows, the quickest first."""
    found: list[tuple[float, Plan]] = []
    for brackets, longest_s, repeats, darks in itertools.product(SERIES, LONGEST, REPEATS, DARKS):
        step_ev = math.log2(longest_s / SHORTEST_S) / (brackets - 1)
        try:
            plan = probe_plan(
                rig, sites=look.sites, repeats=repeats, brackets=brackets, longest_s=longest_s,
                step_ev=step_ev, darks=darks,
            )  # fmt: skip
        except PlanError:
            continue  # beyond what the head may do
        found.append((plan.estimated_s(rig), plan))
    for _, plan in sorted(found, key=lambda one: one[0]):
        yield setting_of(plan), plan


def without_sites(
    look: Sight, setting: Setting, plan: Plan, good: Callable[[Prediction], bool]
) -> tuple[Setting, Plan]:
    """Take off sites that the others, and people in general, tell of as well as is wanted.

    Parameters
    ----------
    look
        See `sight`.
    setting, plan
        That reach what is wanted.
    good
        Whether errors keep to what is wanted.
    """
    while len(setting.sites) > 1:
        for site in setting.sites:
            rest = tuple(other for other in setting.sites if other != site)
            if good(predict(look, replace(setting, sites=rest))):
                kept = tuple(s for s in plan.steps if s.index.get("site") != site)
                setting, plan = replace(setting, sites=rest), replace(plan, steps=kept)
                break
        else:
            break
    return setting, plan


def setting_of(plan: Plan) -> Setting:
    """Return what of a plan sigma_tr hangs on.

    Raises
    ------
    PlanningError
        Where nothing is measured on skin, or no dark frame is there.
    """
    shots = [step for step in plan.steps if step.kind == "fibres"]
    darks = [step for step in plan.steps if step.kind == "dark"]
    if not shots:
        raise PlanningError("plan: got no series on skin, expected at least one")
    if not darks:
        raise PlanningError("plan: got no frame without light, expected some: the dark current")
    placements = list(dict.fromkeys(placement_of(step) for step in shots))
    sites = tuple(dict.fromkeys(str(step.index["site"]) for step in shots))
    first = [step for step in shots if placement_of(step) == placements[0]]
    times = {float(step.settings["exposure_s"]) for step in darks}
    return Setting(
        sites, tuple(sorted(float(step.settings["exposure_s"]) for step in first)),
        max(1, len(placements) // len(sites)), max(1, len(darks) // max(len(times), 1)),
        float(first[0].settings.get("level", 1.0)),
    )  # fmt: skip


def _variance(
    look: Sight, value: Floats, exposures_s: Sequence[float], darks: int, level: float
) -> Floats:
    """Return the variance of readings in 1/mm^4, (F, 3); infinite where all are saturated."""
    rate = level * look.unit * value  # full scales per second
    told = np.zeros(rate.shape)
    for seconds in exposures_s:
        gain, floor = look.chip.noise_profile(seconds)
        light = rate * seconds
        spread = gain * np.maximum(light, 0.0) + floor * (1.0 + 1.0 / darks)
        told += np.where(light < SATURATED, seconds**2 / spread, 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / (told * look.pixels * np.square(level * look.unit)))


def _crosstalk(count: int) -> Any:
    """Return cross-talk of none, known as well as a calibration leaves it.

    The nearest fibres are brighter than the farthest by a million times on skin and by a thousand
    on the phantom; what a calibration has wrong of their light in far spots cancels only as far as
    the two are alike.
    """
    from capture.calibration.fibre_crosstalk import CrossTalk

    place = np.arange(count)
    apart = np.minimum(np.abs(place[:, None] - place), len(CROSSTALK_ERROR) - 1)
    nothing = np.zeros((count, 3))
    error = np.array(CROSSTALK_ERROR)[apart]
    return CrossTalk(np.eye(count), error, nothing, nothing, nothing, True)


def _between(look: Sight, found: Floats, sigma: Floats, good: NDArray[np.bool_]) -> Floats:
    """Return the relative error of sigma_tr at each site by the map between the others, (S, 3)."""
    from reconstruction import translucency

    known = [k for k, site in enumerate(look.sites) if site in translucency.SITE_UV]
    measured = [k for k in known if good[k].any()]
    out = np.full(found.shape, np.inf)
    if not measured:
        return out
    made = translucency.interpolate(
        [translucency.SITE_UV[look.sites[k]] for k in measured],
        np.where(good[measured], found[measured], 1.0),
        np.where(good[measured], sigma[measured] * found[measured], np.inf),
        (MAP_PX, MAP_PX), valid=good[measured],
    )  # fmt: skip
    for k in known:
        u, v = translucency.SITE_UV[look.sites[k]]
        at = min(int((1.0 - v) * MAP_PX), MAP_PX - 1), min(int(u * MAP_PX), MAP_PX - 1)
        out[k] = np.where(made.valid[at], made.log_stderr[at], np.inf)
    return out


def _choice(
    rig: Rig, look: Sight, plan: Plan, setting: Setting, wants: Mapping[str, float], *,
    path: tuple[Mapping[str, float], ...] = (), reasons: tuple[str, ...] = (),
) -> Choice:  # fmt: skip
    found = predict(look, setting)
    full = probe_plan(rig, repeats=setting.repeats)
    value = 100.0 * found.median
    low, high = found.interval()
    forecast = Forecast("sigma_tr", "%", value, (100.0 * low, 100.0 * high), wants.get("sigma_tr"))
    left_out = []
    if len(setting.exposures_s) < BRACKETS:
        left_out.append((
            f"{BRACKETS - len(setting.exposures_s)} of {BRACKETS} exposures of a series",
            "wider steps still show every fibre unsaturated and above the noise",
        ))  # fmt: skip
    if setting.exposures_s[-1] < 0.99 * LONGEST_S:
        left_out.append((
            f"exposures above {setting.exposures_s[-1]:.3g} s",
            "what the farthest fibres would add does not show beside misfit and certificate",
        ))  # fmt: skip
    for k, site in enumerate(look.sites):
        if not found.measured[k]:
            left_out.append((
                f"the {site}",
                f"the other sites and people in general tell its sigma_tr to "
                f"{100.0 * float(np.median(found.sigma[k])):.2g} %",
            ))  # fmt: skip
    if "angle" not in {name for step in plan.steps for name in step.index if step.index[name]}:
        left_out.append((
            "further directions of the head", "sigma_tr is wanted, not how it changes with them"
        ))  # fmt: skip
    by_site = {
        site: [round(100.0 * float(one), 3) for one in found.sigma[k]]
        for k, site in enumerate(look.sites)
    }
    return Choice(
        rig, plan, (forecast,), plan.estimated_s(rig), full.estimated_s(rig),
        {
            "sites": list(setting.sites), "repeats": setting.repeats, "directions": 1,
            "exposures_s": [round(seconds, 5) for seconds in setting.exposures_s],
            "darks": setting.darks, "valid_share": found.valid_share, "percent_by_site": by_site,
        },
        tuple(left_out), path, reasons, light_of(plan, rig),
    )  # fmt: skip


def _why(look: Sight, whole: Prediction, target: float) -> str:
    """Say why no plan reaches what is wanted."""
    stays = 100.0 * median_of_normals(whole.misfit)
    calibration = 100.0 * median_of_normals(whole.common)
    return (
        f"sigma_tr: the rig's own series leave {100.0 * whole.median:.2g} %; without any noise "
        f"layers unlike any homogeneous medium and the calibration (the phantom's certificate, far "
        f"cross-talk) leave {stays:.2g} %, the calibration alone {calibration:.2g} %; "
        + (
            "more exposures or placements will not help"
            if stays > 100.0 * target
            else f"more than {REPEATS[-1]} placements would be needed"
        )
    )
