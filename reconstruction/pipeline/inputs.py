"""What a reconstruction stands on: a session, its calibrations, what is assumed without them."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

from capture.calibration import store as calibration_store
from capture.calibration.record import CALIBRATION_KINDS
from capture.session import Session
from reconstruction.pipeline.graph import PipelineStage, make_stage_factory
from reconstruction.pipeline.hold_out import NO_HOLD_OUT, HoldOut

PROGRESS_INTERVAL_S = 5.0
"""Seconds between two lines about the same stage."""


class InputsError(ValueError):
    """A session that cannot be reconstructed as asked."""


@dataclass(frozen=True, slots=True)
class DomeOptions:
    """What only sessions of the dome take."""

    scan: str | Path | None = None
    """PLY of the face in mm that takes the place of the session's own; None: the session's."""
    basis: str | Path | None = None
    """Folder of MERL ``.binary`` tables to fit surface lobes with; None: the generated
    dielectrics."""
    hold_out: HoldOut | str | None = None
    """Lights and views whose frames no fit sees, as "lights=L007,L023,views=C03" or as parsed;
    what `skinrig render --against` compares with."""
    rank: int | None = None
    """Lobes that the points share, 1 to 59; None: 4."""


@dataclass(slots=True)
class Inputs:
    """A session and a folder of calibrations; keeps account of what was read and what assumed.

    Attributes
    ----------
    session
        Open for reading.
    calibration
        CALIBRATION/ folder; None: everything is assumed.
    state
        Which state of the subject.
    on_date
        The date that calibrations must be valid on.
    scan, basis, hold_out, rank
        As of `DomeOptions`, the scan as it was read.
    landmarks
        Table of places on the face's texture; None: those that are known.
    repeat
        Which of the state's repeats; None: all of them together.
    assumed
        What was taken for granted for want of a calibration, one line each.
    hashes
        SHA-256 of everything that was read, by what it is.
    noted
        JSON values that belong into the record of the maps.
    progress
        Called with a line of text now and then while a stage runs.
    """

    session: Session
    calibration: Path | None
    state: str
    on_date: date
    scan: bytes | None = None
    basis: Path | None = None
    hold_out: HoldOut = NO_HOLD_OUT
    rank: int | None = None
    landmarks: Path | None = None
    repeat: int | None = None
    assumed: list[str] = field(default_factory=list)
    hashes: dict[str, str] = field(default_factory=dict)
    noted: dict[str, Any] = field(default_factory=dict)
    progress: Callable[[str], None] | None = None
    _reported_at: float = 0.0

    def report_progress(self, stage: str, done: float) -> None:
        """Say how far a stage is, 0 to 1, every few seconds at most."""
        now = time.monotonic()
        if self.progress is not None and now - self._reported_at >= PROGRESS_INTERVAL_S:
            self._reported_at = now
            self.progress(f"{stage}: {100 * done:.0f} %")

    @staticmethod
    def of(
        session: Session,
        calibration: str | Path | None,
        *,
        state: str,
        on_date: date | None = None,
        landmarks: str | Path | None = None,
        dome: DomeOptions | None = None,
    ) -> Inputs:
        """Begin with what the session itself says that it assumed.

        Raises
        ------
        InputsError
            When ``calibration`` or ``basis`` is no folder, the first holds no calibration or
            those of other rigs alone, or ``scan`` is no PLY.
        """
        dome = dome or DomeOptions()
        found = Inputs(
            session,
            None if calibration is None else Path(calibration),
            state,
            on_date or session.manifest.created_at.date(),
            rank=dome.rank,
            assumed=[str(text) for text in session.manifest.extra.get("assumed", [])],
            hashes={"session": session.content_hash},
        )
        if found.calibration is not None:
            _require_some(found.calibration, session.rig.name)
        if dome.scan is not None:
            found.scan = Path(dome.scan).read_bytes()
            if not found.scan.startswith(b"ply"):
                hint = "`skinrig import mesh` takes .obj and .ply"
                raise InputsError(f"scan: got no PLY mesh in {dome.scan}; {hint}")
            found.hashes["scan"] = hashlib.sha256(found.scan).hexdigest()
        if dome.basis is not None:
            found.basis = Path(dome.basis)
            found.hashes["basis"] = _digest_of(found.basis)
        if landmarks is not None:
            found.landmarks = Path(landmarks)
            found.hashes["landmarks"] = hashlib.sha256(found.landmarks.read_bytes()).hexdigest()
        if dome.hold_out is not None:
            text = dome.hold_out
            found.hold_out = HoldOut.parse(text) if isinstance(text, str) else text
        return found

    def stage_maker(self, revision: int) -> Callable[..., PipelineStage]:
        """Return `graph.stage_maker` for stages of a revision of their code and all that was read.

        Parameters
        ----------
        revision
            Grows when the code of a stage changes its result, so that older maps are made again.
        """
        return make_stage_factory(
            {"revision": revision, "inputs": dict(sorted(self.hashes.items()))}
        )

    def load(
        self, kind: str, serials: Sequence[str], otherwise: str
    ) -> calibration_store.Calibration | None:
        """Return the calibration of a kind, or None and note what is assumed instead.

        Parameters
        ----------
        kind
            "white", "color", "geometry", ...
        serials
            Devices that it must be of.
        otherwise
            What is assumed where the folder holds none of that kind.

        Raises
        ------
        CalibrationError
            When it is damaged, of another rig or device, or out of date.
        """
        if self.calibration is not None:
            with suppress(calibration_store.CalibrationMissing):
                found = calibration_store.load(self.calibration, kind)
                rig, day = self.session.rig.name, self.on_date
                calibration_store.require_valid(
                    found, rig=rig, serials=list(serials), on_date=day, kind=kind
                )
                content = (self.calibration / f"{kind}.json").read_bytes()
                self.hashes[f"calibration {kind}"] = hashlib.sha256(content).hexdigest()
                return found
        self.assumed.append(otherwise)
        return None


def _require_some(folder: Path, rig: str) -> None:
    """Refuse a folder without a calibration of a rig: else everything would be assumed."""
    if not folder.is_dir():
        raise InputsError(f"calibration: {folder} is no folder; `skinrig calibrate` makes one")
    files = [path for kind in CALIBRATION_KINDS if (path := folder / f"{kind}.json").is_file()]
    if not files:
        raise InputsError(
            f"calibration: {folder} holds none, expected {', '.join(CALIBRATION_KINDS)} or some of "
            "them (.json); `skinrig calibrate` makes them"
        )
    rigs = set()
    for path in files:
        try:
            rigs.add(str(json.loads(path.read_bytes())["rig"]))
        except (ValueError, KeyError, TypeError):
            return  # what is wrong with it is said where it is needed
    if rig not in rigs:
        raise InputsError(
            f"calibration: those in {folder} were made on rig {', '.join(sorted(rigs))}, the "
            f"session is of rig {rig}; leave --calibration out, or give that rig's folder"
        )


def _digest_of(folder: Path) -> str:
    """Return the hash of a folder's tables, their names and contents."""
    if not folder.is_dir():
        raise InputsError(f"basis: {folder} is no folder; give one with MERL .binary files")
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.binary")):
        digest.update(path.name.encode() + b"\0")
        with open(path, "rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()
