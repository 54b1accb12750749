"""journal.jsonl: one sealed line per frame, attachment or omission, chained to all before it.

A line is ``{"h":HASH,"r":RECORD}`` in canonical JSON, with HASH the SHA-256 of the previous hash
and of RECORD; the first is chained to the seal of session.json. Any line of another session, a
missing line, and any changed byte are therefore detected, and a line truncated by a crash can only
be the last.
"""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import xxhash

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
from capture.former_names import translate_names
from capture.plan import Value
from capture.rig import ID_RULE, is_id
from capture.session.disk import Blob
from capture.session.errors import SessionDamage, SessionError

MAX_LINE_BYTES = 65_536
ATTACHMENT_RULE = f"{ID_RULE}, not ending in .part"
_XXH128_PATTERN = re.compile(r"[0-9a-f]{32}")
_HEAD_PATTERN = re.compile(rb'\{"h":"([0-9a-f]{64})","r":(?:\{"([a-z]+)")?')
"""Beginning of a line: its hash, and the first key of its record."""
_KIND_PATTERN = re.compile(rb'"type":"([a-z_]+)"(?:,"xxh128":|\}\}\n)')
_FILE_PATTERN = re.compile(rb'"file":"frames/([\w.-]+)\+([\w.-]+)(?:\+\d+)?\.dng"')
_STEP_PATTERN = re.compile(rb'"step":"([\w.-]+)","t_box_s":')
_LINE_PATTERN = re.compile(rb"[^\n]*\n|[^\n]+")


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameLine(Document):
    """Journal line of one committed frame."""

    step: str
    camera: str
    attempt: int
    file: str
    """Path inside the session; must follow from step, camera and attempt."""
    bytes: int
    xxh128: str
    settings: Mapping[str, Value]
    """Requested settings."""
    actual: Mapping[str, Value]
    """Settings that controller and camera report."""
    t_box_s: float | None
    """Time of the exposure on the controller's clock; None for a rig without controller."""
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
class NewFrame:
    """One frame of a step, and what its journal line contains."""

    camera: str
    """One of the step's cameras."""
    blob: Blob
    """A DNG of ours that names the step and the session."""
    settings: Mapping[str, Value]
    """Requested settings."""
    actual: Mapping[str, Value]
    """Settings that controller and camera report."""
    t_box_s: float | None = None
    """Time of the exposure on the controller's clock, s; None without a controller."""
    t_host_s: float
    """Time of arrival on the host's clock, s."""
    attempt: int = 1
    """1, or one more than the last attempt for a frame taken again."""

    def line(self, step_id: str) -> FrameLine:
        """Return the journal line of the frame."""
        return FrameLine(
            step=step_id,
            camera=self.camera,
            attempt=self.attempt,
            file=frame_path(step_id, self.camera, self.attempt),
            bytes=len(self.blob),
            xxh128=xxhash.xxh3_128_hexdigest(self.blob),
            settings=dict(self.settings),
            actual=dict(self.actual),
            t_box_s=None if self.t_box_s is None else float(self.t_box_s),
            t_host_s=float(self.t_host_s),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class AttachmentLine(Document):
    """Journal line of one attached file: part of the capture, but not a frame."""

    name: str
    file: str
    """Path inside the session; must follow from the name."""
    bytes: int
    xxh128: str
    about: Mapping[str, Value]
    """Provenance of the file: texts and numbers."""

    def __post_init__(self) -> None:
        checks = FaultCollector("Attachment line", SessionDamage)
        checks.check("name", self.name, is_attachment_name(self.name), ATTACHMENT_RULE)
        expected = attachment_path(self.name)
        checks.check("file", self.file, self.file == expected, expected)
        checks.check("bytes", self.bytes, self.bytes > 0, "> 0")
        good = _XXH128_PATTERN.fullmatch(self.xxh128) is not None
        checks.check("xxh128", self.xxh128, good, "32 hexadecimal digits")
        checks.close()


FileLine = FrameLine | AttachmentLine


@dataclass(frozen=True, slots=True, kw_only=True)
class OmissionLine(Document):
    """Journal line of plan steps that will not be captured."""

    steps: tuple[str, ...]
    reason: str
    """Reason, for people."""
    about: Mapping[str, Value]
    """Findings, for programs: texts and numbers."""
    t_host_s: float

    def __post_init__(self) -> None:
        checks = FaultCollector("Line of omitted steps", SessionDamage)
        differ = len(set(self.steps)) == len(self.steps) > 0
        checks.check("steps", self.steps, differ, "at least one, none twice")
        for step in self.steps:
            checks.check("steps", step, is_id(step), ID_RULE)
        checks.check("reason", self.reason, bool(self.reason.strip()), "a text")
        checks.close()


@dataclass(frozen=True, slots=True, kw_only=True)
class CloseLine(Document):
    """Journal line that ends a session: nothing may follow."""

    frames: int
    missing: tuple[str, ...]
    """Number of plan steps that were neither captured nor omitted with a reason of their own."""
    reason: str
    """Reason why steps are missing; empty when none is."""


Line = FrameLine | AttachmentLine | OmissionLine | CloseLine
_LINE_KINDS: Mapping[str, type[Any]] = {
    "frame": FrameLine,
    "attachment": AttachmentLine,
    "omission": OmissionLine,
    "close": CloseLine,
}
_FIRST_KEYS = {
    kind.encode(): min(one.name for one in fields(known)).encode()
    for kind, known in _LINE_KINDS.items()
}


@dataclass(frozen=True, slots=True)
class JournalWalk:
    """Result of following a journal's chain."""

    lines: tuple[tuple[int, Line], ...]
    """First byte and content of every valid line."""
    head: str
    """Last hash of the chain."""
    end: int
    """Byte after the last valid line."""
    torn: int
    """Bytes after ``end`` of a line that a crash truncated; 0 for none."""
    damage: SessionDamage | None
    """The first line that differs from what was written; None when all are valid."""

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
    """Return whether ``name`` is valid for an attachment: a plain file name.

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
    """Return the bytes of the line after ``previous``, and its hash."""
    kind = next(name for name, known in _LINE_KINDS.items() if isinstance(line, known))
    record = canonical_json({"type": kind, **to_json_table(line)})
    digest = hashlib.sha256(previous.encode("ascii") + record).hexdigest()
    return b'{"h":"' + digest.encode("ascii") + b'","r":' + record + b"}\n", digest


def seal_bounded_line(previous: str, line: Line) -> tuple[bytes, str]:
    """Return `seal_line` of a line; raise SessionError when it cannot be written or is too long."""
    try:
        text, head = seal_line(previous, line)
    except (TypeError, ValueError, RecursionError) as exc:
        path = "about" if isinstance(line, AttachmentLine | OmissionLine) else "settings, actual"
        faults = [Fault(path, str(exc), "texts, finite numbers, true or false")]
        raise SessionError("the journal line cannot be written", faults=faults) from exc
    if len(text) > MAX_LINE_BYTES:
        faults = [Fault("line", f"{len(text)} bytes", f"at most {MAX_LINE_BYTES}")]
        raise SessionError("its metadata are too long", faults=faults)
    return text, head


def walk_journal(
    data: bytes, *, seal: str, where: str, cameras: Mapping[str, int] | None = None
) -> JournalWalk:
    """Follow the chain from ``seal`` to the last line, truncated lines, or the first damage.

    Parameters
    ----------
    data, seal, where
        The journal, the seal of its manifest, and its name for messages.
    cameras
        Number of cameras by step: the lines of a step's frames are written at once. None: each line
        was written alone.
    """
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
            last = _is_one_write(text, data[start + len(text) :], cameras or {})
            if _is_torn(text, unended=stop < 0, last=last, head=head):
                return JournalWalk(tuple(lines), head, start, len(data) - start, None)
            return JournalWalk(tuple(lines), head, start, 0, exc)
        if line is None:  # complete but for its newline: was never acknowledged
            return JournalWalk(tuple(lines), head, start, len(data) - start, None)
        lines.append((start, line))
        head, start = digest, start + len(text)
    return JournalWalk(tuple(lines), head, start, 0, None)


def _unseal(text: bytes, head: str, where: str) -> tuple[Line | None, str]:
    """Return content and hash of one line; None when only its newline is missing."""
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
    kind = "omission" if kind == "left_out" else kind  # its name in version 1
    for part in {"settings", "actual"} & record.keys():
        record[part] = translate_names(record[part])
    if isinstance(kind, str) and kind in _LINE_KINDS:
        return parse_document(_LINE_KINDS[kind], record, where=where, error=SessionDamage), digest
    raise _damage_error(
        where, None, "type", short_repr(kind), '"frame", "attachment", "omission" or "close"'
    )


def _is_one_write(text: bytes, behind: bytes, cameras: Mapping[str, int]) -> bool:
    """Return whether a bad line and all behind it may be of one write.

    That is one line, or lines of frames of one step, each of another camera. What a hole covers is
    unknown: all that is left must fit.

    Parameters
    ----------
    text
        The bad line; a hole may have joined several.
    behind
        All behind its newline.
    cameras
        Number of cameras by step.
    """
    rest = text + behind
    files = _FILE_PATTERN.findall(rest)
    views = [camera for _, camera in files]
    steps = {step for step, _ in files} | set(_STEP_PATTERN.findall(rest))
    kinds, begin = _KIND_PATTERN.findall(rest), _HEAD_PATTERN.match(text)
    first_key = begin[2] if begin else None
    several = bool(behind) or len(kinds) > 1
    if any(first_key not in (None, _FIRST_KEYS.get(kind, first_key)) for kind in kinds):
        return False
    if len(steps) > 1 or len(set(views)) < len(views) or (several and set(kinds) - {b"frame"}):
        return False
    if not behind:
        return True
    if first_key not in (None, b"actual"):
        return False
    before, count = text, 1
    for line in _LINE_PATTERN.findall(behind):
        count += 1
        if line.endswith(b"\n") and line.count(b"\0") < 2:
            if not _KIND_PATTERN.search(line):
                return False
            if _HEAD_PATTERN.match(before) and not _is_next(before, line):
                if before is not text:
                    return False
                count += 1  # the hole has joined two lines at least
        before = line
    most = max(cameras.values(), default=1)
    return count <= min((cameras.get(step.decode(), 0) for step in steps), default=most)


def _is_next(before: bytes, line: bytes) -> bool:
    """Return whether a line's hash follows from its record and from the hash of the line before."""
    record = line[76:-2]
    digest = hashlib.sha256(before[6:70] + record).hexdigest()
    return line == b'{"h":"' + digest.encode("ascii") + b'","r":' + record + b"}\n"


def _is_torn(text: bytes, *, unended: bool, last: bool, head: str) -> bool:
    """Return whether a bad line looks like the truncated end of an interrupted write.

    An interrupted write leaves a prefix of its lines, zeros, a prefix and zeros, or a hole of zeros
    before further lines of its own. A flipped bit leaves at most one zero byte, and a line whose
    newline was hit is one byte longer than a whole record: these are damage to an acknowledged
    line.

    Parameters
    ----------
    text
        The bad line.
    unended
        Whether its newline is missing.
    last
        Whether it and all after it may be of one write.
    head
        Hash of the line before.
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
    code = "SR-SES-012"
    return SessionDamage("is damaged", where=place, faults=faults, advice=advice, code=code)
