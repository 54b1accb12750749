"""Kernels compiled while setting up: the list fits the code, and what does not fit is harmless."""

import ast
import importlib.util
from pathlib import Path

import numpy as np
import pytest
from fixtures.product_code import tree_of

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("tool", ROOT / "tools" / "compile_kernels.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_most_listed_kernels_match_code_and_argument_count(tool):
    """A tenth may be out of date; `python tools/compile_kernels.py --record` lists them anew."""
    rows = [row for rows in tool.listed() for row in rows]
    fit = 0
    for module, name, signature in rows:
        path = ROOT.joinpath(*module.split(".")).with_suffix(".py")
        body = tree_of(path).body if path.is_file() else []
        found = [d for d in body if isinstance(d, ast.FunctionDef) and d.name == name]
        given = eval(signature, {"__builtins__": {}}, tool._NAMES)
        # a function that makes kernels stands with a type of numbers, a kernel with its arguments'
        count = len(given) if isinstance(given, tuple) else 1
        fit += any(len(d.args.args) == count for d in found)
    assert len(rows) > 50
    assert fit >= 0.9 * len(rows)


def test_unmatched_kernel_is_counted_and_compiled_on_call(tool):
    text = "(unicode_type,)"
    good = "(Array(float64, 2, 'C', False, aligned=True),)"
    for row in [
        ("rigsim.no_such", "f", good),
        ("rigsim.geometry.atlas", "no_such", good),
        ("rigsim.geometry.atlas", "sample", good),  # no kernel
        ("rigsim.subject.head", "_distance", text),
        (
            "model.photon_table.kernels",
            "evaluate",
            good,
        ),  # has types of its own, and takes no other
        (
            "reconstruction.photometric_stereo.kernels",
            "fit_points",
            "unicode_type",
        ),  # makes no such one
        ("rigsim.subject.head", "_distance", "(Array(float64"),
        ("rigsim.subject.head", "_distance", "__import__('os')"),
    ]:
        assert tool.compile_module([row]) == 1


@pytest.mark.parametrize(
    ("module", "function"),
    [
        ("rigsim.geometry.atlas", "_rasterize"),
        ("model.photon_table.kernels", "evaluate"),  # compiled as it is imported
        ("reconstruction.photometric_stereo.kernels", "fit_points"),  # made by a cached function
    ],
)
def test_a_listed_kernel_compiles_for_its_types(module, function, tool):
    rows = [row for rows in tool.listed() for row in rows if row[:2] == (module, function)]
    assert rows
    assert tool.compile_module(rows) == 0


def test_kernels_are_listed_under_name_that_compiles_them(tool):
    """A kernel's function may stand under another name, or be compiled by a function's call."""
    from reconstruction.photometric_stereo import kernels as photometric_kernels
    from rigsim.geometry import atlas
    from rigsim.tissue import skin_table

    kinds = (tool._NAMES["float32"], tool._NAMES["int64"])
    assert tool._named(atlas._rasterize.py_func, kinds) == ("_rasterize", "(float32, int64)")
    assert tool._named(skin_table._interpolate, kinds)[0].startswith("_interpolate_f")
    named = tool._named(photometric_kernels._fit_points, kinds)
    assert named == ("fit_points", "float32")
    assert tool.compile_module([(photometric_kernels.__name__, *named)]) == 0


def test_readonly_or_noncontiguous_arrays_need_no_compilation(rng):
    """Statistics in discs and filled textures: 10 s and 13 s each time, before."""
    from model.facial_color import disc_kernels, disc_statistics
    from reconstruction.surface import texture_fill

    height, weight = rng.normal(size=(9, 12)), rng.random((9, 12)).astype(np.float32)
    kept = height.copy()
    kept.flags.writeable = False
    for values in (height, kept):
        for valid in (None, weight > 0.1):
            disc_statistics.measure(values, 2.0, valid=valid)
    by_type = [given[0].dtype for given in disc_kernels.disc_moments.signatures]
    assert len(by_type) == len(set(by_type))
    kernels = (texture_fill._pull, texture_fill._push, texture_fill._relax)
    rows = texture_fill.push_pull(height, weight)
    before = [len(kernel.signatures) for kernel in kernels]
    columns = texture_fill.push_pull(height, np.asfortranarray(weight))
    assert [len(kernel.signatures) for kernel in kernels] == before
    np.testing.assert_array_equal(rows.values, columns.values)
