"""Run a plan on a rig by the addresses of its boxes and cameras, whatever answers there."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from capture.plan import Plan, flash_calibration_plan, flash_plan
from capture.rig import Rig, load_rig
from capture.session import Session, Subject
from skinrig.console import Console

CALIBRATION_TARGETS = ("dark", "flat", "chart", "malus")


class CaptureError(ValueError):
    """A capture that cannot start as asked."""


def addresses(given: Sequence[str], option: str) -> dict[str, str]:
    """Return NAME=URL pairs as a mapping.

    Examples
    --------
    >>> addresses(["flash=/dev/ttyUSB0"], "--port")
    {'flash': '/dev/ttyUSB0'}
    """
    found: dict[str, str] = {}
    for text in given:
        name, equals, url = text.partition("=")
        if not (equals and name and url):
            raise CaptureError(f"{option}: got {text!r}, expected NAME=URL")
        if name in found:
            raise CaptureError(f"{option}: {name!r} is given twice")
        found[name] = url
    return found


def choose_plan(rig: Rig, file: Path | None, target: str | None) -> Plan:
    """Return the plan in ``file``, or the rig's own for a target, or for a subject."""
    if file is not None:
        return Plan.from_json(file.read_text(encoding="utf-8"), where=str(file))
    if target is None:
        return flash_plan(rig)
    if target == "white":
        return flash_plan(rig, states=("white",), repeats=4)
    if target not in CALIBRATION_TARGETS:
        expected = ", ".join(("white", *CALIBRATION_TARGETS))
        raise CaptureError(f"target: got {target!r}, expected one of {expected}")
    return flash_calibration_plan(rig, target)  # type: ignore[arg-type]


def capture_session(
    rig_name: str,
    out: Path,
    *,
    ports: Sequence[str],
    cameras: Sequence[str],
    plan: Path | None,
    target: str | None,
    pseudonym: str,
    consent: tuple[str, ...],
    dry_run: bool,
    resume: bool,
    console: Console,
) -> Mapping[str, Any]:
    """Capture into ``out`` and return the command's document.

    Raises
    ------
    CaptureError
        For an address that is none, or a missing one.
    DeviceError
        When a box or camera fails; what was captured stays and can be resumed.
    """
    box_urls, camera_urls = addresses(ports, "--port"), addresses(cameras, "--camera")
    rig = load_rig(rig_name)
    chosen = choose_plan(rig, plan, target)
    seconds = chosen.estimated_s(rig)
    console.say(f"{len(chosen.steps)} steps, about {seconds:.0f} s")
    if dry_run:
        console.rows(
            ("step", "kind", "settings"),
            [(s.id, s.kind, " ".join(f"{k}={v}" for k, v in s.settings.items()))
             for s in chosen.steps],
        )  # fmt: skip
        return {"steps": len(chosen.steps), "estimated_s": seconds, "captured": 0}
    for name in rig.boxes:
        if name not in box_urls:
            raise CaptureError(f"box {name!r}: no address was given; add --port {name}=URL")
    for view in rig.views:
        if view.name not in camera_urls:
            raise CaptureError(f"view {view.name!r}: add --camera {view.name}=URL")
    return _run(
        rig, chosen, out, box_urls, camera_urls, Subject(pseudonym, consent), resume, console
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
) -> Mapping[str, Any]:
    from capture.acquire import run_plan
    from capture.devices.camera import open_camera
    from capture.devices.flash import FlashBox
    from capture.devices.port import Port

    with contextlib.ExitStack() as stack:
        box = FlashBox(Port(box_urls["flash"]))
        stack.callback(box.close)
        opened = {}
        for view in rig.views:
            opened[view.name] = open_camera(camera_urls[view.name])
            stack.callback(opened[view.name].close)
        sizes = {(c.info.width_px, c.info.height_px) for c in opened.values()}
        width, _ = next(iter(sizes))
        if width != rig.views[0].width_px:
            # a served simulation may run smaller than the rig file's camera
            rig = rig.resized(width)
        if resume:
            session = Session.resume(out)
            plan = session.plan
        else:
            session = Session.create(
                out, plan=plan, rig=rig,
                devices={"flash": box_urls["flash"],
                         **{name: camera.info.serial for name, camera in opened.items()}},
                subject=subject, source=_source(box.identify()),
            )  # fmt: skip
        stack.callback(session.release)
        with _stop_on_signal() as stopped:
            done = run_plan(
                plan, rig, boxes={"flash": box}, cameras=opened, session=session,
                progress=console.progress, prompt=lambda s: console.progress(f"state: {s}"),
                interrupted=stopped,
            )  # fmt: skip
        session.close()
    console.say(f"{out}: {done.frames} frames in {done.steps} steps, {done.retakes} retaken")
    console.say(f"next: skinrig verify {out}")
    return {
        "session": out, "captured": done.frames, "retakes": done.retakes,
        "stale_frames": done.stale, "steps": len(plan.steps),
    }  # fmt: skip


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
