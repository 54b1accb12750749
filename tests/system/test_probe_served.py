"""A served probe is captured by the command that it names, over TCP and in real time."""

import json
import subprocess
import sys

import pytest

from capture.plan.probe import probe_plan
from capture.rig import load_rig
from capture.session import Session, verify
from skinrig import errors

CLI = [sys.executable, "-m", "skinrig.cli"]
RIG = load_rig("probe")


@pytest.mark.long
@pytest.mark.timeout(180)
def test_served_probe_is_captured_by_printed_command(tmp_path):
    plan = probe_plan(RIG, sites=("cheek",), brackets=5, max_exposure_s=0.3, step_ev=1.0, darks=1)
    (tmp_path / "plan.json").write_text(json.dumps(plan.to_json()), encoding="utf-8")
    with subprocess.Popen(
        [*CLI, "serve", "probe", "--subject", "homogeneous:0.04,1.5", "--seed", "2"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as server:
        try:
            found = dict(server.stdout.readline().split() for _ in range(2))
            assert list(found) == ["probe", "cam"]
            out = tmp_path / "session"
            run = subprocess.run(
                [
                    *CLI,
                    "capture",
                    "probe",
                    "--plan",
                    str(tmp_path / "plan.json"),
                    "--port",
                    f"probe={found['probe']}",
                    "--camera",
                    f"cam={found['cam']}",
                    "--all-brackets",
                    "--out",
                    str(out),
                ],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=120,
            )
            assert run.returncode == errors.EXIT_DONE, run.stderr
            assert "place the head on the cheek at 0 degrees" in run.stderr
            session = Session.open(out)
            assert (session.closed, session.source) == (True, "simulated")
            assert session.pending_frames() == []
            assert verify(out).ok
            # each exposure is twice the one before, and so is the light of the far fibers
            frames = session.frames("fibers")
            assert len(frames) == 5
            signal = [
                session.read(record).cfa[:, RIG.views[0].width_px // 2 :].astype(float).mean() - 64
                for record in frames
            ]
            assert signal == sorted(signal)
            assert signal[-1] > 4.0 * signal[0] > 0.0
        finally:
            server.terminate()
