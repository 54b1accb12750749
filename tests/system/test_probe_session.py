"""The fiber probe from the command line: refusals, simulated sessions, and their resume."""

import functools
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from capture.session import Session, verify
from model import store
from skinrig import errors
from skinrig.capturing import plan_choice
from skinrig.cli import main
from skinrig.simulating import probe

SUBJECT = "homogeneous:0.05,1.4"
FEW_PHOTONS = {"small": 2000, "full": 2000}


@pytest.fixture
def small(monkeypatch):
    """Few photons, and series of 8 exposures that end at half a second."""
    short = {"brackets": 8, "max_exposure_s": 0.5, "darks": 1}
    monkeypatch.setattr(probe, "TRUTH_PHOTONS", FEW_PHOTONS)
    for name in ("probe_plan", "probe_calibration_plan"):
        honest = getattr(plan_choice, name)
        monkeypatch.setattr(plan_choice, name, functools.partial(honest, **short))


def simulate(out, *more):
    return ["simulate", "probe", "--subject", SUBJECT, "--out", str(out), *more]


# plans ----------------------------------------------------------------------------------------


def test_dry_run_prints_plan_time_light_without_address(capsys):
    arguments = ["capture", "probe", "--dry-run", "--sites", "cheek", "--json"]
    assert main(arguments) == errors.EXIT_DONE
    document = json.loads(capsys.readouterr().out)
    assert document["steps"] == 6 + 23
    assert 160.0 < document["estimated_s"] < 175.0  # 66 s of darks, 88 s of brackets, suction
    assert document["light"]["led_ws"] < document["light"]["limit_ws"]
    assert main(arguments[:-1]) == errors.EXIT_DONE
    printed = capsys.readouterr()
    assert "do not look into the fiber" in printed.out + printed.err


@pytest.mark.parametrize(
    ("arguments", "code", "match"),
    [
        (["--angles", "0,90"], errors.EXIT_USAGE, "number of directions"),
        (["--steps", "-1..1"], errors.EXIT_USAGE, "--steps"),
        (["--sites", "cheek,cheek"], errors.EXIT_BAD_INPUT, "none twice"),
        (["--repeats", "0"], errors.EXIT_BAD_INPUT, "repeats"),
        (["--target", "ball"], errors.EXIT_BAD_INPUT, "expected one of phantom, dark"),
        (["--target", "phantom", "--sites", "cheek"], errors.EXIT_USAGE, "default plan of skin"),
    ],
)
def test_a_wrong_option_is_named(capsys, arguments, code, match):
    assert main(["capture", "probe", "--dry-run", *arguments]) == code
    assert match in capsys.readouterr().err


@pytest.mark.parametrize("option", [["--sites", "cheek"], ["--all-brackets"]])
def test_other_rigs_reject_probe_options(capsys, tmp_path, option):
    assert main(["simulate", "gradient", "--out", str(tmp_path / "s"), *option]) != errors.EXIT_DONE
    assert "not an option of the gradient rig" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["--subject", "homogeneous:1"], "subject: got 'homogeneous:1'"),
        (["--width", "64"], "--width: not an option of the probe rig"),
        (["--site", "cheek"], "site: not an option of the probe rig"),
        (["--target", "chart"], "expected one of phantom, dark"),
        (
            ["--target", "dark", "--sites", "cheek"],
            "sites: not an option of the target of the probe rig",
        ),
    ],
)
def test_unsimulatable_request_is_reported_and_nothing_written(capsys, tmp_path, arguments, match):
    out = tmp_path / "session"
    assert main([*simulate(out), *arguments]) != errors.EXIT_DONE
    assert match in capsys.readouterr().err
    assert not out.exists()


# sessions -------------------------------------------------------------------------------------


@pytest.mark.usefixtures("small")
def test_tissue_is_captured_with_ground_truth_alongside(capsys, tmp_path):
    out = tmp_path / "session-probe"
    assert main([*simulate(out, "--sites", "cheek", "--seed", "3"), "--json"]) == errors.EXIT_DONE
    document = json.loads(capsys.readouterr().out)
    session = Session.open(out)
    assert document["frames"] == len(session.frames()) == 3 + len(session.frames("fibers"))
    assert verify(out).ok
    assert session.pending_frames() == []
    truth = store.read(tmp_path / "truth-probe")
    assert truth.parameters["kind"] == "truth"
    (profile,) = truth.parameters["profiles"]
    assert (profile["site"], profile["repeat"], profile["angle_deg"]) == ("cheek", 0, 0.0)
    assert profile["sigma_a_per_mm"] == [0.05] * 3
    # what the truth says of the suction is not the gauge's word, but near it
    record = session.frames("fibers")[0]
    assert profile["suction_mbar"] != record.actual["suction_mbar"]
    assert abs(profile["suction_mbar"] - record.actual["suction_mbar"]) < 4.0
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


@pytest.mark.usefixtures("small")
def test_the_same_seed_gives_the_same_bytes(tmp_path):
    hashes = []
    for name in ("a", "b"):
        assert (
            main(simulate(tmp_path / name, "--target", "dark", "--seed", "4")) == errors.EXIT_DONE
        )
        session = Session.open(tmp_path / name)
        hashes.append([record.line.xxh128 for record in session.frames()])
        # the identity of the session stands in each file: what the sensor saw does not
        frames = [session.read(record).cfa.tobytes() for record in session.frames()]
        hashes[-1] = [hash(data) for data in frames]
    assert hashes[0] == hashes[1]


