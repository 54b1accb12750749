"""Read and write the CALIBRATION/ format ``skinrig.calibration/1``.

One JSON file per kind (``sensor.json``, ``color.json``, ...), written atomically and sealed with a
digest of its own content; images that belong to it (a white reference) are float32 EXR files in the
same folder, named by their digest. Numbers are keyed by the serial of their camera.
"""

import contextlib
import hashlib
import io
import json
import math
import os
import shlex
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from capture.arrays import Float32Array
from capture.calibration.record import (
    CALIBRATION_KINDS,
    Calibration,
    CalibrationDamaged,
    CalibrationError,
    CalibrationExpired,
    CalibrationMismatch,
    CalibrationMissing,
    Quantity,
    Source,
    default_validity,
    digest_arrays,
    require_plain_name,
)
from capture.calibration.validity import CalibrationDrift, measure_drift, require_valid
from capture.former_names import FORMER_KINDS, FORMER_NAMES, translate_names

__all__ = [
    "CALIBRATION_KINDS",
    "SCHEMA",
    "Calibration",
    "CalibrationDamaged",
    "CalibrationDrift",
    "CalibrationError",
    "CalibrationExpired",
    "CalibrationMismatch",
    "CalibrationMissing",
    "Quantity",
    "Source",
    "default_validity",
    "digest_arrays",
    "load",
    "measure_drift",
    "require_valid",
    "save",
]

SCHEMA = "skinrig.calibration/2"
READABLE_SCHEMAS = (SCHEMA, "skinrig.calibration/1")

Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class _QuantityFile(_Strict):
    shape: list[Annotated[int, Field(ge=0)]]
    value: list[Finite]
    stderr: list[Annotated[Finite, Field(ge=0)]] | None
    interval: list[Finite | None] | None


class _MapFile(_Strict):
    file: str
    sha256: str
    shape: list[Annotated[int, Field(ge=1)]]


class _CalibrationFile(_Strict):
    schema_: Literal["skinrig.calibration/2", "skinrig.calibration/1"] = Field(alias="schema")
    kind: str
    rig: str
    serials: list[str]
    created: str
    valid_until: str
    source: Source
    values: dict[str, dict[str, _QuantityFile]]
    maps: dict[str, _MapFile]
    notes: dict[str, str]
    inputs: dict[str, str]
    versions: dict[str, str]
    sha256: str


def save(calibration: Calibration, directory: str | Path) -> Path:
    """Write a calibration as ``<directory>/<kind>.json`` (and its maps), replacing an older one.

    The JSON file appears whole or not at all: maps are written first under names made of their
    digests, then the JSON is renamed into place, then unused maps are removed.

    Parameters
    ----------
    calibration : Calibration
        Calibration to write.
    directory : str or Path
        Created if missing.

    Returns
    -------
    Path
        The JSON file.
    """
    folder = Path(directory)
    fresh = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    before = set(folder.iterdir())
    try:
        return _write(calibration, folder)
    except BaseException:
        with contextlib.suppress(OSError):
            for made in set(folder.glob(f"{calibration.kind}-*.exr")) - before:
                made.unlink()
            if fresh:
                folder.rmdir()
        raise


def _write(calibration: Calibration, folder: Path) -> Path:
    maps = {
        name: _write_map(folder, f"{calibration.kind}-{name}", image)
        for name, image in sorted(calibration.maps.items())
    }
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "kind": calibration.kind,
        "rig": calibration.rig,
        "serials": list(calibration.serials),
        "created": calibration.created.isoformat(),
        "valid_until": calibration.valid_until.isoformat(),
        "source": calibration.source,
        "values": {
            serial: {name: _quantity_document(q) for name, q in sorted(quantities.items())}
            for serial, quantities in sorted(calibration.values.items())
        },
        "maps": maps,
        "notes": dict(sorted(calibration.notes.items())),
        "inputs": dict(sorted(calibration.inputs.items())),
        "versions": dict(sorted(calibration.versions.items())),
    }
    document["sha256"] = _seal(document)
    path = folder / f"{calibration.kind}.json"
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    _write_atomically(path, text.encode())
    kept = {entry["file"] for entry in maps.values()}
    for stale in folder.glob(f"{calibration.kind}-*.exr"):
        if stale.name not in kept:
            stale.unlink()
    return path


def load(directory: str | Path, kind: str) -> Calibration:
    """Read the calibration of one kind from a CALIBRATION/ folder.

    Parameters
    ----------
    directory : str or Path
        The folder.
    kind : str
        One of `CALIBRATION_KINDS`.

    Returns
    -------
    Calibration

    Raises
    ------
    CalibrationMissing
        If the file does not exist.
    CalibrationDamaged
        If the file is not of this schema, or it or one of its maps was altered.
    """
    if kind not in CALIBRATION_KINDS:
        raise ValueError(f"kind: got {kind!r}, expected one of {CALIBRATION_KINDS}")
    folder = Path(directory)
    path = folder / f"{kind}.json"
    former = folder / f"{FORMER_KINDS.get(kind, kind)}.json"
    try:
        raw = (path if path.exists() else former).read_bytes()
    except OSError as exc:
        raise CalibrationMissing(
            f"{path}: no {kind} calibration there ({exc.strerror}); make one with"
            f" `skinrig calibrate {kind} SESSION --out {shlex.quote(str(folder))}` [SR-CAL-013]"
        ) from exc
    document = _parse(path, raw)
    if FORMER_NAMES.get(document.kind, document.kind) != kind:
        raise CalibrationMismatch(
            f"{path}: contains kind {document.kind!r}, expected {kind!r}; "
            "rename the file or calibrate again"
        )
    try:
        return Calibration(
            kind=kind,
            rig=document.rig,
            serials=tuple(document.serials),
            created=date.fromisoformat(document.created),
            valid_until=date.fromisoformat(document.valid_until),
            source=document.source,
            values={
                serial: {
                    FORMER_NAMES.get(name, name): _quantity_from(q)
                    for name, q in quantities.items()
                }
                for serial, quantities in document.values.items()
            },
            maps={name: _read_map(folder, name, m) for name, m in document.maps.items()},
            notes=translate_names(document.notes),
            inputs=document.inputs,
            versions=document.versions,
        )
    except CalibrationError:
        raise
    except ValueError as exc:
        raise CalibrationDamaged(f"{path}: {exc}; calibrate again") from exc


