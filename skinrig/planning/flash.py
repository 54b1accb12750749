"""Plan the flash rig: choose the frames, flash power and dark frames that a face needs.

The forecast is the Cramér-Rao bound of both chromophores at every pixel of a simulated face. It
contains the sensor noise at the reflected light, the model error and the prior of illumination, as
in the report. The error that all pixels of the face share is that of the estimator itself on the
face's colors without noise. The settings change only the noise.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from capture.plan import Plan, flash_plan
from capture.plan.led_bands import add_led_frames, led_names
from capture.rig import Rig
from model.skin import SkinAppearance
from reconstruction.chromophores.pixel_checks import is_detectable
from reconstruction.pipeline.flash.stages import MIN_SIGNAL_SIGMAS
from skinrig.arrays import BoolArray, Float64Array
from skinrig.evaluating import flash
from skinrig.evaluating.bounds import relative_bounds
from skinrig.planning import plan_omissions, plans, time_budget
from skinrig.planning.camera_separability import assess_camera
from skinrig.planning.flash_observation import (
    CHROMOPHORE_NAMES,
    CONFIRM_PX,
    FlashObservation,
    simulate_observation,
)
from skinrig.planning.led_information import assess_leds
from skinrig.planning.plans import PlanChoice, PlanRequest

REPEAT_CHOICES = (1, 2, 4, 8, 16)
"""Numbers of averaged crossed-polarized frames per expression; 16 take about 90 s."""
DARK_CHOICES = (0, 1, 4)
POWER_CHOICES = (0.03125, 0.0625, 0.125, 0.25, 0.5, 1.0)
"""Fractions of the flashes' full energy; less reduces glare and takes the same time."""
FORECAST_RELATIVE_SD: Mapping[str, float] = {"melanin": 0.2, "hemoglobin": 0.15}
"""Relative deviation of measured from predicted medians, see docs/validation/forecasts.md."""
ERROR_OVER_BOUND: Mapping[str, float] = {"melanin": 1.1, "hemoglobin": 1.0}
"""Ratio of measured error to its bound, median of sessions.

Melanin exceeds its bound for three reasons. The prior of illumination is less informative for most
pixels than its mean (2 to 10 %). The model error of one face differs from the population's (up to
10 %). Color is nonlinear over errors of this size.
"""


@dataclass(frozen=True, slots=True, eq=False)
class FlashPrediction:
    """Predicted relative standard deviations per pixel, keyed by chromophore."""

    sigma: Mapping[str, Float64Array]
    """(H, W)."""
    valid: Mapping[str, BoolArray]
    """(H, W) pixels whose estimate would not be masked."""
    skin: BoolArray
    bias: Mapping[str, float]
    """Relative error that all pixels of the face share."""

    def median(self, name: str) -> float:
        """Return the predicted median relative error."""
        return plans.median_magnitude(self.sigma[name][self.valid[name]], self.bias[name])

    def valid_share(self, name: str) -> float:
        """Return the fraction of the skin with an unmasked estimate."""
        return float(self.valid[name].sum() / max(self.skin.sum(), 1))


def predict(
    observation: FlashObservation, *, repeats: int, power: float, darks: int
) -> FlashPrediction:
    """Predict the errors of chromophores from crossed-polarized frames.

    Parameters
    ----------
    observation
        See `simulate_observation`.
    repeats
        Number of averaged crossed-polarized frames.
    power
        Flash energy, fraction of full, 0 to 1.
    darks
        Number of dark frames; 0: the camera's nominal black level is used.
    """
    frame = observation.gain * power * np.maximum(observation.light, 0.0) + observation.floor
    dark = observation.floor / darks if darks else 0.0
    variance = (frame / repeats + dark) * observation.shares
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = variance / np.square(power * observation.light)
    skin = observation.skin & (relative < 1.0 / MIN_SIGNAL_SIGMAS**2).all(axis=-1)
    bounds = relative_bounds(
        observation.table,
        observation.melanin[skin],
        observation.hemoglobin[skin],
        relative[skin],
        log_shading_std=observation.log_light_sd,
        model_scale=observation.mixing,
    )
    sigma, valid = {}, {}
    for name, truth, bound in zip(
        CHROMOPHORE_NAMES, (observation.melanin, observation.hemoglobin), bounds, strict=True
    ):
        deviation = np.full(skin.shape, np.inf)
        deviation[skin] = ERROR_OVER_BOUND[name] * bound
        sigma[name] = deviation
        valid[name] = is_detectable(truth, np.where(skin, deviation, 0.0) * truth, skin)
    return FlashPrediction(sigma, valid, observation.skin, observation.bias)


