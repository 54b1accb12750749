"""Plan the fiber probe: choose the exposures, placements and sites that sigma_tr needs.

`skinrig.planning.probe_forecast` predicts the errors of a plan.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from capture.plan import Plan, PlanError
from capture.plan.probe import MAX_EXPOSURE_S, N_BRACKETS, exposure_series_s, probe_plan
from capture.plan.suction import step_placement
from capture.rig import Rig
from model.skin import SkinAppearance
from reconstruction.pipeline.probe.profile_fits import METHOD_NAMES
from skinrig.evaluating import subsurface
from skinrig.planning import plan_omissions, plans, time_budget
from skinrig.planning.plans import PlanChoice, PlanRequest
from skinrig.planning.probe_forecast import Memory, ProbePrediction, ProbeSettings, predict
from skinrig.planning.probe_observation import ProbeObservation, simulate_observation

MIN_EXPOSURE_S = exposure_series_s()[0]
"""Shortest exposure of the rig's own series, s; the nearest fiber must not saturate in it."""
BRACKET_CHOICES = (3, 4, 6, 8, 12, N_BRACKETS)
"""Numbers of exposures per series."""
LONGEST_EXPOSURE_CHOICES_S = (0.5, 1.0, 2.0, 4.0, 8.0, 15.0, MAX_EXPOSURE_S)
"""Longest exposures of a series, s."""
REPEAT_CHOICES = (1, 2, 4)
DARK_CHOICES = (1, 2)


def choose(rig: Rig, request: PlanRequest) -> PlanChoice:
    """Choose the shortest plan that reaches the goal.

    Parameters
    ----------
    rig
        The probe.
    request
        Goal by name: "sigma_tr" in percent, the median of the relative error over sites and
        colors; empty: forecast of the rig's own plan. The valid fraction refers to the valid fits
        of that plan.
    """
    if request.budget_s is not None:
        return time_budget.choose_within_budget(generate_choices, rig, request)
    observation = simulate_observation(rig, request.subject, seed=request.seed)
    own, wants, valid_share = probe_plan(rig), request.goals, request.min_valid_fraction
    if not wants:
        setting = read_settings(own)
        return _choice(rig, observation, own, setting, predict(observation, setting), wants)
    target = wants.get("sigma_tr", math.inf) / 100.0
    memory: Memory = {}
    whole = predict(observation, read_settings(own), memory=memory)

    def good(found: ProbePrediction) -> bool:
        left = found.sigma[~found.measured]
        return (
            found.valid_share >= valid_share * whole.valid_share
            and found.median <= target
            # the other sites must predict an omitted one within the goal
            and (not left.size or plans.median_magnitude(left) <= target)
        )

    tried: list[tuple[ProbeSettings, Plan, ProbePrediction]] = []
    for setting, plan in generate_candidates(rig, observation):
        tried.append((setting, plan, predict(observation, setting, memory=memory)))
        if good(tried[-1][2]):
            break
    path = tuple(
        {
            "exposures": float(len(one.exposures_s)),
            "longest_s": one.exposures_s[-1],
            "repeats": float(one.repeats),
            "seconds": plan.estimate_duration_s(rig),
            "sigma_tr_percent": 100.0 * found.median,
            "valid_share": found.valid_share,
        }
        for one, plan, found in tried
    )
    setting, plan, found = tried[-1]
    reasons: tuple[str, ...] = ()
    if good(found):
        setting, plan = remove_sites(observation, setting, plan, good, memory=memory)
    else:
        reasons = (_explain_shortfall(observation, whole, target),)
        least = valid_share * whole.valid_share
        best = min(one[2].median for one in tried if one[2].valid_share >= least)
        setting, plan, _ = next(
            one for one in tried if one[2].median <= 1.05 * best and one[2].valid_share >= least
        )
    found = predict(observation, setting, memory=memory)
    choice = _choice(rig, observation, plan, setting, found, wants)
    return replace(choice, path=path, reasons=reasons)


def generate_choices(
    rig: Rig, request: PlanRequest, is_affordable: time_budget.Affordable
) -> Iterator[PlanChoice]:
    """Yield affordable plans of all sites with their forecasts, by increasing duration.

    They have the fewest dark frames: more hardly lower the error.
    """
    observation = simulate_observation(rig, request.subject, seed=request.seed)
    memory: Memory = {}
    for setting, plan in generate_candidates(rig, observation):
        if setting.darks == DARK_CHOICES[0] and is_affordable(rig, plan):
            found = predict(observation, setting, memory=memory)
            yield _choice(rig, observation, plan, setting, found, request.goals)


def forecast(rig: Rig, plan: Plan, request: PlanRequest) -> PlanChoice:
    """Forecast the errors of a plan of the probe at its sites."""
    setting = read_settings(plan)
    observation = simulate_observation(rig, request.subject, seed=request.seed, sites=setting.sites)
    return _choice(rig, observation, plan, setting, predict(observation, setting), request.goals)


def describe_rehearsal(_: PlanChoice) -> plans.Rehearsal:
    """Return the probe's phantom and its calibration."""
    return plans.Rehearsal({"phantom": {}}, (("fiber", ("phantom",)),), ("subsurface",))


def measure_errors(
    _choice: PlanChoice, appearance: SkinAppearance, truth: SkinAppearance, _: int
) -> dict[str, tuple[float, float]]:
    """Return median error, percent, and valid fraction of sigma_tr over sites and colors."""
    fits = subsurface.compare_fits(appearance, truth)
    rows = [row for row in fits if row.method == METHOD_NAMES[0]]
    good = [abs(row.relative) for row in rows if row.valid]
    median = 100.0 * float(np.median(good)) if good else math.inf
    return {"sigma_tr": (median, len(good) / max(len(rows), 1))}


