"""Plan the gradient sphere: choose the patterns and exposures that skin normals need.

The forecast propagates the sensor's noise through the reconstruction itself, on images of a small
patch of simulated skin: moments, Wiener filter and lookup yield a standard uncertainty per pixel.
The excess error of measured patches is added. The topography lost by the lens is reported
separately.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture.plan import Plan, PlanError
from capture.plan.gradient import PATTERN_DWELL_S, PATTERN_EXPOSURE_S, gradient_plan, strain_state
from capture.plan.steps import LIGHT_PATTERNS
from capture.rig import Rig
from model import metrics
from model.skin import SkinAppearance
from reconstruction.gradient_normals import estimate_roughness, from_patterns
from reconstruction.gradient_normals.patterns import MissingPatternsError, require_patterns
from reconstruction.photometric_stereo.light_selection import rayleigh_mixture_median
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import Float32Array
from skinrig.planning import plan_omissions, plans, time_budget
from skinrig.planning.gradient_observation import (
    BORDER_PX,
    GradientObservation,
    Key,
    simulate_observation,
)
from skinrig.planning.plans import PlanChoice, PlanRequest

PATTERN_SETS: tuple[tuple[str, ...], ...] = (
    ("x", "-x", "y", "z"),
    ("full", "x", "y", "z", "-x", "-y", "-z"),
    tuple(LIGHT_PATTERNS),
)
"""Sets of patterns that determine total light and three gradients, from four to all.

In the first set, one complement replaces the full pattern, which reduces the noise more.
"""
EXPOSURE_CHOICES = (0.125, 0.25, 0.5, 1.0, 1.5, 2.0)
"""Multiples of the rig's nominal exposure time."""
MAX_SIGNAL_FRACTION = 0.98
"""Upper limit of the 99.9th percentile of pixels, fraction of full scale."""
UNMODELED_TILT_RAD = math.radians(0.65)
"""Error of each tilt that the standard uncertainties omit: shadows in grooves and deviations from
the assumed lobe, 0.08 of the slopes of a forehead; see docs/validation/forecasts.md."""
FORECAST_RELATIVE_SD = {"normals": 0.2}
"""Relative deviation of measured from predicted medians, see docs/validation/forecasts.md."""
WHOLE_READOUT_S = PATTERN_DWELL_S - PATTERN_EXPOSURE_S
"""Time between two exposures: read-out and settling of the LEDs."""


SMOOTH_PX = 1.0
"""Blur of the images before facet roughness is estimated: the lens resolves three pixels."""


@dataclass(frozen=True, slots=True)
class GradientScanSettings:
    """Settings of a plan that determine the errors of the normals of one strain step."""

    patterns: tuple[str, ...]
    exposure_s: float
    darks: int
    """Total number of dark frames."""
    level: float = 1.0


@dataclass(frozen=True, slots=True)
class GradientPrediction:
    """Predicted errors of a patch's normals."""

    median_rad: float
    noise_rad: float
    """Median error by noise and unresolved detail."""
    valid_share: float


def predict(observation: GradientObservation, setting: GradientScanSettings) -> GradientPrediction:
    """Predict the errors of the normals of one strain step.

    Parameters
    ----------
    observation
        See `simulate_observation`.
    setting
        Patterns, exposure time, dark frames and LED level.
    """
    rng = np.random.default_rng([observation.seed, 23])
    gain, floor = observation.chip.noise_profile(setting.exposure_s)
    values: dict[Key, Float32Array] = {}
    variance: dict[Key, Float32Array] = {}
    for key, rate in observation.rates.items():
        if key[0] not in setting.patterns:
            continue
        light = (setting.level * setting.exposure_s * rate).astype(np.float64)
        spread = gain * np.maximum(light, 0.0) + floor
        noisy = light + np.sqrt(spread) * rng.standard_normal(light.shape)
        values[key] = noisy.astype(np.float32)
        dark = floor / setting.darks if setting.darks else 0.0
        variance[key] = (spread + dark).astype(np.float32)
    known = dict(observation.known)
    alpha = estimate_roughness(
        values, lights=known["lights"], view=known["view"], variance=variance, smooth_px=SMOOTH_PX
    )
    found = from_patterns(values, variance=variance, smoothing="wiener", alpha=alpha, **known)
    inner = (slice(BORDER_PX, -BORDER_PX),) * 2
    valid = np.asarray(found.valid)[inner]
    # of two directions, and of the half of the variance that belongs to a surface
    tilt = np.asarray(found.stderr_rad, np.float64)[inner][valid] / 2.0
    median_rad = rayleigh_mixture_median(np.hypot(tilt, UNMODELED_TILT_RAD))
    return GradientPrediction(median_rad, rayleigh_mixture_median(tilt), float(valid.mean()))


