import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures.operators import by_operator

from capture.acquire import AcquisitionError, CaptureInterrupted, run_plan
from capture.devices.camera import (
    CameraError,
    CameraInfo,
    Frame,
    FrameTimeout,
    Trigger,
    WrongCamera,
)
from capture.devices.port import LinkLost
from capture.plan import Plan, flash_plan
from capture.rig import load_rig
from capture.session import Session, SubjectRecord, verify

RIG = load_rig("flash").resized(16)
VIEW = RIG.views[0]


class Box:
    """A flash box that notes what it is told and drives the cameras' trigger line."""

    def __init__(self, log, fail_at=None):
        self.log, self.fail_at, self.shots = log, fail_at, 0
        self.limits = {"power_min": 0.03125, "power_max": 1.0}
        self.polarizer, self.power, self.line = "parallel", 0.0, []
        self.led, self.forgotten = "", 0

    def arm(self):
        self.log.append("arm")

    def set_polarizer(self, polarizer):
        self.polarizer = polarizer

    def set_analyzer(self, angle_deg):
        self.polarizer = "other"

    def set_sync_delay(self, seconds):
        self.log.append(f"sync {seconds:g}")

    def set_power(self, power):
        self.power = power

    def set_led(self, center_nm, width_nm):
        self.led = f"LED-{center_nm:.0f}-{width_nm:.0f}"
        if self.forgotten:  # such as after a power cut
            self.forgotten -= 1
            self.led = ""

    def wait_charged(self, timeout_s):
        pass

    def fire(self, token):
        self.shots += 1
        if self.shots == self.fail_at:
            raise LinkLost("unplugged")
        self.log.append(f"fire {token} {self.polarizer}")
        for camera in self.line:
            camera.expose()
        led, self.led = self.led, ""
        return SimpleNamespace(
            led=led,
            token=token,
            t_box_s=float(self.shots),
            power=self.power,
            polarizer=self.polarizer,
            analyzer_deg=90.0 if self.polarizer == "crossed" else 0.0,
        )

    def trigger_cameras(self, token):
        self.log.append(f"trigger {token}")
        for camera in self.line:
            camera.expose()

    def dark(self):
        self.log.append("dark")


class Camera:
    def __init__(self, spoil=()):
        self.info = CameraInfo(
            VIEW.serial,
            VIEW.camera_model,
            VIEW.width_px,
            VIEW.height_px,
            "RGGB",
            (512.0,) * 4,
            VIEW.white_level,
            (Trigger.EDGE, Trigger.SOFTWARE),
        )
        self.now, self.spoil, self.taken, self.queue = 0.0, list(spoil), 0, []

    def clock_s(self):
        return self.now

    def configure(self, want):
        self.want = want
        return want

    def arm(self, count, trigger):
        self.queue = []

    def fire(self):
        self.expose()

    def expose(self):
        self.now += 1.0
        image = np.full((VIEW.height_px, VIEW.width_px), 600 + self.taken, np.uint16)
        frame = Frame(VIEW.serial, 0, self.now, self.now + 0.01, self.want, image)
        self.taken += 1
        if self.spoil:
            change = self.spoil.pop(0)
            frame = None if change == "dropped" else dataclasses.replace(frame, **change)
        if frame is not None:
            self.queue.append(frame)

    def frame(self, timeout_s):
        if not self.queue:
            raise FrameTimeout("no frame")
        return self.queue.pop(0)

    def abort(self):
        self.queue = []

    def close(self):
        pass


@pytest.fixture
def plan():
    return flash_plan(RIG, darks=1, states=("neutral", "smile"))


def created(path, plan):
    """Create a session, and release it after the test."""
    made = Session.create(
        path, plan=plan, rig=RIG, devices={}, subject=SubjectRecord("p"), source="measured"
    )
    yield made
    made.release()


@pytest.fixture
def session(tmp_path, plan):
    yield from created(tmp_path / "s", plan)


def run(plan, session, box, camera, **more):
    box.line = [camera]
    return run_plan(
        plan,
        RIG,
        boxes={"flash": box},
        cameras={"cam": camera},
        session=session,
        **by_operator(more),
    )


