"""Orders of simulations: what is asked, and what was made."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from capture.plan import Plan
from capture.session import Subject
from skinrig.capturing.sequences import SequenceOrder
from skinrig.errors import UsageError
from skinrig.simulating.leaving_out import left_out_of

RIGS = ("flash", "dome", "gradient", "probe")


SIZES = ("small", "full")


USES = ("research", "publication")
"""What may be done with a face that is nobody's, unless said otherwise."""


class SimulationError(ValueError):
    """A simulation that cannot be set up as asked."""


class OptionsError(SimulationError, UsageError):
    """Options of a simulation that do not go together, or with its rig."""


@dataclass(frozen=True, slots=True)
class Simulated:
    """What a simulated capture left behind."""

    session: Path
    truth: Path | None
    frames: int
    rig_seconds: float
    """Time that passed on the rig's own clock."""
    left_out: tuple[tuple[str, str], ...]
    """What the scene did not build, and why."""
    blur_mm: tuple[float, ...] = ()
    """Width from 10 to 90 % of an edge that light spreading in the skin blurs, R, G, B, mm."""
    light: Mapping[str, float | str] = field(default_factory=dict)
    """Figures of the LEDs' light, see `skinrig.capturing.light_safety`; empty for the flash rig."""
    effects: tuple[Mapping[str, Any], ...] = ()
    """What the scene built and what not, with reasons, see `rigsim.needs.effects.Effect`."""

    def document(self) -> Mapping[str, Any]:
        """Return this as JSON values."""
        return {
            "session": self.session,
            "truth": self.truth,
            "frames": self.frames,
            "rig_seconds": self.rig_seconds,
            "left_out": self.left_out,
            "blur_mm": self.blur_mm,
            "light": dict(self.light),
            "effects": [dict(effect) for effect in self.effects],
        }


def truth_folder(session: Path) -> Path:
    """Return the folder beside a session that holds its truth.

    Examples
    --------
    >>> truth_folder(Path("demo/session-flash")).as_posix()
    'demo/truth-flash'
    """
    name = session.name
    short = name.removeprefix("session-") if name.startswith("session-") else name
    return session.with_name(f"truth-{short}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """What is to be simulated; see `simulate_session`."""

    out: Path
    size: str
    seed: int
    subject: str
    mesh: str | Path | None
    target: str | None
    states: tuple[str, ...]
    repeats: int
    resume: bool
    width_px: int | None
    lights: int | None
    views: int | None
    move: bool
    site: str | None
    angles: tuple[float, ...] | None
    steps: tuple[int, int] | None
    sites: tuple[str, ...] | None
    all_brackets: bool
    movement: bool
    wrapped: bool
    created: datetime | None
    person: Subject | None
    progress: Callable[[str], None] | None
    sequence: SequenceOrder | None = None
    relaxation_s: float | None = None
    subsurface: bool = False
    interreflections: bool = False
    conditions: Mapping[str, float] = field(default_factory=dict)
    plan: Plan | None = None
    leave_out: tuple[str, ...] = ()
    nearer_mm: float = 0.0

    def __post_init__(self) -> None:
        if self.size not in SIZES:
            raise SimulationError(f"size: got {self.size!r}, expected one of {', '.join(SIZES)}")
        if self.seed < 0:
            raise SimulationError(f"seed: got {self.seed}, expected 0 or more")
        if self.width_px is not None and self.width_px < 16:
            raise SimulationError(f"width: got {self.width_px}, expected 16 pixels or more")

    def refuse(self, rig: str, **unset: object) -> None:
        """Raise where something was asked for that the rig does not know."""
        for name, value in unset.items():
            if getattr(self, name) != value:
                raise OptionsError(f"{name}: the {rig} rig knows nothing of it; leave it out")

    def without(self, rig: str) -> dict[str, Any]:
        """Return arguments of a scene of skin that leave out what is to be left out.

        Raises
        ------
        SimulationError
            Where the rig's scenes cannot, or a target or a sequence is ordered.
        """
        if not self.leave_out:
            return {}
        if self.target is not None or self.sequence is not None:
            what = "a sequence" if self.target is None else "a target"
            raise OptionsError(f"leave_out: is of skin at rest or in a state, not of {what}")
        try:
            return left_out_of(rig, self.leave_out)
        except ValueError as exc:
            raise SimulationError(str(exc)) from exc

    def check_stance(self, rig: str) -> None:
        """Raise where a face stands off the tile's place that the rig cannot place."""
        if self.nearer_mm == 0.0:
            return
        if not math.isfinite(self.nearer_mm):
            raise SimulationError(f"nearer: got {self.nearer_mm}, expected finite millimetres")
        if rig != "flash":
            raise OptionsError(f"nearer: the {rig} rig knows nothing of it; leave it out")
        if self.target is not None or self.sequence is not None:
            what = "a sequence" if self.target is None else "a target"
            raise OptionsError(f"nearer: is of a face at rest or in a state, not of {what}")

    def check_plan(self, rig: str) -> None:
        """Raise where a plan was handed over that is another rig's, or a target's or sequence's."""
        if self.plan is None:
            return
        if self.plan.rig != rig:
            raise SimulationError(f"plan: got one of {self.plan.rig!r}, expected {rig!r}")
        if self.target is not None or self.sequence is not None:
            raise OptionsError("plan: is for a subject; targets and sequences have their own")
