"""Plans of the light dome: which of its lights and cameras a subject needs.

The forecast follows a face of the rig's simulation: which points each light and camera reach, how
much light comes back, how noisy the sensor is. What no sample removes is taken from what the
reconstruction itself states: samples misplaced by part of a pixel, and relief too fine for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from capture.plan import Plan
from capture.plan.dome import EXPOSURES_S, dome_plan
from capture.plan.rows import lights_of
from capture.rig import Rig
from model import store
from reconstruction.photometric_stereo import light_selection
from reconstruction.photometric_stereo.light_selection import Prediction
from reconstruction.pipeline import recipes as pipeline
from reconstruction.surface import errors as surface_errors
from reconstruction.surface import estimates as surface_estimates
from skinrig.arrays import Float64Array
from skinrig.calibrating.calibrate import calibrate
from skinrig.evaluating import surface as surface_evaluation
from skinrig.planning.dome_observation import LIGHT_ERROR, Observation, simulate_observation
from skinrig.planning.plans import Choice, Forecast, PlanningError, light_of
from skinrig.simulating.simulation import simulate_session

VALID_SHARE = 0.9
"""Of the points that the whole dome gives an estimate, so many must keep one."""
FORECAST_RELATIVE_SD = {"normals": 0.2, "r_d": 0.2}
"""Relative deviation of measured from predicted medians, see docs/planning.md."""
SHARED_R_D_ERROR = 0.0095
"""Relative error of R_d that a face's points share or that follows nothing known, whatever the
lights. With `GLOSS_R_D_ERROR` set on faces of seeds 1 to 3, types V, I and IV."""
GLOSS_R_D_ERROR = 0.0022
"""What gloss outside the part that is left out adds to R_d by one light: the same on all skin, so
much on dark skin. Lights' errors of R_d by it are as far from each other as their `LIGHT_ERROR`."""


def choose(
    rig: Rig,
    wants: Mapping[str, float],
    *,
    subject: str = "III",
    seed: int = 0,
    valid_share: float = VALID_SHARE,
    most_lights: int | None = None,
) -> Choice:
    """Choose the fewest lights, then the fewest cameras, that reach what is wanted.

    Parameters
    ----------
    rig
        A dome.
    wants
        By name: "normals" in degrees, "r_d" in percent, both medians over the face; empty: the
        forecast of the whole dome.
    subject
        Preset of the face that is forecast.
    seed
        Of that face.
    valid_share
        Of the points that the whole dome estimates, so many must keep an estimate.
    most_lights
        Largest number of lights.
    """
    least = surface_estimates.MIN_LIGHTS
    if len(rig.lights) < least or len(rig.views) < surface_estimates.MIN_VIEWS:
        raise PlanningError(
            f"rig: got {len(rig.lights)} lights and {len(rig.views)} cameras, expected at least "
            f"{least} and {surface_estimates.MIN_VIEWS}"
        )
    observation = simulate_observation(rig, subject, seed=seed)
    every_view = range(len(rig.views))
    every_light = range(len(rig.lights))
    best = light_selection.predict(observation.information(every_view), every_light, least=least)
    full = dome_plan(rig)
    if not wants:
        return _choice(
            rig, observation, list(every_light), list(every_view), best, wants, rig, full
        )
    reasons = _out_of_reach(best, observation, wants)
    target = math.radians(wants.get("normals", 90.0))
    share = valid_share * best.valid_share
    selected = light_selection.select(
        observation.information(every_view),
        median_rad=target,
        valid_share=share,
        least=least,
        most=most_lights,
    )
    lights, prediction = list(selected.lights), selected.prediction
    while not _r_d_reached(prediction, observation, wants) and len(lights) < len(rig.lights):
        selected = light_selection.select(
            observation.information(every_view),
            median_rad=0.0,
            valid_share=2.0,
            least=least,
            most=len(lights) + 1,
            fixed=tuple(lights),
        )
        lights, prediction = list(selected.lights), selected.prediction
        if most_lights is not None and len(lights) >= most_lights:
            break
    views, prediction = _fewer_views(observation, lights, prediction, wants, share)
    kept = rig.subset(
        lights=[rig.lights[k].name for k in lights], views=[rig.views[k].name for k in views]
    )
    path = tuple(
        {"lights": float(n), "normals_deg": math.degrees(error), "valid_share": share_now}
        for n, error, share_now in selected.path
    )
    return _choice(
        rig, observation, lights, views, prediction, wants, kept, full, path=path, reasons=reasons
    )


