"""Every extreme case passes in both precisions, and a failed case is reported."""

import json

import pytest

from skinrig.cli import main
from skinrig.extremes import cases as extremes
from skinrig.extremes import expectations
from skinrig.report import build

CASES = extremes.read_cases()
HEAVY = {
    "kernel of flat skin",  # searches all kernels twice
    *("half of a face", "coarse scan", "scan turned by 90 degrees", "scan 100 m away"),
}


@pytest.mark.parametrize(
    "case",
    [pytest.param(c, marks=pytest.mark.long if c.name in HEAVY else ()) for c in CASES],
    ids=[f"{c.stage}: {c.name}" for c in CASES],
)
def test_an_extreme_holds_in_float32_and_float64(case):
    outcomes = extremes.try_case(case).outcomes
    assert set(outcomes) == {"float32", "float64"}
    assert [one.got for one in outcomes.values() if not one.passed] == []


def test_sixty_extremes_have_unique_names():
    assert len(CASES) >= 60
    assert len({(case.stage, case.name) for case in CASES}) == len(CASES)


def a_case(run):
    return expectations.Case("a case", "nothing", "much", "it breaks", "it holds", run)


def broken(_):
    raise ZeroDivisionError("by zero")


@pytest.mark.parametrize(
    ("run", "word"),
    [
        (lambda real: expectations.expect_near(real(1.0), 2.0), "got 1"),
        (lambda real: expectations.expect_within([real("nan")], 0.0, 1.0), "finite"),
        (lambda real: expectations.expect_finite([real("inf")], [True]), "NaN or infinity"),
        (lambda real: expectations.expect_valid_fraction([True, False]), "fraction of 0.5"),
        (
            lambda real: expectations.expect_error(lambda: real(1.0), ValueError),
            "expected ValueError",
        ),
        (lambda real: expectations.expect_rising([real(2.0), real(1.0)]), "rise"),
        (broken, "ZeroDivisionError"),
    ],
)
def test_failed_extreme_case_is_reported(run, word):
    result = extremes.try_case(a_case(run))
    assert not result.passed
    assert all(word in one.got for one in result.outcomes.values())


def test_extremes_command_writes_table_and_report_includes_table(tmp_path, capsys):
    assert main(["bench", "--extremes", "--stage", "hdr", "--out", str(tmp_path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == extremes.SCHEMA
    assert {case["stage"] for case in document["cases"]} == {"hdr"}
    assert json.loads((tmp_path / "extremes.json").read_text())["cases"]
    assert "Extreme cases" in build([tmp_path])


def test_unknown_stage_error_lists_valid_stages(capsys):
    assert main(["bench", "--extremes", "--stage", "hrd"]) == 3
    assert "hdr" in capsys.readouterr().err
