"""Plans run on the fiber probe through its driver, on a world that tells."""

import dataclasses
import itertools
import re

import numpy as np
import pytest
from fixtures.operators import by_operator

from capture.acquire import AcquisitionError, CaptureInterrupted, run_plan
from capture.devices.camera import CameraError, Trigger, open_camera
from capture.devices.port import CommandRefused, DeviceError, Port
from capture.devices.probe import ProbeBox
from capture.plan.probe import group_by_series, probe_calibration_plan, probe_plan
from capture.rig import load_rig
from capture.session import Session, SubjectRecord, verify
from rigsim.boxes.faults import Faults
from rigsim.world.world import World

WHOLE = load_rig("probe")


def cut(rig, every=5):
    """The same rig with a few fibers only, side by side before a small camera."""
    fibers = tuple(
        dataclasses.replace(fiber, spot_px=(21.0 + 42.0 * number, 31.5))
        for number, fiber in enumerate(rig.probe.fibers[::every])
    )
    view = dataclasses.replace(rig.views[0], width_px=42 * len(fibers), height_px=64)
    probe = dataclasses.replace(rig.probe, fibers=fibers)
    return dataclasses.replace(rig, probe=probe, views=(view,))


RIG = cut(WHOLE)
PROBE = RIG.probe
NAMES = (f"acquire-probe-{number}" for number in itertools.count())
SEED = 3
BRIGHT = 40.0
"""Peak of a fiber at the source in full scales per second."""
FALL_MM = 2.0
SPOT_PX = 7
SHIFT_PX = 1
ROWS, COLUMNS = np.mgrid[: RIG.views[0].height_px, : RIG.views[0].width_px]


CAPPED = "put the cap on the head"


class Witness:
    """Spots of an exponential profile, and pixels that tell light and head, in the top row."""

    def __init__(self, bright=BRIGHT, fall_mm=FALL_MM):
        self.bright, self.fall_mm = bright, fall_mm
        self.heads = []

    def exposure(self, view_name, *, pops, exposure_s, seed, head):
        rng = np.random.default_rng(seed)
        light_s = sum(pop.level * (pop.t_off_s - pop.t_on_s) for pop in pops)
        only = {pop.fiber for pop in pops}
        electrons = np.full(ROWS.shape, 2.0 * exposure_s)
        for number, fiber in enumerate(PROBE.fibers):
            if only - {None} and number not in only:
                continue
            x, y = fiber.spot_px
            disc = np.hypot(COLUMNS - x - SHIFT_PX, ROWS - y) < SPOT_PX
            level = self.bright * np.exp(-fiber.radius_mm / self.fall_mm) * light_s
            electrons[disc] += 18000.0 * level
        electrons = rng.poisson(np.minimum(electrons, 1e6)) + rng.normal(0.0, 7.0, ROWS.shape)
        image = np.clip(np.round(64 + electrons / RIG.views[0].gain_e_per_dn), 0, 4095)
        image = image.astype(np.uint16)
        image[0, :8] = 64
        image[0, 0] += len(pops)
        image[0, 1] += round(100 * light_s) % 4000
        image[0, 2] = 100 + round(head.angle_deg)
        image[0, 3] = round(head.suction_mbar)
        image[0, 4] = head.placed
        image[0, 5] = min(len(head.site), 99)
        self.heads.append((head, bool(pops)))
        return image


