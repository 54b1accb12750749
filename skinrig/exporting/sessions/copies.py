"""Copy sessions or their frames, or describe the frames by Bluesky's event model."""

import json
import shutil
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from capture.plan import Value
from capture.session import FrameRecord, Session
from capture.session.consent_seal import SEAL_FILE
from capture.session.contents import read_undamaged_contents
from capture.session.view import check_file
from reconstruction.pipeline.inputs import Inputs
from skinrig.exporting.options import ExportSettings
from skinrig.exporting.sealing import write_json

FRAMES_FOLDER, DOCUMENTS_FILE = "frames", "documents.jsonl"


def write_session_document(
    path: Path, inputs: Inputs, content: Mapping[str, Any], left_out: Sequence[tuple[str, str]]
) -> None:
    """Write the document of a session's exported images, with their provenance."""
    session = inputs.session
    origin = {
        "source": session.source,
        "inputs": inputs.hashes,
        "assumed": list(inputs.assumed),
        "consent": [session.manifest.to_json()["subject"]],
    }
    write_json(path, {**content, **origin, "left_out": [list(row) for row in left_out]})


def write_session(session: Session, out: Path, delivery: ExportSettings) -> None:
    """Copy all files of a session."""
    for name in ("session.json", "journal.jsonl", SEAL_FILE):
        if (session.path / name).is_file():
            shutil.copyfile(session.path / name, out / name)
    for folder in ("frames", "attachments"):
        if (session.path / folder).is_dir():
            (out / folder).mkdir()
    # all attempts of frames, not only the last, since the journal lists them
    lines = read_undamaged_contents(session.path).file_lines
    for number, line in enumerate(lines, start=1):
        delivery.report(f"write {number}/{len(lines)} files")
        (out / line.file).write_bytes(check_file(session.path / line.file, line))


def write_frames(session: Session, out: Path, delivery: ExportSettings) -> None:
    """Copy the DNG files alone."""
    (out / FRAMES_FOLDER).mkdir()
    records = session.frames()
    for number, record in enumerate(records, start=1):
        delivery.report(f"write {number}/{len(records)} frames")
        (out / record.file).write_bytes(check_file(session.path / record.file, record.line))


def write_events(session: Session, out: Path, delivery: ExportSettings) -> None:
    """Copy the frames, and write documents.jsonl, a run in Bluesky's event model."""
    write_frames(session, out, delivery)
    with (out / DOCUMENTS_FILE).open("w", encoding="utf-8") as stream:
        for name, document in generate_documents(session):
            stream.write(json.dumps([name, document], allow_nan=False) + "\n")


HANDLER_SPEC = "SKINRIG_DNG"
"""Name of the handler that opens a datum: ``handler(resource_path)(file=...)`` reads a DNG."""
_UNIT_SUFFIXES = {"_s": "s", "_deg": "deg", "_w": "W", "_mm": "mm", "_us": "us"}

Document = tuple[str, dict[str, Any]]


