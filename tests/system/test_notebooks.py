"""The notebooks run from top to bottom, and every result that a cell ends with is displayed."""

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
RUNNER = """
import ast, json, sys
from skinrig.simulating import probe
probe.TRUTH_PHOTONS["small"] = 15_000
names = {}
for cell in json.load(open(sys.argv[1]))["cells"]:
    if cell["cell_type"] == "code":
        tree = ast.parse("".join(cell["source"]))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, "cell", "exec"), names)
        if last is not None:
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
            show = getattr(value, "_repr_html_", None)
            print(len(show()) if show else repr(value))
"""
"""What a kernel does: cells run in one namespace, and the value of a last expression is shown.

A quarter of the probe's photons: other tests judge the accuracy of its sessions.
"""

needs_xarray = pytest.mark.skipif(find_spec("xarray") is None, reason="no xarray")


def test_there_are_four_clean_notebooks():
    assert len(NOTEBOOKS) == 4
    for path in NOTEBOOKS:
        document = json.loads(path.read_text(encoding="utf-8"))
        assert document["nbformat"] == 4
        code = [cell for cell in document["cells"] if cell["cell_type"] == "code"]
        assert all(cell["outputs"] == [] for cell in code)
        assert document["cells"][0]["source"][0].startswith("# ")


@pytest.mark.long
@needs_xarray
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_and_displays_results(path, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", RUNNER, str(path)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert any(line.isdigit() and int(line) > 1000 for line in done.stdout.splitlines())
