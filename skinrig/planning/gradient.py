"""Plans of the gradient sphere: which patterns, and how long, the normals of skin need.

The forecast propagates the sensor's noise through the reconstruction itself, on the pictures of a
small patch of simulated skin: moments, Wiener filter and lookup state a standard error for each
pixel. What measured patches were off beyond it is added, and what the lens takes from the relief is
told beside.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture.plan import Plan, PlanError
from capture.plan.gradient import DWELL_S, EXPOSURE_S, gradient_plan, state_of
from capture.plan.steps import LIGHT_PATTERNS
from capture.rig import Rig
from model import metrics
from model.skin import SkinAppearance
from reconstruction.gradient_normals import estimate_roughness, from_patterns
from reconstruction.gradient_normals.patterns import MissingPatterns, require
from reconstruction.photometric_stereo.light_selection import median_of_rayleigh
from reconstruction.pipeline.gradient.stages import SMOOTH_PX
from skinrig.appearances.contents import jointly_valid
from skinrig.arrays import Float32Array
from skinrig.planning import plans
from skinrig.planning.gradient_observation import BORDER_PX, Key, Observation, simulate_observation
from skinrig.planning.plans import Choice, PlanRequest

PATTERN_SETS: tuple[tuple[str, ...], ...] = (
    ("x", "-x", "y", "z"),
    ("full", "x", "y", "z", "-x", "-y", "-z"),
    tuple(LIGHT_PATTERNS),
)
"""Patterns that tell light and three gradients: one complement instead of full, which lowers the
noise more; all complements; and dark."""
EXPOSURE_CHOICES = (0.125, 0.25, 0.5, 1.0, 1.5, 2.0)
"""Of the rig's own exposure."""
MAX_SIGNAL_FRACTION = 0.98
"""Of full scale, in the brightest thousandth of the pixels."""
UNMODELED_TILT_RAD = math.radians(0.2)
"""Error of each tilt that is in no standard error: shadows in furrows, a lobe unlike the one that
is assumed; see docs/validation/forecasts.md."""
FORECAST_RELATIVE_SD = {"normals": 0.2}
"""Relative deviation of measured from predicted medians, see docs/validation/forecasts.md."""
WHOLE_READOUT_S = DWELL_S - EXPOSURE_S
"""Between two exposures of patterns: read-out and settling of the LEDs."""


@dataclass(frozen=True, slots=True)
class Setting:
    """What of a plan the normals of one state hang on."""

    patterns: tuple[str, ...]
    exposure_s: float
    darks: int
    """Frames without light, all in all."""
    level: float = 1.0


@dataclass(frozen=True, slots=True)
class Prediction:
    """Errors of a patch's normals."""

    median_rad: float
    noise_rad: float
    """Median of the errors that noise and lost detail make."""
    valid_share: float


def predict(observation: Observation, setting: Setting) -> Prediction:
    """Return the errors that a scan of one state leaves.

    Parameters
    ----------
    observation
        See `simulate_observation`.
    setting
        Patterns, exposure and darks.
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
    tilt = np.asarray(found.stderr_rad, np.float64)[inner][valid] / math.sqrt(2.0)
    median_rad = median_of_rayleigh(np.hypot(tilt, UNMODELED_TILT_RAD))
    return Prediction(median_rad, median_of_rayleigh(tilt), float(valid.mean()))


def choose(rig: Rig, asked: PlanRequest) -> Choice:
    """Choose the quickest scan of the neutral skin that reaches what is wanted.

    Parameters
    ----------
    rig
        The gradient sphere.
    asked
        Wants by name: "normals" in degrees, the median over the patch as the lens shows it; empty:
        the forecast of the rig's own plan. The share is of the patch.
    """
    observation = simulate_observation(rig, asked.subject, seed=asked.seed)
    if not asked.wants:
        plan = gradient_plan(rig)
        return _choice(rig, observation, plan, setting_of(plan), asked)
    tried: list[tuple[Setting, Plan, Prediction]] = []
    target = math.radians(asked.wants.get("normals", 90.0))
    for setting, plan in candidates(rig, observation):
        found = predict(observation, setting)
        tried.append((setting, plan, found))
        if found.median_rad <= target and found.valid_share >= asked.valid_share:
            break
    if not tried:
        raise plans.PlanningError("rig: got limits that no pattern keeps to")
    best = min((found for _, _, found in tried), key=lambda found: found.median_rad)
    path = tuple(
        {
            "patterns": float(len(one.patterns)),
            "exposure_s": one.exposure_s,
            "darks": float(one.darks),
            "seconds": plan.estimated_s(rig),
            "normals_deg": math.degrees(found.median_rad),
            "valid_share": found.valid_share,
        }
        for one, plan, found in tried
    )
    setting, plan, found = tried[-1]
    reasons: tuple[str, ...] = ()
    if found.median_rad > target:
        reasons = (_why(best, observation),)
        # the quickest of those that are nearly as good as it gets
        setting, plan, found = next(
            one for one in tried if one[2].median_rad <= 1.05 * best.median_rad
        )
    return _choice(rig, observation, plan, setting, asked, found=found, path=path, reasons=reasons)


def forecast(rig: Rig, plan: Plan, asked: PlanRequest) -> Choice:
    """Return what a plan of the gradient sphere will give, in its neutral state."""
    observation = simulate_observation(rig, asked.subject, seed=asked.seed)
    return _choice(rig, observation, plan, setting_of(plan), asked)


def rehearsal(choice: Choice) -> plans.Rehearsal:
    """Return the gradient sphere's targets, skin and flat field on few pixels."""
    width = {"width_px": min(choice.rig.views[0].width_px, 128)}
    of_ball = tuple((kind, ("ball",)) for kind in ("lights", "polarization"))
    calibrations = (("sensor", ("flat",)), *of_ball)
    return plans.Rehearsal({"flat": width, "ball": {}}, calibrations, ("normals",), width)


