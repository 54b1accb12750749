"""Simulate captures with the fiber probe: tissue at several sites or a target, with the truth."""

from collections.abc import Mapping, Sequence
from typing import Any

from capture.plan import Plan
from capture.plan.probe import PHANTOM_SITE, PROBE_SITES, group_by_series
from capture.plan.suction import HeadPlacement
from capture.rig import Rig, load_rig
from capture.session import Session
from rigsim.fiber.probe_tissue import PHANTOM_BLOCK as BLOCK
from rigsim.fiber.probe_tissue import TissueError
from rigsim.needs.effects import AUTOMATIC_EFFECTS, SceneEffects
from rigsim.population import files as subject_file
from rigsim.scenes.probe.scene import ProbePlacement, ProbeScene
from rigsim.scenes.probe.scene import probe_truth as ground_truth
from skinrig.capturing.plan_choice import DefaultPlan, parse_direction_count
from skinrig.console import select_attributes
from skinrig.simulating import driving, reference
from skinrig.simulating.exposure_log import SceneLog
from skinrig.simulating.orders import ProbeOrder, SimulationError, SimulationResult, truth_folder

TRUTH_PHOTONS = {"small": 60_000, "full": 2_000_000}
"""Photons per site and angle of skin: noise of about 2 %, or a third of 1 %, in the far fibers."""


def simulate_probe(order: ProbeOrder) -> SimulationResult:
    """Simulate a capture with the fiber probe; see `simulation.simulate`.

    Both sizes have all sites, brackets and pixels, which are fast to simulate; "full" traces more
    photons for the ground truth.
    """
    rig, plan = plan_capture(order)
    driving.require_room(order, rig, plan)
    asked = driving.manifest_settings(
        order,
        sites=",".join(order.sites or PROBE_SITES),
        angles=parse_direction_count(order.angles),
        **select_attributes(order, "size", "repeats", "all_brackets"),
    )
    scene = _build_scene(rig, plan, order)
    if order.target is None:
        _check_sites(scene.tissue, order.sites or PROBE_SITES, rig)
    light = driving.announce_light(plan, rig, order)
    session, log = driving.open_logged_session(order, plan, rig, asked, scene, HeadLog)
    # nobody places the head: a placement is sent to the controller, which passes it to the world
    rig_seconds = driving.drive_plan(order, session, rig, log, all_brackets=order.all_brackets)
    truth = None
    if order.target != "dark":
        truth = truth_folder(order.out)
        appearance = ground_truth(scene, log.list_placements(session))
        driving.write_truth(truth, order, session, appearance, subject=order.subject)
    log.remove()
    return driving.build_result(order, session, scene, rig_seconds, truth, light=light)


def plan_capture(order: ProbeOrder) -> tuple[Rig, Plan]:
    """Return the rig and the plan of an order."""
    rig = load_rig("probe").at_iso(order.iso_factor)
    details = select_attributes(order, "target", "sites", "repeats", "angles")
    return rig, order.plan or DefaultPlan(**details).of(rig)


def _build_scene(rig: Rig, plan: Plan, order: ProbeOrder) -> Any:
    given = select_attributes(order, "subject", "seed", "noise_seed")
    effects = SceneEffects.from_switches(order.scene_switches())
    if order.renderer != "reference" or order.target is not None:
        photons = TRUTH_PHOTONS[order.size]
        return make_scene(rig, order.target, photons=photons, effects=effects, **given)
    order.refuse_options("probe (renderer reference)", "leave_out")
    places = {(head.site, head.angle_deg) for head, _ in group_by_series(plan)}
    return reference.make_probe_scene(
        rig, places=places, **given, **select_attributes(order, "size", "progress")
    )


def _check_sites(tissue: Any, sites: Sequence[str], rig: Rig) -> None:
    """Raise for a site that the tissue does not have, before the capture begins."""
    suction_mbar = rig.probe.suction_mbar if rig.probe is not None else 0.0
    for site in sites:
        try:
            tissue.optics(site, 0.0, suction_mbar)
        except TissueError as error:
            raise SimulationError(str(error)) from error


def make_scene(
    rig: Rig,
    target: str | None,
    *,
    subject: str,
    seed: int,
    photons: int,
    noise_seed: int | None = None,
    effects: SceneEffects = AUTOMATIC_EFFECTS,
) -> Any:
    """Return the scene of a tissue or a target under the probe's actual fibers.

    Parameters
    ----------
    rig : Rig
        Rig of the probe.
    target : str or None
        "phantom" or "dark"; None: skin, or another tissue.
    subject : str
        Preset of the skin, or "homogeneous:SIGMA_A,SIGMA_S_PRIME[,G]" in 1/mm.
    seed : int
        Seed of the subject and the photons; the probe is the same for all.
    noise_seed : int, optional
        Seed of the sensor's noise; default `seed`.
    photons : int
        Photons per site and angle.
    effects : SceneEffects
        Requested effects.

    Raises
    ------
    SimulationError
        For an unknown or malformed subject.
    """
    try:
        tissue = BLOCK if target == "phantom" else subject_file.load_tissue(subject, seed=seed)
    except TissueError as error:
        raise SimulationError(str(error)) from error
    return ProbeScene(
        rig, tissue, seed=seed, noise_seed=noise_seed, photons=photons, effects=effects
    )


class HeadLog(SceneLog):
    """Scene that logs the suction of the head at each exposure.

    The pressure that a session records has the gauge's offset; the ground truth needs the actual
    suction.
    """

    suffix, kinds, max_lag_s = "heads", ("fibers", PHANTOM_SITE), 1e-3

    def describe_exposure(self, exposed: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the suction of the lit head."""
        return {"suction_mbar": exposed["head"].suction_mbar}

    def list_placements(self, session: Session) -> list[Any]:
        """Return the placements with a recorded series, in the plan's order."""
        entries = self.read()
        frames = {record.step_id: record for record in session.frames()}
        suctions: dict[HeadPlacement, list[float]] = {}
        for placement, steps in group_by_series(session.plan):
            for step in steps:
                if step.kind != "mask" and (record := frames.get(step.id)) is not None:
                    entry = self.at(entries, record, f"step {step.id}")
                    suctions.setdefault(placement, []).append(float(entry["suction_mbar"]))
        return [
            ProbePlacement(head.site, head.repeat, head.angle_deg, sum(mbar) / len(mbar))
            for head, mbar in suctions.items()
        ]
