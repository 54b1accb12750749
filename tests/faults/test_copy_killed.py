"""A copy killed with SIGKILL at random moments is unfinished, and continues to equal bytes."""

import multiprocessing
import os
import signal
import time

import numpy as np
import pytest

from capture import raw
from capture.plan import Plan, Step
from capture.rig import load_rig
from capture.session import Session, SubjectRecord
from capture.session.consent_seal import KEY_VARIABLE, SEAL_FILE
from capture.session.copying import copy_session

FORK = multiprocessing.get_context("fork")
RIG = load_rig("flash").resized(16)
FRAMES = 60
PLAN = Plan("flash", tuple(Step(f"S{n:03d}", "subject", {}, {}, ("cam",)) for n in range(FRAMES)))
MIN_KILLS = 20


def write_session(path):
    random = np.random.default_rng(5)
    with Session.create(
        path,
        plan=PLAN,
        rig=RIG,
        devices={},
        subject=SubjectRecord("P1", ("research",)),
        source="simulated",
    ) as session:
        for step, camera in session.pending_frames():
            values = random.integers(512, 16000, (96, 128), np.uint16)
            blob = raw.encode_dng(
                values,
                pattern="RGGB",
                black=512,
                white=16383,
                step_id=step.id,
                session_id=session.id,
            )
            session.commit(step.id, camera, blob, settings={}, actual={}, t_host_s=0.0)
        session.close()


def read_files(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def copy_in_child(source, target):
    process = FORK.Process(target=copy_session, args=(source, target), kwargs={"read_back": True})
    process.start()
    return process


@pytest.mark.long
def test_killed_copy_continues_to_equal_bytes(tmp_path, monkeypatch):
    key = tmp_path / "consent.key"
    key.write_bytes(bytes(range(32)))
    key.chmod(0o600)
    monkeypatch.setenv(KEY_VARIABLE, str(key))
    source = tmp_path / "s"
    write_session(source)
    expected = read_files(source)
    assert SEAL_FILE in expected
    begun = time.perf_counter()
    copy_in_child(source, tmp_path / "whole").join()
    whole_s = time.perf_counter() - begun
    random = np.random.default_rng(3)
    kills, number = 0, 0
    while kills < MIN_KILLS:
        target = tmp_path / f"c{number}"
        while True:
            process = copy_in_child(source, target)
            process.join(random.uniform(0.0, 0.8 * whole_s))
            if not process.is_alive():
                break
            os.kill(process.pid, signal.SIGKILL)
            process.join()
            kills += process.exitcode != 0
            # a folder under the copy's name is complete
            assert not target.exists() or read_files(target) == expected
            if target.exists():
                break
        assert read_files(target) == expected
        assert not (tmp_path / f".c{number}.copying").exists()
        number += 1
