"""A session in the words of Bluesky's event model: run start, descriptors, resource, events, stop.

Documents are plain dictionaries; no library is needed to make or to read them. Frames of one kind
and camera that bear the same settings are one stream; the picture is an external datum, the file
inside the exported folder.

References
----------
Event model 1.x, https://blueskyproject.io/event-model (schemas of each document).
"""

import uuid
from collections.abc import Iterator
from typing import Any

from capture.plan import Value
from capture.session import FrameRecord, Session

HANDLER_SPEC = "SKINRIG_DNG"
"""Name of the handler that opens a datum: ``handler(resource_path)(file=...)`` reads a DNG."""
_UNIT_SUFFIXES = {"_s": "s", "_deg": "deg", "_w": "W", "_mm": "mm", "_us": "us"}

Document = tuple[str, dict[str, Any]]


def documents(session: Session) -> Iterator[Document]:
    """Yield name and content of every document of a session, in the order of a run.

    Notes
    -----
    Uids follow from the session's id, so that a second export gives the same documents.
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
    missing = len(session.todo())
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
    """Return what stands beside a frame, each name saying where it is from."""
    asked = {f"set_{key}": value for key, value in record.settings.items()}
    actual = {f"actual_{key}": value for key, value in record.actual.items()}
    index = {f"index_{key}": value for key, value in record.index.items()}
    return {"step": record.step_id, "attempt": record.attempt, **index, **asked, **actual}


def _descriptor(
    session: Session, record: FrameRecord, uid: str, start: str, stream: str, data: dict[str, Value]
) -> dict[str, Any]:
    view = session.rig.view(record.camera)
    keys: dict[str, dict[str, Any]] = {
        key: {"source": f"skinrig:{key}", "dtype": _dtype(value), "shape": [], **_unit(key)}
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


def _unit(key: str) -> dict[str, str]:
    return next(({"units": unit} for end, unit in _UNIT_SUFFIXES.items() if key.endswith(end)), {})