class Bench:
    def __init__(self, tmp_path, plan, scene=None, rig=RIG, **faults):
        self.rig, self.plan = rig, plan
        self.scene = scene or Witness()
        self.session = Session.create(
            tmp_path / "s",
            plan=plan,
            rig=rig,
            devices={},
            subject=SubjectRecord("p"),
            source="simulated",
            seed=SEED,
        )
        self.asked, self.told = [], []
        self.world = None
        self.build(**faults)

    def build(self, **faults):
        """Stand a rig of its own before the session, as after a night."""
        self.tear()
        self.world = World(self.rig, seed=SEED, scene=self.scene, faults=Faults(**faults))
        name = self.world.register(next(NAMES))
        self.box = ProbeBox(Port(f"sim://probe?world={name}", clock=self.world.clock))
        self.cameras = {v.name: open_camera(f"sim://{name}/{v.name}") for v in self.rig.views}

    @property
    def placings(self):
        """What was asked for, but for the cap."""
        return [text for text in self.asked if text != CAPPED]

    def run(self, **more):
        words = {"prompt": self.asked.append, "progress": self.told.append, **more}
        return run_plan(
            self.plan,
            self.rig,
            boxes={"probe": self.box},
            cameras=self.cameras,
            session=self.session,
            **by_operator(words),
        )

    def resume(self):
        path = self.session.path
        self.session.release()
        self.session = Session.resume(path)

    def tear(self):
        if self.world is not None:
            self.box.close()
            self.world.unregister()

    def close(self):
        self.session.release()
        self.tear()

    @property
    def at_rest(self):
        """Whether all is dark and nothing is held."""
        status = self.box.status()
        idle = not (status.lit or status.sucking or status.busy or status.armed)
        return idle and self.box.level() == 0.0


@pytest.fixture
def make(tmp_path):
    made = []

    def make(plan=None, scene=None, rig=RIG, **faults):
        made.append(Bench(tmp_path, plan or short(), scene, rig, **faults))
        return made[-1]

    yield make
    for bench in made:
        bench.close()


def short(sites=("cheek",), brackets=6, longest_s=0.5, step_ev=1.0, darks=1, **more):
    return probe_plan(
        RIG,
        sites=sites,
        brackets=brackets,
        max_exposure_s=longest_s,
        step_ev=step_ev,
        darks=darks,
        **more,
    )


def check_frames(session):
    """Fail unless each frame shows its own light and a held head, of one placement a series."""
    placements = {}
    for placement, steps in group_by_series(session.plan):
        ids = {step.id for step in steps}
        for record in session.frames():
            if record.step_id not in ids:
                continue
            cfa, settings, actual = session.read(record).cfa, record.settings, record.actual
            assert cfa[0, 0] == 65, record.step_id
            light_s = settings["level"] * settings["exposure_s"]
            assert abs(int(cfa[0, 1]) - 64 - 100 * light_s) < 0.6, record.step_id
            assert cfa[0, 2] == 100 + round(placement.angle_deg)
            assert cfa[0, 4] == 1, record.step_id
            assert cfa[0, 5] == len(placement.site)
            assert abs(int(cfa[0, 3]) - PROBE.suction_mbar) <= PROBE.suction_tolerance_mbar + 3
            for name in ("suction_before_mbar", "suction_after_mbar"):
                assert abs(actual[name] - PROBE.suction_mbar) <= PROBE.suction_tolerance_mbar
            assert actual["open_s"] == pytest.approx(settings["exposure_s"], abs=1e-5)
            assert abs(actual["camera_c"] - PROBE.camera_c) <= PROBE.camera_tolerance_c
            fiber = settings.get("fiber")
            name = str(placement) if fiber is None else f"fiber {fiber}"
            placements.setdefault(name, set()).add(actual["placement"])
    for record in session.frames("dark"):
        assert session.read(record).cfa[0, 0] == 64
    assert all(len(one) == 1 for one in placements.values()), placements
    return {name: next(iter(one)) for name, one in placements.items()}


# what is captured -----------------------------------------------------------------------------


def test_frames_show_their_light_and_head_held_throughout(make):
    bench = make(short(sites=("forehead", "chin"), angles=2))
    done = bench.run(all_brackets=True)
    assert (done.frames, done.retakes, done.stale) == (len(bench.plan.steps), 0, 0)
    assert check_frames(bench.session) == {
        "forehead at 0 degrees": 1,
        "forehead at 180 degrees": 2,
        "chin at 0 degrees": 3,
        "chin at 180 degrees": 4,
    }
    assert bench.placings == [
        "place the head on the forehead at 0 degrees",
        "place the head on the forehead at 180 degrees",
        "place the head on the chin at 0 degrees",
        "place the head on the chin at 180 degrees",
    ]
    assert bench.at_rest
    bench.session.close()
    assert verify(bench.session.path).ok