def _quantity_document(quantity: Quantity) -> dict[str, Any]:
    return {
        "shape": list(quantity.value.shape),
        "value": quantity.value.ravel().tolist(),
        "stderr": None if quantity.stderr is None else quantity.stderr.ravel().tolist(),
        "interval": None if quantity.interval is None else list(quantity.interval),
    }


def _quantity_from(document: _QuantityFile) -> Quantity:
    if math.prod(document.shape) != len(document.value):
        raise ValueError(f"got {len(document.value)} numbers for shape {document.shape}")
    value = np.array(document.value, dtype=np.float64).reshape(document.shape)
    stderr = None
    if document.stderr is not None:
        stderr = np.array(document.stderr, dtype=np.float64).reshape(document.shape)
    interval = None
    if document.interval is not None:
        if len(document.interval) != 2:
            raise ValueError(f"got an interval of {len(document.interval)} ends, expected 2")
        interval = (document.interval[0], document.interval[1])
    return Quantity(value, stderr, interval)


def _seal(document: Mapping[str, Any]) -> str:
    """Return the digest of a document without its own seal, in canonical JSON."""
    body = {key: value for key, value in document.items() if key != "sha256"}
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _parse(path: Path, raw: bytes) -> _CalibrationFile:
    try:
        document = json.loads(raw.decode("utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as exc:
        raise CalibrationDamaged(f"{path}: not JSON ({exc}); calibrate again") from exc
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema not in READABLE_SCHEMAS:
        raise CalibrationDamaged(
            f"{path}: got schema {schema!r}, expected {SCHEMA!r} or older; calibrate again or use"
            " the version that wrote it"
        )
    if document.get("sha256") != _seal(document):
        raise CalibrationDamaged(
            f"{path}: its content does not match its seal, so it was altered after it was written;"
            " restore it or calibrate again [SR-CAL-014]"
        )
    try:
        return _CalibrationFile.model_validate_json(raw)
    except ValidationError as exc:
        faults = "; ".join(
            f"{'.'.join(str(p) for p in e['loc'])}: {e['msg']}" for e in exc.errors()
        )
        raise CalibrationDamaged(f"{path}: {faults}; calibrate again") from exc


def _write_atomically(path: Path, data: bytes) -> None:
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(part, path)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _write_map(folder: Path, stem: str, image: Float32Array) -> dict[str, Any]:
    import OpenEXR

    pixels = np.ascontiguousarray(image, dtype=np.float32)
    if pixels.ndim not in (2, 3):
        raise ValueError(f"map {stem}: got shape {pixels.shape}, expected (H, W) or (H, W, C)")
    planes = pixels[..., None] if pixels.ndim == 2 else pixels
    digest = hashlib.sha256(pixels.tobytes()).hexdigest()
    path = folder / f"{stem}-{digest[:16]}.exr"
    part = path.with_name(path.name + ".part.exr")
    channels = {f"c{i}": np.ascontiguousarray(planes[..., i]) for i in range(planes.shape[2])}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        OpenEXR.File(header, channels).write(str(part))
        os.replace(part, path)
    except RuntimeError as error:  # the library's error for a full disk
        with contextlib.suppress(OSError):
            part.unlink()
        raise CalibrationError(
            f"{path}: cannot be written ({error}); free space, or name another disk, then run the "
            "command again"
        ) from error
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise
    return {"file": path.name, "sha256": digest, "shape": list(pixels.shape)}


def _read_map(folder: Path, name: str, entry: _MapFile) -> Float32Array:
    import OpenEXR

    require_plain_name(name)
    if Path(entry.file).name != entry.file:
        raise CalibrationDamaged(f"map {name}: file {entry.file!r} is outside the folder")
    path = folder / entry.file
    if not path.is_file():
        raise CalibrationDamaged(f"{path}: missing, map {name!r} needs it; calibrate again")
    try:
        # the library prints what it cannot read, on stdout, and goes on
        with (
            contextlib.redirect_stdout(io.StringIO()),
            OpenEXR.File(str(path), separate_channels=True) as stream,
        ):
            channels = stream.channels()
            count = entry.shape[2] if len(entry.shape) == 3 else 1
            planes = [np.array(channels[f"c{i}"].pixels, dtype=np.float32) for i in range(count)]
        image = np.stack(planes, axis=-1).reshape(entry.shape)
    except (OSError, RuntimeError, KeyError, ValueError) as exc:
        raise CalibrationDamaged(f"{path}: cannot be read ({exc}); calibrate again") from exc
    if hashlib.sha256(np.ascontiguousarray(image).tobytes()).hexdigest() != entry.sha256:
        raise CalibrationDamaged(f"{path}: pixels do not match their digest; calibrate again")
    return image
