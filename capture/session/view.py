"""Query a session, whether it is being written or only read."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path

import xxhash

from capture import raw
from capture.documents import Fault, short_repr
from capture.plan import Step, Value
from capture.session.contents import SessionContents
from capture.session.disk import Blob, read_file
from capture.session.errors import ConsentError, SessionDamage, SessionError
from capture.session.journal import AttachmentLine, FrameLine, OmissionLine
from capture.session.manifest import ANY_USE

MAX_FRAME_BYTES = 2**30
"""Journal line of a frame or of an attachment."""


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
        """Indices of the step in its series."""
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
        """Number of the attempt, from 1."""
        return self.line.attempt

    @property
    def settings(self) -> Mapping[str, Value]:
        """Requested settings."""
        return self.line.settings

    @property
    def actual(self) -> Mapping[str, Value]:
        """Settings that controller and camera report."""
        return self.line.actual


def check_file(path: Path, line: FrameLine | AttachmentLine) -> bytes:
    """Return the bytes of a committed file after a check of size and hash."""
    what = "frame" if isinstance(line, FrameLine) else "attachment"
    blob = read_file(path, limit=MAX_FRAME_BYTES, label=what)
    found = xxhash.xxh3_128_hexdigest(blob)
    if len(blob) != line.bytes or found != line.xxh128:
        got = f"{len(blob)} bytes, xxh128 {found}"
        faults = [Fault("content", got, f"{line.bytes} bytes, xxh128 {line.xxh128}")]
        advice = f"Restore the {what} from a copy, or take it again in a new session."
        code = "SR-SES-004"
        raise SessionDamage("is damaged", where=str(path), faults=faults, advice=advice, code=code)
    return blob


def check_blob(blob: Blob, step_id: str, session_id: str) -> None:
    """Reject a frame that is too large or that names another step or session."""
    if len(blob) > MAX_FRAME_BYTES:
        faults = [Fault("blob", f"{len(blob)} bytes", f"at most {MAX_FRAME_BYTES}")]
        raise SessionError("the frame is too large", faults=faults)
    frame = raw.decode(memoryview(blob), where=f"frame of step {step_id}")
    for field, got, wanted in (
        ("step_id", frame.step_id, step_id),
        ("session_id", frame.session_id, session_id),
    ):
        if got != wanted:
            advice = "Encode the DNG with the step and session it is committed to."
            what = "the frame names another step or session"
            raise SessionError(what, faults=[Fault(field, short_repr(got), wanted)], advice=advice)


class SessionView:
    """Plan, frames, consent and provenance of one session.

    Attributes
    ----------
    path : Path
        Folder of the session.
    manifest : Manifest
        Manifest, written when the session began.
    id : str
        Name of the session, written into each of its frames.
    plan : Plan
        Planned steps.
    rig : Rig
        The nominal rig, at the image size in use.
    source : {"measured", "simulated"}
        Whether the frames are measured or simulated.
    subject : Subject
        Captured subject.
    seed : int or None
        Seed of the simulation, None for a measured session.
    """

    def __init__(self, path: Path, contents: SessionContents) -> None:
        self.path = path
        self.manifest = manifest = contents.manifest
        self.id, self.plan, self.rig = manifest.id, manifest.plan, manifest.rig
        self.source, self.subject, self.seed = manifest.source, manifest.subject, manifest.seed
        self._head = contents.walk.head
        self._close_line = contents.close_line
        self._lines: dict[tuple[str, str], list[FrameLine]] = {}
        for line in contents.frame_lines:
            self._lines.setdefault((line.step, line.camera), []).append(line)
        self._attached: dict[str, AttachmentLine] = {
            line.name: line for line in contents.attachment_lines
        }
        self._left_out: dict[str, OmissionLine] = {
            step: line for line in contents.omission_lines for step in line.steps
        }

    def pending_frames(self) -> list[tuple[Step, str]]:
        """Return the steps and cameras without a committed frame, in the order of the plan.

        Omitted steps are not returned.
        """
        return [
            (step, camera)
            for step in self.plan.steps
            if step.id not in self._left_out
            for camera in step.cameras
            if (step.id, camera) not in self._lines
        ]

    def omitted_steps(self) -> Mapping[str, str]:
        """Return the omitted steps, each with its reason, in the order of the plan."""
        return {
            step.id: self._left_out[step.id].reason
            for step in self.plan.steps
            if step.id in self._left_out
        }

    def omission_line(self, step_id: str) -> OmissionLine:
        """Return the journal line of an omitted step.

        Raises
        ------
        SessionError
            When the step was not omitted.
        """
        if step_id not in self._left_out:
            faults = [Fault("step", short_repr(step_id), "an omitted step")]
            raise SessionError("was not omitted", where=str(self.path), faults=faults)
        return self._left_out[step_id]

    def frames(self, kind: str | None = None, **index: str | int | float) -> list[FrameRecord]:
        """Return the last attempt of each committed frame, in the order of the plan.

        Frames of a step that was omitted afterwards are not returned.

        Parameters
        ----------
        kind : str, optional
            Only steps of this kind.
        **index
            Only steps whose index has these values, e.g. ``polarizer="crossed"``.
        """
        missing = object()
        return [
            FrameRecord(step=step, line=self._lines[step.id, camera][-1])
            for step in self.plan.steps
            if kind in (None, step.kind)
            and step.id not in self._left_out
            and all(step.index.get(key, missing) == value for key, value in index.items())
            for camera in step.cameras
            if (step.id, camera) in self._lines
        ]

    def read(self, record: FrameRecord) -> raw.RawFrame:
        """Return a committed frame after a check of its hash.

        Raises
        ------
        SessionDamage
            When the file is missing or differs in any bit from what was committed.
        """
        where = self.path / record.file
        blob = check_file(where, record.line)
        frame = raw.decode(memoryview(blob), where=str(where))
        if frame.step_id != record.step_id:
            faults = [Fault("step", frame.step_id, record.step_id)]
            raise SessionDamage("is another frame", where=str(where), faults=faults)
        return frame

    def attachments(self) -> tuple[str, ...]:
        """Return the names of the files attached, in the order they were attached."""
        return tuple(self._attached)

    def attachment_line(self, name: str) -> AttachmentLine:
        """Return the journal line of an attachment: size, hash, and provenance.

        Raises
        ------
        SessionError
            When there is none of that name.
        """
        if name not in self._attached:
            known = ", ".join(self._attached) or "none"
            faults = [Fault("attachment", short_repr(name), f"one of: {known}")]
            raise SessionError(
                "contains no such attachment",
                where=str(self.path),
                faults=faults,
                advice="Name one of those listed.",
                code="SR-SES-010",
            )
        return self._attached[name]

    def attachment(self, name: str) -> bytes:
        """Return the bytes of an attachment after a check of its hash.

        Raises
        ------
        SessionError
            When there is none of that name.
        SessionDamage
            When the file is missing or differs in any bit from what was attached.
        """
        line = self.attachment_line(name)
        return check_file(self.path / line.file, line)

    def is_export_allowed(self, scope: str, *, today: date | None = None) -> bool:
        """Return whether the subject's consent covers ``scope`` on the day; "any" covers all."""
        expires = self.subject.consent_expires
        in_time = expires is None or (today or datetime.now(UTC).date()) <= expires
        return in_time and bool({scope, ANY_USE} & set(self.subject.consent_scope))

    def require_consent(self, scope: str, *, today: date | None = None) -> None:
        """Raise `ConsentError` when `is_export_allowed` is False."""
        if not self.is_export_allowed(scope, today=today):
            allowed = ", ".join(self.subject.consent_scope) or "nothing"
            until = self.subject.consent_expires
            expected = f"one of: {allowed}" + (f", until {until}" if until else "")
            what = f"subject {self.subject.pseudonym} has not agreed to this use"
            faults = [Fault("scope", short_repr(scope), expected)]
            advice = "Ask the subject again, or keep the data inside the agreed scope."
            raise ConsentError(
                what, where=str(self.path), faults=faults, advice=advice, code="SR-SES-009"
            )

    @property
    def closed(self) -> bool:
        """Whether the session is closed."""
        return self._close_line is not None

    @property
    def complete(self) -> bool:
        """Whether the session is closed and lacks no frame of its plan but omitted ones."""
        return self.closed and not self.pending_frames()

    @property
    def content_hash(self) -> str:
        """``sha256:`` hash that covers manifest, journal and, through it, every frame."""
        return self._head if self._head.startswith("sha256:") else f"sha256:{self._head}"
