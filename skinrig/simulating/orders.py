"""Orders and results of simulated captures, with one class of order per rig."""

import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, ClassVar, get_args

from capture.plan import Plan
from capture.plan.dome import DomeTarget
from capture.plan.gradient import GradientTarget
from capture.plan.probe import ProbeTarget
from capture.session import SubjectRecord
from rigsim.as_built.aging import RigAge, draw_rig_age
from rigsim.mitsuba.variant import Renderer
from skinrig.capturing.sequences import SequenceOrder
from skinrig.capturing.source_date import read_clock
from skinrig.errors import UsageError, require_choice
from skinrig.simulating.effect_omission import omission_arguments

PICTURE_SIZES = ("small", "full")
SIMULATED_USES = ("research", "publication")
"""Default consent scope of simulated subjects."""
MIN_WIDTH_PX = 16
_COUNT_OPTIONS = {"width_px": "width", "lights": "lights", "views": "views"}
"""Fields that count something, and their names in messages."""


class SimulationError(ValueError):
    """A simulation that cannot be set up with the given options."""


class SimulationOptionsError(SimulationError, UsageError):
    """Options that exclude each other or do not apply to the rig."""


@dataclass(frozen=True, slots=True)
class SimulationResult:
    """Result of a simulated capture."""

    session: Path
    truth: Path | None
    frames: int
    rig_seconds: float
    """Time elapsed on the rig's clock, s."""
    left_out: tuple[tuple[str, str], ...]
    """Effects that the scene omitted, each with the reason."""
    blur_mm: tuple[float, ...] = ()
    """Width from 10 to 90 % of an edge blurred by lateral scattering in skin, R, G, B, mm."""
    light: Mapping[str, float | str] = field(default_factory=dict)
    """Figures of the LEDs' light, see `skinrig.capturing.light_safety`; empty for the flash rig."""
    effects: tuple[Mapping[str, Any], ...] = ()
    """Effects that the scene built or omitted, with reasons, see `rigsim.needs.effects.Effect`."""

    @property
    def truth_name(self) -> str:
        """Name of the ground truth's folder; empty without one."""
        return self.truth.name if self.truth else ""

    def document(self) -> Mapping[str, Any]:
        """Return the result as JSON values."""
        return {one.name: getattr(self, one.name) for one in fields(self)}


def require_size(size: str) -> None:
    """Raise unless a size is "small" or "full"."""
    require_choice("size", size, PICTURE_SIZES, SimulationError)


def truth_folder(session: Path) -> Path:
    """Return the folder of a session's ground truth, next to the session.

    Examples
    --------
    >>> truth_folder(Path("demo/session-flash")).as_posix()
    'demo/truth-flash'
    """
    return session.with_name(f"truth-{session.name.removeprefix('session-')}")


