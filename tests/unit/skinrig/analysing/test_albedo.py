"""Color histograms of groups and components of a population whose difference is known."""

import csv
import json

import numpy as np
import pytest

from skinrig.analysing import albedo as analysing_albedo
from skinrig.analysing.population_sessions import load_population_sessions
from skinrig.cli import main


@pytest.fixture(scope="module")
def lab(tmp_path_factory, dome_faces):
    folder = tmp_path_factory.mktemp("albedo")
    return folder, *dome_faces.population(folder, count=4)


@pytest.mark.long
def test_groups_differ_in_histograms_as_generated(lab, capsys):
    folder, paths, labels = lab
    out = folder / "analysis"
    argv = ["analyse", "albedo", *map(str, paths), "--labels", str(labels), "--out", str(out)]
    assert main([*argv, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["source"], told["consent"]) == ("simulated", [])
    assert told["groups"] == {"all": 4, "tan": 2, "no tan": 2, "oily": 2, "no oily": 2}
    ratio = np.log(np.array(told["mean_r_d"]["face"]["tan"]) / told["mean_r_d"]["face"]["no tan"])
    np.testing.assert_allclose(ratio, -0.365 * np.array([1.0, 1.1, 1.2]), atol=0.06)
    assert told["explained"]["face"][0] > 0.5
    assert sum(told["explained"]["face"]) == pytest.approx(1.0)
    with open(out / "histograms.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    share = {
        group: sum(
            float(r["share"])
            for r in rows
            if r["group"] == group and r["region"] == "face" and r["channel"] == "red"
        )
        for group in told["groups"]
    }
    np.testing.assert_allclose(list(share.values()), 1.0, rtol=1e-4)
    assert {path.name for path in out.iterdir()} == set(analysing_albedo.OUTPUT_FILES)
    assert (out / "figure-16.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize("people", ["1", "88"])
def test_more_people_than_were_captured_are_refused(people, tmp_path, capsys):
    argv = ["analyse", "albedo", "--people", people, "--out", str(tmp_path / "out")]
    assert main(argv) == 3
    most = len(load_population_sessions().captured)
    assert f"people: got {people}, expected 2 to {most}" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_labels_without_faces_are_refused(tmp_path, capsys):
    labels = tmp_path / "labels.csv"
    labels.write_text("name,tan\nface,1\n")
    argv = ["analyse", "albedo", "--labels", str(labels), "--out", str(tmp_path / "none")]
    assert main(argv) == 2
    assert "name APPEARANCE/ folders" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--size-px", "96"], "--size-px: apply to measured faces only"),
        (["folder", "--people", "3"], "--people, --seed: apply to simulated faces only"),
        (["folder", "--seed", "0"], "--people, --seed: apply to simulated faces only"),
        (["--seed", "0"], "--seed: has no effect without --people"),
    ],
)
def test_options_without_effect_are_refused(options, expected, tmp_path, capsys):
    assert main(["analyse", "albedo", *options, "--out", str(tmp_path / "out")]) == 2
    assert expected in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_analysis_without_faces_uses_sessions(tmp_path):
    found = analysing_albedo.analyze_simulated(tmp_path / "out", people=3)
    assert set(found.names) < set(load_population_sessions().captured)
    assert found.document()["groups"]["all"] == 3
    assert found.explained["face"].size == 2
