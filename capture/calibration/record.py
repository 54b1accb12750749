"""Calibrations in memory: quantities with errors, devices, and validity."""

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date, timedelta
from typing import Any, Literal, NotRequired, TypeAlias, TypedDict, Unpack, cast

import numpy as np
from numpy.typing import NDArray

from capture.arrays import Float32Array, Float64Array
from capture.documents import InputError


def freeze_arrays(
    row: Any, shape: tuple[int, ...], *names: str, kind: Any = np.float64, owner: str = ""
) -> None:
    """Replace fields by read-only copies of the type; reject another shape or infinite numbers.

    A field that is None becomes zeros.
    """
    for name in names:
        given = getattr(row, name)
        array = np.array(np.zeros(shape) if given is None else given, dtype=kind)
        if array.shape != shape or not np.isfinite(array).all():
            raise ValueError(
                f"{type(row).__name__}.{name}: got shape {array.shape}, expected finite numbers of"
                f" shape {shape}{owner}"
            )
        array.setflags(write=False)
        object.__setattr__(row, name, array)


CALIBRATION_KINDS = (
    "sensor",
    "color",
    "polarization",
    "white",
    "geometry",
    "lights",
    "fiber",
    "scanner",
)
DEFAULT_VALIDITY_DAYS = 90

Source: TypeAlias = Literal["measured", "simulated"]


class CalibrationError(InputError):
    """Raised for a calibration that cannot be used; the message states the remedy."""


class CalibrationMissing(CalibrationError, FileNotFoundError):
    """Raised when the folder has no calibration of this kind."""


class CalibrationDamaged(CalibrationError):
    """Raised for a file of another schema, or one that was altered after it was written."""


class CalibrationExpired(CalibrationError):
    """Raised for a calibration that is used outside its dates of validity."""


class CalibrationMismatch(CalibrationError):
    """Raised for a calibration of another rig, another device or another kind."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """One calibrated number or array with its standard error.

    Attributes
    ----------
    value : ndarray of float64
        Any shape; a scalar has shape ``()``. Unit: see the quantity's name.
    stderr : ndarray of float64 or None
        Standard error (68 %) of each element; None for a choice or a count, which is not measured.
    interval : tuple of (float or None, float or None) or None
        95 % interval of a scalar whose distribution is not symmetric; an open end is None.
    """

    value: Float64Array
    stderr: Float64Array | None = None
    interval: tuple[float | None, float | None] | None = None

    def __post_init__(self) -> None:
        """Convert to float64 arrays and reject infinite values or differing shapes."""
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

    @property
    def stderr_or_zero(self) -> Float64Array:
        """Standard errors of the value's shape; 0 where none is stated."""
        return np.zeros_like(self.value) if self.stderr is None else self.stderr


@dataclass(frozen=True, slots=True)
class Calibration:
    """Result of one calibration run, with its devices and validity.

    Attributes
    ----------
    kind : str
        One of `CALIBRATION_KINDS`.
    rig : str
        Name of the calibrated rig.
    serials : tuple of str
        Serials of the calibrated devices.
    created, valid_until : datetime.date
        First and last day on which it may be used.
    source : {"measured", "simulated"}
        Whether the frames were measured or simulated.
    values : mapping of str to mapping of str to Quantity
        ``values[serial][name]``.
    maps : mapping of str to ndarray of float32, shape (H, W) or (H, W, C)
        Images, by name; may be empty.
    notes : mapping of str to str
        Texts that belong to the numbers: color names, the reference used, the method.
    inputs : mapping of str to str
        Digest of every input frame, by step or file name.
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
    maps: Mapping[str, Float32Array] = field(default_factory=dict)
    notes: Mapping[str, str] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the fields against each other."""
        if self.kind not in CALIBRATION_KINDS:
            raise ValueError(
                f"Calibration.kind: got {self.kind!r}, expected one of {CALIBRATION_KINDS}"
            )
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
            require_plain_name(name)

    def quantity(self, serial: str, name: str) -> Quantity:
        """Return one quantity of one device.

        Raises
        ------
        CalibrationMismatch
            If this calibration does not contain it.
        """
        if serial not in self.values:
            raise CalibrationMismatch(
                f"{self.kind} calibration of rig {self.rig!r}: no values of device {serial!r}, "
                f"it contains {sorted(self.values)}; calibrate this device"
            )
        if name not in self.values[serial]:
            raise CalibrationMismatch(
                f"{self.kind} calibration of rig {self.rig!r}: no {name!r} of device "
                f"{serial!r}, it contains {sorted(self.values[serial])}; calibrate again with "
                "this version"
            )
        return self.values[serial][name]


