"""Orders of simulations, one class a rig, and what a simulation returns."""

import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar, get_args

from capture.plan import Plan
from capture.plan.dome import DomeTarget
from capture.plan.gradient import GradientTarget
from capture.plan.probe import ProbeTarget
from capture.session import SubjectRecord
from skinrig.capturing.sequences import SequenceOrder
from skinrig.errors import UsageError, one_of
from skinrig.simulating.effect_omission import omission_arguments

PICTURE_SIZES = ("small", "full")
SIMULATED_USES = ("research", "publication")
"""What may be done with a face that is nobody's, unless said otherwise."""
MIN_WIDTH_PX = 16
_COUNT_OPTIONS = {"width_px": "width", "lights": "lights", "views": "views"}
"""Fields that count something, and their names in messages."""


class SimulationError(ValueError):
    """A simulation that cannot be set up as asked."""


class SimulationOptionsError(SimulationError, UsageError):
    """Options of a simulation that do not go together, or with its rig."""


@dataclass(frozen=True, slots=True)
class SimulationResult:
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

    @property
    def truth_name(self) -> str:
        """Name of the truth's folder; empty without one."""
        return self.truth.name if self.truth else ""

    def document(self) -> Mapping[str, Any]:
        """Return this as JSON values."""
        return {one.name: getattr(self, one.name) for one in fields(self)}


def require_size(size: str) -> None:
    """Raise for a size that no simulation has."""
    one_of("size", size, PICTURE_SIZES, SimulationError)


