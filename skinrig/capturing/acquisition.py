"""Run a plan on a rig by the addresses of its boxes and cameras, whatever answers there."""

from __future__ import annotations

import contextlib
import json
import math
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast, get_args

from capture.devices.dome import Eyes
from capture.plan import Plan, flash_calibration_plan, flash_plan
from capture.plan.dome import DomeTarget, dome_calibration_plan, dome_plan
from capture.plan.gradient import GradientTarget, gradient_calibration_plan, gradient_plan, state_of
from capture.plan.probe import PROBE_SITES, ProbeTarget, probe_calibration_plan, probe_plan
from capture.rig import Rig, load_rig
from capture.session import Session, Subject
from skinrig.capturing.addresses import addresses, patiently, require_addresses
from skinrig.capturing.light_safety import light_figures, light_lines
from skinrig.capturing.sequences import SequenceOrder, sequence_lines, sequence_plan
from skinrig.console import Console
from skinrig.errors import UnusableError, UsageError
from skinrig.next_steps import named

CALIBRATION_TARGETS = ("dark", "flat", "chart", "malus")


class CaptureError(ValueError):
    """A capture that cannot start as asked."""


def eyes_of(text: str) -> Eyes:
    """Return what is said of the subject's eyes.

    Raises
    ------
    UnusableError
    """
    if text not in get_args(Eyes):
        raise UnusableError(f"--eyes: got {text!r}, expected one of {', '.join(get_args(Eyes))}")
    return cast(Eyes, text)


def numbers_of(text: str | None, option: str) -> tuple[float, ...] | None:
    """Return numbers joined by commas; None for None.

    Examples
    --------
    >>> numbers_of("0,90", "--angles")
    (0.0, 90.0)

    Raises
    ------
    UsageError
    """
    if text is None:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as exc:
        raise UsageError(f"{option}: got {text!r}, expected numbers joined by commas") from exc


def names_of(text: str | None) -> tuple[str, ...] | None:
    """Return names joined by commas; None for None.

    Examples
    --------
    >>> names_of("cheek, chin")
    ('cheek', 'chin')
    """
    return None if text is None else tuple(part.strip() for part in text.split(","))


def amounts_of(texts: Sequence[str] | None, option: str) -> dict[str, float]:
    """Return the amounts of ``NAME`` or ``NAME=AMOUNT``; a name alone stands for 1.

    Examples
    --------
    >>> amounts_of(["lotion=0.6", "powder"], "--condition")
    {'lotion': 0.6, 'powder': 1.0}

    Raises
    ------
    UsageError
    """
    found: dict[str, float] = {}
    for text in texts or ():
        name, sign, amount = text.partition("=")
        try:
            value = float(amount) if sign else 1.0
        except ValueError as exc:
            raise UsageError(f"{option}: got {text!r}, expected NAME or NAME=AMOUNT") from exc
        if not name or name in found:
            raise UsageError(f"{option}: got {text!r}, expected each NAME once, or NAME=AMOUNT")
        found[name] = value
    return found


def range_of(text: str | None, option: str) -> tuple[int, int] | None:
    """Return the first and last number of ``FIRST..LAST``; None for None.

    Examples
    --------
    >>> range_of("-2..3", "--steps")
    (-2, 3)

    Raises
    ------
    UsageError
    """
    if text is None:
        return None
    first, dots, last = text.partition("..")
    try:
        if not dots:
            raise ValueError(text)
        return int(first), int(last)
    except ValueError as exc:
        raise UsageError(f"{option}: got {text!r}, expected FIRST..LAST, such as -2..3") from exc


def sequence_of(
    state: str | None,
    prompt_period: str | None,
    shot_period: str | None,
    captures: int | None,
    duration: str | None,
) -> SequenceOrder | None:
    """Return the sequence that options ask for; None without one.

    Examples
    --------
    >>> sequence_of("smile", None, "10.25", None, None).shot_period_s
    '10.25'

    Raises
    ------
    UsageError
        For options without a sequence, or of another kind of it, or that are no numbers.
    """
    if state is None:
        if any(option is not None for option in (prompt_period, shot_period, captures, duration)):
            raise UsageError(
                "--prompt-period, --shot-period, --captures, --duration: are for a sequence; add "
                "--sequence STATE"
            )
        return None
    for option, text in (
        ("--prompt-period", prompt_period),
        ("--shot-period", shot_period),
        ("--duration", duration),
    ):
        if text is not None:
            _seconds(text, option)
    order = SequenceOrder(
        state=state, shot_period_s=shot_period, captures=captures, duration_s=duration
    )
    if order.prompted and duration is not None:
        raise UsageError(f"--duration: is for an event; {state} goes by --captures")
    if not order.prompted and (prompt_period is not None or captures is not None):
        raise UsageError(f"--prompt-period, --captures: {state} is no expression; use --duration")
    return order if prompt_period is None else replace(order, prompt_period_s=prompt_period)


