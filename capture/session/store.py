"""Write and read a session: create, commit, resume, close, query."""

from __future__ import annotations

import logging
import uuid
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import xxhash

from capture.documents import Fault, FaultCollector, short_repr
from capture.plan import Plan, Value
from capture.rig import Rig
from capture.session.contents import JOURNAL_FILE, SessionContents, read_undamaged_contents
from capture.session.disk import Blob, Disk
from capture.session.errors import SessionError, SessionLocked
from capture.session.folder import (
    DiskErrors,
    make_attachments_folder,
    make_folder,
    move_orphans,
    note_errors,
    write_group,
)
from capture.session.journal import (
    ATTACHMENT_RULE,
    AttachmentLine,
    CloseLine,
    FileLine,
    FrameLine,
    NewFrame,
    OmissionLine,
    attachment_path,
    is_attachment_name,
    seal_bounded_line,
)
from capture.session.manifest import (
    CalibrationRef,
    Manifest,
    SubjectRecord,
    calibration_refs,
    package_versions,
)
from capture.session.view import MAX_FRAME_BYTES, SessionView, check_blob

_log = logging.getLogger(__name__)


class Session(SessionView):
    """Frames on disk with the journal that verifies them.

    Make one with `create`, go on with `resume`, read with `open`. A committed frame survives a
    killed process and a power cut; a closed session is never modified.

    Examples
    --------
    >>> import tempfile, numpy as np
    >>> from capture import raw
    >>> from capture.plan import flash_plan
    >>> from capture.rig import load_rig
    >>> rig = load_rig("flash").resized(16)
    >>> folder = tempfile.TemporaryDirectory()
    >>> session = Session.create(
    ...     folder.name + "/s", plan=flash_plan(rig, darks=1), rig=rig, devices={},
    ...     subject=SubjectRecord("P042", ("research",)), source="simulated", seed=1)
    >>> step, camera = session.pending_frames()[0]
    >>> blob = raw.encode_dng(
    ...     np.full((10, 16), 512, np.uint16), pattern="RGGB", black=512, white=16383,
    ...     step_id=step.id, session_id=session.id)
    >>> session.commit(step.id, camera, blob, settings=step.settings, actual={}, t_host_s=0.0)
    >>> session.release()
    >>> [(r.step_id, r.kind) for r in Session.open(folder.name + "/s").frames()]
    [('D000', 'dark')]
    >>> folder.cleanup()
    """

    def __init__(
        self, path: Path, contents: SessionContents, *, disk: Disk, descriptor: int | None
    ) -> None:
        super().__init__(path, contents)
        self._disk = disk
        self._descriptor = descriptor

    @classmethod
    def create(
        cls,
        path: str | Path,
        *,
        plan: Plan,
        rig: Rig,
        devices: Mapping[str, Any],
        subject: SubjectRecord,
        source: Literal["measured", "simulated"],
        calibrations: Sequence[CalibrationRef | Mapping[str, str]] = (),
        seed: int | None = None,
        extra: Mapping[str, Any] | None = None,
        session_id: str | None = None,
        now: Callable[[], datetime] | None = None,
        disk: Disk | None = None,
    ) -> Session:
        """Start a session in a new (or empty) folder and open it for writing.

        Parameters
        ----------
        path : str or Path
            The folder; its parent exists.
        plan, rig : Plan, Rig
            Must fit each other.
        devices : mapping
            Identification of each controller and camera: JSON values.
        subject : Subject
        source : {"measured", "simulated"}
        calibrations : sequence of CalibrationRef, or of tables of kind, sha256, path
        seed : int, optional
            Seed of a simulation.
        extra : mapping, optional
            Further JSON values.
        session_id : str, optional
            A fresh random one by default.
        now : callable, optional
            Clock, returns a time with its zone.
        disk : Disk, optional
            File operations; the real ones by default.

        Raises
        ------
        SessionError
            When the folder is not empty, or a value cannot be written.
        """
        disk, place = disk or Disk(), Path(path)
        manifest = Manifest(
            id=session_id or uuid.uuid4().hex,
            created_at=(now or (lambda: datetime.now(UTC)))(),
            source=source,
            subject=subject,
            plan=plan,
            rig=rig,
            devices=dict(devices),
            calibrations=calibration_refs(calibrations),
            seed=seed,
            versions=package_versions(),
            extra=dict(extra or {}),
        )
        make_folder(disk, place, manifest.encode()[0])
        return cls._acquire(place, disk)

    @classmethod
    def open(cls, path: str | Path) -> Session:
        """Open a session for reading, closed or not; a truncated last line is not modified.

        Raises
        ------
        SessionError
            When the folder is not a session, or its schema is unknown.
        SessionDamage
            When manifest or journal differ from what was written.
        """
        place = Path(path)
        return cls(place, read_undamaged_contents(place), disk=Disk(), descriptor=None)

    @classmethod
    def resume(cls, path: str | Path, *, disk: Disk | None = None) -> Session:
        """Open a session for writing after any kind of interruption.

        Acquires the writer's lock, removes a truncated last line of the journal, and moves files
        without a line to ``orphans/``. Acknowledged frames are kept.

        Raises
        ------
        SessionLocked
            When another process is writing.
        SessionError
            When the session is closed.
        SessionDamage
            When manifest or journal differ from what was written, or a committed frame is missing.
        """
        return cls._acquire(Path(path), disk or Disk(), interrupted=True)

    @classmethod
    def _acquire(cls, place: Path, disk: Disk, *, interrupted: bool = False) -> Session:
        read_undamaged_contents(place)
        with DiskErrors(place):
            descriptor = disk.open_append(place / JOURNAL_FILE)
            try:
                if not disk.lock(descriptor):
                    what, advice = "another process is writing this session", "Wait for its end."
                    raise SessionLocked(what, where=str(place), advice=advice, code="SR-SES-003")
                contents = read_undamaged_contents(place)  # again, under the lock
                if contents.walk.closed:
                    what = "the session is closed"
                    advice = "Start a new session; a closed one is never modified."
                    raise SessionError(what, where=str(place), advice=advice, code="SR-SES-002")
                if contents.walk.torn:
                    _log.warning("%s: cut %d torn bytes", place / JOURNAL_FILE, contents.walk.torn)
                    disk.truncate(descriptor, contents.walk.end)
                # the last process may have ended before the disk confirmed line or folder
                disk.fdatasync(descriptor)
                for folder in (place, place.resolve().parent) if interrupted else ():
                    disk.fsync_dir(folder)
                move_orphans(disk, place, contents)
            except BaseException:
                disk.close(descriptor)
                raise
        return cls(place, contents, disk=disk, descriptor=descriptor)

    def commit(self, step_id: str, camera: str, blob: Blob, **about: Any) -> None:
        """Write one frame to the medium, as `commit_step`; ``about`` are fields of `NewFrame`."""
        self.commit_step(step_id, [NewFrame(camera=camera, blob=blob, **about)])

    def commit_step(self, step_id: str, frames: Iterable[NewFrame]) -> None:
        """Write frames of a step to the medium; when this returns, they survive a power cut.

        Their files are flushed several at once, then their names together, then their lines. After
        an interruption all frames count, or the first ones, or none. A generator of frames makes
        the next ones while others are written.

        Parameters
        ----------
        step_id : str
            Step of the plan.
        frames : iterable of NewFrame
            Each of another camera.

        Raises
        ------
        SessionError
            When a frame does not fit the plan; nothing is left of the group.
        SessionDiskError
            When the disk refuses; committed frames are unchanged, and the session can be resumed.
        """

        def check() -> Iterator[tuple[FrameLine, Blob]]:
            seen: set[str] = set()
            for frame in frames:
                self._check_commit(step_id, frame, others=seen)
                seen.add(frame.camera)
                yield frame.line(step_id), frame.blob

        self._write(self._writable(), check())

    def attach(self, name: str, data: bytes, *, about: Mapping[str, Value] | None = None) -> None:
        """Attach a file other than a frame; when this returns, it survives a power cut.

        Parameters
        ----------
        name : str
            1 to 64 of A-Z a-z 0-9 _ - . , not starting with a dot, e.g. ``"scan.ply"``; not the
            name of an existing attachment, because attachments are never replaced.
        data : bytes
            Its content, at least one byte.
        about : mapping, optional
            Provenance: texts, finite numbers, true or false.

        Raises
        ------
        SessionError
            When the session is closed, or name or content are invalid; nothing is written.
        SessionDiskError
            When the disk refuses; committed frames are unchanged, and the session can be resumed.
        """
        descriptor = self._writable()
        if name in self._attached:
            faults = [Fault("name", short_repr(name), "a name that is free")]
            advice = "Attachments are never replaced; choose another name."
            what = "an attachment of this name is there already"
            raise SessionError(what, where=str(self.path), faults=faults, advice=advice)
        checks = FaultCollector("Attachment", SessionError)
        checks.check("name", name, is_attachment_name(name), ATTACHMENT_RULE)
        fits = 0 < len(data) <= MAX_FRAME_BYTES
        checks.check("data", f"{len(data)} bytes", fits, f"1 to {MAX_FRAME_BYTES} bytes")
        checks.close()
        line = AttachmentLine(
            name=name,
            file=attachment_path(name),
            bytes=len(data),
            xxh128=xxhash.xxh3_128_hexdigest(data),
            about=dict(about or {}),
        )
        if not self._attached:
            with self._released_on_failure():
                make_attachments_folder(self._disk, self.path)
        self._write(descriptor, [(line, bytes(data))])

    def omit_steps(
        self,
        step_ids: Sequence[str],
        *,
        reason: str,
        about: Mapping[str, Value] | None = None,
        t_host_s: float,
    ) -> None:
        """Record, safe from a power cut, that steps will not be captured, and why.

        The session is complete without them. Their frames stay on the disk, and do not count.

        Parameters
        ----------
        step_ids : sequence of str
            Steps of the plan that were not omitted before.
        reason : str
            Reason, for people.
        about : mapping, optional
            Findings: texts, finite numbers, true or false.
        t_host_s : float
            The host's time, s.

        Raises
        ------
        SessionError
            When the session is closed, a step is unknown or was omitted before, or the reason is
            empty; nothing is written.
        SessionDiskError
            When the disk refuses; committed frames are unchanged, and the session can be resumed.
        """
        descriptor = self._writable()
        checks = FaultCollector("Omitted steps", SessionError)
        differ = len(set(step_ids)) == len(step_ids) > 0
        checks.check("step_ids", tuple(step_ids), differ, "at least one, none twice")
        checks.check("reason", reason, bool(reason.strip()), "a text")
        for step_id in step_ids:
            self.plan.step(step_id)  # names unknown steps
            fresh = step_id not in self._left_out
            checks.check("step_ids", step_id, fresh, "steps not omitted before")
        checks.close()
        line = OmissionLine(
            steps=tuple(step_ids), reason=reason, about=dict(about or {}), t_host_s=float(t_host_s)
        )
        text, head = seal_bounded_line(self._head, line)
        with self._released_on_failure():
            self._append(descriptor, text)
            self._head = head
            self._left_out.update(dict.fromkeys(line.steps, line))

    def _write(self, descriptor: int, files: Iterable[tuple[FileLine, Blob]]) -> None:
        """Write files of one folder, and then their lines of the journal, to the medium."""
        text, head = b"", self._head
        lines: list[FileLine] = []
        refused: list[BaseException] = []

        def seal() -> Iterator[tuple[Path, Blob]]:
            nonlocal text, head
            for line, blob in files:
                sealed, head = seal_bounded_line(head, line)
                text += sealed
                lines.append(line)
                yield self.path / line.file, blob

        with self._released_on_failure(refused):
            write_group(self._disk, note_errors(seal(), refused))
            if text:
                self._append(descriptor, text)
            self._head = head
            for line in lines:
                self._add_line(line)

    def _add_line(self, line: FileLine) -> None:
        """Count a file whose line is durable."""
        if isinstance(line, AttachmentLine):
            self._attached[line.name] = line
        else:
            self._lines.setdefault((line.step, line.camera), []).append(line)

    @contextmanager
    def _released_on_failure(self, refused: Sequence[BaseException] = ()) -> Iterator[None]:
        """Release the session after any error or stop, except the caller's errors ``refused``."""
        try:
            yield
        except BaseException as exc:
            if exc not in refused:
                self.release()  # only resume() can find out how much reached the medium
                with DiskErrors(self.path):
                    raise
            raise

    def close(self, *, missing_reason: str = "") -> None:
        """Close the session for good: nothing can be added afterwards.

        Parameters
        ----------
        missing_reason : str
            Why steps are missing that were not omitted; required where there are any.

        Raises
        ------
        SessionError
            When steps are missing and no reason is given.
        """
        descriptor = self._writable()
        missing = tuple(dict.fromkeys(step.id for step, _ in self.pending_frames()))
        if missing and not missing_reason:
            faults = [Fault("steps", f"{len(missing)} missing, first {missing[0]!r}", "none")]
            advice = "Capture them, release() the session until later, or give missing_reason."
            what = "the session is not complete"
            raise SessionError(what, where=str(self.path), faults=faults, advice=advice)
        frames = sum(len(lines) for lines in self._lines.values())
        line = CloseLine(frames=frames, missing=missing, reason=missing_reason if missing else "")
        text, head = seal_bounded_line(self._head, line)
        with self._released_on_failure():
            self._append(descriptor, text)
            self._head, self._close_line = head, line
            self.release()

    def release(self) -> None:
        """Release the writer's lock; the session stays open and can be resumed."""
        if self._descriptor is not None:
            self._disk.close(self._descriptor)
            self._descriptor = None

    def __enter__(self) -> Session:
        """Return the session."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release the lock; the session is not closed."""
        self.release()

    def _writable(self) -> int:
        if self._descriptor is None:
            why = "closed" if self.closed else "not open for writing"
            advice = "A closed session is never modified; Session.resume opens an unfinished one."
            raise SessionError(f"the session is {why}", where=str(self.path), advice=advice)
        return self._descriptor

    def _check_commit(self, step_id: str, frame: NewFrame, others: Container[str]) -> None:
        step, camera = self.plan.step(step_id), frame.camera
        if camera not in step.cameras:
            faults = [Fault("camera", short_repr(camera), f"one of {', '.join(step.cameras)}")]
            raise SessionError(f"step {step_id!r} has no such camera", faults=faults)
        if camera in others:
            faults = [Fault("camera", short_repr(camera), "one frame of each camera")]
            raise SessionError(f"step {step_id!r} has two frames of a camera", faults=faults)
        if step_id in self._left_out:
            faults = [Fault("step", short_repr(step_id), "one that was not omitted")]
            raise SessionError("the step was omitted", where=str(self.path), faults=faults)
        done = self._lines.get((step_id, camera), [])
        expected = done[-1].attempt + 1 if done else 1
        if frame.attempt < 1 or (done and frame.attempt != expected):
            faults = [Fault("attempt", str(frame.attempt), f"{expected}")]
            advice = "A committed frame is never replaced; take it with the next attempt number."
            what = f"frame of step {step_id!r}, camera {camera!r} is already committed"
            raise SessionError(what, where=str(self.path), faults=faults, advice=advice)
        check_blob(frame.blob, step_id, self.id)

    def _append(self, descriptor: int, text: bytes) -> None:
        self._disk.write(descriptor, text)
        self._disk.fdatasync(descriptor)