def test_repeats_reposition_head(make):
    bench = make(short(repeats=2, brackets=2))
    bench.run()
    assert len(bench.placings) == 2
    assert set(check_frames(bench.session).values()) == {1, 2}


def test_whole_series_rests_once_and_takes_planned_time(make):
    plan = probe_plan(RIG, sites=["cheek"], darks=0)
    bench = make(plan, Witness(bright=0.03))
    bench.run(all_brackets=True)
    assert len(bench.session.frames("fibers")) == 23
    check_frames(bench.session)
    assert bench.world.box("probe").device.pump.count == 2
    lit = [source for source in bench.world.switched if source.level > 0]
    gaps = [b.t_on_s - a.t_off_s for a, b in itertools.pairwise(lit)]
    assert int(np.argmax(gaps)) == 20  # the rest stands between brackets 20 and 21
    assert gaps[20] > PROBE.rest_s
    frames_s = lit[-1].t_off_s - lit[0].t_on_s
    assert 85.0 < frames_s < 105.0
    assert 0.9 < bench.world.now / plan.estimate_duration_s(RIG) < 1.1


def test_no_suction_lasts_longer_than_skin_bears(make):
    bench = make(probe_plan(RIG, sites=["cheek"], darks=0), Witness(bright=0.03))
    bench.run(all_brackets=True)
    held_since = None
    for t_s, head in bench.world.head_history:
        if head.suction_mbar > 5.0 and held_since is None:
            held_since = t_s
        elif head.suction_mbar <= 5.0:
            held_since = None
        assert held_since is None or t_s - held_since <= PROBE.max_suction_s + 1.0


# fewer exposures ------------------------------------------------------------------------------


def test_longer_exposures_are_omitted_once_all_fibers_measured(make):
    bench = make(short(brackets=10, longest_s=4.0), Witness(bright=10.0, fall_mm=7.0))
    bench.run()
    (reason,) = set(bench.session.omitted_steps().values())
    match = re.fullmatch(
        r"cheek at 0 degrees: bracket(?:s (\d+)-9| 9) omitted: all 6 fibers above 50 % of full "
        r"scale at ([\d.]+) s",
        reason,
    )
    assert match, reason
    assert reason in bench.told
    frames = bench.session.frames("fibers")
    # the farthest fiber reaches half of full scale within its last exposure
    peak = 10.0 * np.exp(-6.55 / 7.0)
    last_s = frames[-1].settings["exposure_s"]
    assert 0.5 <= peak * last_s
    assert peak * frames[-2].settings["exposure_s"] < 0.52
    assert bench.session.pending_frames() == []
    bench.session.close()
    assert verify(bench.session.path).ok


def test_all_brackets_are_taken_on_request(make):
    bench = make(short(brackets=10, longest_s=4.0), Witness(bright=10.0, fall_mm=7.0))
    bench.run(all_brackets=True)
    assert bench.session.omitted_steps() == {}
    assert len(bench.session.frames("fibers")) == 10


def test_exposures_continue_while_any_fiber_is_still_measurable(make):
    bench = make(short(brackets=10, longest_s=4.0), Witness(bright=10.0, fall_mm=1.0))
    bench.run()
    assert len(bench.session.frames("fibers")) == 10


def test_fibers_staying_in_noise_do_not_delay_others(make):
    scene = Witness(bright=3e4, fall_mm=0.25)  # bright near ones, and nothing at all far off
    bench = make(short(brackets=12, longest_s=0.1, step_ev=0.5), scene)
    bench.run()
    reasons = set(bench.session.omitted_steps().values())
    assert all("would stay in the noise" in reason for reason in reasons)


