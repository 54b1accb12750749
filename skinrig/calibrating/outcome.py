"""What the calibrations of all rigs share: results, provenance, the camera's sensor."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from capture.calibration import sensor, store
from capture.calibration.sensor.noise_model import SensorCalibration
from capture.calibration.sensor.transfer_curve import FlatPair
from capture.raw import RawFrame
from capture.session import Session
from skinrig.arrays import UInt16Array


class CalibratingError(ValueError):
    """Sessions that do not hold what a calibration needs."""


@dataclass(frozen=True, slots=True)
class Made:
    """A calibration and what to say of it."""

    calibration: store.Calibration
    summary: tuple[tuple[str, str], ...]
    """Quantity and value with standard error."""
    findings: tuple[str, ...] = ()
    """What is wrong with the rig."""


def provenance(sessions: Sequence[Session], created: date) -> dict[str, Any]:
    """Return rig, source, date and inputs of a calibration from sessions of one rig."""
    return {
        "rig": sessions[0].rig.name,
        "source": sessions[0].source,
        "created": created,
        "inputs": {session.id: session.content_hash for session in sessions},
    }


def numbered(findings: Iterable[str]) -> Mapping[str, str]:
    """Return findings as notes of a calibration.

    Examples
    --------
    >>> numbered(["light L007 is dead"])
    {'finding 0': 'light L007 is dead'}
    """
    return {f"finding {k}": text for k, text in enumerate(findings)}


def sensor_in(folder: Path, session: Session, created: date) -> SensorCalibration | None:
    """Return the sensor calibration in a folder of a session's first camera; None: it has none."""
    serial = session.rig.views[0].serial
    try:
        found = store.load(folder, "sensor")
        store.require(found, rig=session.rig.name, serials=[serial], on_date=created, kind="sensor")
    except store.CalibrationMissing:
        return None
    return SensorCalibration.from_calibration(found, serial)


def photon_transfer(
    flats: Sequence[tuple[float, RawFrame]], darks: Sequence[tuple[float, RawFrame]]
) -> SensorCalibration:
    """Return a sensor's calibration from flat frames with their light and darks with their time.

    Parameters
    ----------
    flats
        Light, any unit, and frame; of equal light each two follow each other as a pair.
    darks
        Exposure time, s, and frame.
    """
    by_light: dict[float, list[UInt16Array]] = defaultdict(list)
    for light, frame in flats:
        by_light[light].append(frame.cfa)
    pairs = [
        FlatPair(cfas[k], cfas[k + 1], light)
        for light, cfas in sorted(by_light.items())
        for k in range(0, len(cfas) - 1, 2)
    ]
    first = flats[0][1]
    return sensor.photon_transfer(
        pairs,
        [frame.cfa for _, frame in darks],
        white_dn=first.white,
        pattern=first.pattern,
        dark_exposures_s=[seconds for seconds, _ in darks],
        block=max(4, min(16, min(first.cfa.shape) // 32)),
    )