def _seconds(text: str, option: str) -> None:
    """Refuse what is no number; the plan keeps the digits as they were given."""
    try:
        float(text)
    except ValueError as exc:
        raise UsageError(f"{option}: got {text!r}, expected seconds, such as 5.5") from exc


def read_plan(file: Path) -> Plan:
    """Return the plan in a JSON file, as ``--plan-out`` and `skinrig plan` write it."""
    return Plan.from_json(file.read_bytes(), where=str(file))


def choose_plan(
    rig: Rig,
    file: Path | None,
    target: str | None,
    *,
    angles: Sequence[float] | None = None,
    steps: tuple[int, int] | None = None,
    sites: Sequence[str] | None = None,
    repeats: int = 1,
    sequence: SequenceOrder | None = None,
    states: Sequence[str] = (),
) -> Plan:
    """Return the plan in ``file``, or the rig's own for a target, or for a subject.

    Parameters
    ----------
    rig
    file
        A plan, JSON.
    target
        What stands in the rig; None: a subject.
    angles, steps
        Of a caliper; None: all. Of a probe one number, of directions.
    sites, repeats
        Of a probe; repeats also of a subject's states before the flash rig.
    sequence
        In time, of the flash rig.
    states
        Of a subject before the flash rig; none: neutral. Repeats go through all of them in turn.

    Raises
    ------
    CaptureError
        For an unknown target.
    UsageError
        For what the rig does not know, or that a plan in a file has already.
    """
    own = file is None and target is None
    if sequence is not None:
        if not own or "flash" not in rig.boxes:
            raise UsageError("--sequence: is for the flash rig's own plan of a subject")
        return sequence_plan(rig, sequence)
    if (angles or steps) and not (own and (rig.caliper or (rig.probe and not steps))):
        raise UsageError(
            "--angles, --steps: are for the gradient rig's own plan of skin, --angles for the "
            "probe's, too"
        )
    if sites and not (own and rig.probe):
        raise UsageError("--sites: is for the probe's own plan of skin")
    flash = own and "flash" in rig.boxes
    if states and not flash:
        raise UsageError("--state: is for the flash rig's own plan of a subject")
    if repeats != 1 and not flash and (file is not None or rig.probe is None):
        raise UsageError("--repeats: is for the probe's own plans and the flash rig's states")
    if file is not None:
        return read_plan(file)
    if "gradient_sphere" in rig.boxes:
        return _gradient_plan(rig, target, angles, steps)
    if "dome" in rig.boxes:
        return _dome_plan(rig, target)
    if rig.probe is not None:
        return _probe_plan(rig, target, sites, repeats, angles)
    if target is None:
        return flash_plan(rig, states=states or ("neutral",), repeats=repeats, interleave=True)
    if target == "white":
        return flash_plan(rig, states=("white",), repeats=4)
    if target not in CALIBRATION_TARGETS:
        expected = ", ".join(("white", *CALIBRATION_TARGETS))
        raise CaptureError(f"target: got {target!r}, expected one of {expected}")
    return flash_calibration_plan(rig, target)  # type: ignore[arg-type]


def _dome_plan(rig: Rig, target: str | None) -> Plan:
    if target is None:
        return dome_plan(rig)
    if target not in get_args(DomeTarget):
        expected = ", ".join(get_args(DomeTarget))
        raise CaptureError(f"target: got {target!r}, expected one of {expected}")
    return dome_calibration_plan(rig, cast(DomeTarget, target))


def _gradient_plan(
    rig: Rig, target: str | None, angles: Sequence[float] | None, steps: tuple[int, int] | None
) -> Plan:
    if target is None:
        return gradient_plan(rig, angles=angles, steps=steps)
    if target not in get_args(GradientTarget):
        expected = ", ".join(get_args(GradientTarget))
        raise CaptureError(f"target: got {target!r}, expected one of {expected}")
    return gradient_calibration_plan(rig, cast(GradientTarget, target))


def _probe_plan(
    rig: Rig,
    target: str | None,
    sites: Sequence[str] | None,
    repeats: int,
    angles: Sequence[float] | None,
) -> Plan:
    if target is None:
        return probe_plan(
            rig, sites=sites or PROBE_SITES, repeats=repeats, angles=directions_of(angles)
        )
    if target not in get_args(ProbeTarget):
        expected = ", ".join(get_args(ProbeTarget))
        raise CaptureError(f"target: got {target!r}, expected one of {expected}")
    return probe_calibration_plan(rig, cast(ProbeTarget, target), repeats=repeats)


