"""Committed frames and attachments as they are asked for and checked."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import xxhash

from capture import raw
from capture.documents import Fault, shown
from capture.plan import Step, Value
from capture.session.disk import read_file
from capture.session.errors import SessionDamage, SessionError
from capture.session.journal import AttachmentLine, FrameLine

MAX_FRAME_BYTES = 2**30
"""Of one frame, and of one attachment."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameRecord:
    """One committed frame: its line of the journal and its step of the plan."""

    step: Step
    line: FrameLine

    @property
    def step_id(self) -> str:
        """Id of the step."""
        return self.step.id

    @property
    def kind(self) -> str:
        """Kind of the step: "dark", "flat", "chart", "malus" or "subject"."""
        return self.step.kind

    @property
    def index(self) -> Mapping[str, str | int | float]:
        """Where the step stands in its series."""
        return self.step.index

    @property
    def camera(self) -> str:
        """Name of the view."""
        return self.line.camera

    @property
    def file(self) -> str:
        """Path inside the session."""
        return self.line.file

    @property
    def attempt(self) -> int:
        """1 for the first time the frame was taken."""
        return self.line.attempt

    @property
    def settings(self) -> Mapping[str, Value]:
        """What was asked for."""
        return self.line.settings

    @property
    def actual(self) -> Mapping[str, Value]:
        """What box and camera report to have done."""
        return self.line.actual


def check_file(path: Path, line: FrameLine | AttachmentLine) -> bytes:
    """Return the bytes of a committed file, after size and hash have been checked."""
    what = "frame" if isinstance(line, FrameLine) else "attachment"
    blob = read_file(path, limit=MAX_FRAME_BYTES, what=what)
    found = xxhash.xxh3_128_hexdigest(blob)
    if len(blob) != line.bytes or found != line.xxh128:
        got = f"{len(blob)} bytes, xxh128 {found}"
        faults = [Fault("content", got, f"{line.bytes} bytes, xxh128 {line.xxh128}")]
        advice = f"Restore the {what} from a copy, or take it again in a new session."
        raise SessionDamage("is damaged", where=str(path), faults=faults, advice=advice)
    return blob


def check_blob(blob: bytes, step_id: str, session_id: str) -> None:
    """Refuse a frame that is too large or that names another step or session."""
    if len(blob) > MAX_FRAME_BYTES:
        faults = [Fault("blob", f"{len(blob)} bytes", f"at most {MAX_FRAME_BYTES}")]
        raise SessionError("the frame is absurdly large", faults=faults)
    frame = raw.decode(memoryview(blob), where=f"frame of step {step_id}")
    for field, got, wanted in (
        ("step_id", frame.step_id, step_id),
        ("session_id", frame.session_id, session_id),
    ):
        if got != wanted:
            advice = "Encode the DNG with the step and session it is committed to."
            what = "the frame says it belongs elsewhere"
            raise SessionError(what, faults=[Fault(field, shown(got), wanted)], advice=advice)
