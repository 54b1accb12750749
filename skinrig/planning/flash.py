"""Plans of the flash rig: how many frames, how much light and how many darks a face needs.

The forecast is the Cramer-Rao bound of both chromophores at every pixel of a simulated face: the
sensor's noise at the light that comes back, the model error and the prior of the light, as in the
report; what noise leaves beside the model error is what the knobs can change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from capture.plan import Plan, flash_plan
from capture.rig import Rig
from model import store
from reconstruction.chromophores.detectability import detectable
from reconstruction.pipeline import recipes as pipeline
from reconstruction.pipeline.flash.stages import MIN_SIGNAL_SIGMAS
from skinrig.arrays import BoolArray, Float64Array
from skinrig.calibrating.calibrate import calibrate
from skinrig.evaluating import flash
from skinrig.evaluating.bounds import relative_bounds
from skinrig.planning.flash_observation import (
    CHROMOPHORE_NAMES,
    CONFIRM_PX,
    Observation,
    simulate_observation,
)
from skinrig.planning.plans import Choice, Forecast, PlanningError, interval_of, median_of_normals
from skinrig.simulating.simulation import simulate_session

REPEAT_CHOICES = (1, 2, 4, 8, 16)
"""Crossed frames of a state that are averaged: 16 of them take a minute and a half."""
DARK_CHOICES = (0, 1, 4)
POWER_CHOICES = (0.03125, 0.0625, 0.125, 0.25, 0.5, 1.0)
"""Of the flashes' full energy; less is kinder to eyes and costs no time."""
FORECAST_RELATIVE_SD: Mapping[str, float] = {"melanin": 0.2, "hemoglobin": 0.15}
"""Relative deviation of measured from predicted medians, see docs/planning.md."""
ERROR_OVER_BOUND: Mapping[str, float] = {"melanin": 1.1, "hemoglobin": 1.0}
"""Errors over their bounds, medians of sessions. Melanin's exceed it as the light's prior tells
less of most pixels than its information says in the mean (2 to 10 %), as the model error of a face
is not that of faces in general (up to 10 %), and as color bends over errors of its size."""


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Relative errors of the face's pixels, standard deviations, by chromophore."""

    sigma: Mapping[str, Float64Array]
    """(H, W)."""
    valid: Mapping[str, BoolArray]
    """(H, W) where the estimate would not be masked."""
    skin: BoolArray

    def median(self, name: str) -> float:
        """Return the predicted median relative error."""
        return median_of_normals(self.sigma[name][self.valid[name]])

    def valid_share(self, name: str) -> float:
        """Return the share of the skin that keeps an estimate."""
        return float(self.valid[name].sum() / max(self.skin.sum(), 1))