def directions_of(angles: Sequence[float] | None) -> int:
    """Return how many directions of the probe's head ``--angles N`` asks for; 1 for None.

    Raises
    ------
    UsageError
        For anything but one whole number.

    Examples
    --------
    >>> directions_of((16.0,)), directions_of(None)
    (16, 1)
    """
    if angles is None:
        return 1
    if len(angles) != 1 or not float(angles[0]).is_integer():
        text = ",".join(f"{angle:g}" for angle in angles)
        raise UsageError(
            f"--angles: got {text!r}, expected how many directions of the probe's head, such as 16"
        )
    return int(angles[0])


def needed_boxes(rig: Rig, plan: Plan) -> tuple[str, ...]:
    """Return the boxes of a rig that a plan uses: a caliper only where it holds skin."""
    skin = any(state_of(step) is not None for step in plan.steps)
    return tuple(name for name in rig.boxes if skin or name != "caliper")


def write_plan(plan: Plan, file: Path) -> None:
    """Write a plan as ``--plan`` takes it; a file that exists may hold somebody's changes.

    Raises
    ------
    CaptureError
        Where `file` exists.
    """
    text = json.dumps(plan.to_json(), indent=1) + "\n"
    try:
        with file.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except FileExistsError as exc:
        raise CaptureError(f"{file}: exists; choose a new name for the plan") from exc


def capture_session(
    rig_name: str,
    out: Path | None,
    *,
    ports: Sequence[str],
    cameras: Sequence[str],
    plan: Path | None,
    target: str | None,
    subject: Subject,
    dry_run: bool,
    plan_out: Path | None,
    resume: bool,
    console: Console,
    eyes: Eyes = "open",
    force_limit_n: float | None = None,
    angles: Sequence[float] | None = None,
    steps: tuple[int, int] | None = None,
    sites: Sequence[str] | None = None,
    repeats: int = 1,
    all_brackets: bool = False,
    sequence: SequenceOrder | None = None,
    states: Sequence[str] = (),
) -> Mapping[str, Any]:
    """Capture into ``out`` and return the command's document.

    Raises
    ------
    UsageError
        For an address that is none, or a missing one, or a missing force limit.
    CaptureError
        For an unknown target, or a plan file that exists.
    DeviceError
        When a box or camera fails; what was captured stays and can be resumed.
    """
    box_urls, camera_urls = addresses(ports, "--port"), addresses(cameras, "--camera")
    if force_limit_n is not None and not 0.0 < force_limit_n < math.inf:
        raise UnusableError(f"--force-limit: got {force_limit_n:g}, expected more than 0 newton")
    rig = load_rig(rig_name)
    chosen = choose_plan(
        rig,
        plan,
        target,
        angles=angles,
        steps=steps,
        sites=sites,
        repeats=repeats,
        sequence=sequence,
        states=states,
    )
    seconds = chosen.estimated_s(rig)
    needed = needed_boxes(rig, chosen)
    if not dry_run:
        require_addresses(rig, box_urls, camera_urls, needed=needed)
        if "caliper" in needed and force_limit_n is None:
            raise UsageError(
                "a capture with the caliper needs --force-limit N: how much force this skin may "
                "bear is for a person to decide, and there is no default"
            )
    if out is None and not dry_run:
        raise UsageError("a capture needs --out SESSION")
    console.say(f"{len(chosen.steps)} steps, about {seconds:.0f} s")
    for line in sequence_lines(chosen):
        console.say(line)
    light: Mapping[str, Any] = {}
    if rig.leds is not None:
        light = light_figures(chosen, rig)
        for line in light_lines(chosen, rig):
            console.say(line)
    if plan_out is not None:
        write_plan(chosen, plan_out)
        console.say(
            f"{plan_out}: the plan; change it and hand it over with --plan {named(plan_out)}"
        )
    if out is None or dry_run:
        console.rows(
            ("step", "kind", "settings"),
            [
                (s.id, s.kind, " ".join(f"{k}={v}" for k, v in s.settings.items()))
                for s in chosen.steps
            ],
        )
        return {
            "steps": len(chosen.steps),
            "estimated_s": seconds,
            "captured": 0,
            "light": light,
            "plan": chosen.to_json(),
        }
    box_urls = {name: box_urls[name] for name in needed}
    return _run(
        rig,
        chosen,
        out,
        box_urls,
        camera_urls,
        subject,
        resume,
        console,
        eyes,
        force_limit_n,
        all_brackets,
    )


