import dataclasses

import numpy as np
import pytest

from capture import raw
from capture.devices import camera as cameras
from capture.devices.camera import CameraInfo, Exposure, Frame, Trigger, check_frame, next_frame
from capture.devices.cameras import gphoto
from capture.devices.cameras.hot_folder import HotFolder

INFO = CameraInfo("A1", "test", 4, 2, "RGGB", (64.0,) * 4, 4095, (Trigger.EDGE,))
WANT = Exposure(0.01, 100)
GOOD = Frame("A1", 0, 10.0, 10.01, WANT, np.zeros((2, 4), np.uint16))


def check(frame):
    check_frame(frame, INFO, seq=0, not_before_s=10.0, want=WANT)


def test_the_frame_that_was_asked_for_is_accepted():
    check(GOOD)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"serial": "B2"}, cameras.WrongCamera),
        ({"seq": 3}, cameras.StaleFrame),
        ({"t_start_s": 9.999}, cameras.StaleFrame),
        ({"exposure": Exposure(0.013, 100)}, cameras.WrongExposure),
        ({"exposure": Exposure(0.01, 50)}, cameras.WrongExposure),
        ({"image": np.zeros((4, 2), np.uint16)}, cameras.FrameRefused),
        ({"image": np.zeros((2, 4))}, cameras.FrameRefused),
    ],
)
def test_any_other_frame_is_refused_by_name(change, error):
    with pytest.raises(error, match="A1"):
        check(dataclasses.replace(GOOD, **change))


def test_a_third_of_a_stop_is_near_enough():
    check(dataclasses.replace(GOOD, exposure=Exposure(0.01 * 2 ** (1 / 3), 100)))


class Queue:
    info = INFO

    def __init__(self, frames):
        self.frames = list(frames)

    def frame(self, timeout_s):
        if not self.frames:
            raise cameras.FrameTimeout("nothing")
        return self.frames.pop(0)


def test_stale_frames_are_dropped_and_counted():
    old = dataclasses.replace(GOOD, t_start_s=1.0)
    frame, stale = next_frame(
        Queue([old, old, GOOD]), seq=0, not_before_s=10.0, want=WANT, timeout_s=1.0
    )
    assert (frame, stale) == (GOOD, 2)


def test_nothing_but_stale_frames_ends_in_a_timeout():
    old = dataclasses.replace(GOOD, t_start_s=1.0)
    with pytest.raises(cameras.FrameTimeout):
        next_frame(Queue([old] * 20), seq=0, not_before_s=10.0, want=WANT, timeout_s=1.0)


def test_frame_of_other_camera_fails_without_waiting():
    with pytest.raises(cameras.WrongCamera):
        next_frame(
            Queue([dataclasses.replace(GOOD, serial="B2"), GOOD]),
            seq=0,
            not_before_s=10.0,
            want=WANT,
            timeout_s=1.0,
        )


@pytest.mark.parametrize("url", ["nonsense", "floppy:1", ""])
def test_unknown_address_error_lists_valid_kinds(url):
    with pytest.raises(cameras.CameraUrlError, match="hotfolder"):
        cameras.open_camera(url)


@pytest.mark.parametrize(("time", "iso"), [(0.0, 100), (float("nan"), 100), (1.0, 0)])
def test_an_impossible_exposure_is_refused(time, iso):
    with pytest.raises(ValueError, match="got"):
        Exposure(time, iso)


class Clock:
    def __init__(self, at_each_sleep):
        self.now = 1000.0
        self.at_each_sleep = at_each_sleep

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds
        self.at_each_sleep(self.now)


def dng(value, **more):
    cfa = np.full((16, 16), value, np.uint16)
    return raw.encode_dng(
        cfa,
        pattern="RGGB",
        black=64,
        white=4095,
        exposure_s=0.01,
        iso=100,
        camera_model="test",
        camera_serial="A1",
        **more,
    )


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "old.dng").write_bytes(dng(100))
    return tmp_path


def test_file_counts_only_after_growth_stops(folder):
    whole = dng(200)

    def grow(now):
        share = min(1.0, (now - 1000.0) / 2.0)
        (folder / "new.dng").write_bytes(whole[: int(share * len(whole))])

    clock = Clock(grow)
    camera = HotFolder(folder, clock=clock, sleep=clock.sleep)
    camera.arm(1, Trigger.EDGE)
    frame = camera.frame(10.0)
    assert clock.now >= 1002.4
    assert frame.image == whole
    assert (frame.serial, frame.exposure) == ("A1", Exposure(0.01, 100))


def test_files_from_before_arming_are_not_frames(folder):
    clock = Clock(lambda now: None)
    camera = HotFolder(folder, clock=clock, sleep=clock.sleep)
    (folder / "between.dng").write_bytes(dng(300))
    camera.arm(1, Trigger.EDGE)
    with pytest.raises(cameras.FrameTimeout, match="no new raw file"):
        camera.frame(5.0)


def test_folder_address_selects_release_by_controller_or_hand(folder):
    for query, known in (
        ("", Trigger.EDGE),
        ("?serial=A1", Trigger.EDGE),
        ("?release=hand", Trigger.HAND),
        ("?serial=A1&release=hand", Trigger.HAND),
        ("?release=box", Trigger.EDGE),
    ):
        camera = cameras.open_camera(f"hotfolder:{folder}{query}")
        assert camera.info.triggers == (known,)
        camera.arm(1, known)
        with pytest.raises(cameras.CameraError, match="cannot be released"):
            camera.arm(1, Trigger.SOFTWARE)
        with pytest.raises(cameras.CameraError, match="by the controller or by hand"):
            camera.fire()
    for query in ("?release=foot", "?seriel=A1", "?serial=", "?x"):
        with pytest.raises(cameras.CameraUrlError, match="release=hand"):
            cameras.open_camera(f"hotfolder:{folder}{query}")


def test_folder_without_test_image_error_names_remedy(tmp_path):
    with pytest.raises(cameras.CameraUrlError, match="test image"):
        HotFolder(tmp_path)
    with pytest.raises(cameras.CameraUrlError, match="not a folder"):
        HotFolder(tmp_path / "nothing")


@pytest.mark.parametrize(
    ("text", "seconds"), [("1/125", 0.008), ("0.5", 0.5), ("30s", 30.0), ("bulb", None)]
)
def test_shutter_names_of_cameras_are_understood(text, seconds):
    assert gphoto._seconds(text) == seconds
