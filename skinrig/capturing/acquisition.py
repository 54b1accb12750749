"""Capture a plan into a SESSION/ folder with the devices at the given addresses."""

import contextlib
import math
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from capture.acquire import Operator, run_plan
from capture.devices.box import Box
from capture.devices.camera import Camera, CameraInfo, open_camera
from capture.devices.led_box import Eyes
from capture.plan import Plan
from capture.rig import Rig
from capture.session import Session, SessionDiskError, SubjectRecord
from capture.session.consent_seal import SEAL_FILE
from skinrig.capturing.addresses import open_box, open_with_retry, require_addresses
from skinrig.capturing.camera_colors import nominal_camera_colors
from skinrig.capturing.light_safety import light_figures, light_lines
from skinrig.capturing.plan_choice import needed_boxes, write_plan
from skinrig.capturing.sequences import sequence_lines
from skinrig.console import Console
from skinrig.errors import UnusableError, UsageError
from skinrig.next_steps import shell_quote


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureOrder:
    """Options of a capture besides its rig and plan.

    Raises
    ------
    UnusableError
        For a force limit that is not finite or not above 0 N.
    """

    out: Path | None
    """New SESSION/ folder; None is allowed only with `dry_run`."""
    boxes: Mapping[str, str]
    """Address of each controller."""
    cameras: Mapping[str, str]
    """Address of each camera."""
    subject: SubjectRecord
    dry_run: bool = False
    """Print the plan without opening a device."""
    plan_out: Path | None = None
    """New JSON file for the plan."""
    resume: bool = False
    eyes: Eyes = "open"
    """State of the subject's eyes, as declared by the operator."""
    force_limit_n: float | None = None
    """Maximum force of the caliper, N."""
    all_brackets: bool = False
    """Record every exposure bracket (probe only)."""

    def __post_init__(self) -> None:
        if self.force_limit_n is not None and not 0.0 < self.force_limit_n < math.inf:
            raise UnusableError(
                f"--force-limit: got {self.force_limit_n:g}, expected more than 0 newton; give "
                "the force that this skin may bear"
            )


def capture_session(
    rig: Rig, plan: Plan, order: CaptureOrder, console: Console
) -> Mapping[str, Any]:
    """Capture a plan into a session's folder and return the command's JSON document.

    Raises
    ------
    UsageError
        For a malformed or missing address, or a missing force limit.
    CaptureError
        If `plan_out` exists.
    DeviceError
        If a controller or camera fails; recorded frames are kept and the session can be resumed.
    """
    seconds = plan.estimate_duration_s(rig)
    needed = needed_boxes(rig, plan)
    if not order.dry_run:
        require_addresses(rig, order.boxes, order.cameras, needed=needed)
        if "caliper" in needed and order.force_limit_n is None:
            raise UsageError(
                "a capture with the caliper needs --force-limit N: the operator decides how much "
                "force this skin may bear; no default exists [SR-CAP-015]"
            )
    if order.out is None and not order.dry_run:
        raise UsageError("a capture needs --out SESSION; name a new folder, or add --dry-run")
    console.print_line(f"{len(plan.steps)} steps, about {seconds:.0f} s")
    light: Mapping[str, Any] = {} if rig.leds is None else light_figures(plan, rig)
    for line in (*sequence_lines(plan), *(light_lines(plan, rig) if light else ())):
        console.print_line(line)
    if (file := order.plan_out) is not None:
        write_plan(plan, file)
        console.print_line(
            f"{file}: the plan; edit it, then capture it with --plan {shell_quote(file)}"
        )
    if order.out is None or order.dry_run:
        steps = plan.steps
        settings = [" ".join(f"{k}={v}" for k, v in step.settings.items()) for step in steps]
        rows = [(s.id, s.kind, text) for s, text in zip(steps, settings, strict=True)]
        console.print_table(("step", "kind", "settings"), rows)
        figures = {"steps": len(steps), "estimated_s": seconds, "captured": 0, "light": light}
        return figures | {"plan": plan.to_json()}
    return _run(rig, plan, order.out, order, console)


def _run(
    rig: Rig, plan: Plan, out: Path, order: CaptureOrder, console: Console
) -> Mapping[str, Any]:
    """Run a plan through the drivers into a new or resumed session."""
    if order.resume and (opened := Session.open(out)).complete:
        return _describe_complete(opened, console)
    with contextlib.ExitStack() as stack:
        boxes, cameras = _open_devices(stack, rig, plan, order, console)
        rig = match_camera(rig, cameras[rig.views[0].name].info)
        if order.resume:
            session = Session.resume(out)
            plan = session.plan
        else:
            fresh, maker = not out.exists(), next(iter(boxes.values())).identify()
            session = Session.create(
                out,
                plan=plan,
                rig=rig,
                devices={name: order.boxes[name] for name in boxes}
                | {name: camera.info.serial for name, camera in cameras.items()},
                subject=order.subject,
                source="simulated" if maker.upper().startswith("RIGSIM") else "measured",
            )
            stack.enter_context(discard_unused_session(session, fresh, console))
        stack.callback(session.release)
        with _stop_on_signal() as stopped:
            done = run_plan(
                plan,
                rig,
                boxes=boxes,
                cameras=cameras,
                session=session,
                operator=Operator(
                    progress=console.progress,
                    prompt=partial(prompt_operator, console.progress),
                    interrupted=stopped,
                    signal=partial(signal_subject, console.progress),
                ),
                eyes=order.eyes,
                force_limit_n=order.force_limit_n,
                all_brackets=order.all_brackets,
                camera_colors=nominal_camera_colors(rig),
            )
        session.close()
        omitted = dict(session.omitted_steps())
    if done.dead_lights:
        console.print_line(f"dead lights: {', '.join(done.dead_lights)}; their frames are dark")
    console.print_each("omitted", dict.fromkeys(omitted.values()))
    console.print_line(f"{out}: {done.frames} frames in {done.steps} steps, {done.retakes} retaken")
    console.print_line(f"next: skinrig verify {shell_quote(out)}")
    figures = {"session": out, "captured": done.frames, "retakes": done.retakes}
    figures |= {"stale_frames": done.stale, "steps": len(plan.steps)}
    return figures | {"dead_lights": done.dead_lights, "left_out": omitted}


