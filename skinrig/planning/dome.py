"""Plan the light dome: choose the lights and cameras that a subject needs.

The forecast simulates a face: visibility of its points from each light and camera, reflected light
and sensor noise. Two errors do not decrease with more samples: registration errors below a pixel,
and surface topography finer than a pixel.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from capture.plan import Plan
from capture.plan.dome import DOME_EXPOSURES_S, dome_plan
from capture.plan.rows import step_lights
from capture.rig import Rig, load_rig
from model.skin import SkinAppearance
from reconstruction.photometric_stereo import light_selection
from reconstruction.photometric_stereo.light_selection import ErrorPrediction
from reconstruction.surface import errors as surface_errors
from reconstruction.surface import estimates as surface_estimates
from skinrig.evaluating import surface as surface_evaluation
from skinrig.planning import plan_omissions, plans, time_budget
from skinrig.planning.dome_observation import LIGHT_ERROR, DomeObservation, simulate_observation
from skinrig.planning.plans import PlanChoice, PlanRequest

FORECAST_RELATIVE_SD = {"normals": 0.2, "r_d": 0.2}
"""Relative deviation of measured from predicted medians, see docs/validation/forecasts.md."""
SHARED_R_D_ERROR = 0.0095
"""Relative error of R_d that is independent of the number of lights.

Fitted together with `SPECULAR_R_D_ERROR` to simulated faces of seeds 1 to 3, types V, I and IV.
"""
SPECULAR_R_D_ERROR = 0.0022
"""Absolute standard deviation of R_d per light by specular reflection outside the omitted lobe.

It is the same for all skin, thus relatively larger on dark skin. It averages over lights as
`LIGHT_ERROR` does.
"""
LIGHT_COUNTS = (10, 12, 14, 16, 20, 24, 28, 32, 40, 48, 60, 75, 100, 125, 150)
"""Numbers of lights of the plans within a time."""
VIEW_COUNTS = (4, 5, 6, 8, 12, 16)
"""Numbers of cameras of these plans."""
EXPOSURE_CHOICES = (DOME_EXPOSURES_S[:1], DOME_EXPOSURES_S)
"""Exposure times per light of these plans, s.

