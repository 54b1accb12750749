"""Every extreme case passes in both precisions, and a failed case is reported."""

import json
from collections import Counter

import pytest
from fixtures.iterative_solvers import iterative_modules
from fixtures.product_code import ROOT

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


STAGES = {
    "capture/calibration/geometry/bundle_equations.py": "bundle adjustment",
    "capture/calibration/geometry/intrinsics.py": "lens inverse",
    "capture/calibration/lights/reflection.py": "mirror points",
    "capture/calibration/polarization/malus.py": "polarized leakage",
    "model/dipole/profile.py": "dipole",
    "model/texture_statistics/description.py": "Heeger-Bergen",
    "model/traits/nonnegative_kernels.py": "traits",
    "reconstruction/anisotropy/diffusion_ellipse.py": "diffusion ellipse",
    "reconstruction/brdf_basis/fit.py": "NMF",
    "reconstruction/brdf_basis/nnls_kernels.py": "lobe weights",
    "reconstruction/brdf_basis/space.py": "common mixtures",
    "reconstruction/chromophores/table_fit/kernels.py": "chromophores",
    "reconstruction/correspondence/landmark_field.py": "landmark field",
    "reconstruction/diffuse_albedo/kernels.py": "diffuse albedo",
    "reconstruction/facial_color/perfusion_likelihood.py": "perfusion fits",
    "reconstruction/gradient_normals/moment_kernels.py": "gradient normals",
    "reconstruction/normal_integration/discontinuities.py": "depth steps",
    "reconstruction/normal_integration/integration.py": "normal integration",
    "reconstruction/normal_integration/weighted_poisson.py": "normal integration",
    "reconstruction/photometric_stereo/kernels.py": "photometric stereo",
    "reconstruction/scan/registration.py": "scan registration",
    "reconstruction/scan/template_wrapping.py": "template",
    "reconstruction/stack_diagnosis/shading_space.py": "listed lights",
    "reconstruction/subsurface/levenberg_marquardt.py": "subsurface fit",
    "reconstruction/tsumura.py": "independent pigments",
    "rigsim/skin_patch/equilibrium.py": "skin equilibrium",
    "rigsim/skin_patch/stretch.py": "stretched skin",
    "skinrig/applying/pushed_patch.py": "pushed patch",
    "skinrig/viewer/assets/gaussian_profiles.py": "screen-space scattering",
}
"""Iterative modules, with the stage of their cases."""
SOLVERS_WITHOUT_LOOPS = {"taped skin", "image registration", "synthesis", "fiber calibration"}
"""Further stages that need four cases; the scan finds no search in their modules."""
JUDGED_BY = {
    "capture/calibration/fiber/crosstalk.py": "unit/capture/calibration/fiber/test_gains.py",
    "capture/calibration/fiber/discs.py": "unit/capture/calibration/fiber/test_spots.py",
    "capture/calibration/fiber/spot_photometry.py": (
        "unit/capture/calibration/fiber/test_spot_photometry.py"
    ),
    "capture/calibration/fiber/spots.py": "unit/capture/calibration/fiber/test_spots.py",
    "capture/calibration/led_sphere/glass_ball.py": (
        "unit/capture/calibration/led_sphere/test_glass_ball.py"
    ),
    "capture/calibration/led_sphere/polarization.py": (
        "unit/capture/calibration/led_sphere/test_polarization.py"
    ),
    "capture/calibration/lights/light_fit.py": "recovery/test_dome_calibration.py",
    "capture/calibration/lights/mirror_lights.py": "recovery/test_dome_calibration.py",
    "capture/calibration/lights/mirror_sphere.py": "recovery/test_dome_calibration.py",
    "reconstruction/chromophores/face_distribution.py": (
        "unit/reconstruction/chromophores/test_face_distribution.py"
    ),
    "reconstruction/chromophores/ridge_kernels.py": (
        "unit/reconstruction/chromophores/test_posterior.py"
    ),
    "reconstruction/facial_color/shared_melanin_kernels.py": (
        "unit/reconstruction/facial_color/test_shared_melanin.py"
    ),
    "reconstruction/gradient_normals/kernels.py": "recovery/test_gradient_normals.py",
    "reconstruction/gradient_normals/occlusion.py": (
        "unit/reconstruction/gradient_normals/test_occlusion.py"
    ),
    "reconstruction/registration/head_motion.py": "recovery/test_head_motion.py",
    "reconstruction/registration/strain.py": "unit/reconstruction/registration/test_strain.py",
    "reconstruction/stack_diagnosis/moved_images.py": (
        "unit/reconstruction/stack_diagnosis/test_diagnosis.py"
    ),
    "reconstruction/stack_diagnosis/unlisted_lights.py": (
        "unit/reconstruction/stack_diagnosis/test_unlisted_lights.py"
    ),
    "reconstruction/wrinkles/fit.py": "unit/reconstruction/wrinkles/test_fit.py",
    "reconstruction/wrinkles/texels.py": "unit/reconstruction/wrinkles/test_fit.py",
    "reconstruction/wrinkles/zones.py": "unit/reconstruction/wrinkles/test_zones.py",
    "rigsim/fiber/homogeneous_fit.py": "unit/rigsim/scenes/probe/test_truth.py",
    "skinrig/fitting/brdf_tables.py": "unit/skinrig/fitting/test_brdf_tables.py",
}
"""Solvers of images, scans and sessions, with the tests that judge them instead of cases."""
NO_SEARCH = {
    "capture/devices/box.py": "reads a queue",
    "capture/plan/light_order.py": "any order is valid",
    "reconstruction/chromophores/start.py": "a linear program of the color table alone",
    "reconstruction/kernel_fit/table.py": "the best of eight linear fits",
    "rigsim/as_built/dome.py": "the simulator's lens has an inverse",
    "rigsim/geometry/atlas.py": "fills a border",
    "rigsim/subject/head.py": "rays of the simulator end at its surface",
}
"""Modules whose loops need no case, with the reason."""


def test_iterative_solvers_without_four_cases_are_none():
    counts = Counter(case.stage for case in CASES)
    few = {name for name in {*STAGES.values(), *SOLVERS_WITHOUT_LOOPS} if counts[name] < 4}
    assert few == set()
    found = Counter([*STAGES, *JUDGED_BY, *NO_SEARCH])
    assert found == Counter(path for path, _, _ in iterative_modules())
    assert [name for name in JUDGED_BY.values() if not (ROOT / "tests" / name).is_file()] == []


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