def match_camera(rig: Rig, info: CameraInfo) -> Rig:
    """Return the rig with the images of its first camera, which a simulation may serve smaller.

    Pixels of another size are those of `Rig.resized`; fewer pixels of one size are those of
    `Rig.cropped`. A camera that does not report the size of its pixels shows the rig's whole
    field, except in front of a caliper.

    Parameters
    ----------
    rig
        Rig of the rig file.
    info
        Properties of its first camera.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> rig = load_rig("flash")
    >>> served = rig.resized(260).cropped(16)
    >>> view = served.views[0]
    >>> info = CameraInfo("A1", "sim", 16, 16, "RGGB", (0.0,), 4095, (), view.pixel_um)
    >>> match_camera(rig, info) == served
    True
    """
    view = rig.views[0]
    width_px = info.width_px
    if info.pixel_um is None:
        if width_px == view.width_px:
            return rig
        return rig.resized(width_px) if rig.caliper is None else rig.cropped(width_px)
    if not math.isclose(info.pixel_um, view.pixel_um):
        rig = rig.resized(round(view.width_px * view.pixel_um / info.pixel_um))
    view = rig.views[0]
    return rig if width_px == view.width_px else rig.cropped(width_px)


def _describe_complete(session: Session, console: Console) -> Mapping[str, Any]:
    """Report a session that lacks nothing; no device is opened."""
    frames = len(session.frames())
    console.print_line(f"{session.path}: complete, {frames} frames; nothing is left to capture")
    console.print_line(f"next: skinrig verify {shell_quote(session.path)}")
    figures: dict[str, Any] = {
        "session": session.path,
        "captured": 0,
        "retakes": 0,
        "stale_frames": 0,
    }
    figures |= {"steps": len(session.plan.steps), "dead_lights": ()}
    return figures | {"left_out": dict(session.omitted_steps())}


def _open_devices(
    stack: contextlib.ExitStack, rig: Rig, plan: Plan, order: CaptureOrder, console: Console
) -> tuple[dict[str, Box], dict[str, Camera]]:
    """Open the controllers that a plan needs and all cameras; the stack closes them."""
    boxes: dict[str, Box] = {}
    for kind in needed_boxes(rig, plan):
        opening = partial(open_box, kind, order.boxes[kind])
        boxes[kind] = open_with_retry(opening, console.progress)
        stack.callback(boxes[kind].close)
    cameras: dict[str, Camera] = {}
    for view in rig.all_views:
        opened = open_with_retry(partial(open_camera, order.cameras[view.name]), console.progress)
        cameras[view.name] = opened
        stack.callback(opened.close)
    return boxes, cameras


def prompt_operator(progress: Callable[[str], None], instruction: str) -> None:
    """Show an instruction to the operator and, at a terminal, wait for Enter."""
    instruction = (
        instruction
        if instruction.startswith(("step ", "tape ", "place ", "put "))
        else f"prepare: {instruction}"
    )
    if sys.stdin is None or not sys.stdin.isatty():
        progress(instruction)  # nobody can press Enter: continue at once
        return
    progress(f"{instruction}; then press Enter")
    sys.stdin.readline()


def signal_subject(progress: Callable[[str], None], instruction: str) -> None:
    """Ring the terminal bell and show the subject's next expression, without waiting."""
    progress(f"\a{instruction}")


@contextlib.contextmanager
def discard_unused_session(session: Session, fresh: bool, console: Console) -> Iterator[None]:
    """Remove a new session if a device fails before its first frame.

    After an error of the disk it is kept: it can be resumed, and may contain what was not
    acknowledged.
    """
    try:
        yield
    except SessionDiskError:
        raise
    except Exception:
        if not session.frames() and not session.attachments():
            session.release()
            remove_unused(session.path, with_folder=fresh)
            console.progress(f"{session.path}: removed, because no frame was recorded")
        raise


def remove_unused(path: Path, *, with_folder: bool) -> None:
    """Remove the files of a session without frames, and with ``with_folder`` its folder.

    The manifest is removed first: a folder without it is not a session, even if the rest fails.
    """
    # rmdir fails on a folder that holds foreign files: those and their folder are kept
    with contextlib.suppress(OSError):
        for name in ("session.json", "journal.jsonl"):
            (path / name).unlink()
        (path / SEAL_FILE).unlink(missing_ok=True)
        for part in (path / "frames").glob("*.part"):
            part.unlink()
        (path / "frames").rmdir()
        (path / "orphans").rmdir()
        if with_folder:
            path.rmdir()


@contextlib.contextmanager
def _stop_on_signal() -> Iterator[Any]:
    """Turn the first Ctrl-C or SIGTERM into a stop between steps; the second interrupts at once."""
    received: list[int] = []

    def record_signal(number: int, frame: object) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(number)

    numbers = (signal.SIGINT, signal.SIGTERM)
    previous = {number: signal.signal(number, record_signal) for number in numbers}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