def choose(rig: Rig, request: PlanRequest) -> PlanChoice:
    """Choose the shortest plan that reaches the goals; of equal ones, that with the least light.

    Frames under the LEDs of the request are added to it.

    Parameters
    ----------
    rig
        The flash rig.
    request
        Goals by name: "melanin" and "hemoglobin", medians of the relative error over the face,
        percent; empty: forecast of the rig's own plan. The valid fraction refers to the skin that
        full power and the most frames estimate.
    """
    if request.budget_s is not None:
        return time_budget.choose_within_budget(generate_choices, rig, request)
    observation = simulate_observation(rig, request.subject, seed=request.seed)
    best = predict(observation, repeats=REPEAT_CHOICES[-1], power=1.0, darks=DARK_CHOICES[-1])
    if not request.goals:
        whole = {"repeats": 1, "power": 1.0, "darks": 4, "parallel": True}
        return _choice(rig, observation, flash_plan(rig), whole, request)
    path = []
    for settings in _candidates(rig):
        found = predict(observation, **settings)
        if settings["power"] == POWER_CHOICES[-1]:
            path.append(
                {name: float(settings[name]) for name in ("repeats", "darks")}
                | {f"{name}_percent": 100.0 * found.median(name) for name in CHROMOPHORE_NAMES}
            )
        if _is_reached(found, best, request):
            plan = build_crossed_plan(rig, **settings)
            return _choice(rig, observation, plan, settings, request, path=tuple(path))
    least = next(one for one in _candidates(rig) if one["power"] == 1.0)
    reasons = _explain_shortfall(best, observation, request)
    # an unreachable goal does not justify sixteen frames: keep the fewest within 5 % of the best
    estimable = [name for name in request.goals if np.isfinite(best.median(name))]
    for settings in _candidates(rig) if estimable else ():  # else fewer frames are as good
        now = predict(observation, **settings)
        if all(now.median(name) <= 1.05 * best.median(name) for name in estimable):
            least = settings
            break
    plan = build_crossed_plan(rig, **least)
    return _choice(rig, observation, plan, least, request, path=tuple(path), reasons=reasons)


def generate_choices(
    rig: Rig, request: PlanRequest, is_affordable: time_budget.Affordable
) -> Iterator[PlanChoice]:
    """Yield affordable plans at full flash power with their forecasts, by increasing duration."""
    observation = simulate_observation(rig, request.subject, seed=request.seed)
    for settings in _candidates(rig):
        plan = build_crossed_plan(rig, **settings)
        if settings["power"] == POWER_CHOICES[-1] and is_affordable(rig, plan):
            yield _choice(rig, observation, plan, settings, request)


def forecast(rig: Rig, plan: Plan, request: PlanRequest) -> PlanChoice:
    """Forecast the errors of a plan with crossed-polarized frames, for its first expression."""
    shots = [step for step in plan.steps if step.kind == "subject"]
    crossed = [step for step in shots if step.index.get("polarizer") == "crossed"]
    if not crossed:
        raise plans.PlanningError(
            "plan: got no crossed-polarized frame of a subject, expected at least one; add one"
        )
    own = [step for step in crossed if step.index.get("state") == crossed[0].index.get("state")]
    powers = [float(step.settings.get("power", 1.0)) for step in own]
    settings = {
        "repeats": len(own),
        "power": sum(powers) / len(powers),
        "darks": sum(step.kind == "dark" for step in plan.steps),
        "parallel": any(step.index.get("polarizer") == "parallel" for step in shots),
    }
    observation = simulate_observation(rig, request.subject, seed=request.seed)
    return _choice(rig, observation, plan, settings, request)


def describe_rehearsal(choice: PlanChoice) -> plans.Rehearsal:
    """Return the targets and calibrations that confirm a choice, at the forecast's image width."""
    width = {"width_px": min(choice.rig.views[0].width_px, CONFIRM_PX)}
    target_of = {"sensor": "flat", "white": "white", "polarization": "malus"}
    calibrations = tuple((kind, (target,)) for kind, target in target_of.items())
    targets = dict.fromkeys(target_of.values(), width)
    return plans.Rehearsal(targets, calibrations, CHROMOPHORE_NAMES, width)


def measure_errors(
    _: PlanChoice, appearance: SkinAppearance, truth: SkinAppearance, seed: int
) -> dict[str, tuple[float, float]]:
    """Return median error, percent, and valid fraction of the chromophores over the face."""
    rows = flash.compare(appearance, truth, rng=np.random.default_rng(seed))
    return {
        row.name: (100.0 * row.median_relative, 1.0 - row.masked)
        for row in rows
        if row.band is None and row.against == "blurred"
    }


