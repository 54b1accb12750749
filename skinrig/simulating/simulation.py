"""Simulated captures: a world of boxes and a scene, driven through the real drivers by URL."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from capture.acquire import run_plan
from capture.devices.box import Box
from capture.devices.caliper import CaliperBox
from capture.devices.camera import open_camera
from capture.devices.dome import DomeBox, Eyes
from capture.devices.flash import FlashBox
from capture.devices.gradient_sphere import GradientSphereBox
from capture.devices.port import Port
from capture.devices.probe import ProbeBox
from capture.plan import Plan
from capture.rig import Rig
from capture.session import Session, Subject
from skinrig.capturing.sequences import SequenceOrder
from skinrig.errors import UsageError
from skinrig.simulating.leaving_out import left_out_of
from skinrig.simulating.resumption import refusals
from skinrig.simulating.shot_numbers import shots_made
from skinrig.simulating.subject_records import pseudonym

RIGS = ("flash", "dome", "gradient", "probe")
BOXES: Mapping[str, type[Box]] = {
    "flash": FlashBox, "dome": DomeBox, "gradient_sphere": GradientSphereBox, "caliper": CaliperBox,
    "probe": ProbeBox,
}  # fmt: skip
"""Driver of each kind of box."""
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


def simulate_session(
    rig_name: str,
    out: str | Path,
    *,
    size: str = "small",
    seed: int = 0,
    subject: str = "III",
    mesh: str | Path | None = None,
    target: str | None = None,
    states: tuple[str, ...] = ("neutral",),
    repeats: int = 1,
    resume: bool = False,
    width_px: int | None = None,
    lights: int | None = None,
    views: int | None = None,
    move: bool = False,
    site: str | None = None,
    angles: Sequence[float] | None = None,
    steps: tuple[int, int] | None = None,
    sites: Sequence[str] | None = None,
    all_brackets: bool = False,
    movement: bool = True,
    wrapped: bool = False,
    created: datetime | None = None,
    person: Subject | None = None,
    progress: Callable[[str], None] | None = None,
    sequence: SequenceOrder | None = None,
    relaxation_s: float | None = None,
    subsurface: bool = False,
    interreflections: bool = False,
    conditions: Mapping[str, float] | None = None,
    plan: Plan | None = None,
    leave_out: Sequence[str] = (),
    nearer_mm: float = 0.0,
) -> Simulated:
    """Simulate a capture into SESSION/, and write its truth beside it.

    Parameters
    ----------
    rig_name
        One of :data:`RIGS`.
    out
        The session's folder. The truth goes to ``truth-NAME`` beside ``session-NAME``.
    size
        "small" or "full": of the flash rig 768 pixels across or the camera's own 3024; of the dome
        6 cameras, 200 pixels across, and 48 lights, or all that it has; of the gradient sphere the
        middle 256 pixels and one angle of the caliper, or all 2048, which the ball always takes,
        and all angles; of the probe only how many photons its truth is made of.
    seed
        Of the subject, the sensor and the boxes.
    subject
        Preset of the face, by skin type; of the dome also a member of the simulated population, P01
        to P87 (`rigsim.population.population.table_1`), with what it wears; of the probe also
        "homogeneous:SIGMA_A,SIGMA_S_PRIME[,G]" in 1/mm. Of every rig also a file NAME.toml, see
        `rigsim.population.files`.
    mesh
        A face mesh to wear the skin instead of the procedural head.
    target
        Something else instead of a face: of the flash rig "white", "chart", "flat", "dark" or
        "malus"; of the dome "charuco", "mirror", "white" or "dark"; of the gradient sphere "ball",
        "flat" or "dark"; of the probe "phantom" or "dark".
    states
        Expressions and physiological states: the flash rig captures one after the other, a session
        of the dome has one.
    repeats
        Image pairs a state of the flash rig, or placements of the probe a site and angle.
    resume
        Go on with a session that was interrupted; what is on disk is kept.
    width_px
        Pixels across, instead of ``size``.
    lights, views
        So many lights and cameras of the dome, spread evenly; None: as many as ``size`` says.
    move
        Whether the face in the dome drifts and twitches during the capture.
    site
        Where the skin in the gradient sphere is from: "forehead" (the default), "cheek", "chin".
    angles
        Angles of the caliper, degrees; None: as ``size`` says. Of the probe one number: how many
        directions of its head; None: 1.
    steps
        Its first and last position; None: all. Where the skin ends is found out.
    sites
        Where the probe is placed; None: forehead, cheek and chin.
    all_brackets
        Whether the probe takes exposures that can show no more.
    movement
        Whether the face moves and wrinkles with its states; else they change the blood only.
    wrapped
        Whether the scan of the face in the dome is a template wrapped onto it, of the same
        triangles and texture coordinates in every state, so that maps of states share one texture.
    created
        Date of the session; None: now.
    person
        Pseudonym and consent to record; None: one who agreed to :data:`USES`, or, where a session
        is gone on with, as it was begun. Others than it was begun with are refused.
    progress
        Called with one line a frame.
    sequence
        A sequence in time before the flash rig instead of ``states``.
    relaxation_s
        Time constant of its blood, s; None: of the state, see `rigsim.subject.perfusion_course`.
    subsurface, interreflections
        True: light in the dome spreads sideways inside the skin, and goes from skin to skin, even
        where that changes no pixel; False: where it does, see `rigsim.needs.effects`.
    conditions
        Conditions of the face in the dome with their amounts, see `rigsim.population.conditions`.
    plan
        What is captured of the subject instead of the rig's own plan; of the dome its lights and
        cameras are those of targets, too.
    leave_out
        What is not built of skin although it changes pixels, by the switches of
        `skinrig.simulating.leaving_out`.
    nearer_mm
        How much nearer to the flash rig's camera than the white tile's place the face stands, mm;
        below 0 farther. The flashes are then as much nearer, and the lens is focused on the tile.

    Raises
    ------
    SimulationError
        For an unknown rig, size or target.
    """
    if rig_name not in RIGS:
        raise SimulationError(f"rig: got {rig_name!r}, expected one of {', '.join(RIGS)}")
    for name, number in (("width", width_px), ("lights", lights), ("views", views)):
        if number is not None and number < 1:
            raise SimulationError(f"{name}: got {number}, expected a number above 0, or none")
    order = Order(
        out=Path(out), size=size, seed=seed, subject=subject, mesh=mesh, target=target,
        states=tuple(states), repeats=repeats, resume=resume, width_px=width_px, lights=lights,
        views=views, move=move, site=site, angles=None if angles is None else tuple(angles),
        steps=steps, sites=None if sites is None else tuple(sites), all_brackets=all_brackets,
        movement=movement, wrapped=wrapped, created=created, person=person, progress=progress,
        sequence=sequence, relaxation_s=relaxation_s, subsurface=subsurface,
        interreflections=interreflections, conditions=dict(conditions or {}),
        plan=plan, leave_out=tuple(leave_out), nearer_mm=float(nearer_mm),
    )  # fmt: skip
    order.check_stance(rig_name)
    if rig_name != "dome":
        order.refuse(rig_name, subsurface=False, interreflections=False, conditions={})
        order.check_plan(rig_name)
    order.without(rig_name)
    if sequence is not None and rig_name != "flash":
        raise OptionsError(f"sequence: the {rig_name} rig knows nothing of it; leave it out")
    if sequence is None and relaxation_s is not None:
        raise OptionsError("relaxation: is for a sequence")
    if rig_name == "dome":
        from skinrig.simulating.dome import simulate_dome

        return simulate_dome(order)
    if rig_name == "gradient":
        from skinrig.simulating.gradient import simulate_gradient

        return simulate_gradient(order)
    if rig_name == "probe":
        from skinrig.simulating.probe import simulate_probe

        return simulate_probe(order)
    from skinrig.simulating.flash import simulate_flash

    return simulate_flash(order)


def effects_of(scene: Any) -> tuple[Mapping[str, Any], ...]:
    """Return what a scene builds and what not, as its manifest and `Simulated` hold it."""
    return tuple(scene.needs.document())


def open_session(
    order: Order, plan: Plan, rig: Rig, asked: Mapping[str, Any], scene: Any
) -> Session:
    """Begin the session of an order, or go on with it where it was begun with the same settings."""
    if order.resume:
        session = Session.resume(order.out)
        lines = refusals(session, asked, order.seed, order.person)
        if lines:
            session.release()
            told = "".join(f"\n  {line}" for line in lines)
            raise SimulationError(
                f"{order.out}: cannot be gone on with as asked{told}\n"
                "  resume with the same settings, or name another folder"
            )
        return session
    order.out.parent.mkdir(parents=True, exist_ok=True)
    created = order.created
    return Session.create(
        order.out,
        plan=plan,
        rig=rig,
        devices={
            **{name: f"rigsim {name} box" for name in rig.boxes},
            **{view.name: view.serial for view in rig.views},
        },
        subject=order.person or Subject(pseudonym(order.subject, order.seed), USES),
        source="simulated",
        seed=order.seed,
        extra={"simulation": dict(asked), "effects": [dict(one) for one in effects_of(scene)]},
        now=None if created is None else (lambda: created),
    )


def drive(
    session: Session,
    rig: Rig,
    scene: Any,
    seed: int,
    prompt: Callable[[Any, str], None],
    progress: Callable[[str], None] | None,
    *,
    eyes: Eyes = "open",
    force_limit_n: float | None = None,
    run_id: str = "",
    all_brackets: bool = False,
    signal: Callable[[Any, str], None] | None = None,
    begun_s: float | None = None,
) -> float:
    """Run a session's plan through the drivers, on a world registered under its id, and close it.

    Parameters
    ----------
    session, rig
        Open for writing; the rig as it is drawn.
    scene
        What the cameras see first.
    seed
        Of the world.
    prompt
        Called with the world and what the operator is asked for.
    progress
        Called with one line now and then.
    eyes
        What is said of the subject's eyes.
    force_limit_n
        Of a caliper, N.
    run_id
        Begins the tokens of this run.
    all_brackets
        Of a probe.
    signal
        Called with the world and what the subject of a sequence is asked for, at the time.
    begun_s
        The host's time at which the world begins, s since 1970; None: the host's clock is not the
        world's, but this computer's.

    Returns
    -------
    float
        Time that has passed on the rig, s.
    """
    from rigsim.world import World

    world = World(rig, seed=seed, clock="virtual", scene=scene, shots_made=shots_made(session))
    name = world.register(session.id)
    boxes = {
        # a number of fixed length: with drawn ones the lines would take a little longer or shorter
        kind: BOXES[kind](Port(f"sim://{kind}?world={name}", clock=world.clock, first_seq=1))
        for kind in rig.boxes
    }
    cameras = {view.name: open_camera(f"sim://{name}/{view.name}") for view in rig.views}
    hear = None if signal is None else partial(signal, world)
    try:
        run_plan(
            session.plan, rig, boxes=boxes, cameras=cameras, session=session,
            progress=progress, prompt=lambda text: prompt(world, text), eyes=eyes,
            force_limit_n=force_limit_n, run_id=run_id, all_brackets=all_brackets, signal=hear,
            timer=world.clock,
            clock=time.time if begun_s is None else lambda: begun_s + world.now,
        )  # fmt: skip
        session.close()
        return float(world.now)
    finally:
        for camera in cameras.values():
            camera.close()
        for box in boxes.values():
            box.close()
        world.unregister()
        session.release()