def predict(observation: Observation, *, repeats: int, power: float, darks: int) -> Prediction:
    """Return the errors that crossed frames of a face leave.

    Parameters
    ----------
    observation
        See `simulate_observation`.
    repeats
        Crossed frames that are averaged.
    power
        Of the flashes, 0 to 1.
    darks
        Frames without light; 0: the black level of the camera is taken at its word.
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
        shading_spread=observation.light_spread,
        model_scale=observation.mixing,
    )
    sigma, valid = {}, {}
    for name, truth, bound in zip(
        CHROMOPHORE_NAMES, (observation.melanin, observation.hemoglobin), bounds, strict=True
    ):
        told = np.full(skin.shape, np.inf)
        told[skin] = ERROR_OVER_BOUND[name] * bound
        sigma[name] = told
        valid[name] = detectable(truth, np.where(skin, told, 0.0) * truth, skin)
    return Prediction(sigma, valid, observation.skin)


def choose(
    rig: Rig,
    wants: Mapping[str, float],
    *,
    subject: str = "III",
    seed: int = 0,
    valid_share: float = 0.9,
) -> Choice:
    """Choose the quickest plan, and of those the one with the least light, for a face.

    Parameters
    ----------
    rig
        The flash rig.
    wants
        By name: "melanin" and "hemoglobin", medians of the relative error over the face, percent;
        empty: the forecast of the rig's own plan.
    subject, seed
        The face that is forecast.
    valid_share
        Of the skin that most light and most frames give an estimate, so much must keep one.
    """
    observation = simulate_observation(rig, subject, seed=seed)
    best = predict(observation, repeats=REPEAT_CHOICES[-1], power=1.0, darks=DARK_CHOICES[-1])
    if not wants:
        plan = flash_plan(rig)
        whole = {"repeats": 1, "power": 1.0, "darks": 4, "parallel": True}
        return _choice(rig, observation, plan, whole, wants)
    path = []
    chosen: dict[str, Any] = {}
    for settings in _candidates(rig):
        found = predict(observation, **settings)
        if settings["power"] == POWER_CHOICES[-1]:
            path.append(
                {name: float(settings[name]) for name in ("repeats", "darks")}
                | {f"{name}_percent": 100.0 * found.median(name) for name in CHROMOPHORE_NAMES}
            )
        chosen = settings
        if _good(found, best, wants, valid_share):
            return _choice(
                rig, observation, crossed_plan(rig, **chosen), chosen, wants, path=tuple(path)
            )
    least = next(one for one in _candidates(rig) if one["power"] == 1.0)
    reasons = _out_of_reach(best, observation, wants, valid_share)
    # what cannot be reached is not worth sixteen frames: the plan keeps those that still tell more
    told = [name for name in wants if np.isfinite(best.median(name))]  # less tells nothing as well
    for settings in _candidates(rig) if told else ():
        now = predict(observation, **settings)
        if all(now.median(name) <= 1.05 * best.median(name) for name in told):
            least = settings
            break
    return _choice(
        rig,
        observation,
        crossed_plan(rig, **least),
        least,
        wants,
        path=tuple(path),
        reasons=reasons,
    )


def forecast(
    rig: Rig, plan: Plan, wants: Mapping[str, float], *, subject: str = "III", seed: int = 0
) -> Choice:
    """Return what a plan of the flash rig will give, in its first state.

    Parameters
    ----------
    rig
        The flash rig.
    plan
        With crossed frames of a subject.
    wants, subject, seed
        As in `choose`.
    """
    shots = [step for step in plan.steps if step.kind == "subject"]
    crossed = [step for step in shots if step.index.get("polarizer") == "crossed"]
    if not crossed:
        raise PlanningError("plan: got no crossed frame of a subject, expected at least one")
    own = [step for step in crossed if step.index.get("state") == crossed[0].index.get("state")]
    powers = [float(step.settings.get("power", 1.0)) for step in own]
    settings = {
        "repeats": len(own),
        "power": sum(powers) / len(powers),
        "darks": sum(step.kind == "dark" for step in plan.steps),
        "parallel": len(shots) > len(crossed),
    }
    return _choice(rig, simulate_observation(rig, subject, seed=seed), plan, settings, wants)


def confirm(
    choice: Choice, out: Path, *, subject: str, seed: int, progress: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Simulate a face under a choice, and the calibration, reconstruct, compare with the truth."""
    width = min(choice.rig.views[0].width_px, CONFIRM_PX)
    calibration = out / "calibration"
    for kind, target in (("sensor", "flat"), ("white", "white"), ("polarization", "malus")):
        progress(f"simulate {target}")
        session = out / f"session-{target}"
        simulate_session("flash", session, target=target, seed=seed, width_px=width)
        calibrate(kind, [session], calibration)
    progress(f"simulate the face {subject}")
    done = simulate_session(
        "flash", out / "session-face", subject=subject, seed=seed, width_px=width, plan=choice.plan
    )
    progress("reconstruct")
    pipeline.reconstruct(
        done.session,
        want=CHROMOPHORE_NAMES,
        out=out / "appearance",
        calibration=calibration,
        truth=done.truth.name if done.truth else "",
    )
    rows = flash.compare(
        store.read(out / "appearance"),
        store.read(out / "truth-face"),
        rng=np.random.default_rng(seed),
    )
    found = {row.name: row for row in rows if row.band is None and row.against == "blurred"}
    out_rows = []
    for one in choice.forecasts:
        if one.name not in found:
            continue
        median = 100.0 * found[one.name].median_relative
        out_rows.append(
            {
                "name": one.name,
                "unit": one.unit,
                "median": median,
                "forecast": one.value,
                "within": one.interval[0] <= median <= one.interval[1],
                "valid_share": 1.0 - found[one.name].masked,
            }
        )
    return out_rows


def crossed_plan(rig: Rig, *, repeats: int, power: float, darks: int) -> Plan:
    """Return a plan of crossed frames alone.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> rig = load_rig("flash")
    >>> plan = crossed_plan(rig, repeats=2, power=0.5, darks=0)
    >>> [step.index["polarizer"] for step in plan.steps], round(plan.estimated_s(rig), 1)
    (['crossed', 'crossed'], 11.4)
    """
    whole = flash_plan(rig, repeats=repeats, power=power, darks=darks)
    kept = tuple(step for step in whole.steps if step.index.get("polarizer") != "parallel")
    return replace(whole, steps=kept)


