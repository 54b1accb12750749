"""journal.jsonl: one sealed line per frame, attachment or omission, chained to all before it.

A line is ``{"h":HASH,"r":RECORD}`` in canonical JSON, with HASH the SHA-256 of the hash before and
of RECORD; the first is chained to the seal of session.json. So a line of another session, a line
left out, and any changed byte are found, and a line cut by a crash can only be the last.
"""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from capture.documents import (
    Document,
    Fault,
    FaultCollector,
    canonical_json,
    parse_document,
    read_json,
    short_repr,
    to_json_table,
)
from capture.plan import Value
from capture.rig import ID_RULE, is_id
from capture.session.errors import SessionDamage

MAX_LINE_BYTES = 65_536
ATTACHMENT_RULE = f"{ID_RULE}, not ending in .part"
_XXH128_PATTERN = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameLine(Document):
    """One committed frame, as the journal holds it."""

    step: str
    camera: str
    attempt: int
    file: str
    """Path inside the session; must be the one that step, camera and attempt give."""
    bytes: int
    xxh128: str
    settings: Mapping[str, Value]
    """What was asked for."""
    actual: Mapping[str, Value]
    """What box and camera report to have done."""
    t_box_s: float | None
    """Time of the exposure on the clock of the box; None where there is no box."""
    t_host_s: float

    def __post_init__(self) -> None:
        checks = FaultCollector("Frame line", SessionDamage)
        for name in ("step", "camera"):
            checks.check(name, getattr(self, name), is_id(getattr(self, name)), ID_RULE)
        checks.check("attempt", self.attempt, self.attempt >= 1, ">= 1")
        expected = frame_path(self.step, self.camera, self.attempt)
        checks.check("file", self.file, self.file == expected, expected)
        checks.check("bytes", self.bytes, self.bytes > 0, "> 0")
        good = _XXH128_PATTERN.fullmatch(self.xxh128) is not None
        checks.check("xxh128", self.xxh128, good, "32 hexadecimal digits")
        checks.close()


@dataclass(frozen=True, slots=True, kw_only=True)
class AttachmentLine(Document):
    """One file that belongs to the capture and is no frame, as the journal holds it."""

    name: str
    file: str
    """Path inside the session; must be the one that the name gives."""
    bytes: int
    xxh128: str
    about: Mapping[str, Value]
    """Where it is from, for people: texts and numbers."""

    def __post_init__(self) -> None:
        checks = FaultCollector("Attachment line", SessionDamage)
        checks.check("name", self.name, is_attachment_name(self.name), ATTACHMENT_RULE)
        expected = attachment_path(self.name)
        checks.check("file", self.file, self.file == expected, expected)
        checks.check("bytes", self.bytes, self.bytes > 0, "> 0")
        good = _XXH128_PATTERN.fullmatch(self.xxh128) is not None
        checks.check("xxh128", self.xxh128, good, "32 hexadecimal digits")
        checks.close()


@dataclass(frozen=True, slots=True, kw_only=True)
class OmissionLine(Document):
    """Steps of the plan that will not be captured, as the journal holds them."""

    steps: tuple[str, ...]
    reason: str
    """Why, for people."""
    about: Mapping[str, Value]
    """What was found, for programs: texts and numbers."""
    t_host_s: float

    def __post_init__(self) -> None:
        checks = FaultCollector("Line of steps left out", SessionDamage)
        differ = len(set(self.steps)) == len(self.steps) > 0
        checks.check("steps", self.steps, differ, "at least one, none twice")
        for step in self.steps:
            checks.check("steps", step, is_id(step), ID_RULE)
        checks.check("reason", self.reason, bool(self.reason.strip()), "a text")
        checks.close()


@dataclass(frozen=True, slots=True, kw_only=True)
class CloseLine(Document):
    """The end of a session: nothing may follow."""

    frames: int
    missing: tuple[str, ...]
    """Steps of the plan that were neither captured nor left out with a reason of their own."""
    reason: str
    """Why they were not, empty where none is missing."""


Line = FrameLine | AttachmentLine | OmissionLine | CloseLine
_LINE_KINDS: Mapping[str, type[Any]] = {
    "frame": FrameLine,
    "attachment": AttachmentLine,
    "left_out": OmissionLine,
    "close": CloseLine,
}


@dataclass(frozen=True, slots=True)
class JournalWalk:
    """What a journal holds."""

    lines: tuple[tuple[int, Line], ...]
    """First byte and content of every good line."""
    head: str
    """Last hash of the chain."""
    end: int
    """Byte after the last good line."""
    torn: int
    """Bytes after ``end`` that a crash cut off in the middle of writing; 0 for none."""
    damage: SessionDamage | None
    """The first line that is not what was written; None where all are."""

    @property
    def closed(self) -> bool:
        """Whether the session was closed."""
        return bool(self.lines) and isinstance(self.lines[-1][1], CloseLine)