def test_steps_are_committed_with_their_own_light(plan, session):
    log = []
    done = run(plan, session, Box(log), Camera())
    assert (done.steps, done.frames, done.retakes) == (5, 5, 0)
    session.close()
    assert verify(session.path).ok
    crossed = session.frames("subject", state="neutral", polarizer="crossed")[0]
    assert crossed.actual["polarizer"] == "crossed"
    frame = session.read(crossed)
    assert frame.light["polarizer"] == "crossed"
    assert frame.step_id == crossed.step_id
    assert session.read(session.frames("dark")[0]).light["light"] == "none"


def test_the_subject_is_asked_once_for_each_state(plan, session):
    asked = []
    run(plan, session, Box([]), Camera(), prompt=asked.append)
    assert asked == ["neutral", "smile"]


@pytest.mark.parametrize("fault", ["dropped", {"seq": 5}, {"t_start_s": -1.0}])
def test_step_without_frame_is_reshot_with_new_token(plan, session, fault):
    log = []
    done = run(plan, session, Box(log), Camera(spoil=[{}, fault]))
    assert (done.frames, done.retakes) == (5, 1)
    shots = [entry for entry in log if entry.startswith("fire")]
    assert len(shots) == len(set(shots)) == 5


def test_flashes_never_reuse_token_despite_equal_step_names(plan, session, tmp_path):
    log = []
    with pytest.raises(LinkLost):
        run(plan, session, Box(log, fail_at=3), Camera())
    run(plan, session, Box(log), Camera())
    tokens = [entry.split()[1] for entry in log if entry.startswith("fire")]
    assert len(set(tokens)) == len(tokens) == 4
    assert all(len(token) <= 48 for token in tokens)


def test_token_fits_controller_for_any_step_name_length(tmp_path):
    steps = tuple(
        dataclasses.replace(step, id="S" * 63 + str(k))
        for k, step in enumerate(flash_plan(RIG, darks=0).steps)
    )
    plan, log = Plan(RIG.name, steps), []
    with Session.create(
        tmp_path / "s",
        plan=plan,
        rig=RIG,
        devices={},
        subject=SubjectRecord("p"),
        source="measured",
    ) as session:
        run(plan, session, Box(log), Camera())
    tokens = [entry.split()[1] for entry in log if entry.startswith("fire")]
    assert all(len(token) <= 48 for token in tokens)
    assert len(set(tokens)) == len(tokens) == 2


def test_step_failing_repeatedly_ends_dark_keeps_captured_frames(plan, session):
    log = []
    with pytest.raises(AcquisitionError, match=r"failed 3 times.*--resume"):
        run(plan, session, Box(log), Camera(spoil=[{}, {}, *["dropped"] * 9]))
    assert log[-1] == "dark"
    assert len(session.frames()) == 2


def test_lost_link_ends_dark_second_run_takes_missing(plan, session):
    log = []
    with pytest.raises(LinkLost):
        run(plan, session, Box(log, fail_at=3), Camera())
    assert log[-1] == "dark"
    done = run(plan, session, Box(log), Camera())
    assert done.steps == 2
    assert session.pending_frames() == []


def test_an_interrupt_ends_dark(plan, session):
    log = []
    with pytest.raises(CaptureInterrupted):
        run(plan, session, Box(log), Camera(), interrupted=lambda: len(log) > 2)
    assert log[-1] == "dark"


def with_lag(seconds):
    return dataclasses.replace(RIG, views=(dataclasses.replace(VIEW, shutter_lag_s=seconds),))


@pytest.mark.parametrize("lag_s", [0.0, 0.025])
def test_flash_waits_for_shutter_described_in_rig_file(plan, session, lag_s):
    box = Box([])
    box.limits = {"power_max": 1.0, "sync_max_us": 50_000}
    camera = Camera()
    box.line = [camera]
    run_plan(plan, with_lag(lag_s), boxes={"flash": box}, cameras={"cam": camera}, session=session)
    # also a delay of 0 is set: a run before may have left another
    assert [entry for entry in box.log if "sync" in entry] == [f"sync {lag_s:g}"]


@pytest.mark.parametrize("limits", [{}, {"sync_max_us": 20_000}])
def test_shutter_slower_than_controller_wait_is_refused_first(plan, session, limits):
    box = Box([])
    box.limits = {"power_max": 1.0, **limits}
    with pytest.raises(AcquisitionError, match=r"shutter_lag_s.*nothing was fired"):
        run_plan(
            plan, with_lag(0.025), boxes={"flash": box}, cameras={"cam": Camera()}, session=session
        )
    assert box.log == []