def test_whole_series_reports_undetected_fibers(make):
    scene = Witness(bright=1e4, fall_mm=0.25)
    bench = make(short(brackets=6, longest_s=0.5), scene)
    bench.run()
    (noise,) = [line for line in bench.told if "stays in the noise" in line]
    assert re.match(r"cheek at 0 degrees: red of F\d\d", noise)
    (bright,) = [line for line in bench.told if "saturated in every exposure" in line]
    assert "red of F01; green of F01; blue of F01" in bright


# pressure and temperature ---------------------------------------------------------------------


def test_leak_is_refused_reporting_pressure_reached_and_remedy(make):
    bench = make(short(darks=0), pump_leak=0.8)
    with pytest.raises(AcquisitionError) as caught:
        bench.run()
    text = str(caught.value)
    assert re.search(r"cheek at 0 degrees: refused, the suction reached only \d+ mbar", text)
    assert "expected 60 +- 6 mbar" in text
    assert "membrane" in text
    assert "tube" in text
    assert len(bench.placings) == 3
    assert "again: the suction reached only" in bench.placings[1]
    assert bench.session.frames() == []
    assert not any(source.level > 0 for source in bench.world.switched)
    assert bench.at_rest


def test_small_leak_leaving_limits_is_refused(make):
    """The box holds what reaches 70 %; the measurement wants more."""
    bench = make(short(darks=0), pump_leak=0.2)
    with pytest.raises(AcquisitionError, match=r"the suction is 4\d|5[0-3] mbar"):
        bench.run()
    assert bench.session.frames() == []


def test_dead_pump_and_dead_gauge_are_reported_separately(make, tmp_path):
    bench = make(short(darks=0), pump_dead=True)
    with pytest.raises(AcquisitionError, match="reached only"):
        bench.run()
    bench.build(gauge_dead_after=3.0)
    with pytest.raises(DeviceError, match="gauge"):
        bench.run()
    assert bench.session.frames() == []


def test_detached_head_is_placed_again_and_series_restarts(make):
    bench = make(short(brackets=8, longest_s=2.0), head_lifts_after=4.5)
    done = bench.run(all_brackets=True)
    assert done.retakes == 1
    assert check_frames(bench.session) == {"cheek at 0 degrees": 2}
    assert len(bench.placings) == 2
    assert "again: the suction f" in bench.placings[1]
    assert len(bench.session.frames("fibers")) == 8
    assert {record.attempt for record in bench.session.frames()} == {1}


class Drifting:
    """The box's driver, whose gauge goes astray after some readings."""

    def __init__(self, box, wrong):
        self._box, self._wrong, self._count = box, wrong, itertools.count()
        self.exposing = False

    def __getattr__(self, name):
        return getattr(self._box, name)

    def open_shutter(self, seconds):
        self.exposing = True
        return self._box.open_shutter(seconds)

    def pressure_mbar(self):
        value = self._box.pressure_mbar()
        if self.exposing:  # the reading after an exposure
            self.exposing = False
            if next(self._count) in self._wrong:
                return value + 20.0
        return value


def test_exposure_with_drifting_suction_is_retaken_after_suction(make):
    bench = make()
    bench.box = Drifting(bench.box, {2, 3})
    done = bench.run(all_brackets=True)
    assert done.retakes == 2
    check_frames(bench.session)
    tries = [record.actual["tries"] for record in bench.session.frames("fibers")]
    assert tries == [1, 1, 3, 1, 1, 1]
    assert bench.world.box("probe").device.pump.count == 3
    assert len(bench.placings) == 1


def test_three_drifts_refuse_the_measurement(make):
    bench = make()
    bench.box = Drifting(bench.box, {2, 3, 4})
    with pytest.raises(AcquisitionError, match=r"the suction is \d+ mbar, expected 60"):
        bench.run(all_brackets=True)
    assert bench.session.frames("fibers") == []
    assert bench.at_rest


