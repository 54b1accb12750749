"""A capture that is killed: the boxes are free for the next one at once."""

import dataclasses
import json
import subprocess
import sys

import pytest

from capture.plan import Plan, flash_plan
from capture.rig import load_rig
from capture.session import Session
from rigsim.world.serve import serve_world
from skinrig.cli import main

# a client that waits for its frames as no client does: a camera that waited with it would show,
# however busy the machine
PATIENT_S = 120.0
CAPTURE = """
import sys
from capture.acquire import frames
from skinrig.cli import main

frames.FRAME_MARGIN_S = float(sys.argv.pop(1))
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.long
@pytest.mark.parametrize("transport", ["pty", "tcp"])
def test_capture_killed_awaiting_frame_resumes_at_once(tmp_path, transport, capsys):
    """The kill falls into a read-out of 1 s; served devices notice that their client is gone."""
    rig = load_rig("flash").resized(16)
    slow = dataclasses.replace(
        rig, views=(dataclasses.replace(rig.views[0], readout_s=1.0),), polarizer_move_s=0.05
    )
    steps = flash_plan(rig, darks=1).steps[:2]
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps(Plan("flash", steps).to_json()))
    out = tmp_path / "s"
    with serve_world(slow, pty=transport == "pty") as served:
        argv = ["capture", "flash", "--plan", str(plan), "--out", str(out)]
        argv += ["--port", f"flash={served.addresses['flash']}"]
        argv += ["--camera", f"cam={served.addresses['cam']}"]
        with subprocess.Popen(
            [sys.executable, "-c", CAPTURE, str(PATIENT_S), *argv],
            stderr=subprocess.PIPE,
            text=True,
        ) as host:
            while "2/2 S000" not in host.stderr.readline():
                assert host.poll() is None
            struck_s = served.world.now
            while not served.world.pops and served.world.now < struck_s + 60.0:
                served.wait(0.01)
            host.kill()
        killed_s = served.world.now
        assert main([*argv, "--resume"]) == 0, capsys.readouterr().err
        # two read-outs and a recycle time, some 4 s; the dead client would have waited on
        took_s = served.world.now - killed_s
        pops = list(served.world.pops)
    print(f"resumed and done {took_s:.1f} s after the kill")
    assert took_s < PATIENT_S / 2
    session = Session.open(out)
    assert session.closed
    assert len(session.frames()) == 2
    # a run killed between its last frame and its exit is complete; no device is needed
    capsys.readouterr()
    assert main([*argv, "--resume"]) == 0
    assert "complete, 2 frames" in capsys.readouterr().out
    # the killed run's pop and ours: no token twice
    assert len({pop.token for pop in pops}) == len(pops) == 2