SURFACE_FILE = "surface.npz"
"""Surface of a scene in the ground truth of the flash and the gradient rig, for renderers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulationOrder:
    """Options common to all simulations; each rig's order adds its own.

    Raises
    ------
    SimulationError
        For a size, a seed, a target, a plan or another value that the rig does not accept.
    SimulationOptionsError
        For options that exclude each other.
    """

    rig: ClassVar[str]
    targets: ClassVar[tuple[str, ...]]
    """Targets that can replace the subject."""

    out: Path
    """The session's folder ``session-NAME``; the ground truth goes to ``truth-NAME`` next to it."""
    size: str = "small"
    """"small" or "full"; each rig has its own meaning."""
    seed: int = 0
    """Seed of the subject and of the rig as built; without `session_seed` also of the capture."""
    session_seed: int | None = None
    """Seed of one capture of a subject and rig: noise, position, motion, scan, controllers. None:
    `seed`, and the face at the center of the rig."""
    days_ago: int = 0
    """Days before today of the session; LEDs and frames age, see `rigsim.as_built.aging`."""
    iso_factor: float = 1.0
    """ISO of all cameras over the nominal one, see `capture.rig.Rig.at_iso`."""
    subject: str = "III"
    """Preset of the skin, or a file NAME.toml, see `rigsim.population.files`."""
    target: str | None = None
    plan: Plan | None = None
    """Plan to capture instead of the rig's default plan."""
    renderer: Renderer = "mitsuba"
    """Renderer of the images of faces and patches."""
    leave_out: tuple[str, ...] = ()
    """Omitted effects of skin, see `skinrig.simulating.effect_omission`."""
    resume: bool = False
    """Resume an interrupted session; its frames are kept."""
    created: datetime | None = None
    """Date of the session; None: now, less `days_ago`; see `read_clock`."""
    person: SubjectRecord | None = None
    """Pseudonym and consent to record; None: consent to :data:`SIMULATED_USES`, or that of the
    resumed session. A record that differs from the resumed session's is refused."""
    progress: Callable[[str], None] | None = None
    """Called with one line per frame."""

    def __post_init__(self) -> None:
        for name, shown in _COUNT_OPTIONS.items():
            number = getattr(self, name, None)
            if number is not None and number < 1:
                raise SimulationError(
                    f"{shown}: got {number}, expected a number above 0, or none; correct it "
                    "[SR-SIM-002]"
                )
        require_size(self.size)
        require_choice("renderer", self.renderer, get_args(Renderer), SimulationError)
        for name in ("seed", "session_seed", "days_ago"):
            if (number := getattr(self, name)) is not None and number < 0:
                raise SimulationError(f"{name}: got {number}, expected 0 or more")
        width_px = getattr(self, "width_px", None)
        if width_px is not None and width_px < MIN_WIDTH_PX:
            raise SimulationError(
                f"width: got {width_px}, expected {MIN_WIDTH_PX} pixels or more; raise it "
                "[SR-SIM-003]"
            )
        if self.target is not None:
            require_choice("target", self.target, self.targets, SimulationError)
        self.check()
        self.scene_switches()

    def check(self) -> None:
        """Raise if options exclude each other."""
        self.check_rig_of_plan()
        if self.plan is not None and self.exclusive_subject is not None:
            raise SimulationOptionsError(
                "plan: an option of subjects; targets and sequences have their own, so remove it"
            )

    @property
    def noise_seed(self) -> int:
        """Seed of everything that differs between two captures of one subject."""
        return self.seed if self.session_seed is None else self.session_seed

    @property
    def captured_at(self) -> datetime:
        """Date of the session: `created`, or now less `days_ago`."""
        return self.created or read_clock() - timedelta(days=self.days_ago)

    @property
    def rig_age(self) -> RigAge:
        """State of the rig on the day of the session."""
        return draw_rig_age(self.days_ago, seed=self.seed)

    def check_rig_of_plan(self) -> None:
        """Raise for a plan of another rig."""
        if self.plan is not None and self.plan.rig != self.rig:
            raise SimulationError(
                f"plan: got one of rig {self.plan.rig!r}, expected {self.rig!r}; name a plan of it"
            )

    @property
    def exclusive_subject(self) -> str | None:
        """Name of a subject other than skin at rest or with an expression; None for such skin."""
        return None if self.target is None else "a target"

    def refuse_options(self, subject: str, *names: str) -> None:
        """Raise if an option is set that does not apply to `subject`."""
        unset = {one.name: one.default for one in fields(self)}
        for name in names:
            if getattr(self, name) != unset[name]:
                raise SimulationOptionsError(
                    f"{name}: not an option of the {subject} rig; remove it [SR-SIM-004]"
                )

    def scene_switches(self) -> dict[str, Any]:
        """Return the arguments of a scene of skin that omit the effects in `leave_out`.

        Raises
        ------
        SimulationError
            If the rig's scenes cannot omit one of them, or for a target or a sequence.
        """
        if not self.leave_out:
            return {}
        if self.exclusive_subject is not None:
            raise SimulationOptionsError(
                f"--omit (leave_out): an option of skin at rest or with an expression, not of "
                f"{self.exclusive_subject}; remove it"
            )
        try:
            return dict(omission_arguments(self.rig, self.leave_out))
        except ValueError as exc:
            raise SimulationError(str(exc)) from exc