def generate_documents(session: Session) -> Iterator[Document]:
    """Yield name and content of the event-model documents of a session, in the order of a run.

    Notes
    -----
    Uids are derived from the session's id, so that repeated exports give the same documents.
    """
    space = uuid.uuid5(uuid.NAMESPACE_OID, session.id)

    def uid(*names: str) -> str:
        return str(uuid.uuid5(space, "/".join(names)))

    records = sorted(session.frames(), key=lambda record: record.line.t_host_s)
    begin = session.manifest.created_at.timestamp()
    start, resource = uid("start"), uid("resource")
    yield "start", _start(session, start, begin)
    files = {"spec": HANDLER_SPEC, "root": ".", "resource_path": "frames"}
    how = {"path_semantics": "posix", "resource_kwargs": {}}
    yield "resource", {"uid": resource, "run_start": start, **files, **how}
    described: dict[str, str] = {}
    counts: dict[str, int] = {}
    for record in records:
        data = _data(record)
        stream = f"{record.kind}-{record.camera}"
        signature = "/".join([stream, *(f"{k}:{_dtype(v)}" for k, v in sorted(data.items()))])
        time_s = record.line.t_host_s
        if signature not in described:
            name = described[signature] = uid("descriptor", signature)
            yield "descriptor", _descriptor(session, record, name, start, stream, data)
        name = record.file.removeprefix("frames/")
        datum = f"{resource}/{name}"
        yield "datum", {"datum_id": datum, "resource": resource, "datum_kwargs": {"file": name}}
        counts[stream] = counts.get(stream, 0) + 1
        image = f"{record.camera}_image"
        event = {"uid": uid("event", record.file), "descriptor": described[signature]}
        times = dict.fromkeys([*data, image], time_s)
        values = {"data": {**data, image: datum}, "timestamps": times, "filled": {image: False}}
        yield "event", {**event, "seq_num": counts[stream], "time": time_s, **values}
    missing = len(session.pending_frames())
    end = {
        "time": max([begin, *(record.line.t_host_s for record in records)]),
        "exit_status": "success" if session.closed and not missing else "abort",
        "reason": f"{missing} frames of the plan are missing" if missing else "",
        "num_events": counts,
    }
    yield "stop", {"uid": uid("stop"), "run_start": start, **end}


def _start(session: Session, uid: str, time_s: float) -> dict[str, Any]:
    subject, manifest = session.subject, session.manifest
    expires = subject.consent_expires
    return {
        "uid": uid,
        "time": time_s,
        "plan_name": session.plan.rig,
        "sample": subject.pseudonym,
        "consent_scope": list(subject.consent_scope),
        "consent_expires": None if expires is None else expires.isoformat(),
        "session_id": session.id,
        "content_hash": session.content_hash,
        "source": session.source,
        "seed": session.seed,
        "versions": dict(manifest.versions),
    }


def _data(record: FrameRecord) -> dict[str, Value]:
    """Return the settings of a frame; prefixes of names mark their source."""
    asked = {f"set_{key}": value for key, value in record.settings.items()}
    actual = {f"actual_{key}": value for key, value in record.actual.items()}
    index = {f"index_{key}": value for key, value in record.index.items()}
    return {"step": record.step_id, "attempt": record.attempt, **index, **asked, **actual}


def _descriptor(
    session: Session, record: FrameRecord, uid: str, start: str, stream: str, data: dict[str, Value]
) -> dict[str, Any]:
    view = session.rig.view(record.camera)
    keys: dict[str, dict[str, Any]] = {
        key: {"source": f"skinrig:{key}", "dtype": _dtype(value), "shape": [], **_units(key)}
        for key, value in data.items()
    }
    keys[f"{record.camera}_image"] = {
        "source": f"camera:{view.serial}",
        "dtype": "array",
        "dtype_numpy": "<u2",
        "shape": [view.height_px, view.width_px],
        "external": "FILESTORE:",
    }
    return {
        "uid": uid,
        "run_start": start,
        "time": record.line.t_host_s,
        "name": stream,
        "data_keys": keys,
        "object_keys": {record.camera: list(keys)},
        "configuration": {},
        "hints": {},
    }


def _dtype(value: Value) -> str:
    if isinstance(value, bool):
        return "boolean"
    if isinstance(value, int):
        return "integer"
    return "number" if isinstance(value, float) else "string"


def _units(key: str) -> dict[str, str]:
    unit = name_unit(key)
    return {} if unit is None else {"units": unit}


def name_unit(key: str) -> str | None:
    """Return the unit that the suffix of a setting's name states; None without.

    Examples
    --------
    >>> name_unit("actual_exposure_s"), name_unit("light")
    ('s', None)
    """
    return next((unit for end, unit in _UNIT_SUFFIXES.items() if key.endswith(end)), None)