The second, shorter exposure doubles the duration. It is for highlights, which the estimate of
normals leaves out."""


@dataclass(frozen=True, slots=True)
class DomeSettings:
    """Lights and cameras of a plan by their number in the rig, and exposure times per light, s."""

    lights: tuple[int, ...]
    views: tuple[int, ...]
    exposures_s: tuple[float, ...] = DOME_EXPOSURES_S


def choose(rig: Rig, request: PlanRequest) -> PlanChoice:
    """Choose the fewest lights, then the fewest cameras, that reach the goals.

    Parameters
    ----------
    rig
        A dome.
    request
        Goals by name: "normals" in degrees, "r_d" in percent, both medians over the face; empty:
        forecast of the whole dome. The valid fraction refers to the points that the whole dome
        estimates.
    """
    _require_enough("rig: got", len(rig.lights), len(rig.views))
    if request.budget_s is not None:
        return time_budget.choose_within_budget(generate_choices, rig, request)
    least = surface_estimates.MIN_LIGHTS
    observation = simulate_observation(rig, request.subject, seed=request.seed)
    every_view, every_light = list(range(len(rig.views))), list(range(len(rig.lights)))
    information = observation.information(every_view)
    best = light_selection.predict_errors(information, every_light, min_lights=least)
    if not request.goals:
        whole = DomeSettings(tuple(every_light), tuple(every_view))
        return _choice(rig, observation, whole, best, request)
    share = request.min_valid_fraction * best.valid_fraction
    selected = light_selection.select_lights(
        information,
        median_rad=_target_rad(request),
        valid_fraction=share,
        min_lights=least,
        max_lights=request.max_lights,
    )
    lights, prediction = list(selected.lights), selected.prediction
    while not _is_r_d_reached(prediction, observation, request) and len(lights) < len(rig.lights):
        selected = light_selection.select_lights(
            information,
            median_rad=0.0,
            valid_fraction=2.0,
            min_lights=least,
            max_lights=len(lights) + 1,
            fixed=tuple(lights),
        )
        lights, prediction = list(selected.lights), selected.prediction
        if request.max_lights is not None and len(lights) >= request.max_lights:
            break
    views, prediction = _remove_views(observation, lights, prediction, request, share)
    reasons = _explain_shortfall(best, observation, request)
    path = tuple(
        {"lights": float(n), "normals_deg": math.degrees(error), "valid_share": share_now}
        for n, error, share_now in selected.path
    )
    chosen = DomeSettings(tuple(lights), tuple(views))
    choice = _choice(rig, observation, chosen, prediction, request)
    return replace(choice, path=path, reasons=reasons)


def forecast(rig: Rig, plan: Plan, request: PlanRequest) -> PlanChoice:
    """Forecast the errors of a plan from its lights and cameras."""
    olat = [step for step in plan.steps if step.kind == "olat"]
    lit = {name for step in olat for name in step_lights(step)}
    seen = {name for step in olat for name in step.cameras}
    setting = DomeSettings(
        tuple(k for k, light in enumerate(rig.lights) if light.name in lit),
        tuple(k for k, view in enumerate(rig.views) if view.name in seen),
        tuple(sorted({float(step.settings["exposure_s"]) for step in olat}, reverse=True)),
    )
    _require_enough("plan: got", len(setting.lights), len(setting.views))
    observation = simulate_observation(rig, request.subject, seed=request.seed)
    prediction = predict(observation, setting)
    return _choice(rig, observation, setting, prediction, request, plan=plan)


def predict(observation: DomeObservation, setting: DomeSettings) -> ErrorPrediction:
    """Predict the errors of normals and log albedo at the points of a face.

    Parameters
    ----------
    observation
        See `simulate_observation`.
    setting
        Lights, cameras and exposure times.
    """
    information = observation.information(setting.views, setting.exposures_s)
    least = surface_estimates.MIN_LIGHTS
    return light_selection.predict_errors(information, setting.lights, min_lights=least)


def generate_choices(
    rig: Rig, request: PlanRequest, is_affordable: time_budget.Affordable
) -> Iterator[PlanChoice]:
    """Yield affordable plans with their forecasts, by increasing number of frames per camera."""
    observation = simulate_observation(rig, request.subject, seed=request.seed)
    least = surface_estimates.MIN_LIGHTS
    information_of = cache(observation.information)  # of all lights, the same for any number
    full_s = _whole_duration_s(rig)
    for setting, small, plan in generate_candidates(rig, observation, request.max_lights):
        if is_affordable(small, plan):
            information = information_of(setting.views, setting.exposures_s)
            found = light_selection.predict_errors(information, setting.lights, min_lights=least)
            yield _choice(rig, observation, setting, found, request, plan=plan, full_s=full_s)


def generate_candidates(
    rig: Rig, observation: DomeObservation, max_lights: int | None = None
) -> Iterator[tuple[DomeSettings, Rig, Plan]]:
    """Yield nested sets of lights and cameras with the reduced rig and plan.

    The number of frames per camera increases.

    Lights are in the order of their gain, see `light_selection.select_lights`; cameras in the order
    of `rank_views`.

    Parameters
    ----------
    rig
        A dome.
    observation
        See `simulate_observation`.
    max_lights
        Largest number of lights; None: all.
    """
    views = rank_views(observation)
    ranked = light_selection.select_lights(
        observation.information(views),
        median_rad=0.0,
        valid_fraction=2.0,  # out of reach, so that all lights are ranked
        min_lights=surface_estimates.MIN_LIGHTS,
        max_lights=max_lights,
    )
    counts = sorted({min(count, len(ranked.lights)) for count in LIGHT_COUNTS})
    shares = sorted({min(count, len(views)) for count in VIEW_COUNTS})
    pairs = itertools.product(counts, EXPOSURE_CHOICES)
    for count, exposures_s in sorted(pairs, key=lambda pair: pair[0] * len(pair[1])):
        lights = tuple(sorted(ranked.lights[:count]))
        order: list[int] | None = None
        for share in shares:
            setting = DomeSettings(lights, tuple(sorted(views[:share])), exposures_s)
            small = _reduce(rig, setting)
            plan = dome_plan(small, exposures_s=exposures_s, order=order)
            if order is None:  # the cameras do not change the best order of the lights
                order = _read_order(small, plan)
            yield setting, small, plan


def rank_views(observation: DomeObservation) -> list[int]:
    """Return the cameras in the order in which they are added to a plan.

    From all cameras, the one is removed that lowers the number of points with an estimate least,
    and of equal ones the number of samples.

    Parameters
    ----------
    observation
        See `simulate_observation`.
    """
    samples = observation.usable.sum(axis=(0, 1))
    left, removed = list(range(observation.seen.shape[1])), list[int]()
    while left:
        total = observation.seen[:, left].sum(axis=1)
        lost = {
            view: int(np.sum((total == surface_estimates.MIN_VIEWS) & observation.seen[:, view]))
            for view in left
        }
        worst = min(left, key=lambda view: (lost[view], samples[view]))
        left.remove(worst)
        removed.append(worst)
    return removed[::-1]


def describe_rehearsal(choice: PlanChoice) -> plans.Rehearsal:
    """Return the targets and calibrations that confirm a choice, with its lights.

    All cameras of the rig are calibrated: few of them need not share a pose of the board.
    """
    width = {"width_px": choice.rig.views[0].width_px}
    lit = width | {"plan": choice.plan}
    whole = load_rig(choice.rig.name)
    every = {"lights": len(whole.lights), "views": len(whole.views)}
    return plans.Rehearsal(
        {"charuco": width | every, "mirror": lit, "white": lit},
        (("geometry", ("charuco",)), ("lights", ("mirror", "white"))),
        ("normals", "r_d"),
        width,
    )


def measure_errors(
    choice: PlanChoice, appearance: SkinAppearance, truth: SkinAppearance, _: int
) -> dict[str, tuple[float, float]]:
    """Return median error and valid fraction of normals (deg) and R_d (%) over the face."""
    pairs = surface_evaluation.match_texels(appearance, truth)
    found = {}
    for one in choice.forecasts:
        error = np.abs(surface_evaluation.matched_errors(one.name, appearance, truth, pairs))
        found[one.name] = (float(np.nanmedian(error)), float(np.isfinite(error).mean()))
    return found


def _choice(
    rig: Rig,
    observation: DomeObservation,
    setting: DomeSettings,
    prediction: ErrorPrediction,
    request: PlanRequest,
    *,
    plan: Plan | None = None,
    full_s: float | None = None,
) -> PlanChoice:
    small = _reduce(rig, setting)
    unlit = [light.name for k, light in enumerate(rig.lights) if k not in setting.lights]
    unseen = [view.name for k, view in enumerate(rig.views) if k not in setting.views]
    fewer = len(DOME_EXPOSURES_S) - len(setting.exposures_s)
    medians = {
        "normals": math.degrees(prediction.median_rad),
        "r_d": 100.0 * _r_d_error(prediction, observation),
    }
    forecasts = plans.build_forecasts(medians, FORECAST_RELATIVE_SD, request, "dome")
    left_out = plan_omissions.list_omissions(
        "dome",
        (unlit, "lights", len(unlit), len(rig.lights), ", ".join(unlit), _explain_fewer(request)),
        (unseen, "cameras", len(unseen), len(rig.views), ", ".join(unseen)),
        (fewer > 0, "exposures", fewer, len(DOME_EXPOSURES_S)),
    )
    knobs = {
        "lights": [light.name for light in small.lights],
        "views": [view.name for view in small.views],
        "valid_share": prediction.valid_fraction,
        "exposures_s": list(setting.exposures_s),
    }
    full_s = _whole_duration_s(rig) if full_s is None else full_s
    plan = dome_plan(small) if plan is None else plan
    return PlanChoice(small, plan, forecasts, full_s, knobs, left_out)


def _whole_duration_s(rig: Rig) -> float:
    """Return the duration of the plan of all lights and cameras, s."""
    # it does not depend on the order of the lights, whose search takes long
    return dome_plan(rig, order=range(len(rig.lights))).estimate_duration_s(rig)


def _require_enough(what: str, lights: int, views: int) -> None:
    least = surface_estimates.MIN_LIGHTS, surface_estimates.MIN_VIEWS
    if lights < least[0] or views < least[1]:
        raise plans.PlanningError(
            f"{what} {lights} lights and {views} cameras of this rig, expected at least {least[0]} "
            f"and {least[1]}; add more"
        )


def _reduce(rig: Rig, setting: DomeSettings) -> Rig:
    """Return the rig with the lights and cameras of a plan."""
    return rig.subset(
        lights=[rig.lights[k].name for k in setting.lights],
        views=[rig.views[k].name for k in setting.views],
    )


def _read_order(rig: Rig, plan: Plan) -> list[int]:
    """Return the order of a plan's lights, by their number in the rig."""
    place = {light.name: k for k, light in enumerate(rig.lights)}
    shown = (step.index["light"] for step in plan.steps if step.kind == "olat")
    return [place[str(name)] for name in dict.fromkeys(shown)]