@dataclass(frozen=True, slots=True, kw_only=True)
class FaceOrder(SimulationOrder):
    """Order of a face in front of a rig."""

    width_px: int | None = None
    """Width of each camera's image, px, instead of that of ``size``."""
    mesh: str | Path | None = None
    """Face mesh that replaces the procedural head."""
    states: tuple[str, ...] = ("neutral",)
    """Expressions and physiological conditions: any number for the flash rig, one for the dome."""
    movement: bool = True
    """Whether the face moves and wrinkles with its expressions; else only the blood changes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlashOrder(FaceOrder):
    """Order of a face or a target for the flash rig; "small" is 768 px wide, "full" 3024 px."""

    rig: ClassVar[str] = "flash"
    targets: ClassVar[tuple[str, ...]] = ("white", "chart", "flat", "dark", "malus")

    repeats: int = 1
    """Image pairs per expression."""
    nearer_mm: float = 0.0
    """Distance, mm, by which the face is nearer to the camera than the white reference; below 0
    farther. The flashes are nearer by the same distance; the lens focuses on the reference."""
    bands: tuple[str, ...] = ()
    """Narrow-band LEDs with one crossed frame each, see `capture.plan.led_bands.parse_bands`."""
    sequence: SequenceOrder | None = None
    """Sequence in time instead of ``states``."""
    relaxation_s: float | None = None
    """Time constant of the sequence's blood volume fraction, s; None: that of the expression."""
    site: str | None = None
    """Site of the patch of voxel skin (renderer "reference"); None: cheek."""

    @property
    def exclusive_subject(self) -> str | None:
        """Name of a subject other than skin at rest or with an expression; None for such skin."""
        if self.target is not None:
            return "a target"
        return None if self.sequence is None else "a sequence"

    def check(self) -> None:
        """Raise if options exclude each other."""
        if not math.isfinite(self.nearer_mm):
            raise SimulationError(f"nearer: got {self.nearer_mm}, expected a finite distance, mm")
        if self.nearer_mm != 0.0 and self.exclusive_subject is not None:
            raise SimulationOptionsError(
                f"nearer: an option of faces at rest or with an expression, not of "
                f"{self.exclusive_subject}; remove it"
            )
        SimulationOrder.check(self)
        if self.bands and (self.plan is not None or self.target not in (None, "white")):
            raise SimulationOptionsError(
                "bands: an option of the default plan of a subject or of target white; a plan has "
                "its own frames, so remove it"
            )
        if self.sequence is not None:
            self.refuse_options(self.rig, "target", "repeats", "states", "bands")
        elif self.relaxation_s is not None:
            raise SimulationOptionsError("relaxation: an option of sequences; remove it")


