"""The CALIBRATION/ format ``skinrig.calibration/1``: what is known of the instruments, until when.

One JSON file per kind (``sensor.json``, ``color.json``, ...), written atomically and sealed with a
digest of its own content; images that belong to it (a white reference) are float32 EXR files
beside it, named by their digest. Numbers are keyed by the serial of the camera they belong to.
"""

import contextlib
import hashlib
import json
import logging
import math
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import date, timedelta
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from capture.documents import InputError

__all__ = [
    "KINDS",
    "SCHEMA",
    "Calibration",
    "CalibrationDamaged",
    "CalibrationError",
    "CalibrationExpired",
    "CalibrationMismatch",
    "CalibrationMissing",
    "Drift",
    "Quantity",
    "default_validity",
    "digest_arrays",
    "drift",
    "load",
    "require",
    "save",
]

logger = logging.getLogger(__name__)

SCHEMA = "skinrig.calibration/1"
KINDS = ("sensor", "color", "polarization", "white", "geometry", "lights", "fibre")
DEFAULT_VALIDITY_DAYS = 90

Source: TypeAlias = Literal["measured", "simulated"]


class CalibrationError(InputError):
    """A calibration that cannot be used; the message says why and what to do."""


class CalibrationMissing(CalibrationError, FileNotFoundError):
    """The folder holds no calibration of this kind."""


class CalibrationDamaged(CalibrationError):
    """The file is not a calibration of this schema, or was altered after it was written."""


class CalibrationExpired(CalibrationError):
    """The calibration is used after (or before) the dates it holds for."""


class CalibrationMismatch(CalibrationError):
    """The calibration belongs to another rig, another device or another kind."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """One calibrated number or array with its standard error.

    Attributes
    ----------
    value : ndarray of float64
        Any shape; a scalar has shape ``()``. Unit: see the quantity's name.
    stderr : ndarray of float64 or None
        Standard error (68 %) of each element; None where the quantity is a choice or a count, not
        a measurement.
    interval : tuple of (float or None, float or None) or None
        95 % interval of a scalar whose distribution is not symmetric; an open end is None.
    """

    value: NDArray[np.float64]
    stderr: NDArray[np.float64] | None = None
    interval: tuple[float | None, float | None] | None = None

    def __post_init__(self) -> None:
        """Convert to float64 arrays and refuse what is not finite or not of one shape."""
        value = np.array(self.value, dtype=np.float64)
        if not np.isfinite(value).all():
            raise ValueError(f"Quantity.value: got {value.tolist()}, expected finite numbers")
        object.__setattr__(self, "value", value)
        if self.stderr is None:
            return
        stderr = np.array(self.stderr, dtype=np.float64)
        if stderr.shape != value.shape or not np.isfinite(stderr).all() or (stderr < 0).any():
            raise ValueError(
                f"Quantity.stderr: got {stderr.tolist()}, expected finite numbers >= 0 of shape"
                f" {value.shape}"
            )
        object.__setattr__(self, "stderr", stderr)


@dataclass(frozen=True, slots=True)
class Calibration:
    """What one calibration run found, for whom, and until when.

    Attributes
    ----------
    kind : str
        One of `KINDS`.
    rig : str
        Name of the rig it was made on.
    serials : tuple of str
        Serials of the devices it holds for.
    created, valid_until : datetime.date
        First and last day on which it may be used.
    source : {"measured", "simulated"}
        Whether the frames came from instruments or from a simulation.
    values : mapping of str to mapping of str to Quantity
        ``values[serial][name]``.
    maps : mapping of str to ndarray of float32, shape (H, W) or (H, W, C)
        Images, by name; may be empty.
    notes : mapping of str to str
        Words that belong to the numbers: color names, the reference used, the method.
    inputs : mapping of str to str
        Digest of every frame that went in, by step or file name.
    versions : mapping of str to str
        Versions of the programs that made it.
    """

    kind: str
    rig: str
    serials: tuple[str, ...]
    created: date
    valid_until: date
    source: Source
    values: Mapping[str, Mapping[str, Quantity]]
    maps: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    notes: Mapping[str, str] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the fields against each other."""
        if self.kind not in KINDS:
            raise ValueError(f"Calibration.kind: got {self.kind!r}, expected one of {KINDS}")
        if not self.serials:
            raise ValueError("Calibration.serials: got none, expected at least one device serial")
        if self.source not in ("measured", "simulated"):
            raise ValueError(
                f"Calibration.source: got {self.source!r}, expected 'measured' or 'simulated'"
            )
        if self.valid_until < self.created:
            raise ValueError(
                f"Calibration.valid_until: got {self.valid_until}, expected not before created"
                f" ({self.created})"
            )
        unknown = sorted(set(self.values) - set(self.serials))
        if unknown:
            raise ValueError(
                f"Calibration.values: got values of {unknown}, expected only of {self.serials}"
            )
        for name in self.maps:
            _require_plain_name(name)

    def quantity(self, serial: str, name: str) -> Quantity:
        """Return one quantity of one device.

        Raises
        ------
        CalibrationMismatch
            If this calibration does not hold it.
        """
        if serial not in self.values:
            raise CalibrationMismatch(
                f"{self.kind} calibration of rig {self.rig!r}: no values of device {serial!r}, it"
                f" holds {sorted(self.values)}; calibrate this device"
            )
        if name not in self.values[serial]:
            raise CalibrationMismatch(
                f"{self.kind} calibration of rig {self.rig!r}: no {name!r} of device {serial!r}, it"
                f" holds {sorted(self.values[serial])}; calibrate again with this version"
            )
        return self.values[serial][name]