class Origin(TypedDict):
    """Rig, dates and inputs of a calibration."""

    rig: str
    source: Source
    created: date
    valid_until: NotRequired[date | None]
    """Default: `DEFAULT_VALIDITY_DAYS` after `created`."""
    notes: NotRequired[Mapping[str, str] | None]
    inputs: NotRequired[Mapping[str, str] | None]
    versions: NotRequired[Mapping[str, str] | None]


class Provenance(Origin):
    """Rig, dates and inputs of the calibration of one device."""

    serial: str


def make_device_calibration(
    kind: str,
    values: Mapping[str, Mapping[str, Quantity]],
    meaning: Mapping[str, str],
    *,
    maps: Mapping[str, Float32Array] | None = None,
    **about: Unpack[Origin],
) -> Calibration:
    """Return the `Calibration` of some devices.

    Parameters
    ----------
    kind, values, maps
        As in `Calibration`.
    meaning
        Notes that belong to every calibration of this kind.
    **about
        See `Origin`; its notes are added.
    """
    return Calibration(
        kind=kind,
        rig=about["rig"],
        serials=tuple(values),
        created=about["created"],
        valid_until=about.get("valid_until") or default_validity(about["created"]),
        source=about["source"],
        values=values,
        maps=maps or {},
        notes={**meaning, **(about.get("notes") or {})},
        inputs=dict(about.get("inputs") or {}),
        versions=dict(about.get("versions") or {}),
    )


def make_single_device_calibration(
    kind: str,
    values: Mapping[str, Quantity],
    meaning: Mapping[str, str],
    *,
    maps: Mapping[str, Float32Array] | None = None,
    **about: Unpack[Provenance],
) -> Calibration:
    """Return the `Calibration` of one device; see `make_device_calibration`."""
    origin = cast(Origin, {key: word for key, word in about.items() if key != "serial"})
    return make_device_calibration(kind, {about["serial"]: values}, meaning, maps=maps, **origin)


Column: TypeAlias = NDArray[Any] | tuple[NDArray[Any], NDArray[Any]]


def device_rows(names: Sequence[str], **columns: Column) -> dict[str, dict[str, Quantity]]:
    """Return the quantities of devices, by device, from a column of each quantity.

    Parameters
    ----------
    names : sequence of N str
        Names of the devices.
    **columns : ndarray, shape (N, ...), or a pair of them
        The values by device, alone or with their standard errors.

    Examples
    --------
    >>> device_rows(["a", "b"], gain=np.array([1.0, 2.0]))["b"]["gain"].value.tolist()
    2.0
    """
    parts = {key: c if isinstance(c, tuple) else (c,) for key, c in columns.items()}
    return {
        name: {key: Quantity(*(part[k] for part in column)) for key, column in parts.items()}
        for k, name in enumerate(names)
    }


class DeviceColumns:
    """The quantities of devices of a calibration, by column; see `device_rows`."""

    def __init__(self, calibration: Calibration, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self._calibration = calibration

    def values(self, name: str) -> Float64Array:
        """Return the values of a quantity, shape (N, ...)."""
        return np.array([self._calibration.quantity(n, name).value for n in self.names])

    def flags(self, name: str) -> NDArray[np.bool_]:
        """Return a yes-or-no quantity as bool, shape (N, ...)."""
        return np.asarray(self.values(name) > 0)

    def errors(self, name: str) -> Float64Array:
        """Return the standard errors of a quantity, shape (N, ...); 0 for a quantity without."""
        return np.array([self._calibration.quantity(n, name).stderr_or_zero for n in self.names])

    def values_and_errors(self, name: str) -> tuple[Float64Array, Float64Array]:
        """Return the values of a quantity and their standard errors."""
        return self.values(name), self.errors(name)


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


def require_plain_name(name: str) -> None:
    """Raise ValueError unless a name is valid in a file name."""
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,40}", name):
        raise ValueError(f"map name: got {name!r}, expected small letters, digits and _")
