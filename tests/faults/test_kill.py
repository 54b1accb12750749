"""A writer killed with SIGKILL at random instants loses nothing that it acknowledged.

A nursery process imports the package once and forks writers. A writer resumes (or creates) the
session, commits the frames of one step after the other and, when a commit has returned, writes the
step's id to a pipe: the acknowledgement. The test kills it after a random time and looks at what is
there.
"""

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections import Counter

import numpy as np
import pytest

from capture.session import Session, verify

STEPS = 20

NURSERY = """
import json, logging, os, sys, traceback
from pathlib import Path

import numpy as np

from capture import raw
from capture.plan import Plan, Step
from capture.rig import load_rig
from capture.session import NewFrame, Session, SubjectRecord

logging.disable(logging.WARNING)
NAMES = tuple(f"C{n:02d}" for n in range(CAMERAS))
RIG = load_rig("dome").subset(lights=["L000"], views=NAMES).resized(16)
PLAN = Plan("dome", tuple(Step(f"S{n:03d}", "dark", {}, {}, NAMES) for n in range(STEPS)))


def write(path, acknowledged):
    if (path / "session.json").exists():
        session = Session.resume(path)
    else:
        session = Session.create(path, plan=PLAN, rig=RIG, devices={}, subject=SubjectRecord("P1"),
                                 source="simulated", session_id="killed")
    os.write(acknowledged, b"started ")
    done = {(record.step_id, record.camera): record.attempt for record in session.frames()}
    for step in dict.fromkeys(step.id for step, _ in session.pending_frames()):
        values = np.full((96, 128), 600 + int(step[1:]), np.uint16)
        blob = raw.encode_dng(values, pattern="RGGB", black=512, white=16383,
                              step_id=step, session_id=session.id)
        session.commit_step(step, [
            NewFrame(camera=name, blob=blob, settings={}, actual={}, t_host_s=0.0,
                     attempt=done.get((step, name), 0) + 1)
            for name in NAMES])
        os.write(acknowledged, step.encode() + b" ")
    session.close()
    os.write(acknowledged, b"closed ")


for order in iter(sys.stdin.readline, ""):
    path, fifo = json.loads(order)
    child = os.fork()
    if not child:
        try:
            write(Path(path), os.open(fifo, os.O_WRONLY))
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    print(child, flush=True)
    sys.stdin.readline()  # until then a dead child keeps its number, and no other is hit
    _, status = os.waitpid(child, 0)
    print(status, flush=True)
"""


class Nursery:
    """Forks writers and kills them."""

    def __init__(self, folder, cameras):
        self.fifo = folder / "acknowledged"
        os.mkfifo(self.fifo)
        single = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            [
                sys.executable,
                "-c",
                NURSERY.replace("STEPS", str(STEPS)).replace("CAMERAS", str(cameras)),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | single,
        )

    def write(self, path, *, killed_after_s=None):
        """Let a writer work, to its end or to its death; return acknowledgements and status."""
        self.tell(json.dumps([str(path), str(self.fifo)]))
        child = int(self.process.stdout.readline())
        said = b""
        with open(self.fifo, "rb", buffering=0) as acknowledged:
            if killed_after_s is not None:
                deadline = time.monotonic() + killed_after_s
                while (left := deadline - time.monotonic()) > 0:
                    if select.select([acknowledged], [], [], left)[0]:
                        part = acknowledged.read(65536)
                        said += part
                        if not part:  # the writer has ended by itself
                            break
                os.kill(child, signal.SIGKILL)
            while part := acknowledged.read(65536):
                said += part
        self.tell("reap")
        return said.decode().split(), int(self.process.stdout.readline())

    def tell(self, line):
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def end(self):
        self.process.stdin.close()
        self.process.wait(timeout=30)
        self.process.stdout.close()


@pytest.fixture
def nursery(tmp_path, cameras):
    made = Nursery(tmp_path, cameras)
    yield made
    made.end()


def judge_frames(session):
    """Return the whole steps, and the number of frames with other than what was written."""
    found, corrupt = Counter(), 0
    for record in session.frames():
        right = set(np.unique(session.read(record).cfa)) == {600 + int(record.step_id[1:])}
        found[record.step_id] += 1
        corrupt += not right
    steps = session.plan.steps
    return {step.id for step in steps if found[step.id] == len(step.cameras)}, corrupt


@pytest.mark.parametrize("cameras", [1, 4])
@pytest.mark.parametrize("kills", [6, pytest.param(60, marks=pytest.mark.long)])
def test_killed_writer_keeps_all_acknowledged_data(nursery, tmp_path, rng, kills, cameras):
    """Every instant is drawn uniformly over the time of about 15 commits."""
    tally = Counter()
    acknowledged: set[str] = set()
    path = tmp_path / "s0"
    span_s = 0.05
    # a machine may be so busy that the first few writers die before they have committed a frame
    while tally["kills"] < kills or not tally["acknowledged"]:
        started_s = time.monotonic()
        said, status = nursery.write(path, killed_after_s=rng.uniform(0, span_s))
        took_s = time.monotonic() - started_s
        tally["kills"] += os.WIFSIGNALED(status)
        assert os.WIFSIGNALED(status) or status == 0
        fresh = {word for word in said if word not in ("started", "closed")}
        if len(fresh) >= 3:  # follow the speed of the machine
            span_s = 15 * took_s / len(fresh)
        elif not fresh:
            span_s *= 1.5
        acknowledged |= fresh
        if not (path / "session.json").exists():
            assert not said
            continue
        session = Session.open(path)
        whole, corrupt = judge_frames(session)
        tally["lost"] += len(acknowledged - whole)
        tally["corrupt"] += corrupt
        tally["damaged"] += not verify(path).ok
        if session.closed:
            assert whole == {step.id for step in session.plan.steps}
            tally["orphans"] += len(list((path / "orphans").iterdir()))
            tally["sessions completed"] += 1
            acknowledged = set()
            path = tmp_path / f"s{tally['sessions completed']}"
        else:
            assert "closed" not in said
        tally["acknowledged"] += len(fresh)
    print(dict(tally))
    assert (tally["lost"], tally["corrupt"], tally["damaged"]) == (0, 0, 0)
    if (path / "session.json").exists():
        # the last one is left in peace: it completes
        said, status = nursery.write(path)
        assert status == 0
        assert "closed" in said
        assert judge_frames(Session.open(path)) == ({f"S{n:03d}" for n in range(STEPS)}, 0)
        assert verify(path).ok