@dataclass(frozen=True, slots=True, kw_only=True)
class DomeOrder(FaceOrder):
    """Order of a face or a target for the dome.

    "small" is 6 cameras, 320 px wide, and 48 lights; "full" is the whole dome. The subject may also
    be a member of the simulated population, P01 to P87
    (`rigsim.population.population.draw_population`), with its own conditions. The lights and
    cameras of a plan are also used with targets.
    """

    rig: ClassVar[str] = "dome"
    targets: ClassVar[tuple[str, ...]] = get_args(DomeTarget)

    lights: int | None = None
    """Number of evenly distributed lights; None: that of ``size``."""
    views: int | None = None
    """Number of evenly distributed cameras; None: that of ``size``."""
    move: bool = False
    """Whether the face drifts and twitches during the capture."""
    wrapped: bool = False
    """Whether the scan is a template wrapped onto the face, with the same triangles and texture
    coordinates for every expression, so that maps of expressions share one texture."""
    scanner: bool = False
    """Whether the scanner's stripes are captured, for a face instead of an attached mesh, for a
    board to calibrate the scanner."""
    subsurface: bool = False
    """True: lateral scattering in skin is always built; False: only if it changes pixels, see
    `rigsim.needs.effects`."""
    interreflections: bool = False
    """True: interreflection of skin is always built; False: only if it changes pixels."""
    conditions: Mapping[str, float] = field(default_factory=dict)
    """Conditions of the face with their amounts, see `rigsim.population.conditions`."""
    texels: int | None = None
    """Texels per side of the face's simulated maps; None: `subject_records.choose_face_texels`."""

    @property
    def state(self) -> str:
        """The expression of the face."""
        return self.states[0]

    def check(self) -> None:
        """Raise if options exclude each other; a dome's plan also applies to targets."""
        if len(self.states) != 1:
            raise SimulationOptionsError(
                f"states: got {', '.join(self.states) or 'none'}, expected one; a session of the "
                "dome has one expression, so capture each into its own session"
            )
        if self.plan is not None and (self.lights, self.views) != (None, None):
            raise SimulationOptionsError("lights, views: a plan has its own; remove them")
        self.check_rig_of_plan()
        if self.scanner and self.wrapped:
            raise SimulationOptionsError("scanner, wrapped: two kinds of scan; remove one of them")
        if self.scanner and (self.plan is not None or self.target not in (None, "charuco")):
            raise SimulationOptionsError(
                "scanner: an option of the default plan of a face or of target charuco; remove it"
            )
        if self.target is None:
            return
        if self.state != "neutral":
            raise SimulationOptionsError(
                f"state: got {self.state!r}, but a target has none; remove it"
            )
        if self.conditions:
            raise SimulationOptionsError(
                f"condition: got {', '.join(self.conditions)}, but a target has none; remove it"
            )
        if self.subsurface or self.interreflections:
            raise SimulationOptionsError(
                "subsurface, interreflections: options of faces, not of targets; remove them"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class GradientOrder(SimulationOrder):
    """Order of a patch of skin in a caliper, or a target, for the gradient sphere.

    "small" is the middle 256 pixels and one angle of the caliper; "full" is all 2048 pixels, which
    the ball always uses, and all angles.
    """

    rig: ClassVar[str] = "gradient"
    targets: ClassVar[tuple[str, ...]] = get_args(GradientTarget)

    width_px: int | None = None
    """Width of the image, px, instead of that of ``size``."""
    site: str | None = None
    """Site of the skin: "forehead" (the default), "cheek", "chin"."""
    angles: tuple[float, ...] | None = None
    """Angles of the caliper, degrees; None: those of ``size``."""
    steps: tuple[int, int] | None = None
    """First and last strain step; None: all, up to the travel limit found in the capture."""

    def check(self) -> None:
        """Raise if options exclude each other."""
        SimulationOrder.check(self)
        if self.target is not None:
            self.refuse_options("target of the gradient", "site", "angles", "steps")


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeOrder(SimulationOrder):
    """Order of tissue or a target for the fiber probe; "full" traces more photons for the truth.

    The subject may also be "homogeneous:SIGMA_A,SIGMA_S_PRIME[,G]" in 1/mm.
    """

    rig: ClassVar[str] = "probe"
    targets: ClassVar[tuple[str, ...]] = get_args(ProbeTarget)

    sites: tuple[str, ...] | None = None
    """Sites of the probe; None: forehead, cheek and chin."""
    repeats: int = 1
    """Placements per site and direction."""
    angles: tuple[float, ...] | None = None
    """One number, the count of directions of the head; None: 1."""
    all_brackets: bool = False
    """Record every exposure bracket, also those that add no information."""

    def check(self) -> None:
        """Raise if options exclude each other."""
        SimulationOrder.check(self)
        if self.target is not None:
            self.refuse_options("target of the probe", "sites", "angles")


ORDER_BY_RIG: Mapping[str, type[SimulationOrder]] = {
    kind.rig: kind for kind in (FlashOrder, DomeOrder, GradientOrder, ProbeOrder)
}
"""Class of each rig's orders."""


def order_for(rig: str, **options: Any) -> SimulationOrder:
    """Create a rig's order from options by name.

    Parameters
    ----------
    rig
        A key of :data:`ORDER_BY_RIG`.
    options
        Fields of its order; a field of another rig's order is refused unless it has its default.

    Raises
    ------
    SimulationError
        For an unknown rig or an invalid value.
    SimulationOptionsError
        For an option of another rig.

    Examples
    --------
    >>> order_for("dome", out=Path("session"), lights=12).rig
    'dome'
    """
    require_choice("rig", rig, ORDER_BY_RIG, SimulationError)
    own = {one.name for one in fields(ORDER_BY_RIG[rig])}
    foreign = {one.name: one for kind in ORDER_BY_RIG.values() for one in fields(kind)}
    for name in sorted(options.keys() & foreign.keys() - own):
        default = foreign[name].default
        if options.pop(name) not in ({} if default is MISSING else default, None):
            shown = name.removesuffix("_mm")
            raise SimulationOptionsError(
                f"{shown}: not an option of the {rig} rig; remove it [SR-SIM-004]"
            )
    return ORDER_BY_RIG[rig](**options)
