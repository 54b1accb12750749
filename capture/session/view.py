"""What a session can be asked, whether it is being written or only read."""

from collections.abc import Mapping
from datetime import UTC, date, datetime
from pathlib import Path

from capture import raw
from capture.documents import Fault, shown
from capture.plan import Step
from capture.session.contents import Contents
from capture.session.errors import ConsentError, SessionDamage, SessionError
from capture.session.frames import FrameRecord, check_file
from capture.session.journal import AttachmentLine, FrameLine, LeftOutLine
from capture.session.manifest import ANY_USE


class SessionView:
    """Plan, frames, consent and provenance of one session.

    Attributes
    ----------
    path : Path
        Its folder.
    manifest : Manifest
        All that was known when the session began.
    id : str
        Name of the session, written into each of its frames.
    plan : Plan
        What was to be captured.
    rig : Rig
        The nominal rig, resized as it was used.
    source : {"measured", "simulated"}
        Whether light or a simulation made the frames.
    subject : Subject
        Who was captured.
    seed : int or None
        Seed of the simulation, None for a measured session.
    """

    def __init__(self, path: Path, contents: Contents) -> None:
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
        self._left_out: dict[str, LeftOutLine] = {
            step: line for line in contents.left_out_lines for step in line.steps
        }

    def todo(self) -> list[tuple[Step, str]]:
        """Return the steps and cameras without a committed frame, in the order of the plan.

        Steps that were left out are not to be done.
        """
        return [
            (step, camera)
            for step in self.plan.steps
            if step.id not in self._left_out
            for camera in step.cameras
            if (step.id, camera) not in self._lines
        ]

    def left_out(self) -> Mapping[str, str]:
        """Return the steps that will not be captured, each with the reason, in the plan's order."""
        return {
            step.id: self._left_out[step.id].reason
            for step in self.plan.steps
            if step.id in self._left_out
        }

    def left_out_line(self, step_id: str) -> LeftOutLine:
        """Return what the journal says of a step that was left out.

        Raises
        ------
        SessionError
            Where it was not.
        """
        if step_id not in self._left_out:
            faults = [Fault("step", shown(step_id), "a step that was left out")]
            raise SessionError("was not left out", where=str(self.path), faults=faults)
        return self._left_out[step_id]

    def frames(self, kind: str | None = None, **index: str | int | float) -> list[FrameRecord]:
        """Return the last attempt of each committed frame, in the order of the plan.

        Frames of a step that was left out afterwards are not among them.

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
        """Return a committed frame, after its hash has been checked.

        Raises
        ------
        SessionDamage
            Where the file is missing or one bit of it differs from what was committed.
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
        """Return what the journal says of an attachment: size, hash, and where it is from.

        Raises
        ------
        SessionError
            Where there is none of that name.
        """
        if name not in self._attached:
            known = ", ".join(self._attached) or "none"
            faults = [Fault("attachment", shown(name), f"one of: {known}")]
            raise SessionError("holds no such attachment", where=str(self.path), faults=faults)
        return self._attached[name]

    def attachment(self, name: str) -> bytes:
        """Return the bytes of an attachment, after its hash has been checked.

        Raises
        ------
        SessionError
            Where there is none of that name.
        SessionDamage
            Where the file is missing or one bit of it differs from what was attached.
        """
        line = self.attachment_line(name)
        return check_file(self.path / line.file, line)

    def export_allowed(self, scope: str, *, today: date | None = None) -> bool:
        """Return whether the subject's consent covers ``scope`` on the day; "any" covers all."""
        expires = self.subject.consent_expires
        in_time = expires is None or (today or datetime.now(UTC).date()) <= expires
        return in_time and bool({scope, ANY_USE} & set(self.subject.consent_scope))

    def require_consent(self, scope: str, *, today: date | None = None) -> None:
        """Raise `ConsentError` where `export_allowed` is False."""
        if not self.export_allowed(scope, today=today):
            allowed = ", ".join(self.subject.consent_scope) or "nothing"
            until = self.subject.consent_expires
            expected = f"one of: {allowed}" + (f", until {until}" if until else "")
            what = f"subject {self.subject.pseudonym} has not agreed to this use"
            faults = [Fault("scope", shown(scope), expected)]
            advice = "Ask the subject again, or keep the data inside the agreed scope."
            raise ConsentError(what, where=str(self.path), faults=faults, advice=advice)

    @property
    def closed(self) -> bool:
        """Whether the session has ended for good."""
        return self._close_line is not None

    @property
    def content_hash(self) -> str:
        """``sha256:`` hash that vouches for manifest, journal and, through it, every frame."""
        return self._head if self._head.startswith("sha256:") else f"sha256:{self._head}"