def _explain_fewer(request: PlanRequest) -> str:
    """Return why lights are omitted."""
    if request.budget_s is not None:
        return "with them the forecast time exceeds the budget, or the error is not smaller"
    return "the others reach the goals"


def _target_rad(request: PlanRequest) -> float:
    return math.radians(request.goals.get("normals", 90.0))


def _r_d_error(prediction: ErrorPrediction, observation: DomeObservation) -> float:
    """Return the predicted median relative error of R_d."""
    if not prediction.valid.any():
        return math.inf
    good = prediction.valid
    gloss = SPECULAR_R_D_ERROR / LIGHT_ERROR / observation.r_d[good]
    common = (
        SHARED_R_D_ERROR**2 + (surface_errors.R_D_ERROR_PER_RAD * prediction.tilt_rad[good]) ** 2
    )
    sigma = np.sqrt(
        np.square(prediction.log_albedo[good, None]) * (1.0 + np.square(gloss)) + common[:, None]
    )
    return plans.median_magnitude(sigma, observation.unresolved[good])


def _is_r_d_reached(
    prediction: ErrorPrediction, observation: DomeObservation, request: PlanRequest
) -> bool:
    most = request.goals.get("r_d")
    return most is None or 100.0 * _r_d_error(prediction, observation) <= most


