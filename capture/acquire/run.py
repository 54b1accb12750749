"""Run a plan on the rig that it is for."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping
from typing import Any

from capture.acquire.dome import run_dome
from capture.acquire.flash.run import run_flash
from capture.acquire.gradient.run import run_gradient
from capture.acquire.outcome import Acquired, AcquisitionError, Operator
from capture.acquire.probe.run import run_probe
from capture.devices.camera import Camera, check_serials
from capture.devices.dome import Eyes
from capture.devices.port import SYSTEM_CLOCK, Clock
from capture.plan import Plan
from capture.rig import Rig
from capture.session import Session

RIG_KINDS = ("gradient_sphere", "dome", "probe", "flash")
"""Boxes by which a rig is known."""


def run_plan(
    plan: Plan,
    rig: Rig,
    *,
    boxes: Mapping[str, Any],
    cameras: Mapping[str, Camera],
    session: Session,
    progress: Callable[[str], None] | None = None,
    prompt: Callable[[str], None] | None = None,
    interrupted: Callable[[], bool] | None = None,
    signal: Callable[[str], None] | None = None,
    clock: Callable[[], float] = time.time,
    timer: Clock = SYSTEM_CLOCK,
    run_id: str = "",
    eyes: Eyes = "open",
    force_limit_n: float | None = None,
    all_brackets: bool = False,
) -> Acquired:
    """Capture what the session still lacks of a plan.

    Parameters
    ----------
    plan
        What to capture; steps that the session holds already are not repeated.
    rig
        The rig that the plan is for.
    boxes, cameras
        Open drivers by name: the box of the rig ("flash", "dome", "probe" or "gradient_sphere",
        and "caliper" where skin is stretched), and a camera for each view.
    session
        Open for writing.
    progress
        Called with one line a step, or a second of a sequence.
    prompt
        Called before the first step that needs it with the state ("smile"), with the place of the
        target on the dome ("pose 3"), with how skin is to be taped ("tape the skin at 45
        degrees"), or with where the probe goes ("put the cap on the head", "place the head on the
        cheek at 0 degrees"); returns when the subject or the target is ready. Called
        too with what to press when only a hand can release a camera.
    interrupted
        Asked before each step, or each sequence; True stops in good order.
    signal
        Called in a sequence with the state that the subject shall change to, at the time; gives a
        sound and returns at once.
    clock
        The host's time, s since 1970, for the journal.
    timer
        What the times of a sequence are kept by; the world's own where it is simulated.
    run_id
        Begins the token of every flash or sequence of this run; drawn at random by default, so
        that no two bear one token, also after a resume.
    eyes
        What a person says of the subject's eyes: "open", "closed" or "shielded". Light that
        flickers too much for open eyes is refused; so are patterns on skin with open eyes.
    force_limit_n
        Greatest force of the caliper on the skin, N; there is no default, and nothing moves
        without.
    all_brackets
        Whether the probe takes all exposures of a series, also those that can show no more.

    Returns
    -------
    Acquired

    Raises
    ------
    AcquisitionError
        When a step fails three times, or the plan goes beyond what the box allows; this is found
        before anything flashes.
    DeviceError
        When a box or camera is lost; what was captured is safe in the session.
    Interrupted
        When ``interrupted`` said so.
    """
    plan.check(rig)
    kind = next(name for name in RIG_KINDS if name in rig.boxes or name == "flash")
    if kind not in boxes:
        raise AcquisitionError(f"box {kind!r}: no port was given; add --port {kind}=URL")
    check_serials(cameras, [(view.name, view.serial) for view in rig.views])
    operator = Operator(
        progress=progress or _ignore,
        prompt=prompt or _ignore,
        interrupted=interrupted or _never,
        clock=clock,
        run_id=run_id or secrets.token_hex(4),
        signal=signal or _ignore,
        timer=timer,
    )
    if kind == "gradient_sphere":
        return run_gradient(
            plan,
            rig,
            boxes=boxes,
            cameras=cameras,
            session=session,
            operator=operator,
            eyes=eyes,
            force_limit_n=force_limit_n,
        )
    box = boxes[kind]
    if kind == "dome":
        return run_dome(
            plan, rig, box=box, cameras=cameras, session=session, operator=operator, eyes=eyes
        )
    if kind == "probe":
        return run_probe(
            plan,
            rig,
            box=box,
            cameras=cameras,
            session=session,
            operator=operator,
            all_brackets=all_brackets,
        )
    return run_flash(plan, rig, box=box, cameras=cameras, session=session, operator=operator)


def _ignore(_: str) -> None:
    """Do nothing."""


def _never() -> bool:
    return False
