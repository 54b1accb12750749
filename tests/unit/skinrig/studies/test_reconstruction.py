"""Reconstructions on executors: paths, lost workers and other installations."""

from pathlib import Path

import pytest

from reconstruction.pipeline.inputs import DomeOptions
from skinrig.studies.reconstruction import ReconstructionOrder


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
