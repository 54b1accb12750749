"""Inputs of a reconstruction: session, calibrations, options, and assumptions made instead."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any, TypeVar

from capture.calibration import store as calibration_store
from capture.calibration.record import CALIBRATION_KINDS
from capture.session import Session
from model.brdf.tables import list_material_files
from reconstruction.pipeline.checkpoints import Checkpoints, RunRecord, compute_tiles
from reconstruction.pipeline.graph import PipelineStage, make_stage_factory
from reconstruction.pipeline.hold_out import NO_HOLD_OUT, HoldOut
from reconstruction.pipeline.run_progress import RunProgress

Result = TypeVar("Result")
Tile = TypeVar("Tile")


class InputsError(ValueError):
    """A session that cannot be reconstructed with the given options."""


@dataclass(frozen=True, slots=True)
class DomeOptions:
    """Options that only sessions of the dome take."""

    scan: str | Path | None = None
    """PLY mesh of the face in mm that replaces the session's own; None: the session's."""
    basis: str | Path | None = None
    """Folder of MERL and RGL tables as basis BRDFs; None: the generated dielectrics."""
    hold_out: HoldOut | str | None = None
    """Lights and views whose frames are excluded from every fit, as "lights=L007,L023,views=C03"
    or as parsed; `skinrig render --against` compares with them."""
    rank: int | None = None
    """Number of basis BRDFs, 1 to 59; None: 4."""


@dataclass(slots=True)
class Inputs:
    """A session and a folder of calibrations, with a record of files read and assumptions made.

    Attributes
    ----------
    session
        Session, open for reading.
    calibration
        CALIBRATION/ folder; None: assumptions replace every calibration.
    state
        Name of the subject's expression or condition.
    on_date
        Date on which calibrations must be valid.
    scan, basis, hold_out, rank
        See `DomeOptions`; the scan as bytes.
    landmarks
        Table of positions on the face's texture; None: the built-in ones.
    repeat
        Number of one repeat of the state; None: all repeats together.
    assumed
        Assumptions that replace missing calibrations, one line each.
    hashes
        SHA-256 of everything that was read, by role.
    noted
        JSON values for the record of the maps.
    progress
        Receives the beginning of each stage and tile.
    checkpoints
        Stages and tiles of an interrupted run; None: nothing is stored.
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
    progress: RunProgress = field(default_factory=RunProgress)
    checkpoints: Checkpoints | None = None

    def compute_tiles(
        self,
        stage: str,
        tiles: Sequence[Tile],
        compute: Callable[[Tile], Result],
        *,
        workers: int = 1,
    ) -> Iterator[Result]:
        """Yield the result of each tile in order, report progress, and store the results.

        Parameters
        ----------
        stage
            Name of this pass over the tiles, unique within the stage.
        tiles
            Arguments of ``compute``.
        compute
            Without effect but its result, which depends on nothing but the stage's inputs.
        workers
            Most tiles that are computed at once, on threads.
        """
        report = self.progress.begin_tile
        return compute_tiles(self.checkpoints, stage, tiles, compute, report, workers=workers)

    def compute_part(self, name: str, compute: Callable[[], Result]) -> Result:
        """Return the result of one part of a stage, see `compute_tiles`."""
        return next(self.compute_tiles(name, [None], lambda _: compute()))

    def scratch_folder(self, name: str) -> tuple[Path, object]:
        """Return a folder for a stage's tables, and an object that keeps it until it is freed."""
        if self.checkpoints is not None:
            return self.checkpoints.scratch_folder(name), None
        folder = tempfile.TemporaryDirectory(prefix="skinrig-")
        return Path(folder.name), folder

    def record(self) -> RunRecord:
        """Return the record that stages extend."""
        return RunRecord(self.assumed, self.noted, self.hashes)

    def options(self) -> dict[str, Any]:
        """Return inputs and options that products depend on, as JSON values."""
        folder = self.calibration
        files = [] if folder is None else [folder / f"{kind}.json" for kind in CALIBRATION_KINDS]
        return {
            "hashes": dict(self.hashes),
            "calibrations": {
                path.name: hashlib.sha256(path.read_bytes()).hexdigest()
                for path in files
                if path.is_file()
            },
            "state": self.state,
            "on_date": self.on_date.isoformat(),
            "rank": self.rank,
            "held_out": self.hold_out.record(),
            "repeat": self.repeat,
        }

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
        """Collect a session's inputs; the session's own assumptions come first.

        Raises
        ------
        InputsError
            When ``calibration`` or ``basis`` is not a folder, the folder of calibrations is empty
            or of other rigs only, or ``scan`` is not a PLY mesh.
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
                raise InputsError(
                    f"scan: got {dome.scan}, expected a PLY mesh; convert it with "
                    "`skinrig import mesh`, which takes .obj and .ply [SR-REC-007]"
                )
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
        """Return a `graph.make_stage_factory` that hashes this revision and all files read.

        Parameters
        ----------
        revision
            Grows when the code of a stage changes its result, so that older maps are recomputed.
        """
        return make_stage_factory(
            {"revision": revision, "inputs": dict(sorted(self.hashes.items()))}
        )

    def load(
        self, kind: str, serials: Sequence[str], otherwise: str
    ) -> calibration_store.Calibration | None:
        """Load the calibration of a kind; without one, return None and record the assumption.

        Parameters
        ----------
        kind
            "white", "color", "geometry", ...
        serials
            Serials of the devices that it must belong to.
        otherwise
            Assumption to record if the folder lacks that kind.

        Raises
        ------
        CalibrationError
            When the calibration is damaged, of another rig or device, or out of date.
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
    """Refuse a folder without a calibration of a rig: every quantity would be assumed."""
    if not folder.is_dir():
        raise InputsError(
            f"calibration: got {folder}, expected a CALIBRATION/ folder; make one with "
            "`skinrig calibrate` [SR-CAL-010]"
        )
    files = [path for kind in CALIBRATION_KINDS if (path := folder / f"{kind}.json").is_file()]
    if not files:
        raise InputsError(
            f"calibration: {folder} holds none, expected {', '.join(CALIBRATION_KINDS)} or some of "
            "them (.json); make them with `skinrig calibrate` [SR-CAL-011]"
        )
    rigs = set()
    for path in files:
        try:
            rigs.add(str(json.loads(path.read_bytes())["rig"]))
        except (ValueError, KeyError, TypeError):
            return  # `load` reports a damaged file when a stage needs it
    if rig not in rigs:
        raise InputsError(
            f"calibration: those in {folder} were made on rig {', '.join(sorted(rigs))}, expected "
            f"the session's rig {rig}; omit --calibration, or give that rig's folder [SR-CAL-012]"
        )


def _digest_of(folder: Path) -> str:
    """Hash a folder's tables, names and contents."""
    if not folder.is_dir():
        got = f"got {folder}, expected a folder"
        raise InputsError(f"--merl-basis: {got}; give one with .binary or .bsdf files")
    digest = hashlib.sha256()
    for path in list_material_files(folder):
        digest.update(path.name.encode() + b"\0")
        with open(path, "rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()