def build_crossed_plan(rig: Rig, *, repeats: int, power: float, darks: int) -> Plan:
    """Return a plan of crossed-polarized frames and dark frames only.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> rig = load_rig("flash")
    >>> plan = build_crossed_plan(rig, repeats=2, power=0.5, darks=0)
    >>> [step.index["polarizer"] for step in plan.steps], round(plan.estimate_duration_s(rig), 1)
    (['crossed', 'crossed'], 11.4)
    """
    whole = flash_plan(rig, repeats=repeats, power=power, darks=darks)
    kept = tuple(step for step in whole.steps if step.index.get("polarizer") != "parallel")
    return replace(whole, steps=kept)


def _candidates(rig: Rig) -> Iterator[dict[str, Any]]:
    """Yield settings by increasing duration, then by increasing power."""
    every: list[dict[str, Any]] = [
        {"repeats": repeats, "power": power, "darks": darks}
        for repeats in REPEAT_CHOICES
        for darks in DARK_CHOICES
        for power in POWER_CHOICES
    ]
    yield from sorted(
        every,
        key=lambda one: (
            build_crossed_plan(rig, **one | {"power": 1.0}).estimate_duration_s(rig),
            one["power"],
        ),
    )


def _is_reached(found: FlashPrediction, best: FlashPrediction, request: PlanRequest) -> bool:
    return all(
        100.0 * found.median(name) <= value
        and found.valid_share(name) >= request.min_valid_fraction * best.valid_share(name)
        for name, value in request.goals.items()
    )


def _choice(
    rig: Rig,
    observation: FlashObservation,
    plan: Plan,
    settings: Mapping[str, Any],
    request: PlanRequest,
    *,
    path: tuple[Mapping[str, float], ...] = (),
    reasons: tuple[str, ...] = (),
) -> PlanChoice:
    if request.leds and led_names(plan):
        raise plans.PlanOptionsError("--bands: the plan has frames under LEDs; remove the option")
    plan = add_led_frames(plan, request.leds)
    leds = led_names(plan)
    parallel = bool(settings.get("parallel", False))
    own = {name: settings[name] for name in ("repeats", "power", "darks")}
    found = predict(observation, **own)
    medians = {name: 100.0 * found.median(name) for name in CHROMOPHORE_NAMES}
    forecasts = plans.build_forecasts(medians, FORECAST_RELATIVE_SD, request, "flash")
    left_out = plan_omissions.list_omissions(
        "flash",
        (not parallel, "parallel", own["repeats"]),
        (own["darks"] < 4, "darks", 4 - own["darks"]),
        (
            own["power"] < 1.0,
            "energy",
            100.0 * (1.0 - own["power"]),
            plan_omissions.explain_less_light(reasons),
        ),
    )
    powers = [float(step.settings.get("power", 0.0)) for step in plan.steps]
    tube_powers = [
        power for power, step in zip(powers, plan.steps, strict=True) if "light" not in step.index
    ]
    pops = sum(power > 0 for power in powers)
    energy = sum(light.energy_ws or 0.0 for light in rig.lights)
    flashes: dict[str, Any] = {
        "pops": pops,
        "flash_ws": energy * sum(tube_powers),
        "pops_per_min_limit": rig.max_pops_per_min,
        "flashes_per_s": min(
            rig.max_pops_per_min / 60.0, pops / max(plan.estimate_duration_s(rig), 1e-9)
        ),
    }
    knobs = {
        **own,
        "polarizers": ["parallel", "crossed"] if parallel else ["crossed"],
        "valid_share": {name: found.valid_share(name) for name in CHROMOPHORE_NAMES},
    }
    full = flash_plan(rig, repeats=max(int(own["repeats"]), 1), leds=leds)
    full_s = full.estimate_duration_s(rig)
    information = assess_leds(rig, plan, leds) if leds else ()
    camera = assess_camera(rig.views[0].spectral_sensitivity, rig.lights[0].illuminant)
    if camera.loses:
        reasons = (*reasons, camera.summary())
    return PlanChoice(
        rig, plan, forecasts, full_s, knobs, left_out, path, reasons, flashes, information
    )


def _explain_shortfall(
    best: FlashPrediction, observation: FlashObservation, request: PlanRequest
) -> tuple[str, ...]:
    """Return the reasons why no number of frames reaches the goals."""
    out = []
    for name, value in request.goals.items():
        now = 100.0 * best.median(name)
        if now <= value:
            continue
        still = replace(observation, gain=0.0, floor=0.0)
        model = 100.0 * predict(still, repeats=1, power=1.0, darks=0).median(name)
        why = (
            "more frames will not help; use a camera whose bands separate the chromophores better"
            if model > value
            else f"more than {REPEAT_CHOICES[-1]} frames would be needed"
        )
        out.append(
            f"{name}: {REPEAT_CHOICES[-1]} frames at full power leave {now:.3g} %, of which the "
            f"model error alone, without noise, leaves {model:.3g} %; {why}"
        )
    if not out and not _is_reached(best, best, request):
        out.append("valid_share: too few valid skin pixels; lower --min-valid-fraction")
    return tuple(out)