def forecast(
    rig: Rig, plan: Plan, wants: Mapping[str, float], *, subject: str = "III", seed: int = 0
) -> Choice:
    """Return what a plan of the dome will give.

    Parameters
    ----------
    rig
        The dome.
    plan
        Whose lights and cameras are looked at.
    wants, subject, seed
        As in `choose`.
    """
    lit = {name for step in plan.steps if step.kind == "olat" for name in lights_of(step)}
    seen = {name for step in plan.steps if step.kind == "olat" for name in step.cameras}
    lights = [k for k, light in enumerate(rig.lights) if light.name in lit]
    views = [k for k, view in enumerate(rig.views) if view.name in seen]
    if len(lights) < surface_estimates.MIN_LIGHTS or len(views) < surface_estimates.MIN_VIEWS:
        raise PlanningError(
            f"plan: got {len(lights)} lights and {len(views)} cameras of this rig, expected at "
            f"least {surface_estimates.MIN_LIGHTS} and {surface_estimates.MIN_VIEWS}"
        )
    observation = simulate_observation(rig, subject, seed=seed)
    prediction = light_selection.predict(
        observation.information(views), lights, least=surface_estimates.MIN_LIGHTS
    )
    kept = rig.subset(
        lights=[rig.lights[k].name for k in lights], views=[rig.views[k].name for k in views]
    )
    return _choice(
        rig, observation, lights, views, prediction, wants, kept, dome_plan(rig), plan=plan
    )