@pytest.mark.long
@pytest.mark.usefixtures("small")
def test_phantom_is_captured_with_each_fiber_uncovered(capsys, tmp_path):
    out = tmp_path / "session-phantom"
    assert main(simulate(out, "--target", "phantom")) == errors.EXIT_DONE
    printed = capsys.readouterr()
    assert f"skinrig calibrate fiber {out}" in printed.out + printed.err
    session = Session.open(out)
    assert verify(out).ok
    assert {record.index["fiber"] for record in session.frames("mask")} == set(range(28))
    assert {len(session.frames("mask", fiber=n)) for n in range(28)} <= {1, 2}
    (profile,) = store.read(tmp_path / "truth-phantom").parameters["profiles"]
    assert profile["site"] == "phantom"


class Killed(BaseException):
    """The host is gone."""


@pytest.mark.usefixtures("small")
def test_simulation_resumed_mid_series_has_complete_truth(tmp_path, monkeypatch):
    out = tmp_path / "session-probe"
    words = simulate(out, "--sites", "forehead,cheek", "--seed", "2")
    honest = probe.HeadLog.exposure
    seen = []

    def exposure(self, *args, **more):
        seen.append(1)
        if len(seen) == 3 + 8 + 4:
            raise Killed
        return honest(self, *args, **more)

    monkeypatch.setattr(probe.HeadLog, "exposure", exposure)
    with pytest.raises(Killed):
        main(words)
    monkeypatch.setattr(probe.HeadLog, "exposure", honest)
    assert {r.index["site"] for r in Session.open(out).frames("fibers")} == {"forehead"}
    assert main([*words, "--resume"]) == errors.EXIT_DONE
    session = Session.open(out)
    assert session.closed
    assert verify(out).ok
    assert {r.attempt for r in session.frames()} == {1}
    runs = {r.index["site"]: r.actual["run"] for r in session.frames("fibers")}
    assert runs == {"forehead": "sim1", "cheek": "sim1"}  # the run is replayed
    sites = [p["site"] for p in store.read(tmp_path / "truth-probe").parameters["profiles"]]
    assert sites == ["forehead", "cheek"]
    assert main([*words, "--resume"]) == errors.EXIT_DONE  # complete, its log is removed


@pytest.mark.usefixtures("small")
def test_next_command_is_printed_complete_session_not_continued(capsys, tmp_path):
    out = tmp_path / "session-dark"
    words = simulate(out, "--target", "dark")
    assert main(words) == errors.EXIT_DONE
    printed = capsys.readouterr()
    assert f"next: skinrig verify {out}" in printed.out + printed.err
    before = Session.open(out).content_hash
    assert main([*words, "--resume"]) == errors.EXIT_DONE
    assert "complete: nothing is left" in capsys.readouterr().err
    assert Session.open(out).content_hash == before


HOST = """
import sys
from skinrig.simulating import probe
from skinrig.capturing import plan_choice
from skinrig.cli import main
probe.TRUTH_PHOTONS = {"small": 2000}
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.long
def test_simulation_killed_mid_series_is_resumed(tmp_path):
    out = tmp_path / "session-probe"
    words = simulate(out, "--sites", "forehead,cheek", "--seed", "2")
    command = [sys.executable, "-c", HOST, *words]
    log = tmp_path / ".truth-probe.heads.jsonl"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, **quiet) as host:
        until_s = time.monotonic() + 240.0  # a busy machine takes its time
        # the second series is on its way: the first is committed when it is whole
        while not (log.is_file() and log.read_text().count("\n") > 23 + 4):
            assert host.poll() is None
            assert time.monotonic() < until_s
            time.sleep(0.01)
        os.kill(host.pid, signal.SIGKILL)
        host.wait()
    before = {r.step_id for r in Session.open(out).frames("fibers")}
    assert {step.split("-")[0] for step in before} == {"forehead"}
    done = subprocess.run([*command, "--resume", "--json"], capture_output=True, text=True)
    assert done.returncode == errors.EXIT_DONE, done.stderr
    assert json.loads(done.stdout)["frames"] == 6 + 2 * 23
    session = Session.open(out)
    assert session.closed
    assert verify(out).ok
    placements = {}
    for record in session.frames("fibers"):
        placements.setdefault(record.index["site"], set()).add(record.actual["placement"])
    assert {len(one) for one in placements.values()} == {1}
    assert not log.exists()


@pytest.mark.long
def test_served_probe_is_captured_by_printed_command(tmp_path):
    command = [sys.executable, "-m", "skinrig.cli"]
    server = [*command, "serve", "probe", "--subject", SUBJECT, "--seed", "2"]
    with subprocess.Popen(
        server, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as served:
        try:
            found = dict(served.stdout.readline().split() for _ in range(2))
            plan = tmp_path / "plan.json"
            run = subprocess.run(
                [
                    *command,
                    "capture",
                    "probe",
                    "--dry-run",
                    "--sites",
                    "cheek",
                    "--plan-out",
                    str(plan),
                ],
                capture_output=True,
                text=True,
            )
            assert run.returncode == errors.EXIT_DONE, run.stderr
            # on the rig's own clock a whole series would take its minute and a half
            document = json.loads(plan.read_text())
            document["steps"] = [
                step for step in document["steps"] if step["settings"]["exposure_s"] < 0.05
            ]
            plan.write_text(json.dumps(document))
            out = tmp_path / "session"
            run = subprocess.run(
                [
                    *command,
                    "capture",
                    "probe",
                    "--port",
                    f"probe={found['probe']}",
                    "--camera",
                    f"cam={found['cam']}",
                    "--plan",
                    str(plan),
                    "--out",
                    str(out),
                ],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=100,
            )
            assert run.returncode == errors.EXIT_DONE, run.stderr
            assert "place the head on the cheek at 0 degrees" in run.stderr
            session = Session.open(out)
            assert session.closed
            assert session.source == "simulated"
            assert session.pending_frames() == []
            assert len(session.frames("fibers")) == 9
            assert verify(out).ok
        finally:
            served.terminate()
