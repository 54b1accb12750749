"""Stripes captured through the real drivers: resumed, retaken, and without a lost projector."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from fixtures.operators import by_operator

from capture.acquire import AcquisitionError, CaptureInterrupted, run_plan
from capture.devices.camera import open_camera
from capture.devices.dome import DomeBox
from capture.devices.port import CommandRefused, Port
from capture.devices.scanner import ScannerBox
from capture.plan.dome import add_scan, dome_calibration_plan, dome_plan
from capture.rig import load_rig
from capture.session import Session, SubjectRecord, verify
from rigsim.boxes.faults import Faults
from rigsim.boxes.scanner import ProjectorLight
from rigsim.world.world import World
from skinrig.capturing.light_safety import light_figures
from skinrig.capturing.plan_choice import needed_boxes

DOME = load_rig("dome")
RIG = DOME.subset(lights=["L060", "L090"], views=["C00"]).resized(16).with_scanner()
PLAN = add_scan(dome_plan(RIG, tracking_interval=0, darks=1, exposures_s=(0.02,)), RIG)
NAMES = (f"stripes-{number}" for number in itertools.count())
STRIPES = [step for step in PLAN.steps if step.kind == "stripes"]


class Photometer:
    """A scene whose first pixels tell which pattern was lit, and for how long."""

    def exposure(self, view_name, *, pops, exposure_s, seed):
        view = RIG.view(view_name)
        image = np.full((view.height_px, view.width_px), view.black_level, np.uint16)
        for pop in pops:
            if isinstance(pop, ProjectorLight):
                image[0, :4] = (
                    1 + int(pop.projector[1:]),
                    1 + ("columns", "rows").index(pop.axis),
                    1 + pop.pattern,
                    round(1e5 * (pop.t_off_s - pop.t_on_s)),
                )
        return image


class Bench:
    def __init__(self, folder, plan=PLAN, **faults):
        self.world = World(RIG, seed=7, scene=Photometer(), faults=Faults(**faults))
        self.name = self.world.register(next(NAMES))
        self.folder, self.plan = folder, plan
        self.session = (
            Session.resume(folder)
            if folder.exists()
            else Session.create(
                folder,
                plan=plan,
                rig=RIG,
                devices={},
                subject=SubjectRecord("p"),
                source="simulated",
                seed=7,
            )
        )
        made = {"dome": DomeBox, "scanner": ScannerBox}
        self.boxes = {
            kind: driver(Port(f"sim://{kind}?world={self.name}", clock=self.world.clock))
            for kind, driver in made.items()
        }
        self.cameras = {v.name: open_camera(f"sim://{self.name}/{v.name}") for v in RIG.all_views}

    def run(self, boxes=None, **more):
        return run_plan(
            self.plan,
            RIG,
            boxes=boxes or self.boxes,
            cameras=self.cameras,
            session=self.session,
            **by_operator({"eyes": "closed", **more}),
        )

    def close(self):
        self.session.release()
        for box in self.boxes.values():
            box.close()
        self.world.unregister()


@pytest.fixture
def make(tmp_path):
    made = []

    def make(**faults):
        made.append(Bench(tmp_path / "s", **faults))
        return made[-1]

    yield make
    for bench in made:
        bench.close()


def check_frames(session):
    """Fail unless every frame shows its own pattern, lit for its whole exposure."""
    for record in session.frames("stripes"):
        shown, index = session.read(record).cfa[0, :4].astype(int), record.index
        wanted = int(str(index["projector"])[1:]), ("columns", "rows").index(index["axis"])
        assert (shown[:3] - 1).tolist() == [*wanted, index["pattern"]]
        assert shown[3] == round(1e5 * RIG.scanner.exposure_s)


def test_plan_scans_subject_along_columns():
    assert [step.kind for step in PLAN.steps[:24]] == ["stripes"] * 24
    assert {step.index["axis"] for step in STRIPES} == {"columns"}
    assert STRIPES[0].cameras == ("S0", "S1")
    assert STRIPES[-1].cameras == ("S2", "S3")
    PLAN.check(RIG)


def test_plan_scans_boards_along_both_axes():
    plan = add_scan(dome_calibration_plan(RIG, "charuco", poses=2), RIG)
    kinds = [step.kind for step in plan.steps]
    assert kinds.count("stripes") == 2 * 2 * (12 + 13)
    assert kinds.index("charuco") < kinds.index("stripes")
    mirror = dome_calibration_plan(RIG, "mirror", spheres=1)
    assert add_scan(mirror, RIG) is mirror or add_scan(mirror, RIG).steps == mirror.steps
    without = DOME.subset(views=["C00"])
    assert add_scan(dome_plan(without), without).steps == dome_plan(without).steps


def test_scanner_is_needed_for_stripes_alone():
    assert needed_boxes(RIG, PLAN) == ("dome", "scanner")
    assert needed_boxes(RIG, dome_calibration_plan(RIG, "mirror", spheres=1)) == ("dome",)


def test_capture_keeps_every_pattern(make):
    bench = make()
    result = bench.run()
    frames = bench.session.frames("stripes")
    assert len(frames) == 48
    assert result.steps == len(PLAN.steps)
    assert result.retakes == 0
    check_frames(bench.session)
    record = frames[-1]
    assert record.actual["projector"] == "P1"
    assert record.actual["stripes"] == 11
    assert not bench.world.box("scanner").device.lit
    assert not bench.world.box("scanner").armed
    bench.session.close()
    assert verify(bench.folder).ok


def test_plan_of_stripes_alone_is_captured(make):
    """Its lights are the projectors', so that the LEDs do not flicker."""
    plan = replace(PLAN, steps=tuple(STRIPES[:2]))
    figures = light_figures(plan, RIG)
    assert (figures["flashes_per_s"], figures["open_eyes"]) == (0.0, "refused")
    bench = make(plan=plan)
    bench.run()
    assert len(bench.session.frames("stripes")) == 2 * len(STRIPES[0].cameras)


