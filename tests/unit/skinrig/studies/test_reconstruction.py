"""Reconstructions on executors: paths, lost workers and other installations."""

from concurrent.futures import Executor, Future
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from reconstruction.pipeline.inputs import DomeOptions
from skinrig.errors import UnusableError
from skinrig.studies import description, reconstruction
from skinrig.studies.reconstruction import ReconstructionOrder, reconstruct_sessions


@pytest.fixture
def order():
    return ReconstructionOrder(
        session=Path("session"),
        want=("normals",),
        out=Path("maps"),
        calibration=Path("calibration"),
        state="neutral",
        landmarks=Path("sites.csv"),
        truth="",
        dome=DomeOptions("scan.ply", Path("merl"), "lights=L007", 3),
    )


def test_order_for_workers_has_absolute_paths(order, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    placed = order.with_absolute_paths()
    found = [placed.session, placed.out, placed.calibration, placed.landmarks]
    found += [placed.dome.scan, placed.dome.basis]
    names = ("session", "maps", "calibration", "sites.csv", "scan.ply", "merl")
    assert found == [tmp_path / name for name in names]
    assert (placed.dome.hold_out, placed.dome.rank) == ("lights=L007", 3)


class KilledWorker(Exception):
    """Stands for Dask's error of a task that ended several workers."""


class FarExecutor(Executor):
    """Run tasks here, in a folder as a worker has; the named session ends its workers."""

    def submit(self, fn, /, order, **settings):
        future = Future()
        try:
            if order.session.name == "deadly":
                raise KilledWorker("task")
            future.set_result(fn(order, **settings))
        except Exception as error:
            future.set_exception(error)
        return future


@pytest.fixture
def far(monkeypatch):
    """Let orders run on a `FarExecutor`, and return what they were."""
    begun = []
    fake = SimpleNamespace(KilledWorker=KilledWorker)
    monkeypatch.setitem(__import__("sys").modules, "distributed", fake)
    monkeypatch.setattr(reconstruction, "open_executor", lambda text: nullcontext(FarExecutor()))
    monkeypatch.setattr(reconstruction, "reconstruct_session", begun.append)
    return begun


def run_far(*orders):
    lines = []
    made = reconstruct_sessions(
        orders, executor="local:2", progress=lambda text, left_s: lines.append(text)
    )
    return list(made), lines


def test_workers_get_orders_with_absolute_paths(far, order):
    _, lines = run_far(order)
    assert far == [order.with_absolute_paths()] != [order]
    assert lines == ["sessions: 0/1", "sessions: 1/1, last session"]


def test_session_that_ends_workers_is_named(far, order):
    deadly = replace(order, session=Path("deadly"))
    with pytest.raises(UnusableError, match=r"^deadly: the task ended several worker processes"):
        run_far(order, deadly)


def test_worker_with_other_software_refuses_session(far, order, monkeypatch):
    found = iter(["command", "worker"])
    monkeypatch.setattr(reconstruction, "software_hash", lambda: next(found))
    monkeypatch.setattr(description, "software_hash", lambda: next(found))
    with pytest.raises(UnusableError, match="another installation"):
        run_far(order)
    assert not far