def measured(
    choice: Choice, appearance: SkinAppearance, truth: SkinAppearance, _: int
) -> dict[str, tuple[float, float]]:
    """Return median error, degrees, and valid share of the neutral skin's normals."""
    state = next(name for name in map(state_of, choice.plan.steps) if name is not None)
    made = appearance.maps[f"normals_{state}"]
    known = np.asarray(truth.maps[f"normals_seen_{state}"].values, np.float64)
    inner = (slice(BORDER_PX, -BORDER_PX),) * 2
    good = jointly_valid(made)[inner]
    error = np.degrees(metrics.angular_error_rad(made.values, known))[inner]
    return {"normals": (float(np.median(error[good])), float(good.mean()))}


def candidates(rig: Rig, observation: Observation | None = None) -> Iterator[tuple[Setting, Plan]]:
    """Yield scans of the neutral skin that the rig's limits allow, the quickest first.

    Parameters
    ----------
    rig
        The gradient sphere.
    observation
        Skin that must not be saturated; None: any.
    """
    angle = _angles(rig)[0]
    rates = {} if observation is None else observation.rates
    brightest = max((float(np.quantile(rate, 0.999)) for rate in rates.values()), default=0.0)
    found: list[tuple[float, int, Setting, Plan]] = []
    for patterns in PATTERN_SETS:
        for share in EXPOSURE_CHOICES:
            exposure_s = share * EXPOSURE_S
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
                    continue  # beyond what an LED may do
                setting = setting_of(plan)
                found.append((plan.estimated_s(rig), len(patterns), setting, plan))
    for _, _, setting, plan in sorted(found, key=lambda one: one[:2]):
        yield setting, plan


def setting_of(plan: Plan) -> Setting:
    """Return what the normals of a plan's first neutral state hang on.

    Raises
    ------
    plans.PlanningError
        Where its pictures do not tell light and three gradients, in both polarizations.
    """
    shots = [step for step in plan.steps if step.kind == "gradient" and state_of(step)]
    neutral = [step for step in shots if int(step.index.get("caliper", 1)) == 0]
    if not neutral:
        raise plans.PlanningError("plan: got no neutral state of skin, expected one")
    state = state_of(neutral[0])
    own = [step for step in neutral if state_of(step) == state]
    sets = [
        {str(step.index["pattern"]) for step in own if step.index["polarizer"] == polarizer}
        for polarizer in ("parallel", "crossed")
    ]
    try:
        for polarizer, names in zip(("parallel", "crossed"), sets, strict=True):
            lit = dict.fromkeys(names - {"dark"})
            require(lit, polarizer=polarizer, purpose="normals")
    except MissingPatterns as error:
        raise plans.PlanningError(f"plan: {error}") from error
    both = sets[0] & sets[1]
    darks = sum(step.kind == "dark" or step.index.get("pattern") == "dark" for step in plan.steps)
    first = own[0].settings
    return Setting(
        tuple(name for name in LIGHT_PATTERNS if name in both),
        float(first["exposure_s"]),
        darks,
        max(float(step.settings.get("level", 1.0)) for step in own),
    )


def _angles(rig: Rig) -> Sequence[float]:
    if rig.caliper is None:
        raise plans.PlanningError(
            f"rig: got {rig.name!r} without a caliper, expected one that holds skin"
        )
    return rig.caliper.angles_deg


def _choice(
    rig: Rig,
    observation: Observation,
    plan: Plan,
    setting: Setting,
    asked: PlanRequest,
    *,
    found: Prediction | None = None,
    path: tuple[Mapping[str, float], ...] = (),
    reasons: tuple[str, ...] = (),
) -> Choice:
    found = predict(observation, setting) if found is None else found
    full = gradient_plan(rig)
    medians = {"normals": math.degrees(found.median_rad)}
    predicted = plans.forecasts_of(medians, FORECAST_RELATIVE_SD, asked, "gradient")
    missing = [name for name in LIGHT_PATTERNS if name not in setting.patterns]
    states, every = ({state_of(s) for s in one.steps} - {None} for one in (plan, full))
    lost_ms, full_ms = 1e3 * (EXPOSURE_S - setting.exposure_s), 1e3 * EXPOSURE_S
    left_out = plans.left_out_of(
        "gradient",
        (missing, "patterns", ", ".join(missing)),
        (len(states) < len(every), "states", len(every) - len(states), len(every)),
        (lost_ms > 0.0, "exposure", lost_ms, full_ms, plans.why_less(reasons)),
        (not setting.darks, "darks"),
    )
    reasons += (
        "normals are those that the lens shows; the relief's own are "
        f"{math.degrees(observation.lost_rad):.2g}° off them, which no pattern brings back",
    )
    dwell_s = next(float(s.settings["dwell_s"]) for s in plan.steps if state_of(s))
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
    return Choice(rig, plan, predicted, full.estimated_s(rig), knobs, left_out, path, reasons)


def _why(best: Prediction, observation: Observation) -> str:
    floor = math.degrees(UNMODELED_TILT_RAD * math.sqrt(2.0 * math.log(2.0)))
    return (
        f"normals: the best scan leaves {math.degrees(best.median_rad):.2f}°; noise and "
        f"lost detail {math.degrees(best.noise_rad):.2f}°, shadows and lobes unlike the assumed "
        f"one {floor:.2f}°; "
        + (
            "more patterns or light will not help"
            if best.noise_rad < math.radians(floor)
            else "a longer exposure would saturate or ask too much of the LEDs"
        )
    )
