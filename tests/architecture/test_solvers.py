"""Each iterative solver reports how it ended, or a listed reason makes a report superfluous."""

import ast
import re

import pytest
from fixtures.iterative_solvers import describe_iterations, iterative_modules

REPORTS = re.compile(
    r"\b(SolverOutcome|outcome_from_scipy|_log\.warning|warn_\w+|\w*Diverged)\("
    r"|raise (ConvergenceError|EquilibriumError)\("
)

NEED_NO_REPORT = {
    "capture/calibration/geometry/intrinsics.py": "an inverse of the lens that is not found raises",
    "capture/calibration/fiber/spot_photometry.py": "spots that do not converge are NaN",
    "capture/calibration/lights/reflection.py": "bisection between bounds ends within its steps",
    "capture/calibration/polarization/malus.py": "a fixed number of reweightings",
    "capture/devices/box.py": "reads a queue, not a search",
    "capture/plan/light_order.py": "any order is valid; each move shortens its path",
    "model/dipole/profile.py": "bisection between bounds ends within its steps",
    "model/texture_statistics/description.py": "returns the distance after each iteration",
    "reconstruction/brdf_basis/nnls_kernels.py": "returns each point's end; its caller warns",
    "reconstruction/chromophores/ridge_kernels.py": "a pixel's unfinished step has no parabola",
    "reconstruction/chromophores/start.py": "a linear program of four unknowns",
    "reconstruction/chromophores/table_fit/kernels.py": "a pixel's last step is in its error",
    "reconstruction/correspondence/landmark_field.py": "a scalar search between two bounds",
    "reconstruction/diffuse_albedo/kernels.py": "a pixel's weights, with a fixed number of steps",
    "reconstruction/facial_color/shared_melanin_kernels.py": "a pixel's steps within an axis",
    "reconstruction/gradient_normals/kernels.py": "a pixel with a larger residual is not valid",
    "reconstruction/gradient_normals/moment_kernels.py": "two rounds of noise, not a search",
    "reconstruction/gradient_normals/occlusion.py": "three steps per pixel, more lower no error",
    "reconstruction/kernel_fit/table.py": "returns the best of its trials",
    "reconstruction/photometric_stereo/kernels.py": "a pixel's residual is in its error",
    "reconstruction/registration/strain.py": "a fixed number of rounds of tracking",
    "reconstruction/stack_diagnosis/shading_space.py": "a fixed number of refits, with its misfit",
    "reconstruction/stack_diagnosis/moved_images.py": "a fixed number of steps, with its residual",
    "reconstruction/subsurface/levenberg_marquardt.py": "returns each fit's state by its number",
    "reconstruction/tsumura.py": "scikit-learn warns",
    "rigsim/as_built/dome.py": "the simulator's lens has an inverse",
    "rigsim/geometry/atlas.py": "fills a border of some texels, not a search",
    "rigsim/skin_patch/stretch.py": "a residual above its limit raises `StretchError`",
    "rigsim/subject/head.py": "rays of the simulator end at its surface",
    "rigsim/fiber/homogeneous_fit.py": "the misfit is in its result",
}
"""Iterative modules that neither hold an outcome, nor warn or raise, with the reason."""


def test_every_iterative_solver_reports_its_end():
    found = iterative_modules()
    assert len(found) > 30
    silent = {path for path, text, _ in found if not REPORTS.search(text)}
    assert sorted(silent ^ set(NEED_NO_REPORT)) == []


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("for _ in range(MAX_STEPS):\n    if done:\n        break\n", {"MAX_STEPS"}),
        ("while gain > 1 and rounds < MAX_ROUNDS:\n    rounds += 1\n", {"rounds"}),
        ("from scipy import optimize\noptimize.minimize(cost, start)\n", {"minimize"}),
        ("import scipy\nfit = partial(scipy.optimize.root, cost)\n", {"root"}),
        ("from scipy.optimize import least_squares as f\npartial(f, g)\n", {"least_squares"}),
        ("for _ in range(6 * size + 6):\n    if done:\n        break\n", {"range(6 * size + 6)"}),
        ("for _ in range(MAX_SWEEPS):\n    break\n", {"MAX_SWEEPS"}),
        ("for _ in range(2):\n    break\n", set()),
        ("root = np.sqrt(values)\nself.root = root\n", set()),
        ("for row in range(height):\n    break\n", set()),
    ],
)
def test_solver_scan_finds_loops_and_searches(source, found):
    assert describe_iterations(ast.parse(source)) == found


@pytest.mark.parametrize(
    ("text", "reports"),
    [
        ('raise ValueError("x: got 3")', False),
        ("return Convergence(3)", False),
        ("raise PushDiverged(text)", True),
        ("outcome_from_scipy(found, 0.0)", True),
    ],
)
def test_only_ends_of_solvers_count_as_reports(text, reports):
    assert bool(REPORTS.search(text)) == reports
