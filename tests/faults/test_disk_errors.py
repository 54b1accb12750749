"""A fault at each operation of the disk: the session resumes or starts again, and loses nothing."""

import contextlib
from collections import Counter

import numpy as np
import pytest

from capture import raw
from capture.plan import Plan, Step
from capture.rig import load_rig
from capture.session import Disk, Session, SessionDiskError, SubjectRecord, verify
from capture.session.consent_seal import KEY_VARIABLE, SEALED_STATE
from skinrig.capturing.acquisition import discard_unused_session
from skinrig.console import Console
from skinrig.soaking.host_life import HostKilled
from skinrig.soaking.storage import DISK_FAULTS, FaultyDisk

RIG = load_rig("flash").resized(16)
FRAMES = 3
PLAN = Plan("flash", tuple(Step(f"S{n:03d}", "subject", {}, {}, ("cam",)) for n in range(FRAMES)))
SCAN = b"ply: a scan"


def create(path, disk):
    words = {"devices": {}, "subject": SubjectRecord("P1"), "source": "simulated"}
    return Session.create(path, plan=PLAN, rig=RIG, session_id="disk", disk=disk, **words)


def capture(path, disk, acknowledged, *, resume):
    """Capture what is missing, as the command does; note what was acknowledged."""
    fresh = not path.exists()
    session = Session.resume(path, disk=disk) if resume else create(path, disk)
    unused = discard_unused_session(session, fresh, Console(True))
    with contextlib.nullcontext() if resume else unused:
        for step, _ in session.pending_frames():
            values = np.full((10, 16), 600 + int(step.id[1:]), np.uint16)
            words = {"pattern": "RGGB", "black": 512, "white": 16383}
            blob = raw.encode_dng(values, **words, step_id=step.id, session_id=session.id)
            session.commit(step.id, "cam", blob, settings={}, actual={}, t_host_s=0.0)
            acknowledged.add(step.id)
            if not session.attachments():
                session.attach("scan.ply", SCAN)
                acknowledged.add("scan.ply")
        session.close()


def strike(path, number, fault, acknowledged, *, resume=False):
    """Capture on a disk whose operation ``number`` fails; return its name, empty for none."""
    disk = FaultyDisk(path.parent, strike=number, fault=fault)
    with contextlib.suppress(SessionDiskError, HostKilled):
        capture(path, disk, acknowledged, resume=resume)
    disk.close_all()
    return disk.struck


def finish(path, acknowledged):
    """Go on as the operator would: resume what is a session, else start a new one."""
    if not (path / "session.json").exists():
        assert not acknowledged
        capture(path, Disk(), acknowledged, resume=False)
    elif not Session.open(path).complete:
        capture(path, Disk(), acknowledged, resume=True)
    session = Session.open(path)
    assert session.complete
    assert acknowledged <= {*session.attachments(), *(r.step_id for r in session.frames())}
    for record in session.frames():
        assert set(np.unique(session.read(record).cfa)) == {600 + int(record.step_id[1:])}
    assert verify(path).ok


@pytest.mark.long
@pytest.mark.parametrize("fault", DISK_FAULTS)
def test_session_resumes_or_restarts_after_disk_fault(tmp_path, fault):
    struck = Counter()
    while True:
        path, acknowledged = tmp_path / f"s{struck.total()}", set()
        name = strike(path, struck.total() + 1, fault, acknowledged)
        if not name:
            break
        struck[name] += 1
        finish(path, acknowledged)
    print(f"{fault}: {struck.total()} operations: {dict(struck)}")
    assert struck.total() >= 30
    assert {"create", "write", "fsync", "fdatasync", "rename", "fsync_dir"} <= set(struck)


@pytest.mark.parametrize("fault", ["ENOSPC", "kill"])
def test_fault_while_sealing_leaves_sealed_session(tmp_path, fault, monkeypatch):
    """Each operation that creates a session whose consent a key seals."""
    key = tmp_path / "consent.key"
    key.write_bytes(bytes(32))
    key.chmod(0o600)
    monkeypatch.setenv(KEY_VARIABLE, str(key))
    struck = Counter()
    for number in range(1, 22):
        path, acknowledged = tmp_path / f"s{number}", set()
        struck[strike(path, number, fault, acknowledged)] += 1
        finish(path, acknowledged)
        assert verify(path).consent_seal == SEALED_STATE
    assert {"create", "write", "fsync", "rename", "fsync_dir"} <= set(struck)


@pytest.mark.parametrize("fault", ["ENOSPC", "kill"])
def test_fault_while_resuming_loses_nothing(tmp_path, fault):
    resumed = Counter()
    for first in range(12, 40, 7):
        for second in range(1, 12, 2):
            path, acknowledged = tmp_path / f"s{first}-{second}", set()
            strike(path, first, fault, acknowledged)
            resumed[strike(path, second, fault, acknowledged, resume=True)] += 1
            finish(path, acknowledged)
    assert {"open_append", "rename", "write"} <= set(resumed)
