"""The table of stages: every entry has a function, and every limit has one bound."""

import ast
from importlib.util import find_spec
from pathlib import Path

import pytest

from skinrig.benchmarks.stage import BenchmarkStage, read_descriptions


@pytest.mark.parametrize("name", read_descriptions())
def test_stage_has_function_and_limits_of_its_module(name):
    entry = read_descriptions()[name]
    module, function = entry["run"].rsplit(".", 1)
    source = Path(find_spec(f"skinrig.benchmarks.{module}").origin).read_text(encoding="utf-8")
    tree = ast.parse(source)
    assert function in {n.name for n in tree.body if isinstance(n, ast.FunctionDef)}
    words = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant)}
    for key, limit in entry.get("limits", {}).items():
        assert key in words
        assert ("at_most" in limit) != ("at_least" in limit)


def limit(name, found):
    (limit,) = BenchmarkStage(name, limits=found).to_benchmark().limits
    return limit


def test_results_fill_limit_names_and_bounds():
    assert limit("photon-transport", {"over_own_walk": 5.0}).passed
    clean = limit("gradient-normals", {("clean", "as it is"): 1.0})
    assert clean.name == "mean error without noise on smooth relief, as it is"
    assert (clean.sense, clean.bound, clean.unit, clean.passed) == ("<=", 0.3, "degrees", False)
    rms = limit("light-order", {"rms": (0.1, 0.2)})
    assert (rms.got, rms.bound, rms.passed) == (0.1, 0.2, True)


def test_limit_missing_in_table_is_error():
    with pytest.raises(KeyError, match="tea"):
        limit("hdr", {"tea": 1.0})