def test_plan_beyond_controller_limits_is_refused_before_flash(plan, session):
    box = Box([])
    box.limits = {"power_max": 0.5}
    with pytest.raises(AcquisitionError, match="nothing was fired"):
        run(plan, session, box, Camera())
    assert box.log == []


def test_camera_foreign_to_rig_is_refused_before_flash(plan, session):
    camera, log = Camera(), []
    camera.info = dataclasses.replace(camera.info, serial="ZZ")
    with pytest.raises(WrongCamera, match=r"got the camera ZZ, expected"):
        run(plan, session, Box(log), camera)
    assert log == []


def test_missing_controller_error_names_option_to_type(plan, session):
    with pytest.raises(AcquisitionError, match="--port flash=URL"):
        run_plan(plan, RIG, boxes={}, cameras={"cam": Camera()}, session=session)


def released_by(*triggers):
    camera = Camera()
    camera.info = dataclasses.replace(camera.info, triggers=triggers)
    return camera


def test_camera_on_controller_line_is_released_for_darks(plan, session):
    camera, log = released_by(Trigger.EDGE), []
    camera.fire = lambda: pytest.fail("is not released by the computer")
    done = run(plan, session, Box(log), camera)
    assert done.frames == 5
    (dark,) = [entry for entry in log if entry.startswith("trigger")]
    assert dark.endswith(".D000")
    # no light was allowed before the pulse
    assert "arm" not in log[: log.index(dark)]


def test_manually_released_camera_is_requested_clearly_and_awaited(session, plan):
    camera, asked, waited = released_by(Trigger.HAND), [], []

    def press(text):
        asked.append(text)
        camera.expose()

    def frame(timeout_s):
        waited.append(timeout_s)
        return camera.queue.pop(0)

    camera.frame = frame
    with pytest.raises(CameraError, match="trigger line"):  # the lit step after the dark
        run(plan, session, Box([]), camera, prompt=press)
    (text,) = [text for text in asked if text != "neutral"]
    for word in ("D000", "press the shutter", "cam", VIEW.serial, "0.008 s", "ISO 100", "60 s"):
        assert word in text
    assert waited[0] > 60.0
    assert [record.step_id for record in session.frames()] == ["D000"]


def test_retry_after_misfire_carries_run_name(plan, session):
    log = []
    run(plan, session, Box(log), Camera(spoil=[{}, "dropped"]), run_id="run1")
    tokens = [entry.split()[1] for entry in log if entry.startswith("fire")]
    assert all(token.startswith("run1.") for token in tokens)
    assert tokens[:2] == ["run1.2.1.S000", "run1.2.2.S000"]


def test_camera_unreleasable_by_controller_is_refused_before_flash(plan, session):
    camera, log = Camera(), []
    camera.info = dataclasses.replace(camera.info, triggers=(Trigger.SOFTWARE,))
    with pytest.raises(CameraError, match="hot folder"):
        run(plan, session, Box(log), camera)
    assert not [entry for entry in log if entry.startswith("fire")]


@pytest.fixture
def led_plan():
    return flash_plan(RIG, darks=1, leds=("LED-590-20",))


@pytest.fixture
def led_session(tmp_path, led_plan):
    yield from created(tmp_path / "led", led_plan)


LED_LIMITS = {"power_min": 0.03125, "power_max": 1.0, "led_min_nm": 420, "led_max_nm": 680}


def test_frame_under_wrong_light_is_retaken(led_plan, led_session):
    box = Box([])
    box.limits, box.forgotten = LED_LIMITS, 1
    run(led_plan, led_session, box, Camera())
    lights = [r.line.actual["light"] for r in led_session.frames("subject")]
    assert lights == ["flash", "flash", "LED-590-20"]
    assert [r.line.actual["tries"] for r in led_session.frames("subject")] == [1, 1, 2]


@pytest.mark.parametrize(
    ("limits", "why"),
    [
        ({"led_max_nm": 0}, "the controller has no LEDs"),
        ({"led_min_nm": 600}, "the controller has LEDs of 600 to 680 nm"),
    ],
)
def test_missing_led_is_refused_before_flash(led_plan, led_session, limits, why):
    box = Box([])
    box.limits = LED_LIMITS | limits
    with pytest.raises(AcquisitionError, match=why):
        run(led_plan, led_session, box, Camera())
    assert box.shots == 0