def test_lost_frames_are_retaken(make):
    bench = make(drop_frame=0.05, lose_answer=0.05)
    result = bench.run()
    assert result.retakes > 0
    assert len(bench.session.frames("stripes")) == 48
    check_frames(bench.session)


def test_stopped_scan_is_resumed(make):
    bench = make()
    asked = itertools.count()
    with pytest.raises(CaptureInterrupted):
        bench.run(interrupted=lambda: next(asked) >= 10)
    kept = len(bench.session.frames("stripes"))
    assert 0 < kept < 48
    bench.close()
    again = make()
    again.run()
    assert len(again.session.frames("stripes")) == 48
    check_frames(again.session)


def test_lost_projector_is_omitted_with_reason(make):
    bench = make(led_dead="1")
    bench.run()
    frames = bench.session.frames("stripes")
    assert {record.index["projector"] for record in frames} == {"P0"}
    omitted = bench.session.omitted_steps()
    assert len(omitted) == 12
    assert all("draws no current" in reason for reason in omitted.values())
    assert bench.session.frames("olat")


def test_both_projectors_lost_stop_capture(make):
    bench = make(led_dead="0+1")
    with pytest.raises(AcquisitionError, match=r"draws no current.*SR-CAP-007"):
        bench.run()


def test_open_eyes_are_refused_before_light(make):
    bench = make()
    with pytest.raises(AcquisitionError, match=r"stripes flicker.*--eyes"):
        bench.run(eyes="open")
    assert not bench.world.switched


def test_missing_controller_is_named(make):
    bench = make()
    with pytest.raises(AcquisitionError, match="add --port scanner=URL"):
        bench.run(boxes={"dome": bench.boxes["dome"]})


def test_emergency_stop_stops_scan(make):
    bench = make(interlock=True)
    with pytest.raises(CommandRefused, match="Interlock open"):
        bench.run()
    assert not bench.session.frames()
