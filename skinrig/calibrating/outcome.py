"""Shared parts of all rigs' calibrations: results, target sessions, sensor calibration."""

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
    """Sessions that lack frames or settings that a calibration needs."""


@dataclass(frozen=True, slots=True)
class CalibrationResult:
    """A calibration with its summary and findings."""

    calibration: store.Calibration
    summary: tuple[tuple[str, str], ...]
    """Rows of quantity and value with standard error."""
    findings: tuple[str, ...] = ()
    """Defects of the rig."""


@dataclass(frozen=True, slots=True)
class TargetSessions:
    """Sessions of targets that a calibration is estimated from."""

    sessions: Sequence[Session]
    """One or more, of one rig."""
    folder: Path
    """CALIBRATION/, with the previous calibrations."""
    created: date
    """Date of the calibration."""

    @property
    def rig(self) -> Rig:
        """The rig of the first session."""
        return self.sessions[0].rig

    @property
    def serials(self) -> set[str]:
        """Serial numbers of all cameras."""
        return {view.serial for session in self.sessions for view in session.rig.views}

    @property
    def imported(self) -> bool:
        """Whether the frames are imported photographs."""
        return any("photographs" in session.manifest.extra for session in self.sessions)

    def provenance(self) -> dict[str, Any]:
        """Return rig, source, date and inputs of the calibration."""
        return {
            "rig": self.rig.name,
            "source": self.sessions[0].source,
            "created": self.created,
            "inputs": {session.id: session.content_hash for session in self.sessions},
        }

    def frames(self, kind: str, **index: str | int | float) -> list[tuple[FrameRecord, Session]]:
        """Return the frames of a kind in all sessions."""
        return [
            (record, session)
            for session in self.sessions
            for record in session.frames(kind, **index)
        ]

    def require_frames(
        self, rig: str, kind: str, **index: str | int | float
    ) -> list[tuple[FrameRecord, Session]]:
        """Return the frames of a kind; raise if there are none.

        Raises
        ------
        CalibratingError
            With the commands that capture them.
        """
        found = self.frames(kind, **index)
        if not found:
            wanted = " ".join([kind, *(f"{k}={v}" for k, v in index.items())])
            target = kind if kind != "subject" else "white"
            raise CalibratingError(
                f"sessions: got no frames of kind {wanted!r}, expected some; capture that target "
                f"first (`skinrig simulate {rig} --target {target}`, or `skinrig capture {rig} "
                f"--target {target}`) [SR-CAL-001]"
            )
        return found

    def sensor(self) -> SensorCalibration | None:
        """Return the folder's sensor calibration of the first camera, or None."""
        serial = self.rig.views[0].serial
        try:
            found = store.load(self.folder, "sensor")
            how: dict[str, Any] = {"serials": [serial], "on_date": self.created}
            store.require_valid(found, rig=self.rig.name, kind="sensor", **how)
        except store.CalibrationMissing:
            return None
        return SensorCalibration.from_calibration(found, serial)


def number_findings(findings: Iterable[str]) -> Mapping[str, str]:
    """Return findings as numbered notes of a calibration file.

    Examples
    --------
    >>> number_findings(["light L007 is dead"])
    {'finding 0': 'light L007 is dead'}
    """
    return {f"finding {k}": text for k, text in enumerate(findings)}


def photon_transfer(
    flats: Sequence[tuple[float, RawFrame]], darks: Sequence[tuple[float, RawFrame]]
) -> SensorCalibration:
    """Calibrate a sensor by the photon transfer method from flat and dark frames.

    Parameters
    ----------
    flats
        Light, any unit, and frame. Consecutive frames of equal light form pairs: the difference of
        a pair is free of fixed-pattern noise.
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
