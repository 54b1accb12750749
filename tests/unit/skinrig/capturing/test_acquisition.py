"""Captures as they begin and end on the command line, on worlds without pixels."""

import contextlib
import dataclasses
import signal

import pytest

from capture.devices.camera import CameraBusy, CameraError, open_camera
from capture.devices.port import PortBusy
from capture.plan import Plan, flash_plan
from capture.rig import load_rig
from capture.session import Session
from rigsim.boxes.faults import Faults
from rigsim.scenes.reference.flash_session import crop_to_patch
from rigsim.world.serve import serve_world
from rigsim.world.world import World
from skinrig.capturing import acquisition, addresses
from skinrig.cli import main
from skinrig.errors import UsageError

RIG = load_rig("flash").resized(16)


@pytest.fixture
def sim():
    """Return a function that makes a world and the arguments that capture on it."""
    made = []

    def sim(name, rig=RIG, **faults):
        made.append(World(rig, faults=Faults(**faults)))
        made[-1].register(name)
        return ["--port", f"flash=sim://flash?world={name}", "--camera", f"cam=sim://{name}/cam"]

    yield sim
    for world in made:
        world.unregister()


def test_dry_run_plan_file_is_captured_unchanged(tmp_path, sim, capsys):
    file = tmp_path / "plan.json"
    argv = ["capture", "flash", "--dry-run", "--plan-out", str(file)]
    assert main(argv) == 0
    assert Plan.from_json(file.read_text()) == flash_plan(load_rig("flash"))
    assert main(argv) == 3  # somebody may have changed it
    assert "exists" in capsys.readouterr().err
    out = tmp_path / "s"
    assert main(["capture", "flash", "--plan", str(file), "--out", str(out), *sim("w1")]) == 0
    assert Session.open(out).plan.steps == flash_plan(load_rig("flash")).steps


def test_cropped_camera_keeps_its_pixels_size(tmp_path, sim):
    """Server of a patch of voxels: 16 mm on 16 pixels; the whole field would be 260.7 mm."""
    served = crop_to_patch(load_rig("flash"), 16)
    argv = ["capture", "flash", "--out", str(tmp_path / "s"), *sim("w9", served)]
    assert main(argv) == 0
    assert Session.open(tmp_path / "s").rig == served


@pytest.mark.parametrize("served", [crop_to_patch(load_rig("flash"), 16), RIG])
def test_rig_matches_served_camera(served):
    with (
        serve_world(served) as service,
        contextlib.closing(open_camera(service.addresses["cam"])) as camera,
    ):
        info = camera.info
    assert acquisition.match_camera(load_rig("flash"), info) == served
    unreported = dataclasses.replace(info, pixel_um=None)
    assert acquisition.match_camera(load_rig("flash"), unreported) == RIG


def test_session_records_subject_consent_and_expiry(tmp_path, sim):
    out = tmp_path / "s"
    consent = ["--consent", "research,teaching", "--consent", "publication"]
    argv = ["capture", "flash", "--subject", "P042", *consent, "--consent-expires", "2031-01-01"]
    assert main([*argv, "--out", str(out), *sim("w2")]) == 0
    subject = Session.open(out).subject
    assert (subject.pseudonym, str(subject.consent_expires)) == ("P042", "2031-01-01")
    assert subject.consent_scope == ("research", "teaching", "publication")


def test_invalid_date_is_usage_error(capsys):
    argv = ["capture", "flash", "--dry-run", "--consent-expires", "next year"]
    assert main(argv) == 2
    assert "next year" in capsys.readouterr().err


def test_missing_addresses_give_single_line_usage_error(tmp_path, capsys):
    assert main(["capture", "flash", "--out", str(tmp_path / "s")]) == 2
    err = capsys.readouterr().err
    assert "--port flash=URL --camera cam=URL" in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "s").exists()


def test_unknown_camera_kind_is_reported_before_opening_port(tmp_path, capsys):
    argv = ["capture", "flash", "--out", str(tmp_path / "s")]
    argv += ["--port", "flash=/dev/no-such-port", "--camera", "cam=blah:1"]
    assert main(argv) == 2
    err = capsys.readouterr().err
    assert "--camera cam: camera address: got 'blah:1', expected KIND:REST" in err
    assert "no-such-port" not in err


@pytest.mark.parametrize("force", ["0", "-1", "nan", "inf"])
def test_invalid_force_is_refused_even_in_dry_run(force, capsys):
    assert main(["capture", "gradient", "--dry-run", "--force-limit", force]) == 3
    assert f"--force-limit: got {force}, expected more than 0 newton" in capsys.readouterr().err


