"""Plan the light dome: choose the lights and cameras that a subject needs.

The forecast simulates a face: visibility of its points from each light and camera, reflected light
and sensor noise. Two errors do not decrease with more samples: registration errors below a pixel,
and surface topography finer than a pixel.
"""

import math
from dataclasses import replace

import numpy as np

from capture.plan import Plan
from capture.plan.dome import DOME_EXPOSURES_S, dome_plan
from capture.plan.rows import step_lights
from capture.rig import Rig
from model.skin import SkinAppearance
from reconstruction.photometric_stereo import light_selection
from reconstruction.photometric_stereo.light_selection import ErrorPrediction
from reconstruction.surface import errors as surface_errors
from reconstruction.surface import estimates as surface_estimates
from skinrig.evaluating import surface as surface_evaluation
from skinrig.planning import plan_omissions, plans
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
    least = surface_estimates.MIN_LIGHTS
    if len(rig.lights) < least or len(rig.views) < surface_estimates.MIN_VIEWS:
        raise plans.PlanningError(
            f"rig: got {len(rig.lights)} lights and {len(rig.views)} cameras, expected at least "
            f"{least} and {surface_estimates.MIN_VIEWS}"
        )
    observation = simulate_observation(rig, request.subject, seed=request.seed)
    every_view, every_light = list(range(len(rig.views))), list(range(len(rig.lights)))
    information = observation.information(every_view)
    best = light_selection.predict_errors(information, every_light, min_lights=least)
    if not request.goals:
        return _choice(rig, observation, (every_light, every_view), best, request)
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
    choice = _choice(rig, observation, (lights, views), prediction, request)
    return replace(choice, path=path, reasons=reasons)


def forecast(rig: Rig, plan: Plan, request: PlanRequest) -> PlanChoice:
    """Forecast the errors of a plan from its lights and cameras."""
    olat = [step for step in plan.steps if step.kind == "olat"]
    lit = {name for step in olat for name in step_lights(step)}
    seen = {name for step in olat for name in step.cameras}
    lights = [k for k, light in enumerate(rig.lights) if light.name in lit]
    views = [k for k, view in enumerate(rig.views) if view.name in seen]
    if len(lights) < surface_estimates.MIN_LIGHTS or len(views) < surface_estimates.MIN_VIEWS:
        raise plans.PlanningError(
            f"plan: got {len(lights)} lights and {len(views)} cameras of this rig, expected at "
            f"least {surface_estimates.MIN_LIGHTS} and {surface_estimates.MIN_VIEWS}"
        )
    observation = simulate_observation(rig, request.subject, seed=request.seed)
    information = observation.information(views)
    prediction = light_selection.predict_errors(
        information, lights, min_lights=surface_estimates.MIN_LIGHTS
    )
    return _choice(rig, observation, (lights, views), prediction, request, plan=plan)


def describe_rehearsal(choice: PlanChoice) -> plans.Rehearsal:
    """Return the targets and calibrations that confirm a choice, with its lights and cameras."""
    width = {"width_px": choice.rig.views[0].width_px}
    return plans.Rehearsal(
        dict.fromkeys(("charuco", "mirror", "white"), width | {"plan": choice.plan}),
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
    selection: tuple[list[int], list[int]],
    prediction: ErrorPrediction,
    request: PlanRequest,
    *,
    plan: Plan | None = None,
) -> PlanChoice:
    """Build the choice of a subset of lights and cameras, given by index."""
    lights, views = selection
    small = rig.subset(
        lights=[rig.lights[k].name for k in lights], views=[rig.views[k].name for k in views]
    )
    unlit = [light.name for k, light in enumerate(rig.lights) if k not in lights]
    unseen = [view.name for k, view in enumerate(rig.views) if k not in views]
    medians = {
        "normals": math.degrees(prediction.median_rad),
        "r_d": 100.0 * _r_d_error(prediction, observation),
    }
    forecasts = plans.build_forecasts(medians, FORECAST_RELATIVE_SD, request, "dome")
    left_out = plan_omissions.list_omissions(
        "dome",
        (unlit, "lights", len(unlit), len(rig.lights), ", ".join(unlit)),
        (unseen, "cameras", len(unseen), len(rig.views), ", ".join(unseen)),
    )
    knobs = {
        "lights": [rig.lights[k].name for k in sorted(lights)],
        "views": [rig.views[k].name for k in sorted(views)],
        "valid_share": prediction.valid_fraction,
        "exposures_s": list(DOME_EXPOSURES_S),
    }
    full_s = dome_plan(rig).estimate_duration_s(rig)
    plan = dome_plan(small) if plan is None else plan
    return PlanChoice(small, plan, forecasts, full_s, knobs, left_out)


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
    views = list(range(observation.variance.shape[2]))
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
