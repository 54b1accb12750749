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
from capture.rig import Rig
from capture.session import FrameRecord, Session
from skinrig.arrays import UInt16Array


class CalibratingError(ValueError):
    """Sessions that do not hold what a calibration needs."""


@dataclass(frozen=True, slots=True)
class CalibrationResult:
    """A calibration and what to say of it."""

    calibration: store.Calibration
    summary: tuple[tuple[str, str], ...]
    """Quantity and value with standard error."""
    findings: tuple[str, ...] = ()
    """What is wrong with the rig."""


@dataclass(frozen=True, slots=True)
class TargetSessions:
    """Sessions of targets that a calibration is made of."""

    sessions: Sequence[Session]
    """One or more, of one rig."""
    folder: Path
    """CALIBRATION/, with what was calibrated before."""
    created: date
    """Date of the calibration."""

    @property
    def rig(self) -> Rig:
        """The rig, as of the first session."""
        return self.sessions[0].rig

    @property
    def serials(self) -> set[str]:
        """Serial numbers of all cameras."""
        return {view.serial for session in self.sessions for view in session.rig.views}

    def provenance(self) -> dict[str, Any]:
        """Return rig, source, date and inputs of the calibration."""
        return {
            "rig": self.rig.name,
            "source": self.sessions[0].source,
            "created": self.created,
            "inputs": {session.id: session.content_hash for session in self.sessions},
        }

    def frames(self, kind: str, **index: str | int | float) -> list[tuple[FrameRecord, Session]]:
        """Return the frames of a kind, of all sessions."""
        return [
            (record, session)
            for session in self.sessions
            for record in session.frames(kind, **index)
        ]

    def require_frames(
        self, rig: str, kind: str, **index: str | int | float
    ) -> list[tuple[FrameRecord, Session]]:
        """Return the frames of a kind, or raise where there are none and say how to get them."""
        found = self.frames(kind, **index)
        if not found:
            wanted = " ".join([kind, *(f"{k}={v}" for k, v in index.items())])
            target = kind if kind != "subject" else "white"
            raise CalibratingError(
                f"sessions: hold no frames of kind {wanted!r}; capture that target first (`skinrig"
                f" simulate {rig} --target {target}`, or `skinrig capture {rig} --target {target}`)"
            )
        return found

    def sensor(self) -> SensorCalibration | None:
        """Return the folder's sensor calibration of the first camera; None: it has none."""
        serial = self.rig.views[0].serial
        try:
            found = store.load(self.folder, "sensor")
            how: dict[str, Any] = {"serials": [serial], "on_date": self.created}
            store.require_valid(found, rig=self.rig.name, kind="sensor", **how)
        except store.CalibrationMissing:
            return None
        return SensorCalibration.from_calibration(found, serial)


def number_findings(findings: Iterable[str]) -> Mapping[str, str]:
    """Return findings as notes of a calibration.

    Examples
    --------
    >>> number_findings(["light L007 is dead"])
    {'finding 0': 'light L007 is dead'}
    """
    return {f"finding {k}": text for k, text in enumerate(findings)}


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
    return sensor.calibrate_sensor(
        pairs,
        [frame.cfa for _, frame in darks],
        white_dn=first.white,
        pattern=first.pattern,
        dark_exposures_s=[seconds for seconds, _ in darks],
        block=max(4, min(16, min(first.cfa.shape) // 32)),
    )
