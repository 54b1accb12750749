"""Every extreme case passes in both precisions, and a failed case is reported."""

import json
from collections import Counter
from importlib.util import find_spec

import pytest

from skinrig.cli import main
from skinrig.extremes import cases as extremes
from skinrig.extremes import expectations
from skinrig.reporting.report import build

CASES = extremes.read_cases()
HEAVY = {
    "kernel of flat skin",  # searches all kernels twice
    *("forehead at the ends of the paper's table", "residual of 5e-3 against 1e-6"),
    *("layer 20 times stiffer than its tissue", "scan 14 mm away", "search of two steps"),
    *("points 100 000 px away", "collapsed image", "incompressible tissue"),
    *("mirror up to 80 degrees", "scan of a ball", "texture of 8192 texels"),
    *("half of a face", "coarse scan", "scan turned and 100 m away"),
    *("no overlap of the rigs", "colors outside skin", "surface without reflection"),
    *("black pixels", "nearly forward scattering", "8K images", "rows of zeros"),
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


SOLVERS = {
    "skin equilibrium": "rigsim.skin_patch.equilibrium",
    "pushed patch": "skinrig.applying.pushed_patch",
    "taped skin": "rigsim.world.taped_skin",
    "gradient normals": "reconstruction.gradient_normals.estimation",
    "perfusion fits": "reconstruction.facial_color.perfusion_fit",
    "polarized leakage": "capture.calibration.polarization.malus",
    "Heeger-Bergen": "model.texture_statistics.description",
    "traits": "model.traits.nonnegative_kernels",
    "image registration": "reconstruction.registration.affine_fit",
    "synthesis": "model.displacement_synthesis.growth",
    "bundle adjustment": "capture.calibration.geometry.bundle",
    "scan registration": "reconstruction.scan.registration",
    "fiber calibration": "capture.calibration.fiber.merge",
    "screen-space scattering": "skinrig.viewer.assets.gaussian_profiles",
    "chromophores": "reconstruction.chromophores.inversion",
    "photometric stereo": "reconstruction.photometric_stereo.estimation",
    "normal integration": "reconstruction.normal_integration.integration",
    "subsurface fit": "reconstruction.subsurface.levenberg_marquardt",
    "lobe weights": "reconstruction.brdf_basis.fit",
    "template": "reconstruction.scan.template_wrapping",
}
"""Iterative solvers, by the stage of their cases."""


def test_iterative_solvers_without_four_cases_are_none():
    counts = Counter(case.stage for case in CASES)
    few = {stage for stage in SOLVERS if counts[stage] < 4}
    assert few == set()
    for module in SOLVERS.values():
        assert find_spec(module) is not None


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
    command = ["bench", "--extremes", "--stage", "polarization", "--out", str(tmp_path), "--json"]
    assert main(command) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == extremes.SCHEMA
    assert {case["stage"] for case in document["cases"]} == {"polarization"}
    assert json.loads((tmp_path / "extremes.json").read_text())["cases"]
    assert "Extreme cases" in build([tmp_path])


def test_unknown_stage_error_lists_valid_stages(capsys):
    assert main(["bench", "--extremes", "--stage", "hrd"]) == 3
    assert "hdr" in capsys.readouterr().err
