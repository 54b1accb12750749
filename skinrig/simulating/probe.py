"""The fibre probe simulated: tissue at several sites, or a target, and the truth."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast, get_args

from capture.plan import Plan
from capture.plan.probe import (
    PHANTOM_SITE,
    PROBE_SITES,
    ProbeTarget,
    all_series,
    probe_calibration_plan,
    probe_plan,
)
from capture.plan.suction import Placement
from capture.rig import Rig, load_rig
from capture.session import Session
from model import store
from rigsim.scenes.probe.truth import appearance as ground_truth
from skinrig.capturing.acquisition import directions_of
from skinrig.capturing.light_safety import light_figures, light_lines
from skinrig.simulating import subject_records
from skinrig.simulating.driving import drive, effects_of, open_session
from skinrig.simulating.orders import Order, Simulated, SimulationError, truth_folder

PHOTONS = {"small": 60_000, "full": 2_000_000}
"""Of each site and angle of skin: about two percent in the far fibres, or a third of one."""
NEAR_S = 1e-3


def simulate_probe(order: Order) -> Simulated:
    """Simulate a capture with the fibre probe; see `simulation.simulate_session`.

    Either size has all sites, brackets and pixels, which cost little; what "full" has more of are
    the photons of the truth.
    """
    targets = get_args(ProbeTarget)
    if order.target is not None and order.target not in targets:
        raise SimulationError(f"target: got {order.target!r}, expected one of {', '.join(targets)}")
    order.refuse(
        "probe",
        states=("neutral",),
        movement=True,
        mesh=None,
        lights=None,
        views=None,
        move=False,
        width_px=None,
        site=None,
        steps=None,
        wrapped=False,
    )
    if order.target is not None:
        order.refuse("target of the probe", sites=None, angles=None)
    rig = load_rig("probe")
    plan = plan_of(rig, order)
    shown = subject_records.of_manifest(order.subject)
    asked = {
        "rig": "probe",
        "size": order.size,
        "subject": shown,
        "target": order.target or "",
        "sites": ",".join(order.sites or PROBE_SITES),
        "repeats": order.repeats,
        "angles": directions_of(order.angles),
        "all_brackets": order.all_brackets,
        **({} if order.plan is None else {"plan": order.plan.to_json()}),
    }
    scene = make_scene(rig, order.target, subject=order.subject, seed=order.seed, size=order.size)
    if order.target is None:
        _check_sites(scene.tissue, order.sites or PROBE_SITES, rig)
    figures = light_figures(plan, rig)
    if order.progress is not None:
        for line in light_lines(plan, rig):
            order.progress(line)
    session = open_session(order, plan, rig, asked, scene)
    try:
        log = HeadLog(scene, truth_folder(order.out), resume=order.resume, session=session)
    except BaseException:
        session.release()
        raise
    # nobody has to place the head: the box is told where it is, and with it the world
    rig_seconds = drive(
        session,
        rig,
        log,
        order.seed,
        lambda world, text: None,
        order.progress,
        run_id=log.run_id,
        all_brackets=order.all_brackets,
    )
    truth = None
    if order.target != "dark":
        truth = truth_folder(order.out)
        appearance = ground_truth(scene, log.probings(session))
        appearance = dataclasses.replace(
            appearance,
            parameters={
                "kind": "truth",
                "state": "neutral",
                "subject": order.subject,
                **appearance.parameters,
                **subject_records.of_truth(order.subject, "probe", order.progress),
            },
            inputs={"session": session.content_hash},
            seed=order.seed,
        )
        store.write(truth, appearance)
    log.remove()
    return Simulated(
        order.out,
        truth,
        len(session.frames()),
        rig_seconds,
        tuple(scene.left_out),
        light=figures,
        effects=effects_of(scene),
    )


def _check_sites(tissue: Any, sites: Sequence[str], rig: Rig) -> None:
    """Raise where the tissue has no such site, before anything is captured."""
    from rigsim.fiber.probe_tissue import TissueError

    suction_mbar = rig.probe.suction_mbar if rig.probe is not None else 0.0
    for site in sites:
        try:
            tissue.optics(site, 0.0, suction_mbar)
        except TissueError as error:
            raise SimulationError(str(error)) from error


def plan_of(rig: Rig, order: Order) -> Plan:
    """Return the plan of what is to be simulated."""
    if order.target is not None:
        return probe_calibration_plan(rig, cast(ProbeTarget, order.target), repeats=order.repeats)
    if order.plan is not None:
        return order.plan
    return probe_plan(
        rig,
        sites=order.sites or PROBE_SITES,
        repeats=order.repeats,
        angles=directions_of(order.angles),
    )


def make_scene(
    rig: Rig, target: str | None = None, *, subject: str = "III", seed: int = 0, size: str = "small"
) -> Any:
    """Return what the head is placed on, before fibres as they were built.

    Parameters
    ----------
    rig : Rig
        The probe's.
    target : str, optional
        "phantom" or "dark"; skin, or another tissue, by default.
    subject : str
        Preset of the skin, or "homogeneous:SIGMA_A,SIGMA_S_PRIME[,G]" in 1/mm.
    seed : int
        Of the subject, the photons and the sensor's noise; the probe itself is the same for all.
    size : str
        "small" or "full": how many photons.

    Raises
    ------
    SimulationError
        For a subject that is none.
    """
    from rigsim.fiber.probe_tissue import PHANTOM as BLOCK
    from rigsim.fiber.probe_tissue import TissueError
    from rigsim.population import files as subject_file
    from rigsim.scenes.probe.scene import ProbeScene

    try:
        tissue = BLOCK if target == "phantom" else subject_file.tissue(subject, seed=seed)
    except TissueError as error:
        raise SimulationError(str(error)) from error
    return ProbeScene(rig, tissue, seed=seed, photons=PHOTONS[size])


class HeadLog:
    """A scene that notes under which suction the head was lit, beside the session.

    The gauge that a session tells of has a zero of its own; the truth wants the suction that was
    there, also of series that were captured before an interruption, and no session may hold it.

    Parameters
    ----------
    scene
        What the camera sees.
    truth : Path
        Where the truth will be; the log lies beside it until then.
    resume : bool
        Whether the session was begun before.
    session : Session
        Open.

    Raises
    ------
    SimulationError
        When frames were captured before and their log is gone.
    """

    def __init__(self, scene: Any, truth: Path, *, resume: bool, session: Session) -> None:
        self._scene = scene
        self._path = truth.with_name(f".{truth.name}.heads.jsonl")
        if not resume:
            self._path.unlink(missing_ok=True)
        entries = self._read()
        if any(session.frames(kind) for kind in ("fibres", PHANTOM_SITE)) and not entries:
            raise SimulationError(
                f"{self._path}: is gone, and with it the truth of what was captured before; "
                "simulate the session anew"
            )
        self.run_id = f"sim{1 + max((int(entry['run']) for entry in entries), default=0)}"

    def exposure(
        self, view_name: str, *, pops: Sequence[Any], exposure_s: float, seed: int, head: Any
    ) -> Any:
        """Expose the scene, and note the suction of what is lit."""
        if pops:
            entry = {
                "run": int(self.run_id.removeprefix("sim")),
                "t_s": pops[0].t_on_s,
                "suction_mbar": head.suction_mbar,
            }
            with self._path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(entry) + "\n")
        return self._scene.exposure(
            view_name, pops=pops, exposure_s=exposure_s, seed=seed, head=head
        )

    def probings(self, session: Session) -> list[Any]:
        """Return the placements that the session has series of, in the plan's order."""
        from rigsim.scenes.probe.scene import Probing

        entries = self._read()
        by_run: dict[int, list[tuple[float, float]]] = {}
        for entry in entries:
            row = (float(entry["t_s"]), float(entry["suction_mbar"]))
            by_run.setdefault(int(entry["run"]), []).append(row)
        frames = {record.step_id: record for record in session.frames()}
        suctions: dict[Placement, list[float]] = {}
        for placement, steps in all_series(session.plan):
            for step in steps:
                if step.kind == "mask" or step.id not in frames:
                    continue
                record = frames[step.id]
                run = int(str(record.actual["run"]).removeprefix("sim"))
                time_s = float(record.line.t_box_s or 0.0)
                near = [mbar for t_s, mbar in by_run.get(run, []) if abs(t_s - time_s) < NEAR_S]
                if not near:
                    raise SimulationError(f"{self._path}: tells nothing of the step {step.id}")
                suctions.setdefault(placement, []).append(near[0])
        return [
            Probing(place.site, place.repeat, place.angle_deg, sum(found) / len(found))
            for place, found in suctions.items()
        ]

    def remove(self) -> None:
        """Remove the log: the truth is written."""
        self._path.unlink(missing_ok=True)

    def _read(self) -> list[Mapping[str, Any]]:
        if not self._path.is_file():
            return []
        lines = self._path.read_text(encoding="utf-8").splitlines(keepends=True)
        # a last line may be cut off; its frame was not committed
        return [json.loads(line) for line in lines if line.endswith("}\n")]
