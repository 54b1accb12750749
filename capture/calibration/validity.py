"""Check whether a calibration is valid for a rig and a day, and measure its drift."""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import date

import numpy as np

from capture.calibration.record import Calibration, CalibrationExpired, CalibrationMismatch


@dataclass(frozen=True, slots=True)
class CalibrationDrift:
    """Change of one number between two calibrations.

    Attributes
    ----------
    serial, name : str
        Device and quantity; elements of arrays are written ``name[i]``.
    old, new, change : float
        In the quantity's unit; ``change = new - old``.
    sigmas : float or None
        Change over its combined standard error; None when neither calibration states one.
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


def require_valid(
    calibration: Calibration,
    *,
    rig: str,
    serials: Iterable[str],
    on_date: date,
    kind: str | None = None,
) -> Calibration:
    """Return the calibration if it is valid for rig, devices and day; raise an error otherwise.

    Parameters
    ----------
    calibration : Calibration
        Calibration to check.
    rig : str
        Name of the rig of the session to be corrected.
    serials : iterable of str
        Serials of the devices that made the session's frames.
    on_date : datetime.date
        Day of the session.
    kind : str, optional
        Required kind.

    Raises
    ------
    CalibrationMismatch
        If it belongs to another rig or another device, or is of another kind.
    CalibrationExpired
        If `on_date` is outside its validity.
    """
    what = f"{calibration.kind} calibration of {calibration.created}"
    if kind is not None and calibration.kind != kind:
        raise CalibrationMismatch(
            f"{what}: is of kind {calibration.kind!r}, expected {kind!r}; "
            "choose the folder of that kind"
        )
    if calibration.rig != rig:
        raise CalibrationMismatch(
            f"{what}: made on rig {calibration.rig!r}, the session is of rig {rig!r}; calibrate"
            f" rig {rig!r} and give its folder by --calibration [SR-CAL-005]"
        )
    missing = sorted(set(serials) - set(calibration.serials))
    if missing:
        raise CalibrationMismatch(
            f"{what}: made with devices {sorted(calibration.serials)}, the session used"
            f" {missing}; calibrate these devices [SR-CAL-006]"
        )
    if not calibration.created <= on_date <= calibration.valid_until:
        raise CalibrationExpired(
            f"{what}: valid from {calibration.created} to {calibration.valid_until}, the session"
            f" is of {on_date}; run `skinrig calibrate {calibration.kind}` on frames of that time"
            " [SR-CAL-007]"
        )
    return calibration


def measure_drift(old: Calibration, new: Calibration) -> tuple[CalibrationDrift, ...]:
    """Compare two calibrations of one kind, number by number, largest change first.

    Parameters
    ----------
    old, new : Calibration
        Two calibrations of one kind and rig. Only quantities with the same shape in both are
        compared.

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
    rows: list[CalibrationDrift] = []
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
                    CalibrationDrift(
                        serial, label, float(a.value[index]), float(b.value[index]), change, sigmas
                    )
                )
    return tuple(
        sorted(rows, key=lambda r: -1.0 if r.sigmas is None else abs(r.sigmas), reverse=True)
    )
