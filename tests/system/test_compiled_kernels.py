"""Kernels compiled while setting up: the list fits the code, and what does not fit is harmless."""

import ast
import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("tool", ROOT / "tools" / "compile_kernels.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_most_listed_kernels_are_in_the_code_with_as_many_arguments(tool):
    """A tenth may be out of date; `python tools/compile_kernels.py --record` lists them anew."""
    rows = [row for rows in tool.listed() for row in rows]
    fit = 0
    for module, name, signature in rows:
        path = ROOT.joinpath(*module.split(".")).with_suffix(".py")
        tree = ast.parse(path.read_text("utf-8")) if path.is_file() else ast.Module([], [])
        found = [d for d in tree.body if isinstance(d, ast.FunctionDef) and d.name == name]
        given = eval(signature, {"__builtins__": {}}, tool._NAMES)
        fit += any(len(d.args.args) == len(given) for d in found)
    assert len(rows) > 50
    assert fit >= 0.9 * len(rows)


def test_a_kernel_that_does_not_fit_is_counted_and_left_to_its_first_call(tool):
    text = "(unicode_type,)"
    good = "(Array(float64, 2, 'C', False, aligned=True),)"
    for row in [
        ("rigsim.no_such", "f", good),
        ("rigsim.atlas", "no_such", good),
        ("rigsim.atlas", "sample", good),  # no kernel
        ("rigsim.head", "_distance", text),
        ("model.photon_kernels", "evaluate", good),  # has types of its own, and takes no other
        ("rigsim.head", "_distance", "(Array(float64"),
        ("rigsim.head", "_distance", "__import__('os')"),
    ]:
        assert tool.compile_module([row]) == 1


def test_a_listed_kernel_compiles_for_its_types(tool):
    rows = [r for rows in tool.listed() for r in rows if r[:2] == ("rigsim.atlas", "_rasterize")]
    assert rows
    assert tool.compile_module(rows) == 0