@pytest.mark.parametrize("there_before", [True, False])
def test_capture_failing_before_first_frame_leaves_no_session(tmp_path, sim, capsys, there_before):
    out = tmp_path / "s"
    if there_before:
        out.mkdir()
    other = dataclasses.replace(RIG, views=(dataclasses.replace(RIG.views[0], serial="ZZ-1"),))
    assert main(["capture", "flash", "--out", str(out), *sim("w3", other)]) == 4
    assert "ZZ-1" in capsys.readouterr().err
    assert out.exists() == there_before
    assert not there_before or not list(out.iterdir())


def test_capture_failing_later_keeps_recorded_data(tmp_path, sim, capsys):
    out = tmp_path / "s"
    argv = ["capture", "flash", "--out", str(out)]
    assert main([*argv, *sim("w4", misfire=1.0)]) == 4
    assert "--resume" in capsys.readouterr().err
    assert len(Session.open(out).frames("dark")) == 4
    assert main([*argv, *sim("w5"), "--resume"]) == 0
    assert Session.open(out).closed


def test_first_step_failure_does_not_suggest_resuming(tmp_path, sim, capsys):
    out = tmp_path / "s"
    assert main(["capture", "flash", "--out", str(out), *sim("w6", drop_frame=1.0)]) == 4
    err = capsys.readouterr().err
    assert "no frame was recorded" in err
    assert "--resume" not in err
    assert not out.exists()


def test_files_foreign_to_session_are_never_removed(tmp_path):
    path = tmp_path / "s"
    session = Session.create(
        path,
        plan=flash_plan(RIG),
        rig=RIG,
        devices={},
        subject=acquisition.SubjectRecord("p"),
        source="measured",
    )
    session.release()
    (path / "frames" / "diary.txt").write_text("mine")
    acquisition.remove_unused(path, with_folder=True)
    assert [str(p.relative_to(path)) for p in path.rglob("*.txt")] == ["frames/diary.txt"]
    assert not (path / "session.json").exists()


@pytest.mark.parametrize("error", [CameraBusy("busy"), PortBusy("busy")])
def test_busy_device_is_retried_and_reported_once(error):
    now, said, failures = [0.0], [], [error] * 3

    def open_device():
        if failures:
            raise failures.pop()
        return "camera"

    def sleep(seconds):
        now[0] += seconds

    found = addresses.open_with_retry(open_device, said.append, clock=lambda: now[0], sleep=sleep)
    assert (found, len(said)) == ("camera", 1)
    failures[:] = [error] * 99
    with pytest.raises(type(error)):
        addresses.open_with_retry(open_device, said.append, clock=lambda: now[0], sleep=sleep)
    assert now[0] == pytest.approx(3 * 0.5 + 10.0)


def test_broken_device_is_not_retried():
    def open_device():
        raise CameraError("broken")

    with pytest.raises(CameraError, match="broken"):
        addresses.open_with_retry(open_device, print, sleep=lambda seconds: pytest.fail("waited"))


def test_addresses_of_the_wrong_form_are_usage_errors():
    for given in (["flash"], ["=x"], ["flash="], ["flash=a", "flash=b"]):
        with pytest.raises(UsageError, match="--port"):
            addresses.parse_addresses(given, "--port")


def test_import_records_subject_and_rig_of_photographs(tmp_path, sim, capsys):
    shot = tmp_path / "shot"
    argv = ["capture", "flash", "--out", str(shot), *sim("w7")]
    assert main(argv) == 0
    photos = tmp_path / "photos"
    photos.mkdir()
    crossed = Session.open(shot).frames("subject", polarizer="crossed")[0]
    (photos / "anna crossed.dng").write_bytes((shot / crossed.file).read_bytes())
    out = tmp_path / "s"
    argv = ["import", "photos", str(photos), "--out", str(out), "--subject", "P7"]
    consent = ["--consent", "research", "--consent-expires", "2030-05-06"]
    assert main([*argv, *consent]) == 0
    subject = Session.open(out).subject
    assert (subject.pseudonym, subject.consent_scope) == ("P7", ("research",))
    assert str(subject.consent_expires) == "2030-05-06"
    # the rig that ships has a larger camera: these are no photographs of it
    assert main([*argv[:-4], "--out", str(tmp_path / "t"), "--rig", "flash"]) == 3
    assert "was not taken by this rig's camera" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_first_signal_stops_between_steps(number):
    before = signal.getsignal(number)
    with acquisition._stop_on_signal() as stopped:
        assert not stopped()
        signal.raise_signal(number)
        assert stopped()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    assert signal.getsignal(number) is before