def confirm(
    choice: Choice, out: Path, *, subject: str, seed: int, progress: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Simulate the dome of a choice and its calibration, reconstruct, compare with the truth."""
    width = choice.rig.views[0].width_px
    sessions = {name: out / f"session-{name}" for name in ("charuco", "mirror", "white")}
    for target, session in sessions.items():
        progress(f"simulate {target}")
        simulate_session(
            "dome", session, target=target, seed=seed, width_px=width, plan=choice.plan
        )
    calibration = out / "calibration"
    calibrate("geometry", [sessions["charuco"]], calibration)
    calibrate("lights", [sessions["mirror"], sessions["white"]], calibration)
    progress(f"simulate the face {subject}")
    done = simulate_session(
        "dome", out / "session-face", subject=subject, seed=seed, width_px=width, plan=choice.plan
    )
    progress("reconstruct")
    pipeline.reconstruct(
        done.session,
        want=("normals", "r_d"),
        out=out / "appearance",
        calibration=calibration,
        truth=done.truth.name if done.truth else "",
    )
    appearance, truth = (store.read(out / name) for name in ("appearance", "truth-face"))
    pairs = surface_evaluation.match(appearance, truth)
    rows = []
    for one in choice.forecasts:
        error = np.abs(surface_evaluation.errors_at(one.name, appearance, truth, pairs))
        median = float(np.nanmedian(error))
        rows.append(
            {
                "name": one.name,
                "unit": one.unit,
                "median": median,
                "forecast": one.value,
                "within": one.interval[0] <= median <= one.interval[1],
                "valid_share": float(np.isfinite(error).mean()),
            }
        )
    return rows


def _choice(
    rig: Rig,
    observation: Observation,
    lights: list[int],
    views: list[int],
    prediction: Prediction,
    wants: Mapping[str, float],
    kept: Rig,
    full: Any,
    *,
    path: tuple[Mapping[str, float], ...] = (),
    reasons: tuple[str, ...] = (),
    plan: Plan | None = None,
) -> Choice:
    plan = dome_plan(kept) if plan is None else plan
    forecasts = tuple(
        Forecast(name, unit, value, _interval(name, value), wants.get(name))
        for name, unit, value in (
            ("normals", "deg", math.degrees(prediction.median_rad)),
            ("r_d", "%", 100.0 * _r_d_error(prediction, observation)),
        )
    )
    left_out = []
    if len(lights) < len(rig.lights):
        names = [light.name for k, light in enumerate(rig.lights) if k not in lights]
        left_out.append(
            (
                f"{len(names)} of {len(rig.lights)} lights: {', '.join(names)}",
                "the others reach what is wanted",
            )
        )
    if len(views) < len(rig.views):
        names = [view.name for k, view in enumerate(rig.views) if k not in views]
        left_out.append(
            (
                f"{len(names)} of {len(rig.views)} cameras: {', '.join(names)}",
                "two others see each point that is asked for",
            )
        )
    return Choice(
        kept,
        plan,
        forecasts,
        plan.estimated_s(kept),
        full.estimated_s(rig),
        {
            "lights": [rig.lights[k].name for k in sorted(lights)],
            "views": [rig.views[k].name for k in sorted(views)],
            "valid_share": prediction.valid_share,
            "exposures_s": list(EXPOSURES_S),
        },
        tuple(left_out),
        path,
        reasons,
        light_of(plan, kept),
    )


def _interval(name: str, value: float) -> tuple[float, float]:
    return value / (1.0 + FORECAST_RELATIVE_SD[name]), value * (1.0 + FORECAST_RELATIVE_SD[name])


def _r_d_error(prediction: Prediction, observation: Observation) -> float:
    """Return the predicted median relative error of R_d."""
    if not prediction.valid.any():
        return math.inf
    good = prediction.valid
    gloss = GLOSS_R_D_ERROR / LIGHT_ERROR / observation.r_d[good]
    common = (
        SHARED_R_D_ERROR**2 + (surface_errors.R_D_ERROR_PER_RAD * prediction.tilt_rad[good]) ** 2
    )
    sigma = np.sqrt(
        np.square(prediction.log_albedo[good, None]) * (1.0 + np.square(gloss)) + common[:, None]
    )
    return _median_magnitude(observation.unresolved[good], sigma)


def _median_magnitude(offset: Float64Array, sigma: Float64Array) -> float:
    """Return the median of |error| of a mixture of Gaussian errors about offsets."""
    from scipy.special import ndtr

    low, high = 0.0, float(np.max(np.abs(offset) + 2.0 * sigma))
    for _ in range(40):
        middle = 0.5 * (low + high)
        below = np.mean(ndtr((middle - offset) / sigma) - ndtr((-middle - offset) / sigma))
        low, high = (middle, high) if below < 0.5 else (low, middle)
    return 0.5 * (low + high)


def _r_d_reached(
    prediction: Prediction, observation: Observation, wants: Mapping[str, float]
) -> bool:
    return "r_d" not in wants or 100.0 * _r_d_error(prediction, observation) <= wants["r_d"]


def _fewer_views(
    observation: Observation,
    lights: list[int],
    prediction: Prediction,
    wants: Mapping[str, float],
    valid_share: float,
) -> tuple[list[int], Prediction]:
    """Take off cameras, the one that is missed least first, while what is wanted is reached."""
    views = list(range(observation.variance.shape[2]))
    least = surface_estimates.MIN_LIGHTS
    target = math.radians(wants.get("normals", 90.0))
    if prediction.median_rad > target or prediction.valid_share < valid_share:
        return views, prediction
    while len(views) > surface_estimates.MIN_VIEWS:
        tried = []
        for view in views:
            rest = [other for other in views if other != view]
            now = light_selection.predict(observation.information(rest), lights, least=least)
            if (
                now.median_rad <= target
                and now.valid_share >= valid_share
                and _r_d_reached(now, observation, wants)
            ):
                tried.append((-now.valid_share, now.median_rad, view, now))
        if not tried:
            break
        _, _, view, prediction = min(tried, key=lambda one: one[:3])
        views.remove(view)
    return views, prediction


def _out_of_reach(
    best: Prediction, observation: Observation, wants: Mapping[str, float]
) -> tuple[str, ...]:
    """Say why no number of lights gives what is wanted, where that is so."""
    out = []
    normals = math.degrees(best.median_rad)
    if normals > wants.get("normals", math.inf):
        floor = math.degrees(light_selection.median_of_rayleigh(observation.systematic_rad))
        out.append(
            f"normals: all lights and cameras leave {normals:.2f}°, {floor:.2f}° of it by "
            f"misplaced samples and fine relief at {observation.pixel_mm:.2g} mm a pixel; "
            "more pixels would help, more lights will not"
        )
    r_d = 100.0 * _r_d_error(best, observation)
    if r_d > wants.get("r_d", math.inf):
        out.append(
            f"r_d: all lights and cameras leave {r_d:.2g} %; at {observation.pixel_mm:.2g} mm a "
            "pixel albedo too fine for it is part of that"
        )
    return tuple(out)
