"""A medium under the simulated fiber probe: captured, calibrated, and its sigma_tr found again."""

import json

import pytest

from model import store
from reconstruction.pipeline import recipes as pipeline
from reconstruction.pipeline.graph import StageError
from reconstruction.pipeline.inputs import InputsError
from skinrig.calibrating.calibrate import calibrate
from skinrig.cli import main
from skinrig.evaluating import subsurface as evaluation
from skinrig.reporting.report import build
from skinrig.simulating.orders import truth_folder
from skinrig.simulating.simulation import simulate_session

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]

MEDIUM = "homogeneous:0.0862,1.08,0.86"


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    out = tmp_path_factory.mktemp("probe")
    simulate_session("probe", out / "session-phantom", target="phantom", seed=4)
    calibrate("fiber", [out / "session-phantom"], out / "calibration")
    simulate_session("probe", out / "session", subject=MEDIUM, sites=("cheek", "chin"), seed=4)
    return out


def test_full_session_recovers_sigma_tr_and_dipole_misses(bench):
    pipeline.reconstruct(
        bench / "session",
        want=("profiles", "subsurface", "translucency", "anisotropy"),
        out=bench / "appearance",
        calibration=bench / "calibration",
        truth=truth_folder(bench / "session").name,
    )
    found, truth = store.read(bench / "appearance"), store.read(truth_folder(bench / "session"))
    errors = {
        row.method: row
        for row in evaluation.summarize_methods(evaluation.compare_fits(found, truth))
    }
    assert errors["photon_table"].median < evaluation.MAX_MEDIAN_ERROR
    assert errors["photon_table"].worst < evaluation.MAX_WORST_ERROR
    # it can fail: the baseline is far outside both limits, and outside its own intervals
    assert errors["dipole"].median > evaluation.MAX_WORST_ERROR
    assert errors["dipole"].coverage == 0.0
    for row in evaluation.compare_profiles(found, truth):
        assert row.median < 0.03, row
    assert found.maps["translucency"].values.shape == (256, 256, 3)
    report = build([bench])
    assert "Radial profiles" in report
    assert "Map of the diffuse mean free path" not in report  # a homogeneous medium has no face
    assert "Traceback" not in report


def test_uncalibrated_fibers_error_gives_next_command(bench, capsys):
    with pytest.raises((InputsError, StageError), match="calibrate fiber"):
        pipeline.reconstruct(bench / "session", want=("subsurface",), out=bench / "bare")
    assert not (bench / "bare").exists()
    command = ["reconstruct", str(bench / "session"), "--maps", "subsurface"]
    assert main([*command, "--out", str(bench / "bare")]) == 3
    assert "Traceback" not in capsys.readouterr().err


def test_sites_are_placed_by_a_table_of_landmarks(bench, tmp_path):
    table = tmp_path / "landmarks.csv"
    table.write_text("name,x,y\ncheek,200,128\nchin,128,250\n")
    made = []
    for name, landmarks in (("known", None), ("moved", table)):
        pipeline.reconstruct(
            bench / "session",
            want=("translucency",),
            out=tmp_path / name,
            calibration=bench / "calibration",
            landmarks=landmarks,
        )
        made.append(store.read(tmp_path / name).maps["translucency"].stderr[..., 1])
    assert made[1][128, 200] < 0.5 * made[0][128, 200]
    assert json.loads((tmp_path / "moved" / store.DOCUMENT_FILE).read_text())["inputs"]["landmarks"]