def _candidates(rig: Rig) -> Iterator[dict[str, Any]]:
    """Yield settings, the quickest first, of those the darkest."""
    every: list[dict[str, Any]] = [
        {"repeats": repeats, "power": power, "darks": darks}
        for repeats in REPEAT_CHOICES
        for darks in DARK_CHOICES
        for power in POWER_CHOICES
    ]
    yield from sorted(
        every,
        key=lambda one: (crossed_plan(rig, **one | {"power": 1.0}).estimated_s(rig), one["power"]),
    )


def _good(
    found: Prediction, best: Prediction, wants: Mapping[str, float], valid_share: float
) -> bool:
    return all(
        100.0 * found.median(name) <= value
        and found.valid_share(name) >= valid_share * best.valid_share(name)
        for name, value in wants.items()
    )


def _choice(
    rig: Rig,
    observation: Observation,
    plan: Plan,
    settings: Mapping[str, Any],
    wants: Mapping[str, float],
    *,
    path: tuple[Mapping[str, float], ...] = (),
    reasons: tuple[str, ...] = (),
) -> Choice:
    parallel = bool(settings.get("parallel", False))
    own = {name: settings[name] for name in ("repeats", "power", "darks")}
    found = predict(observation, **own)
    full = flash_plan(rig, repeats=max(int(own["repeats"]), 1))
    forecasts = tuple(
        Forecast(
            name,
            "%",
            100.0 * found.median(name),
            interval_of(100.0 * found.median(name), FORECAST_RELATIVE_SD[name]),
            wants.get(name),
        )
        for name in CHROMOPHORE_NAMES
    )
    left_out = []
    if not parallel:
        left_out.append(
            (
                f"{own['repeats']} parallel frames",
                "the crossed ones alone hold the light that melanin and hemoglobin color; the "
                "parallel ones add the gloss",
            )
        )
    if own["darks"] < 4:
        left_out.append(
            (
                f"{4 - own['darks']} of 4 dark frames",
                "at this exposure the black level that the camera states is off by less than the "
                "noise",
            )
        )
    if own["power"] < 1.0:
        left_out.append(
            (
                f"{100.0 * (1.0 - own['power']):.3g} % of the flashes' energy",
                "what is left errs by at most a twentieth more"
                if reasons
                else "what is left reaches what is wanted",
            )
        )
    powers = [float(step.settings.get("power", 0.0)) for step in plan.steps]
    pops = len([power for power in powers if power > 0])
    energy = sum(light.energy_ws or 0.0 for light in rig.lights)
    light: dict[str, Any] = {
        "pops": pops,
        "flash_ws": energy * sum(powers),
        "pops_per_min_limit": rig.max_pops_per_min,
        "flashes_per_s": min(rig.max_pops_per_min / 60.0, pops / max(plan.estimated_s(rig), 1e-9)),
    }
    return Choice(
        rig,
        plan,
        forecasts,
        plan.estimated_s(rig),
        full.estimated_s(rig),
        {
            **own,
            "polarizers": ["parallel", "crossed"] if parallel else ["crossed"],
            "valid_share": {name: found.valid_share(name) for name in CHROMOPHORE_NAMES},
        },
        tuple(left_out),
        path,
        reasons,
        light,
    )


def _out_of_reach(
    best: Prediction, observation: Observation, wants: Mapping[str, float], valid_share: float
) -> tuple[str, ...]:
    """Say why no number of frames gives what is wanted."""
    out = []
    for name, value in wants.items():
        now = 100.0 * best.median(name)
        if now <= value:
            continue
        still = replace(observation, gain=0.0, floor=0.0)
        model = 100.0 * predict(still, repeats=1, power=1.0, darks=0).median(name)
        why = (
            "more frames will not help; a camera whose colors tell the two apart better might"
            if model > value
            else f"more than {REPEAT_CHOICES[-1]} frames would be needed"
        )
        out.append(
            f"{name}: {REPEAT_CHOICES[-1]} frames at full power leave {now:.3g} %, of which the "
            f"model error alone, without any noise, leaves {model:.3g} %; {why}"
        )
    if not out and not _good(best, best, wants, valid_share):
        out.append("valid_share: too little of the skin keeps an estimate")
    return tuple(out)