def _remove_views(
    observation: DomeObservation,
    lights: list[int],
    prediction: ErrorPrediction,
    request: PlanRequest,
    valid_share: float,
) -> tuple[list[int], ErrorPrediction]:
    """Remove cameras greedily, the least informative first, while the goals are reached."""
    views = list(range(observation.seen.shape[1]))
    least = surface_estimates.MIN_LIGHTS
    target = _target_rad(request)
    if prediction.median_rad > target or prediction.valid_fraction < valid_share:
        return views, prediction
    while len(views) > surface_estimates.MIN_VIEWS:
        tried = []
        for view in views:
            rest = [other for other in views if other != view]
            now = light_selection.predict_errors(
                observation.information(rest), lights, min_lights=least
            )
            if (
                now.median_rad <= target
                and now.valid_fraction >= valid_share
                and _is_r_d_reached(now, observation, request)
            ):
                tried.append((-now.valid_fraction, now.median_rad, view, now))
        if not tried:
            break
        _, _, view, prediction = min(tried, key=lambda one: one[:3])
        views.remove(view)
    return views, prediction


def _explain_shortfall(
    best: ErrorPrediction, observation: DomeObservation, request: PlanRequest
) -> tuple[str, ...]:
    """Return the reasons why no number of lights reaches the goals; empty if one does."""
    out, wants = [], request.goals
    normals = math.degrees(best.median_rad)
    if normals > wants.get("normals", math.inf):
        floor = math.degrees(light_selection.rayleigh_mixture_median(observation.systematic_rad))
        out.append(
            f"normals: all lights and cameras leave {normals:.2f}°, {floor:.2f}° of it by "
            f"registration errors and fine topography at {observation.pixel_mm:.2g} mm per pixel; "
            "use more pixels, not more lights"
        )
    r_d = 100.0 * _r_d_error(best, observation)
    if r_d > wants.get("r_d", math.inf):
        out.append(
            f"r_d: all lights and cameras leave {r_d:.2g} %, in part because albedo varies within"
            f" a "
            f"pixel of {observation.pixel_mm:.2g} mm; use more pixels"
        )
    return tuple(out)