def _run(
    rig: Rig,
    plan: Plan,
    out: Path,
    box_urls: Mapping[str, str],
    camera_urls: Mapping[str, str],
    subject: Subject,
    resume: bool,
    console: Console,
    eyes: Eyes,
    force_limit_n: float | None,
    all_brackets: bool,
) -> Mapping[str, Any]:
    from capture.acquire import run_plan
    from capture.devices.box import Box
    from capture.devices.caliper import CaliperBox
    from capture.devices.camera import open_camera
    from capture.devices.dome import DomeBox
    from capture.devices.flash import FlashBox
    from capture.devices.gradient_sphere import GradientSphereBox
    from capture.devices.port import Port
    from capture.devices.probe import ProbeBox

    drivers: Mapping[str, type[Box]] = {
        "flash": FlashBox,
        "dome": DomeBox,
        "gradient_sphere": GradientSphereBox,
        "caliper": CaliperBox,
        "probe": ProbeBox,
    }

    def open_box(kind: str) -> Box:
        return drivers[kind](Port(box_urls[kind]))

    with contextlib.ExitStack() as stack:
        boxes: dict[str, Box] = {}
        for kind in box_urls:
            boxes[kind] = patiently(partial(open_box, kind), console.progress)
            stack.callback(boxes[kind].close)
        opened = {}
        for view in rig.views:
            url = camera_urls[view.name]
            opened[view.name] = patiently(partial(open_camera, url), console.progress)
            stack.callback(opened[view.name].close)
        sizes = {(c.info.width_px, c.info.height_px) for c in opened.values()}
        width, _ = next(iter(sizes))
        if width != rig.views[0].width_px:
            # a served simulation may run smaller than the rig file's camera
            rig = rig.resized(width) if rig.caliper is None else rig.cropped(width)
        if resume:
            session = Session.resume(out)
            plan = session.plan
        else:
            fresh = not out.exists()
            session = Session.create(
                out,
                plan=plan,
                rig=rig,
                devices={
                    **box_urls,
                    **{name: camera.info.serial for name, camera in opened.items()},
                },
                subject=subject,
                source=_source(next(iter(boxes.values())).identify()),
            )
            stack.enter_context(_unless_used(session, fresh, console))
        stack.callback(session.release)
        with _stop_on_signal() as stopped:
            done = run_plan(
                plan,
                rig,
                boxes=boxes,
                cameras=opened,
                session=session,
                progress=console.progress,
                prompt=partial(ask, console.progress),
                interrupted=stopped,
                eyes=eyes,
                force_limit_n=force_limit_n,
                all_brackets=all_brackets,
                signal=partial(sound, console.progress),
            )
        session.close()
        left_out = dict(session.left_out())
    if done.dead_lights:
        console.say(f"dead lights: {', '.join(done.dead_lights)}; their frames are dark")
    for reason in dict.fromkeys(left_out.values()):
        console.say(f"left out: {reason}")
    console.say(f"{out}: {done.frames} frames in {done.steps} steps, {done.retakes} retaken")
    console.say(f"next: skinrig verify {named(out)}")
    return {
        "session": out,
        "captured": done.frames,
        "retakes": done.retakes,
        "stale_frames": done.stale,
        "steps": len(plan.steps),
        "dead_lights": done.dead_lights,
        "left_out": left_out,
    }


def ask(progress: Callable[[str], None], what: str) -> None:
    """Say what the operator has to make ready, and wait for Enter where there is a keyboard."""
    what = what if what.startswith(("step ", "tape ", "place ", "put ")) else f"make ready: {what}"
    if sys.stdin is None or not sys.stdin.isatty():
        progress(what)
        return
    progress(f"{what}; then press Enter")
    sys.stdin.readline()


def sound(progress: Callable[[str], None], what: str) -> None:
    """Ring the terminal's bell and say what the subject shall change to; wait for nothing."""
    progress(f"\a{what}")


@contextlib.contextmanager
def _unless_used(session: Session, fresh: bool, console: Console) -> Iterator[None]:
    """Take a new session away again when a device failed before its first frame."""
    try:
        yield
    except Exception:
        if not session.frames():
            session.release()
            remove_unused(session.path, with_folder=fresh)
            console.progress(f"nothing was captured: {session.path} was taken away again")
        raise


def remove_unused(path: Path, *, with_folder: bool) -> None:
    """Remove what a session without frames consists of; without ``with_folder`` only its content.

    The manifest goes first: without it there is no session, whatever else is interrupted.
    """
    for name in ("session.json", "journal.jsonl"):
        (path / name).unlink()
    with contextlib.suppress(OSError):  # what is not the session's own stays, and its folder
        for part in (path / "frames").glob("*.part"):
            part.unlink()
        (path / "frames").rmdir()
        (path / "orphans").rmdir()
        if with_folder:
            path.rmdir()


def _source(identity: str) -> Literal["measured", "simulated"]:
    """Say where frames come from, by how the box names its maker."""
    return "simulated" if identity.upper().startswith("RIGSIM") else "measured"


@contextlib.contextmanager
def _stop_on_signal() -> Iterator[Any]:
    """Turn the first Ctrl-C into a stop between two steps; a second one interrupts at once."""
    asked: list[int] = []

    def note(number: int, frame: object) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)

    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(asked)
    finally:
        signal.signal(signal.SIGINT, before)
