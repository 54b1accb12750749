"""Capture and reconstruct sessions of one simulated person, each with its day's calibration."""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from model.skin import SkinAppearance
from model.store import read
from reconstruction.pipeline.recipes import reconstruct
from skinrig.planning.confirmation import calibrate_simulated
from skinrig.simulating.simulation import simulate_session

RIG_SEED: Final = 0
"""Seed of the benchmark's rigs."""


@dataclass(frozen=True, slots=True)
class RigProtocol:
    """How one rig is calibrated and captured for a comparison of sessions."""

    rig: str
    """Name of the rig."""
    maps: tuple[str, ...]
    """Requested maps."""
    targets: Mapping[str, Mapping[str, Any]]
    """Calibration targets with their options."""
    kinds: tuple[tuple[str, tuple[str, ...]], ...]
    """Kinds of calibration, each with its targets."""
    options: Mapping[str, Any]
    """Options of the subject's session."""
    seed: int = RIG_SEED
    """Seed of the rig as built, and of the person where the rig has no other."""


def choose_protocol(rig: str, *, width_px: int) -> RigProtocol:
    """Return the protocol of a rig at an image width.

    Parameters
    ----------
    rig
        "flash", "dome", "gradient" or "probe".
    width_px
        Width of the images, px; that of the probe is fixed.
    """
    wide = {"width_px": width_px}
    if rig == "flash":
        return RigProtocol(
            rig,
            ("melanin", "hemoglobin", "diffuse"),
            dict.fromkeys(("flat", "white", "malus"), wide),
            (("sensor", ("flat",)), ("white", ("white",)), ("polarization", ("malus",))),
            wide,
        )
    if rig == "dome":
        few = {**wide, "lights": 24, "views": 4}
        return RigProtocol(
            rig,
            ("normals", "r_d"),
            dict.fromkeys(("charuco", "mirror", "white"), few),
            (("geometry", ("charuco",)), ("lights", ("mirror", "white"))),
            {**few, "wrapped": True, "leave_out": ("subsurface", "interreflections")},
        )
    if rig == "gradient":
        return RigProtocol(
            rig,
            ("normals", "height"),
            {"ball": {}},
            tuple((kind, ("ball",)) for kind in ("lights", "polarization")),
            {**wide, "angles": (0.0,), "steps": (0, 0)},
        )
    return RigProtocol(rig, ("subsurface",), {"phantom": {}}, (("fiber", ("phantom",)),), {})


@dataclass(frozen=True, slots=True)
class RigDay:
    """A rig on one day, with its calibration of that day.

    Attributes
    ----------
    protocol
        How the rig is used.
    folder
        Its ``calibration`` is in it.
    days_ago
        Days before today.
    """

    protocol: RigProtocol
    folder: Path
    days_ago: int

    @staticmethod
    def calibrate(protocol: RigProtocol, folder: Path, *, days_ago: int, seed: int) -> "RigDay":
        """Simulate the targets of a day and calibrate.

        Parameters
        ----------
        protocol
            How the rig is used.
        folder
            New folder of the day.
        days_ago
            Days before today.
        seed
            Seed of the targets' noise and poses.
        """
        folder.mkdir(parents=True)
        day = {"session_seed": seed, "days_ago": days_ago}
        targets = {name: {**how, **day} for name, how in protocol.targets.items()}
        calibrate_simulated(protocol.rig, folder, targets, protocol.kinds, seed=protocol.seed)
        return RigDay(protocol, folder, days_ago)

    def capture(
        self,
        person: Mapping[str, Any],
        *,
        seed: int,
        state: str = "neutral",
        calibration: Path | None = None,
    ) -> SkinAppearance:
        """Capture a person and return the maps.

        Parameters
        ----------
        person
            Options that describe the person, such as subject and seed.
        seed
            Seed of the session.
        state
            Expression or condition of the face.
        calibration
            Folder of another day's calibration; None: that of the day.
        """
        for path in (self.folder / "session-person", *self.folder.glob("truth-*")):
            shutil.rmtree(path, ignore_errors=True)
        shutil.rmtree(self.folder / "maps", ignore_errors=True)
        options = {"seed": self.protocol.seed, **self.protocol.options, **person}
        if self.protocol.rig in ("flash", "dome"):
            options["states"] = (state,)
        done = simulate_session(
            self.protocol.rig,
            self.folder / "session-person",
            session_seed=seed,
            days_ago=self.days_ago,
            **options,
        )
        used = calibration or self.folder / "calibration"
        maps = self.folder / "maps"
        want = list(self.protocol.maps)
        reconstruct(done.session, want=want, out=maps, calibration=used, state=state)
        return read(maps)