def test_warming_camera_is_refused_with_temperature(make):
    bench = make(camera_warms_after=0.0)
    bench.world.advance(60.0)
    with pytest.raises(AcquisitionError, match=r"camera: still at \d+\.\d degrees.*cooling"):
        bench.run()
    assert bench.session.frames("fibers") == []
    assert any("waiting for it" in line for line in bench.told)
    assert bench.at_rest


def test_camera_still_warm_is_waited_for(make):
    bench = make(short(darks=1))
    honest, count = bench.box.camera_c, itertools.count()
    bench.box.camera_c = lambda: honest() + (12.0 if next(count) < 5 else 0.0)
    bench.run()
    assert bench.session.pending_frames() == []
    check_frames(bench.session)


# camera and shutter ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "faults",
    [
        {"stale": 0.3},
        {"drop_frame": 0.15},
        {"late_frame": 0.2, "late_frame_s": 12.0},
        {"repeat_frame": 0.5, "late_frame_s": 12.0},
    ],
    ids=lambda faults: next(iter(faults)),
)
def test_occasional_frame_failures_leave_sound_session(make, faults):
    bench = make(short(brackets=8), **faults)
    done = bench.run(all_brackets=True)
    assert done.stale + done.retakes > 0
    check_frames(bench.session)
    assert bench.session.pending_frames() == []


@pytest.mark.parametrize("part", ["_stuck", "_jam"])
def test_occasional_shutter_failures_leave_sound_session(make, part):
    bench = make(short(brackets=8))
    shutter, honest, count = bench.world.box("probe").device.shutter, bench.box.open_shutter, [0]

    def open_shutter(seconds):
        count[0] += 1
        setattr(shutter, part, 1.0 if count[0] in (2, 6, 7) else 0.0)
        return honest(seconds)

    def close_shutter():
        setattr(shutter, part, 0.0)
        type(bench.box).close_shutter(bench.box)

    bench.box.open_shutter, bench.box.close_shutter = open_shutter, close_shutter
    done = bench.run(all_brackets=True)
    assert done.retakes == 3
    check_frames(bench.session)
    assert bench.session.pending_frames() == []
    tries = [record.actual["tries"] for record in bench.session.frames("fibers")]
    assert tries == [1, 2, 1, 1, 3, 1, 1, 1]


@pytest.mark.parametrize(
    ("faults", "match"),
    [
        ({"drop_frame": 1.0}, "failed 3 times"),
        ({"wrong_exposure": 1.0}, "stops off"),
        ({"wrong_camera": 1.0}, "two cameras are mixed up"),
        ({"shutter_stuck": 1.0}, "did not open"),
    ],
)
def test_permanent_fault_ends_capture_with_reason(make, faults, match):
    bench = make(short(darks=0), **faults)
    with pytest.raises(AcquisitionError, match=match):
        bench.run()
    assert bench.session.frames() == []
    assert bench.at_rest


def test_camera_without_trigger_line_is_refused_before_light(make):
    bench = make()
    object.__setattr__(bench.cameras["cam"].info, "triggers", (Trigger.SOFTWARE,))
    with pytest.raises(CameraError, match="trigger line"):
        bench.run()
    assert bench.placings == []


@pytest.mark.parametrize(
    ("key", "value", "match"),
    [
        ("fibres", 12, "the controller has 12, the rig 6"),
        ("shutter_max_ms", 100.0, "the shutter opens for"),
        ("suction_max_mbar", 40.0, "the controller allows at most 40"),
        ("suction_max_ms", 1000.0, "the controller applies suction for at most 1 s"),
        ("dose_ws", 1e-4, "light dose"),
    ],
)
def test_plan_beyond_controller_limits_is_refused_before_light(make, key, value, match):
    bench = make()
    bench.box._limits = {**bench.box.limits, key: value}
    with pytest.raises(AcquisitionError, match=match):
        bench.run()
    assert bench.placings == []
    assert bench.session.frames() == []