def frame_path(step: str, camera: str, attempt: int) -> str:
    """Return the path of a frame inside its session.

    Examples
    --------
    >>> frame_path("S001", "cam", 1), frame_path("S001", "cam", 2)
    ('frames/S001+cam.dng', 'frames/S001+cam+2.dng')
    """
    suffix = "" if attempt == 1 else f"+{attempt}"
    return f"frames/{step}+{camera}{suffix}.dng"


def is_attachment_name(name: str) -> bool:
    """Return whether ``name`` can be an attachment's, a plain file name.

    Examples
    --------
    >>> is_attachment_name("scan.ply"), is_attachment_name("../scan.ply")
    (True, False)
    """
    return is_id(name) and not name.endswith(".part")


def attachment_path(name: str) -> str:
    """Return the path of an attachment inside its session.

    Examples
    --------
    >>> attachment_path("scan.ply")
    'attachments/scan.ply'
    """
    return f"attachments/{name}"


def seal_line(previous: str, line: Line) -> tuple[bytes, str]:
    """Return the bytes of the line that follows ``previous``, and its hash."""
    kind = next(name for name, known in _LINE_KINDS.items() if isinstance(line, known))
    record = canonical_json({"type": kind, **to_json_table(line)})
    digest = hashlib.sha256(previous.encode("ascii") + record).hexdigest()
    return b'{"h":"' + digest.encode("ascii") + b'","r":' + record + b"}\n", digest


def walk_journal(data: bytes, *, seal: str, where: str) -> JournalWalk:
    """Follow the chain from ``seal`` to the last line, a torn tail, or the first damage."""
    lines: list[tuple[int, Line]] = []
    head, start = seal, 0
    while start < len(data):
        stop = data.find(b"\n", start)
        text = data[start:] if stop < 0 else data[start : stop + 1]
        if lines and isinstance(lines[-1][1], CloseLine):
            damage = _damage_error(
                where, start, "data after the end", short_repr(text[:40]), "nothing"
            )
            return JournalWalk(tuple(lines), head, start, 0, damage)
        try:
            line, digest = _unseal(text, head, f"{where}, byte {start}")
        except SessionDamage as exc:
            if _is_torn(text, stop < 0, last=start + len(text) == len(data), head=head):
                return JournalWalk(tuple(lines), head, start, len(data) - start, None)
            return JournalWalk(tuple(lines), head, start, 0, exc)
        if line is None:  # complete but for its newline: was never acknowledged
            return JournalWalk(tuple(lines), head, start, len(data) - start, None)
        lines.append((start, line))
        head, start = digest, start + len(text)
    return JournalWalk(tuple(lines), head, start, 0, None)


def _unseal(text: bytes, head: str, where: str) -> tuple[Line | None, str]:
    """Return content and hash of one line; None where only its newline is missing."""
    if len(text) > MAX_LINE_BYTES:
        raise _damage_error(where, None, "line", f"{len(text)} bytes", f"at most {MAX_LINE_BYTES}")
    content = read_json(text, where=where, error=SessionDamage)
    if not isinstance(content, dict) or not isinstance(content.get("r"), dict):
        raise _damage_error(where, None, "line", short_repr(content), '{"h": hash, "r": record}')
    record = dict(content["r"])
    kind = record.pop("type", None)
    try:
        packed = canonical_json(content["r"])
        digest = hashlib.sha256(head.encode("ascii") + packed).hexdigest()
    except (ValueError, RecursionError) as exc:
        raise _damage_error(where, None, "line", str(exc), "canonical JSON") from exc
    expected = b'{"h":"' + digest.encode("ascii") + b'","r":' + packed + b"}\n"
    if text != expected:
        if text + b"\n" == expected:
            return None, digest
        got = short_repr(content.get("h"))
        raise _damage_error(where, None, "hash", got, f"{digest}: the line is not what was written")
    if isinstance(kind, str) and kind in _LINE_KINDS:
        return parse_document(_LINE_KINDS[kind], record, where=where, error=SessionDamage), digest
    raise _damage_error(
        where, None, "type", short_repr(kind), '"frame", "attachment", "left_out" or "close"'
    )


def _is_torn(text: bytes, unended: bool, *, last: bool, head: str) -> bool:
    """Return whether a bad line looks like the cut-off end of an interrupted write.

    A write that never reached the disk leaves a prefix of the line, zeros, or a prefix and zeros.
    A flipped bit leaves at most one zero byte, and a line whose newline was hit is one byte longer
    than a whole record: these are damage to something acknowledged.
    """
    if not last:
        return False
    if text.endswith(b"\0") or text.count(b"\0") > 1:
        return True
    if not unended:
        return False
    try:
        whole, _ = _unseal(text[:-1], head, "")
    except SessionDamage:
        return True
    return whole is not None


def _damage_error(
    where: str, byte: int | None, path: str, got: str, expected: str
) -> SessionDamage:
    place = where if byte is None else f"{where}, byte {byte}"
    advice = "Restore the journal from a copy; no line after this byte can be trusted."
    faults = [Fault(path, got, expected)]
    return SessionDamage("is damaged", where=place, faults=faults, advice=advice)
