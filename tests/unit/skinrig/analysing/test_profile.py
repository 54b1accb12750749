"""Profiles under stretch: closed-form lengths, tables that are read, tables that are refused."""

import json

import numpy as np
import pytest

from skinrig.analysing import profile
from skinrig.cli import main
from skinrig.errors import UnusableError


def write(path, heights, step=5.0, head="position_um,height_um"):
    rows = [f"{step * k},{height}" for k, height in enumerate(heights)]
    path.write_text("\n".join([head, *rows]))
    return path


def test_profile_of_zigzag_has_closed_form_lengths(tmp_path):
    heights = np.tile([0.0, 12.0], 20)
    found = profile.analyze_profile(
        tmp_path / "p", heights, 5.0, source="zigzag", stretches=(0.8, 1.35)
    )
    for row in found["stretches"]:
        expected = np.hypot(12.0, 5.0 * row["stretch"]) / 13.0
        assert row["unchanged_ratio"] == pytest.approx(expected, rel=1e-9)
    compressed, stretched = found["stretches"]
    assert compressed["table_ratio"] > compressed["unchanged_ratio"]
    assert stretched["table_ratio"] < stretched["unchanged_ratio"]
    assert compressed["preserving_ratio"] == pytest.approx(1.0, abs=1e-9)


def test_analyse_profile_reads_a_table(tmp_path, capsys):
    path = write(tmp_path / "p.csv", 30.0 * np.sin(np.arange(100) / 4.0))
    argv = ["analyse", "profile", str(path), "--stretch", "0.9", "--out", str(tmp_path / "o")]
    assert main([*argv, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["spacing_um"] == 5.0
    assert len(document["stretches"]) == 1
    assert (tmp_path / "o" / "figure-4.png").is_file()


@pytest.mark.parametrize(
    ("heights", "head", "word"),
    [
        (np.zeros(40), "x,y", "columns"),
        (np.zeros(5), "position_um,height_um", "rows"),
        (["a"] * 40, "position_um,height_um", "numbers"),
        ([np.nan] * 40, "position_um,height_um", "finite"),
    ],
)
def test_damaged_profile_is_refused(tmp_path, heights, head, word):
    path = write(tmp_path / "p.csv", heights, head=head)
    with pytest.raises(UnusableError, match=word):
        profile.read_profile(path)