def test_the_emergency_stop_ends_a_capture(make):
    bench = make(interlock_after=3.0)
    with pytest.raises(DeviceError):
        bench.run()
    assert bench.at_rest


def test_subject_dose_is_refused_by_controller(make):
    bench = make(short(darks=0))
    bench.world.box("probe").device.shutter.dose_limit_ws = 1e-6
    with pytest.raises(CommandRefused, match="104"):
        bench.run()


# interruptions --------------------------------------------------------------------------------


class Killed(BaseException):
    """The host is gone: nothing is told to anybody."""


def kill_at(bench, owner, name, number):
    """Make the host vanish before its n-th call of something."""
    honest, count = getattr(owner, name), itertools.count(1)

    def act(*args, **words):
        if next(count) == number:
            raise Killed
        return honest(*args, **words)

    setattr(owner, name, act)


@pytest.mark.parametrize(
    ("owner", "name", "number"),
    [
        ("session", "commit_step", 1),
        ("session", "commit_step", 4),
        ("session", "commit_step", 6),
        ("session", "commit_step", 9),
        ("box", "open_shutter", 1),
        ("box", "open_shutter", 4),
        ("box", "open_shutter", 6),
        ("box", "suck", 2),
        ("session", "omit_steps", 1),
        ("session", "omit_steps", 2),
    ],
)
def test_capture_resumes_after_any_interruption(make, owner, name, number):
    bench = make(short(sites=("forehead", "cheek"), brackets=8, longest_s=2.0), Witness(20.0, 7.0))
    kill_at(bench, getattr(bench, owner), name, number)
    with pytest.raises(Killed):
        bench.run()
    before = {r.step_id: r.line.t_box_s for r in bench.session.frames()}
    bench.resume()
    bench.build()
    asked = len(bench.placings)
    bench.run()
    assert bench.session.pending_frames() == []
    check_frames(bench.session)
    assert bench.at_rest
    # a series that was whole is not touched again; the head is placed anew for each other one
    whole = 0
    for _, steps in group_by_series(bench.plan):
        left = [step.id for step in steps if step.id not in bench.session.omitted_steps()]
        attempts = {r.attempt for r in bench.session.frames() if r.step_id in left}
        whole += set(left) <= set(before) and attempts == {1}
    assert len(bench.placings) - asked == 2 - whole
    bench.session.close()
    found = verify(bench.session.path)
    assert found.ok, found.problems


def test_a_series_of_two_placements_would_not_pass(make):
    """The check above can fail."""
    bench = make()
    kill_at(bench, bench.session, "commit_step", 6)  # in the middle of the series' commits
    with pytest.raises(Killed):
        bench.run(all_brackets=True)
    bench.resume()
    series = {r.step_id: r.actual["placement"] for r in bench.session.frames("fibers")}
    assert len(series) == 2
    bench.build()
    bench.run(all_brackets=True)
    anew = {r.step_id: (r.attempt, r.actual["placement"]) for r in bench.session.frames("fibers")}
    assert {anew[step] for step in series} == {(2, 2)}
    assert {anew[step] for step in anew if step not in series} == {(1, 2)}


def test_operator_stop_between_exposures_leaves_all_dark(make):
    bench = make()
    count = itertools.count()
    with pytest.raises(CaptureInterrupted):
        bench.run(interrupted=lambda: next(count) > 7)
    assert bench.at_rest
    bench.resume()
    bench.build()
    bench.run()
    assert bench.session.pending_frames() == []
    check_frames(bench.session)


# the phantom ----------------------------------------------------------------------------------


