"""Each iterative solver reports how it ended, or a listed reason makes a report superfluous."""

import ast
import re
from functools import cache

import pytest
from fixtures.product_code import PACKAGES, ROOT, modules, nodes_of, text_of, tree_of

SCIPY_SEARCHES = {
    *("least_squares", "minimize", "minimize_scalar", "curve_fit", "fsolve", "root"),
    *("cg", "lsmr", "lsqr", "gmres", "linprog", "NMF", "FastICA", "solve_poisson"),
}
LIMIT_NAME = re.compile(r"(?i)(steps|rounds|iterations)$")
REPORTS = re.compile(
    r"\b(SolverOutcome|outcome_from_scipy|_log\.warning|warn_\w+|\w*Diverged)\("
    r"|raise (ConvergenceError|EquilibriumError)\("
)

NEED_NO_REPORT = {
    "capture/calibration/geometry/intrinsics.py": "an inverse of the lens that is not found raises",
    "capture/calibration/fiber/spot_photometry.py": "spots that do not converge are NaN",
    "model/dipole/profile.py": "bisection between bounds ends within its steps",
    "model/texture_statistics/description.py": "returns the distance after each iteration",
    "reconstruction/brdf_basis/fit.py": "an early stop is valid; the misfit is in its result",
    "reconstruction/chromophores/ridge_kernels.py": "a pixel's unfinished step has no parabola",
    "reconstruction/chromophores/start.py": "a linear program of four unknowns",
    "reconstruction/chromophores/table_fit/kernels.py": "a pixel's last step is in its error",
    "reconstruction/correspondence/landmark_field.py": "a scalar search between two bounds",
    "reconstruction/diffuse_albedo/kernels.py": "a pixel's weights, with a fixed number of steps",
    "reconstruction/facial_color/shared_melanin_kernels.py": "a pixel's bracketed root",
    "reconstruction/gradient_normals/moment_kernels.py": "two rounds of noise, not a search",
    "reconstruction/gradient_normals/occlusion.py": "three steps per pixel, more lower no error",
    "reconstruction/photometric_stereo/kernels.py": "a pixel's residual is in its error",
    "reconstruction/registration/strain.py": "a fixed number of rounds of tracking",
    "reconstruction/stack_diagnosis/moved_images.py": "a fixed number of steps, with its residual",
    "reconstruction/subsurface/levenberg_marquardt.py": "returns each fit's state by its number",
    "reconstruction/tsumura.py": "scikit-learn warns",
    "rigsim/as_built/dome.py": "the simulator's lens has an inverse",
    "rigsim/geometry/atlas.py": "fills a border of some texels, not a search",
    "rigsim/fiber/homogeneous_fit.py": "the misfit is in its result",
}
"""Iterative modules that neither hold an outcome, nor warn or raise, with the reason."""


def describe_iterations(tree):
    """Return the solvers of a module: SciPy's, and loops that end early or at a limit."""
    found, imported = set(), set()
    for node in nodes_of(tree, ast.Import, ast.ImportFrom):
        imported |= {(alias.asname or alias.name).split(".")[0] for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            found |= SCIPY_SEARCHES & {alias.name for alias in node.names}
    for node in nodes_of(tree, ast.Attribute):
        if node.attr in SCIPY_SEARCHES:
            base = node.value
            while isinstance(base, ast.Attribute):
                base = base.value
            if isinstance(base, ast.Name) and base.id in imported:
                found.add(node.attr)
    for node in nodes_of(tree, ast.For, ast.While):
        head = node.iter if isinstance(node, ast.For) else node.test
        named = [n for n in ast.walk(head) if isinstance(n, ast.Name | ast.Attribute)]
        names = [getattr(n, "id", getattr(n, "attr", "")) for n in named]
        ranged = isinstance(node, ast.While) or "range" in names
        ends = isinstance(node, ast.While) or any(
            isinstance(n, ast.Break | ast.Return) for n in ast.walk(node)
        )
        limits = [name for name in names if LIMIT_NAME.search(name)]
        if ranged and ends and limits:
            found.add(limits[0])
    return found


@cache
def iterative_modules():
    """Return path, text and solvers of each module of the packages that iterates."""
    return [
        (path.relative_to(ROOT).as_posix(), text_of(path), found)
        for path in modules(*PACKAGES)
        if not {"benchmarks", "extremes"} & set(path.parts)
        and (found := describe_iterations(tree_of(path)))
    ]


def test_every_iterative_solver_reports_its_end():
    found = iterative_modules()
    assert len(found) > 30
    silent = {path for path, text, _ in found if not REPORTS.search(text)}
    assert sorted(silent - set(NEED_NO_REPORT)) == []


def test_reasons_are_of_modules_that_iterate():
    assert sorted(set(NEED_NO_REPORT) - {path for path, _, _ in iterative_modules()}) == []


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("for _ in range(MAX_STEPS):\n    if done:\n        break\n", {"MAX_STEPS"}),
        ("while gain > 1 and rounds < MAX_ROUNDS:\n    rounds += 1\n", {"rounds"}),
        ("from scipy import optimize\noptimize.minimize(cost, start)\n", {"minimize"}),
        ("import scipy\nfit = partial(scipy.optimize.root, cost)\n", {"root"}),
        ("from scipy.optimize import least_squares as f\npartial(f, g)\n", {"least_squares"}),
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