def truth_folder(session: Path) -> Path:
    """Return the folder beside a session that holds its truth.

    Examples
    --------
    >>> truth_folder(Path("demo/session-flash")).as_posix()
    'demo/truth-flash'
    """
    return session.with_name(f"truth-{session.name.removeprefix('session-')}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulationOrder:
    """What every simulation is asked for; each rig's order adds its own options.

    Raises
    ------
    SimulationError
        For a size, a seed, a target or a plan that the rig has not, and the like.
    OptionsError
        For options that do not go together.
    """

    rig: ClassVar[str]
    targets: ClassVar[tuple[str, ...]]
    """What can stand in the rig instead of a subject."""

    out: Path
    """The session's folder; the truth goes to ``truth-NAME`` beside ``session-NAME``."""
    size: str = "small"
    """"small" or "full"; each rig has its own meaning."""
    seed: int = 0
    """Of the subject, the sensor and the boxes."""
    subject: str = "III"
    """Preset of the skin, or a file NAME.toml, see `rigsim.population.files`."""
    target: str | None = None
    plan: Plan | None = None
    """What is captured of the subject instead of the rig's own plan."""
    leave_out: tuple[str, ...] = ()
    """Effects of skin that are not built: `skinrig.simulating.effect_omission`."""
    resume: bool = False
    """Go on with a session that was interrupted; what is on disk is kept."""
    created: datetime | None = None
    """Date of the session; None: now."""
    person: SubjectRecord | None = None
    """Pseudonym and consent to record; None: one who agreed to :data:`SIMULATED_USES`, or, where a
    session is gone on with, as it was begun. Others than it was begun with are refused."""
    progress: Callable[[str], None] | None = None
    """Called with one line a frame."""

    def __post_init__(self) -> None:
        for name, shown in _COUNT_OPTIONS.items():
            number = getattr(self, name, None)
            if number is not None and number < 1:
                raise SimulationError(f"{shown}: got {number}, expected a number above 0, or none")
        require_size(self.size)
        if self.seed < 0:
            raise SimulationError(f"seed: got {self.seed}, expected 0 or more")
        width_px = getattr(self, "width_px", None)
        if width_px is not None and width_px < MIN_WIDTH_PX:
            raise SimulationError(f"width: got {width_px}, expected {MIN_WIDTH_PX} pixels or more")
        if self.target is not None:
            one_of("target", self.target, self.targets, SimulationError)
        self.check()
        self.scene_switches()

    def check(self) -> None:
        """Raise where options do not go together."""
        self.check_rig_of_plan()
        if self.plan is not None and self.exclusive_subject is not None:
            raise SimulationOptionsError(
                "plan: is for a subject; targets and sequences have their own"
            )

    def check_rig_of_plan(self) -> None:
        """Raise for a plan of another rig."""
        if self.plan is not None and self.plan.rig != self.rig:
            raise SimulationError(f"plan: got one of {self.plan.rig!r}, expected {self.rig!r}")

    @property
    def exclusive_subject(self) -> str | None:
        """What is simulated instead of skin at rest or in a state; None for such skin."""
        return None if self.target is None else "a target"

    def refuse_options(self, subject: str, *names: str) -> None:
        """Raise where something was asked for that `subject` has not."""
        unset = {one.name: one.default for one in fields(self)}
        for name in names:
            if getattr(self, name) != unset[name]:
                raise SimulationOptionsError(
                    f"{name}: the {subject} rig knows nothing of it; leave it out"
                )

    def scene_switches(self) -> dict[str, Any]:
        """Return arguments of a scene of skin that leave out what is to be left out.

        Raises
        ------
        SimulationError
            Where the rig's scenes cannot, or a target or a sequence is ordered.
        """
        if not self.leave_out:
            return {}
        if self.exclusive_subject is not None:
            raise SimulationOptionsError(
                f"leave_out: is of skin at rest or in a state, not of {self.exclusive_subject}"
            )
        try:
            return dict(omission_arguments(self.rig, self.leave_out))
        except ValueError as exc:
            raise SimulationError(str(exc)) from exc


@dataclass(frozen=True, slots=True, kw_only=True)
class FaceOrder(SimulationOrder):
    """A face before a rig."""

    width_px: int | None = None
    """Pixels across each camera, instead of ``size``."""
    mesh: str | Path | None = None
    """A face mesh to wear the skin instead of the procedural head."""
    states: tuple[str, ...] = ("neutral",)
    """Expressions and physiological states: one after the other before the flash rig, one alone in
    the dome."""
    movement: bool = True
    """Whether the face moves and wrinkles with its states; else they change the blood only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlashOrder(FaceOrder):
    """A face or a target before the flash rig; "small" is 768 pixels across, "full" 3024."""

    rig: ClassVar[str] = "flash"
    targets: ClassVar[tuple[str, ...]] = ("white", "chart", "flat", "dark", "malus")

    repeats: int = 1
    """Image pairs a state."""
    nearer_mm: float = 0.0
    """How much nearer to the camera than the white tile's place the face stands, mm; below 0
    farther. The flashes are then as much nearer, and the lens is focused on the tile."""
    sequence: SequenceOrder | None = None
    """A sequence in time instead of ``states``."""
    relaxation_s: float | None = None
    """Time constant of its blood, s; None: of the state, see `rigsim.subject.perfusion_course`."""

    @property
    def exclusive_subject(self) -> str | None:
        """What is simulated instead of skin at rest or in a state; None for such skin."""
        if self.target is not None:
            return "a target"
        return None if self.sequence is None else "a sequence"

    def check(self) -> None:
        """Raise where options do not go together."""
        if not math.isfinite(self.nearer_mm):
            raise SimulationError(f"nearer: got {self.nearer_mm}, expected finite millimetres")
        if self.nearer_mm != 0.0 and self.exclusive_subject is not None:
            raise SimulationOptionsError(
                f"nearer: is of a face at rest or in a state, not of {self.exclusive_subject}"
            )
        SimulationOrder.check(self)
        if self.sequence is not None:
            self.refuse_options(self.rig, "target", "repeats", "states")
        elif self.relaxation_s is not None:
            raise SimulationOptionsError("relaxation: is for a sequence")


@dataclass(frozen=True, slots=True, kw_only=True)
class DomeOrder(FaceOrder):
    """A face or a target in the dome.

    "small" is 6 cameras, 320 pixels across, and 48 lights; "full" is all that it has. The subject
    may also be a member of the simulated population, P01 to P87
    (`rigsim.population.population.draw_population`), with what it wears. Lights and cameras of a
    plan are those of targets, too.
    """

    rig: ClassVar[str] = "dome"
    targets: ClassVar[tuple[str, ...]] = get_args(DomeTarget)

    lights: int | None = None
    """So many lights, spread evenly; None: as many as ``size`` says."""
    views: int | None = None
    """So many cameras, spread evenly; None: as many as ``size`` says."""
    move: bool = False
    """Whether the face drifts and twitches during the capture."""
    wrapped: bool = False
    """Whether the scan of the face is a template wrapped onto it, of the same triangles and texture
    coordinates in every state, so that maps of states share one texture."""
    subsurface: bool = False
    """True: light spreads sideways inside the skin even where that changes no pixel; False: where
    it does, see `rigsim.needs.effects`."""
    interreflections: bool = False
    """True: light goes from skin to skin even where that changes no pixel; False: where it does."""
    conditions: Mapping[str, float] = field(default_factory=dict)
    """Conditions of the face with their amounts, see `rigsim.population.conditions`."""

    @property
    def state(self) -> str:
        """The state of the face."""
        return self.states[0]

    def check(self) -> None:
        """Raise where options do not go together; a dome's plan is for targets, too."""
        if len(self.states) != 1:
            raise SimulationOptionsError(
                f"states: got {', '.join(self.states) or 'none'}, expected one; a session of the "
                "dome shows one face, capture each state into a session of its own"
            )
        if self.plan is not None and (self.lights, self.views) != (None, None):
            raise SimulationOptionsError("lights, views: a plan names its own; leave them out")
        self.check_rig_of_plan()
        if self.target is None:
            return
        if self.state != "neutral":
            raise SimulationOptionsError(f"state: got {self.state!r}, but a target has none")
        if self.conditions:
            raise SimulationOptionsError(
                f"condition: got {', '.join(self.conditions)}, but a target has none"
            )
        if self.subsurface or self.interreflections:
            raise SimulationOptionsError(
                "subsurface, interreflections: are of a face; a target has neither"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class GradientOrder(SimulationOrder):
    """A patch of skin in a caliper, or a target, in the gradient sphere.

    "small" is the middle 256 pixels and one angle of the caliper; "full" is all 2048, which the
    ball always takes, and all angles.
    """

    rig: ClassVar[str] = "gradient"
    targets: ClassVar[tuple[str, ...]] = get_args(GradientTarget)

    width_px: int | None = None
    """Pixels across, instead of ``size``."""
    site: str | None = None
    """Where the skin is from: "forehead" (the default), "cheek", "chin"."""
    angles: tuple[float, ...] | None = None
    """Angles of the caliper, degrees; None: as ``size`` says."""
    steps: tuple[int, int] | None = None
    """First and last position of the caliper; None: all. Where the skin ends is found out."""

    def check(self) -> None:
        """Raise where options do not go together."""
        SimulationOrder.check(self)
        if self.target is not None:
            self.refuse_options("target of the gradient", "site", "angles", "steps")


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeOrder(SimulationOrder):
    """Tissue under the fibre probe, or a target; "full" has more photons in its truth.

    The subject may also be "homogeneous:SIGMA_A,SIGMA_S_PRIME[,G]" in 1/mm.
    """

    rig: ClassVar[str] = "probe"
    targets: ClassVar[tuple[str, ...]] = get_args(ProbeTarget)

    sites: tuple[str, ...] | None = None
    """Where the probe is placed; None: forehead, cheek and chin."""
    repeats: int = 1
    """Placements a site and direction."""
    angles: tuple[float, ...] | None = None
    """One number: how many directions of the head; None: 1."""
    all_brackets: bool = False
    """Whether the probe takes exposures that can show no more."""

    def check(self) -> None:
        """Raise where options do not go together."""
        SimulationOrder.check(self)
        if self.target is not None:
            self.refuse_options("target of the probe", "sites", "angles")


ORDER_BY_RIG: Mapping[str, type[SimulationOrder]] = {
    kind.rig: kind for kind in (FlashOrder, DomeOrder, GradientOrder, ProbeOrder)
}
"""The class of each rig's orders."""


def order_for(rig: str, **options: Any) -> SimulationOrder:
    """Return a rig's order out of options by name.

    Parameters
    ----------
    rig
        A key of :data:`ORDER_BY_RIG`.
    options
        Fields of its order; those of another rig's are refused, unless they ask for nothing.

    Raises
    ------
    SimulationError
        For an unknown rig, or as the order does.
    OptionsError
        For another rig's option.

    Examples
    --------
    >>> order_for("dome", out=Path("session"), lights=12).rig
    'dome'
    """
    one_of("rig", rig, ORDER_BY_RIG, SimulationError)
    own = {one.name for one in fields(ORDER_BY_RIG[rig])}
    foreign = {one.name: one for kind in ORDER_BY_RIG.values() for one in fields(kind)}
    for name in sorted(options.keys() & foreign.keys() - own):
        default = foreign[name].default
        if options.pop(name) not in ({} if default is MISSING else default, None):
            shown = name.removesuffix("_mm")
            raise SimulationOptionsError(
                f"{shown}: the {rig} rig knows nothing of it; leave it out"
            )
    return ORDER_BY_RIG[rig](**options)
