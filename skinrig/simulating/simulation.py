"""Simulated captures: a world of boxes and a scene, driven through the real drivers by URL."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path

from capture.plan import Plan
from capture.session import Subject
from skinrig.capturing.sequences import SequenceOrder
from skinrig.simulating.orders import RIGS, OptionsError, Order, Simulated, SimulationError


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
        out=Path(out),
        size=size,
        seed=seed,
        subject=subject,
        mesh=mesh,
        target=target,
        states=tuple(states),
        repeats=repeats,
        resume=resume,
        width_px=width_px,
        lights=lights,
        views=views,
        move=move,
        site=site,
        angles=None if angles is None else tuple(angles),
        steps=steps,
        sites=None if sites is None else tuple(sites),
        all_brackets=all_brackets,
        movement=movement,
        wrapped=wrapped,
        created=created,
        person=person,
        progress=progress,
        sequence=sequence,
        relaxation_s=relaxation_s,
        subsurface=subsurface,
        interreflections=interreflections,
        conditions=dict(conditions or {}),
        plan=plan,
        leave_out=tuple(leave_out),
        nearer_mm=float(nearer_mm),
    )
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
