"""A fault at each operation of the disk: the session resumes or starts again, and loses nothing."""

import contextlib
from collections import Counter

import numpy as np
import pytest
from fixtures.small_sessions import CAMERAS, DOME, commit_step, fill_of, plan_of

from capture.session import Disk, Session, SessionDiskError, SubjectRecord, verify
from capture.session.consent_seal import KEY_VARIABLE, SEALED_STATE
from skinrig.capturing.acquisition import discard_unused_session
from skinrig.console import Console
from skinrig.soaking.host_life import HostKilled
from skinrig.soaking.storage import DISK_FAULTS, FaultyDisk

SCAN = b"ply: a scan"
CREATION = 16
"""Operations that create a session."""
ONE_CAMERA, SEVERAL_CAMERAS = plan_of(3, 1), plan_of(3, len(CAMERAS))


def create(path, disk, plan):
    words = {"devices": {}, "subject": SubjectRecord("P1"), "source": "simulated"}
    return Session.create(path, plan=plan, rig=DOME, session_id="disk", disk=disk, **words)


def capture(path, disk, acknowledged, plan, *, resume):
    """Capture what is missing, as the command does; note what was acknowledged."""
    fresh = not path.exists()
    session = Session.resume(path, disk=disk) if resume else create(path, disk, plan)
    unused = discard_unused_session(session, fresh, Console(True))
    with contextlib.nullcontext() if resume else unused:
        for step in dict.fromkeys(step.id for step, _ in session.pending_frames()):
            commit_step(session, step)
            acknowledged.add(step)
            if not session.attachments():
                session.attach("scan.ply", SCAN)
                acknowledged.add("scan.ply")
        session.close()


def strike(path, number, fault, acknowledged, plan=ONE_CAMERA, *, resume=False):
    """Capture on a disk whose operation ``number`` fails; return its name, empty for none."""
    disk = FaultyDisk(path.parent, strike=number, fault=fault)
    with contextlib.suppress(SessionDiskError, HostKilled):
        capture(path, disk, acknowledged, plan, resume=resume)
    disk.close_all()
    return disk.struck


def finish(path, acknowledged, plan=ONE_CAMERA):
    """Go on as the operator would: resume what is a session, else start a new one."""
    if not (path / "session.json").exists():
        assert not acknowledged
        capture(path, Disk(), acknowledged, plan, resume=False)
    elif not Session.open(path).complete:
        found = {(r.step_id, r.camera) for r in Session.open(path).frames()}
        for step in plan.steps:
            frames = {(step.id, name) for name in step.cameras}
            assert frames <= found or step.id not in acknowledged
        capture(path, Disk(), acknowledged, plan, resume=True)
    session = Session.open(path)
    assert session.complete
    assert acknowledged <= {*session.attachments(), *(r.step_id for r in session.frames())}
    for record in session.frames():
        fill = fill_of(record.step_id, record.camera)
        assert set(np.unique(session.read(record).cfa)) == {fill}
    assert verify(path).ok


@pytest.mark.long
@pytest.mark.parametrize("fault", DISK_FAULTS)
@pytest.mark.parametrize("plan", [ONE_CAMERA, SEVERAL_CAMERAS], ids=["one", "several"])
def test_session_resumes_or_restarts_after_disk_fault(tmp_path, fault, plan):
    struck = Counter()
    while True:
        path, acknowledged = tmp_path / f"s{struck.total()}", set()
        name = strike(path, struck.total() + 1, fault, acknowledged, plan)
        if not name:
            break
        struck[name] += 1
        finish(path, acknowledged, plan)
    print(f"{fault}: {struck.total()} operations: {dict(struck)}")
    assert struck.total() >= 30
    assert {"create", "write", "fsync", "fdatasync", "rename", "fsync_dir"} <= set(struck)


@pytest.mark.parametrize("fault", ["ENOSPC", "kill after"])
def test_fault_in_step_of_several_cameras(tmp_path, fault):
    """Each operation of the first step, from its first file to its lines."""
    struck, written = Counter(), 0
    for number in range(CREATION + 1, CREATION + 1 + 4 * len(CAMERAS) + 3):
        path, acknowledged = tmp_path / f"s{number}", set()
        struck[strike(path, number, fault, acknowledged, SEVERAL_CAMERAS)] += 1
        if (path / "frames").is_dir():
            written = max(written, len(list((path / "frames").glob("*.dng"))))
        finish(path, acknowledged, SEVERAL_CAMERAS)
    assert struck == {
        **dict.fromkeys(("create", "fsync", "rename"), len(CAMERAS)),
        **{"write": len(CAMERAS) + 1, "fsync_dir": 1, "fdatasync": 1},
    }
    assert written == len(CAMERAS)


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
