"""Dispatch a plan to the rig that it is for."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from capture.acquire.outcome import AcquisitionError, AcquisitionResult, CaptureRun, Operator
from capture.devices.camera import Camera, check_serials
from capture.devices.led_box import Eyes
from capture.plan import Plan
from capture.plan.rig_kinds import RIG_KINDS, find_rig_kind
from capture.raw import CameraColor
from capture.rig import Rig
from capture.session import Session


def run_plan(
    plan: Plan,
    rig: Rig,
    *,
    boxes: Mapping[str, Any],
    cameras: Mapping[str, Camera],
    session: Session,
    operator: Operator | None = None,
    eyes: Eyes = "open",
    force_limit_n: float | None = None,
    all_brackets: bool = False,
    camera_colors: Mapping[str, CameraColor] | None = None,
) -> AcquisitionResult:
    """Capture the missing steps of a plan.

    Parameters
    ----------
    plan
        Plan to capture; steps that the session contains already are not repeated.
    rig
        The rig that the plan is for.
    boxes, cameras
        Open drivers by name: the controller of the rig ("flash", "dome", "probe" or
        "gradient_sphere", "caliper" for stretched skin, "scanner" for stripes), and a camera for
        each view.
    session
        Open for writing.
    operator
        Prompts, progress, stop and clocks; nobody by default.
    eyes
        State of the subject's eyes, confirmed by a person: "open", "closed" or "shielded". Light
        that flickers too much for open eyes is refused; so are patterns on skin with open eyes.
    force_limit_n
        Greatest force of the caliper on the skin, N; it has no default, and nothing moves without.
    all_brackets
        Whether the probe takes all exposures of a series, also those that cannot add information.
    camera_colors
        Color of cameras by view, written into their frames; unknown by default.

    Returns
    -------
    Acquired

    Raises
    ------
    AcquisitionError
        When a step fails three times, or the plan exceeds the controller's limits; the latter is
        checked before anything flashes.
    DeviceError
        When a controller or camera is lost; captured frames are safe in the session.
    Interrupted
        When the operator stopped the capture.
    """
    plan.check(rig)
    kind = find_rig_kind(rig)
    if (box := RIG_KINDS[kind].box) not in boxes:
        raise AcquisitionError(f"controller {box!r}: no port was given; add --port {box}=URL")
    check_serials(cameras, [(view.name, view.serial) for view in rig.all_views])
    asked: dict[str, Any] = {
        "eyes": eyes,
        "force_limit_n": force_limit_n,
        "all_brackets": all_brackets,
        "camera_colors": camera_colors or {},
    }
    run = CaptureRun(plan, rig, cameras, session, operator or Operator(), **asked)
    acquire: Callable[..., AcquisitionResult] = import_module(f"capture.acquire.{kind}").acquire
    return acquire(run, boxes)