def test_phantom_is_placed_once_fibers_uncovered_singly(make):
    plan = probe_calibration_plan(RIG, darks=1, brackets=10, max_exposure_s=4.0, step_ev=1.0)
    bench = make(plan, Witness(bright=20.0, fall_mm=2.0))
    bench.run()
    assert bench.placings == ["place the head on the phantom at 0 degrees"]
    assert bench.session.pending_frames() == []
    assert set(check_frames(bench.session).values()) == {1}
    by_fiber = {}
    for record in bench.session.frames("mask"):
        by_fiber.setdefault(record.index["fiber"], []).append(record)
    assert sorted(by_fiber) == list(range(6))
    for number, records in by_fiber.items():
        assert 1 <= len(records) <= 2
        fiber = PROBE.fibers[number]
        x, y = (round(v) for v in fiber.spot_px)
        peaks = [int(bench.session.read(r).cfa[y, x]) for r in records]
        exposures = [r.settings["exposure_s"] for r in records]
        longest = max(s.settings["exposure_s"] for s in plan.steps if s.kind == "mask")
        # its own spot is seen unsaturated, and light astray from it as long as is useful
        assert peaks[0] < 4095 * 0.85
        assert peaks[0] > 64 + 0.05 * 4031 or exposures[0] == longest
        assert exposures[-1] >= min(8.0 * exposures[0], longest)
        other = PROBE.fibers[(number + 2) % 6]
        assert bench.session.read(records[0]).cfa[y, round(other.spot_px[0])] < 120
        assert {r.actual["fiber"] for r in records} == {number}
    (reason,) = {t for t in bench.session.omitted_steps().values() if "covered" in t}
    assert reason in bench.told


def test_requested_masks_are_taken_dark_needs_no_head(make):
    plan = probe_calibration_plan(RIG, darks=1, brackets=4, max_exposure_s=0.1, step_ev=2.0)
    bench = make(plan, Witness(20.0))
    bench.run(all_brackets=True)
    assert len(bench.session.frames("mask")) == 6 * 2
    check_frames(bench.session)


def test_darks_need_a_capped_head_and_no_light(make):
    bench = make(probe_calibration_plan(RIG, "dark", darks=2))
    bench.run()
    assert bench.asked == [CAPPED]
    assert len(bench.session.frames("dark")) == 6
    check_frames(bench.session)
    assert bench.world.switched == []
    record = bench.session.frames("dark", bracket=22, repeat=0)[0]
    assert record.settings["exposure_s"] == 30.0
    assert abs(record.actual["camera_c"] - PROBE.camera_c) <= PROBE.camera_tolerance_c


def test_mask_choice_continues_after_resume_without_choosing_again(make):
    plan = probe_calibration_plan(RIG, darks=0, brackets=8, max_exposure_s=1.0, step_ev=1.0)
    bench = make(plan, Witness(20.0))
    kill_at(bench, bench.box, "open_shutter", 8 + 7)
    with pytest.raises(Killed):
        bench.run()
    left_out = bench.session.omitted_steps()
    assert left_out
    bench.resume()
    bench.build()
    bench.run()
    assert bench.session.omitted_steps() == left_out
    assert bench.session.pending_frames() == []
    placed = check_frames(bench.session)
    assert (placed["phantom at 0 degrees"], placed["fiber 0"], placed["fiber 5"]) == (1, 1, 2)


def test_capped_dark_frames_are_taken_after_controller_release(make):
    bench = make(probe_calibration_plan(RIG, "dark", darks=2, brackets=5, max_exposure_s=0.1))

    def late(honest, which):
        """Have the host busy for longer than the lease, at its n-th call of something."""
        count = itertools.count()

        def act(*args):
            value = honest(*args)
            if next(count) == which:
                bench.world.advance(bench.world.now + 8.0)
            return value

        return act

    bench.box.camera_c = late(bench.box.camera_c, 3)
    bench.box.trigger_camera = late(bench.box.trigger_camera, 4)
    bench.run()
    assert bench.asked == [CAPPED]
    assert len(bench.session.frames("dark")) == 6
    for record in bench.session.frames():
        assert bench.session.read(record).cfa[0, 4] == 1
    assert {record.actual["tries"] for record in bench.session.frames()} == {1, 2}