@dataclass(frozen=True, slots=True)
class Drift:
    """How one number moved between two calibrations.

    Attributes
    ----------
    serial, name : str
        Device and quantity; elements of arrays are written ``name[i]``.
    old, new, change : float
        In the quantity's unit; ``change = new - old``.
    sigmas : float or None
        Change over its combined standard error; None where neither calibration states one.
    """

    serial: str
    name: str
    old: float
    new: float
    change: float
    sigmas: float | None

    def __str__(self) -> str:
        """Return one line for a terminal."""
        size = "no stated error" if self.sigmas is None else f"{self.sigmas:+.1f} sigma"
        return f"{self.serial} {self.name}: {self.old:.6g} -> {self.new:.6g} ({size})"


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
    schema_: Literal["skinrig.calibration/1"] = Field(alias="schema")
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


def digest_arrays(*arrays: NDArray[Any]) -> str:
    """Return a digest of arrays' bytes, shapes and types, to name a calibration's inputs.

    Parameters
    ----------
    *arrays : ndarray
        Any shape and type.

    Returns
    -------
    str
        ``sha256:`` and 64 hexadecimal digits.

    Examples
    --------
    >>> digest_arrays(np.zeros(3)) == digest_arrays(np.zeros(3))
    True
    >>> digest_arrays(np.zeros(3)) == digest_arrays(np.zeros((3, 1)))
    False
    """
    state = hashlib.sha256()
    for array in arrays:
        state.update(f"{array.dtype.str}{array.shape}".encode())
        state.update(np.ascontiguousarray(array).tobytes())
    return f"sha256:{state.hexdigest()}"


def default_validity(created: date, days: int = DEFAULT_VALIDITY_DAYS) -> date:
    """Return the last day of validity of a calibration made on `created`.

    Examples
    --------
    >>> default_validity(date(2026, 11, 21), days=9)
    datetime.date(2026, 11, 30)
    """
    if days < 0:
        raise ValueError(f"days: got {days}, expected >= 0")
    return created + timedelta(days=days)