def choose(rig: Rig, request: PlanRequest) -> PlanChoice:
    """Choose the shortest scan of neutral skin that reaches the goal.

    Parameters
    ----------
    rig
        The gradient sphere.
    request
        Goal by name: "normals" in degrees, the median over the patch as imaged by the lens; empty:
        forecast of the rig's own plan. The valid fraction refers to the patch.
    """
    if request.budget_s is not None:
        return time_budget.choose_within_budget(generate_choices, rig, request)
    observation = simulate_observation(rig, request.subject, seed=request.seed)
    if not request.goals:
        plan = gradient_plan(rig)
        return _choice(rig, observation, plan, read_settings(plan), request)
    tried: list[tuple[GradientScanSettings, Plan, GradientPrediction]] = []
    target = math.radians(request.goals.get("normals", 90.0))
    for setting, plan in generate_candidates(rig, observation):
        found = predict(observation, setting)
        tried.append((setting, plan, found))
        if found.median_rad <= target and found.valid_share >= request.min_valid_fraction:
            break
    if not tried:
        raise plans.PlanningError(
            "rig: got LED limits below those of every pattern; raise the limits in the rig's file"
        )
    best = min((found for _, _, found in tried), key=lambda found: found.median_rad)
    path = tuple(
        {
            "patterns": float(len(one.patterns)),
            "exposure_s": one.exposure_s,
            "darks": float(one.darks),
            "seconds": plan.estimate_duration_s(rig),
            "normals_deg": math.degrees(found.median_rad),
            "valid_share": found.valid_share,
        }
        for one, plan, found in tried
    )
    setting, plan, found = tried[-1]
    reasons: tuple[str, ...] = ()
    if found.median_rad > target:
        reasons = (_explain_shortfall(best, observation),)
        # the shortest of those within 5 % of the smallest error
        setting, plan, found = next(
            one for one in tried if one[2].median_rad <= 1.05 * best.median_rad
        )
    return _choice(
        rig, observation, plan, setting, request, found=found, path=path, reasons=reasons
    )


def generate_choices(
    rig: Rig, request: PlanRequest, is_affordable: time_budget.Affordable
) -> Iterator[PlanChoice]:
    """Yield affordable plans with their forecasts, by increasing duration."""
    observation = simulate_observation(rig, request.subject, seed=request.seed)
    for setting, plan in generate_candidates(rig, observation):
        if is_affordable(rig, plan):
            yield _choice(rig, observation, plan, setting, request)


def forecast(rig: Rig, plan: Plan, request: PlanRequest) -> PlanChoice:
    """Forecast the errors of a plan of the gradient sphere, for its neutral strain step."""
    observation = simulate_observation(rig, request.subject, seed=request.seed)
    return _choice(rig, observation, plan, read_settings(plan), request)


def describe_rehearsal(choice: PlanChoice) -> plans.Rehearsal:
    """Return the targets and calibrations that confirm a choice, of cropped images."""
    width = {"width_px": min(choice.rig.views[0].width_px, 128)}
    of_ball = tuple((kind, ("ball",)) for kind in ("lights", "polarization"))
    calibrations = (("sensor", ("flat",)), *of_ball)
    return plans.Rehearsal({"flat": width, "ball": {}}, calibrations, ("normals",), width)


def measure_errors(
    choice: PlanChoice, appearance: SkinAppearance, truth: SkinAppearance, _: int
) -> dict[str, tuple[float, float]]:
    """Return median error, degrees, and valid fraction of the neutral skin's normals."""
    state = next(name for name in map(strain_state, choice.plan.steps) if name is not None)
    made = appearance.maps[f"normals_{state}"]
    known = np.asarray(truth.maps[f"normals_seen_{state}"].values, np.float64)
    inner = (slice(BORDER_PX, -BORDER_PX),) * 2
    good = intersect_valid(made)[inner]
    error = np.degrees(metrics.angular_error_rad(made.values, known))[inner]
    return {"normals": (float(np.median(error[good])), float(good.mean()))}


def generate_candidates(
    rig: Rig, observation: GradientObservation | None = None
) -> Iterator[tuple[GradientScanSettings, Plan]]:
    """Yield scans of neutral skin within the rig's limits, by increasing duration.

    Parameters
    ----------
    rig
        The gradient sphere.
    observation
        Skin that must not saturate the sensor; None: exposures are not checked.
    """
    angle = _angles(rig)[0]
    rates = {} if observation is None else observation.rates
    brightest = max((float(np.quantile(rate, 0.999)) for rate in rates.values()), default=0.0)
    found: list[tuple[float, int, GradientScanSettings, Plan]] = []
    for patterns in PATTERN_SETS:
        for share in EXPOSURE_CHOICES:
            exposure_s = share * PATTERN_EXPOSURE_S
            if exposure_s * brightest > MAX_SIGNAL_FRACTION:
                continue
            for darks in (0, 2):
                try:
                    plan = gradient_plan(
                        rig,
                        angles=[angle],
                        steps=(0, 0),
                        patterns=patterns,
                        darks=darks,
                        exposure_s=exposure_s,
                        dwell_s=exposure_s + WHOLE_READOUT_S,
                    )
                except PlanError:
                    continue  # beyond the LEDs' limits
                setting = read_settings(plan)
                found.append((plan.estimate_duration_s(rig), len(patterns), setting, plan))
    for _, _, setting, plan in sorted(found, key=lambda one: one[:2]):
        yield setting, plan