def generate_candidates(
    rig: Rig, observation: ProbeObservation
) -> Iterator[tuple[ProbeSettings, Plan]]:
    """Yield plans of all sites in one direction within the rig's limits, by increasing duration."""
    found: list[tuple[float, Plan]] = []
    for brackets, longest_s, repeats, darks in itertools.product(
        BRACKET_CHOICES, LONGEST_EXPOSURE_CHOICES_S, REPEAT_CHOICES, DARK_CHOICES
    ):
        step_ev = math.log2(longest_s / MIN_EXPOSURE_S) / (brackets - 1)
        try:
            plan = probe_plan(
                rig,
                sites=observation.sites,
                repeats=repeats,
                brackets=brackets,
                max_exposure_s=longest_s,
                step_ev=step_ev,
                darks=darks,
            )
        except PlanError:
            continue  # beyond the limits of the probe's head
        found.append((plan.estimate_duration_s(rig), plan))
    for _, plan in sorted(found, key=lambda one: one[0]):
        yield read_settings(plan), plan


def remove_sites(
    observation: ProbeObservation,
    setting: ProbeSettings,
    plan: Plan,
    is_sufficient: Callable[[ProbePrediction], bool],
    *,
    memory: Memory | None = None,
) -> tuple[ProbeSettings, Plan]:
    """Omit sites that the others and the population prior predict within the goal.

    Parameters
    ----------
    observation
        See `simulate_observation`.
    setting, plan
        Settings and plan that reach the goal.
    is_sufficient
        Returns whether predicted errors are within the goal.
    memory
        See `predict`.
    """
    while len(setting.sites) > 1:
        for site in setting.sites:
            rest = tuple(other for other in setting.sites if other != site)
            if is_sufficient(predict(observation, replace(setting, sites=rest), memory=memory)):
                kept = tuple(s for s in plan.steps if s.index.get("site") != site)
                setting, plan = replace(setting, sites=rest), replace(plan, steps=kept)
                break
        else:
            break
    return setting, plan


def read_settings(plan: Plan) -> ProbeSettings:
    """Return the settings of a plan that determine sigma_tr.

    Raises
    ------
    plans.PlanningError
        If the plan has no series on skin or no dark frame.
    """
    shots = [step for step in plan.steps if step.kind == "fibers"]
    darks = [step for step in plan.steps if step.kind == "dark"]
    if not shots:
        raise plans.PlanningError("plan: got no series on skin, expected at least one; add a site")
    if not darks:
        raise plans.PlanningError(
            "plan: got no dark frame, expected at least one per exposure time; add dark frames"
        )
    placements = list(dict.fromkeys(step_placement(step) for step in shots))
    sites = tuple(dict.fromkeys(str(step.index["site"]) for step in shots))
    first = [step for step in shots if step_placement(step) == placements[0]]
    times = {float(step.settings["exposure_s"]) for step in darks}
    return ProbeSettings(
        sites,
        tuple(sorted(float(step.settings["exposure_s"]) for step in first)),
        max(1, len(placements) // len(sites)),
        max(1, len(darks) // max(len(times), 1)),
        float(first[0].settings.get("level", 1.0)),
    )


def _choice(
    rig: Rig,
    observation: ProbeObservation,
    plan: Plan,
    setting: ProbeSettings,
    found: ProbePrediction,
    wants: Mapping[str, float],
) -> PlanChoice:
    value = 100.0 * found.median
    low, high = found.interval()
    predicted = plans.Forecast(
        "sigma_tr", "%", value, (100.0 * low, 100.0 * high), wants.get("sigma_tr")
    )
    fewer = N_BRACKETS - len(setting.exposures_s)
    longest_s = setting.exposures_s[-1]
    percent = [100.0 * float(np.median(sigma)) for sigma in found.sigma]
    sites = zip(observation.sites, percent, found.measured, strict=True)
    turned = {name for step in plan.steps for name in step.index if step.index[name]}
    left_out = plan_omissions.list_omissions(
        "probe",
        (fewer > 0, "exposures", fewer, N_BRACKETS),
        (longest_s < 0.99 * MAX_EXPOSURE_S, "longest", longest_s),
        *((not measured, "site", site, error) for site, error, measured in sites),
        ("angle" not in turned, "directions"),
    )
    knobs = {
        "sites": list(setting.sites),
        "repeats": setting.repeats,
        "directions": 1,
        "exposures_s": [round(seconds, 5) for seconds in setting.exposures_s],
        "darks": setting.darks,
        "valid_share": found.valid_share,
        plans.PERCENT_BY_SITE: {
            site: [round(100.0 * float(one), 3) for one in found.sigma[k]]
            for k, site in enumerate(observation.sites)
        },
    }
    full_s = probe_plan(rig, repeats=setting.repeats).estimate_duration_s(rig)
    return PlanChoice(rig, plan, (predicted,), full_s, knobs, left_out)


def _explain_shortfall(observation: ProbeObservation, whole: ProbePrediction, target: float) -> str:
    """Return the reasons why no plan reaches the goal."""
    stays = 100.0 * plans.median_magnitude(whole.misfit)
    calibration = 100.0 * plans.median_magnitude(whole.common)
    return (
        f"sigma_tr: the rig's own series leave {100.0 * whole.median:.2g} %; without noise, "
        f"layers unlike a homogeneous medium and the calibration (phantom certificate, far "
        f"cross-talk) leave {stays:.2g} %, the calibration alone {calibration:.2g} %; "
        + (
            "more exposures or placements will not help"
            if stays > 100.0 * target
            else f"more than {REPEAT_CHOICES[-1]} placements would be needed"
        )
    )