def save(calibration: Calibration, directory: str | Path) -> Path:
    """Write a calibration as ``<directory>/<kind>.json`` (and its maps), replacing an older one.

    The JSON file appears whole or not at all: maps are written first under names made of their
    digests, then the JSON is renamed into place, then maps nobody names any more are removed.

    Parameters
    ----------
    calibration : Calibration
        What to write.
    directory : str or Path
        Made if missing.

    Returns
    -------
    Path
        The JSON file.
    """
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
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
        One of `KINDS`.

    Returns
    -------
    Calibration

    Raises
    ------
    CalibrationMissing
        If there is no such file.
    CalibrationDamaged
        If the file is not of this schema, or it or one of its maps was altered.
    """
    if kind not in KINDS:
        raise ValueError(f"kind: got {kind!r}, expected one of {KINDS}")
    folder = Path(directory)
    path = folder / f"{kind}.json"
    try:
        raw = path.read_bytes()
    except OSError as exc:
        raise CalibrationMissing(
            f"{path}: no {kind} calibration there ({exc.strerror}); make one with"
            f" `skinrig calibrate {kind} SESSION --out {folder}`"
        ) from exc
    document = _parse(path, raw)
    if document.kind != kind:
        raise CalibrationMismatch(f"{path}: holds kind {document.kind!r}, expected {kind!r}")
    try:
        return Calibration(
            kind=document.kind,
            rig=document.rig,
            serials=tuple(document.serials),
            created=date.fromisoformat(document.created),
            valid_until=date.fromisoformat(document.valid_until),
            source=document.source,
            values={
                serial: {name: _quantity_from(q) for name, q in quantities.items()}
                for serial, quantities in document.values.items()
            },
            maps={name: _read_map(folder, name, m) for name, m in document.maps.items()},
            notes=document.notes,
            inputs=document.inputs,
            versions=document.versions,
        )
    except CalibrationError:
        raise
    except ValueError as exc:
        raise CalibrationDamaged(f"{path}: {exc}; calibrate again") from exc


def require(
    calibration: Calibration,
    *,
    rig: str,
    serials: Iterable[str],
    on_date: date,
    kind: str | None = None,
) -> Calibration:
    """Return the calibration if it may be used here and today; say clearly why not otherwise.

    Parameters
    ----------
    calibration : Calibration
        The candidate.
    rig : str
        Name of the rig of the session to be corrected.
    serials : iterable of str
        Serials of the devices that made the session's frames.
    on_date : datetime.date
        Day of the session.
    kind : str, optional
        The kind wanted.

    Raises
    ------
    CalibrationMismatch
        If it belongs to another rig or another device, or is of another kind.
    CalibrationExpired
        If `on_date` lies outside its validity.
    """
    what = f"{calibration.kind} calibration of {calibration.created}"
    if kind is not None and calibration.kind != kind:
        raise CalibrationMismatch(f"{what}: is of kind {calibration.kind!r}, expected {kind!r}")
    if calibration.rig != rig:
        raise CalibrationMismatch(
            f"{what}: made on rig {calibration.rig!r}, the session is of rig {rig!r}; calibrate"
            f" rig {rig!r} and give its folder by --calibration"
        )
    missing = sorted(set(serials) - set(calibration.serials))
    if missing:
        raise CalibrationMismatch(
            f"{what}: made with devices {sorted(calibration.serials)}, the session used"
            f" {missing}; calibrate these devices"
        )
    if not calibration.created <= on_date <= calibration.valid_until:
        raise CalibrationExpired(
            f"{what}: valid from {calibration.created} to {calibration.valid_until}, the session"
            f" is of {on_date}; run `skinrig calibrate {calibration.kind}` on frames of that time"
        )
    return calibration


def drift(old: Calibration, new: Calibration) -> tuple[Drift, ...]:
    """Compare two calibrations of one kind, number by number, largest change first.

    Parameters
    ----------
    old, new : Calibration
        Of the same kind and rig. Only quantities with the same shape in both are compared.

    Returns
    -------
    tuple of Drift
        Sorted by the size of ``sigmas``; those without stated errors come last.

    Raises
    ------
    CalibrationMismatch
        If the two are not of one kind and one rig.
    """
    if (old.kind, old.rig) != (new.kind, new.rig):
        raise CalibrationMismatch(
            f"drift: got {old.kind!r} of rig {old.rig!r} and {new.kind!r} of rig {new.rig!r},"
            " expected two of one kind and one rig"
        )
    rows: list[Drift] = []
    for serial in sorted(set(old.values) & set(new.values)):
        for name in sorted(set(old.values[serial]) & set(new.values[serial])):
            a, b = old.values[serial][name], new.values[serial][name]
            if a.value.shape != b.value.shape:
                continue
            error = np.zeros(a.value.shape)
            for q in (a, b):
                if q.stderr is not None:
                    error = np.hypot(error, q.stderr)
            for index in np.ndindex(a.value.shape):
                change = float(b.value[index] - a.value[index])
                label = name + "".join(f"[{i}]" for i in index)
                sigmas = change / float(error[index]) if error[index] > 0 else None
                rows.append(
                    Drift(
                        serial, label, float(a.value[index]), float(b.value[index]), change, sigmas
                    )
                )
    return tuple(
        sorted(rows, key=lambda r: -1.0 if r.sigmas is None else abs(r.sigmas), reverse=True)
    )


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
    """Digest of a document without its own seal, in canonical JSON."""
    body = {key: value for key, value in document.items() if key != "sha256"}
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _parse(path: Path, raw: bytes) -> _CalibrationFile:
    try:
        document = json.loads(raw.decode("utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as exc:
        raise CalibrationDamaged(f"{path}: not JSON ({exc}); calibrate again") from exc
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema != SCHEMA:
        raise CalibrationDamaged(
            f"{path}: schema is {schema!r}, this version reads {SCHEMA!r}; calibrate again or use"
            " the version that wrote it"
        )
    if document.get("sha256") != _seal(document):
        raise CalibrationDamaged(
            f"{path}: its content does not match its seal, so it was altered after it was written;"
            " restore it or calibrate again"
        )
    try:
        return _CalibrationFile.model_validate_json(raw)
    except ValidationError as exc:
        faults = "; ".join(
            f"{'.'.join(str(p) for p in e['loc'])}: {e['msg']}" for e in exc.errors()
        )
        raise CalibrationDamaged(f"{path}: {faults}; calibrate again") from exc


def _require_plain_name(name: str) -> None:
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,40}", name):
        raise ValueError(f"map name: got {name!r}, expected small letters, digits and _")


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


def _write_map(folder: Path, stem: str, image: NDArray[np.float32]) -> dict[str, Any]:
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
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise
    return {"file": path.name, "sha256": digest, "shape": list(pixels.shape)}


def _read_map(folder: Path, name: str, entry: _MapFile) -> NDArray[np.float32]:
    import OpenEXR

    _require_plain_name(name)
    if Path(entry.file).name != entry.file:
        raise CalibrationDamaged(f"map {name}: file {entry.file!r} leaves the folder")
    path = folder / entry.file
    if not path.is_file():
        raise CalibrationDamaged(f"{path}: missing, map {name!r} needs it; calibrate again")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as stream:
            channels = stream.channels()
            count = entry.shape[2] if len(entry.shape) == 3 else 1
            planes = [np.array(channels[f"c{i}"].pixels, dtype=np.float32) for i in range(count)]
        image = np.stack(planes, axis=-1).reshape(entry.shape)
    except (OSError, RuntimeError, KeyError, ValueError) as exc:
        raise CalibrationDamaged(f"{path}: cannot be read ({exc}); calibrate again") from exc
    if hashlib.sha256(np.ascontiguousarray(image).tobytes()).hexdigest() != entry.sha256:
        raise CalibrationDamaged(f"{path}: pixels do not match their digest; calibrate again")
    return image