def read_settings(plan: Plan) -> GradientScanSettings:
    """Return the settings of a plan's first neutral strain step.

    Raises
    ------
    plans.PlanningError
        If its images do not determine total light and three gradients in both polarizations.
    """
    shots = [step for step in plan.steps if step.kind == "gradient" and strain_state(step)]
    neutral = [step for step in shots if int(step.index.get("caliper", 1)) == 0]
    if not neutral:
        raise plans.PlanningError(
            "plan: got no neutral strain step of skin, expected one; add caliper step 0"
        )
    state = strain_state(neutral[0])
    own = [step for step in neutral if strain_state(step) == state]
    sets = [
        {str(step.index["pattern"]) for step in own if step.index["polarizer"] == polarizer}
        for polarizer in ("parallel", "crossed")
    ]
    try:
        for polarizer, names in zip(("parallel", "crossed"), sets, strict=True):
            lit = dict.fromkeys(names - {"dark"})
            require_patterns(lit, polarizer=polarizer, purpose="normals")
    except MissingPatternsError as error:
        raise plans.PlanningError(f"plan: {error}") from error
    both = sets[0] & sets[1]
    darks = sum(step.kind == "dark" or step.index.get("pattern") == "dark" for step in plan.steps)
    first = own[0].settings
    return GradientScanSettings(
        tuple(name for name in LIGHT_PATTERNS if name in both),
        float(first["exposure_s"]),
        darks,
        max(float(step.settings.get("level", 1.0)) for step in own),
    )


def _angles(rig: Rig) -> Sequence[float]:
    if rig.caliper is None:
        raise plans.PlanningError(
            f"rig: got {rig.name!r} without a caliper, expected one with a caliper; choose"
            f" another rig file"
        )
    return rig.caliper.angles_deg


def _choice(
    rig: Rig,
    observation: GradientObservation,
    plan: Plan,
    setting: GradientScanSettings,
    request: PlanRequest,
    *,
    found: GradientPrediction | None = None,
    path: tuple[Mapping[str, float], ...] = (),
    reasons: tuple[str, ...] = (),
) -> PlanChoice:
    found = predict(observation, setting) if found is None else found
    full = gradient_plan(rig)
    medians = {"normals": math.degrees(found.median_rad)}
    predicted = plans.build_forecasts(medians, FORECAST_RELATIVE_SD, request, "gradient")
    missing = [name for name in LIGHT_PATTERNS if name not in setting.patterns]
    states, every = ({strain_state(s) for s in one.steps} - {None} for one in (plan, full))
    lost_ms, full_ms = 1e3 * (PATTERN_EXPOSURE_S - setting.exposure_s), 1e3 * PATTERN_EXPOSURE_S
    left_out = plan_omissions.list_omissions(
        "gradient",
        (missing, "patterns", ", ".join(missing)),
        (len(states) < len(every), "states", len(every) - len(states), len(every)),
        (lost_ms > 0.0, "exposure", lost_ms, full_ms, plan_omissions.explain_less_light(reasons)),
        (not setting.darks, "darks"),
    )
    reasons += (
        "normals are evaluated as imaged by the lens; those of the topography differ by "
        f"{math.degrees(observation.lost_rad):.2g}°, which no pattern recovers",
    )
    dwell_s = next(float(s.settings["dwell_s"]) for s in plan.steps if strain_state(s))
    knobs = {
        "patterns": list(setting.patterns),
        "polarizers": ["parallel", "crossed"],
        "states": sorted(str(name) for name in states),
        "exposure_s": round(setting.exposure_s, 6),
        "dwell_s": round(dwell_s, 6),
        "darks": setting.darks,
        "level": setting.level,
        "valid_share": found.valid_share,
    }
    return PlanChoice(
        rig, plan, predicted, full.estimate_duration_s(rig), knobs, left_out, path, reasons
    )


def _explain_shortfall(best: GradientPrediction, observation: GradientObservation) -> str:
    floor = math.degrees(UNMODELED_TILT_RAD * math.sqrt(2.0 * math.log(2.0)))
    return (
        f"normals: the best scan leaves {math.degrees(best.median_rad):.2f}°; noise and "
        f"unresolved detail {math.degrees(best.noise_rad):.2f}°, shadows and deviations from the"
        f" lobe "
        f"{floor:.2f}°; "
        + (
            "more patterns or light will not help"
            if best.noise_rad < math.radians(floor)
            else "a longer exposure would saturate or exceed the limits of the LEDs"
        )
    )
