"""The examples that a test draws are independent of the tests that share its process."""

import importlib.util
import sys

import hypothesis
from hypothesis import strategies


def drawn():
    seen = []

    @hypothesis.settings(max_examples=200)
    @hypothesis.given(strategies.floats(0.0, 5.0))
    def draw(value):
        seen.append(value)

    draw()
    return seen


def test_numbers_of_module_imported_meanwhile_are_not_drawn(tmp_path, monkeypatch):
    before = drawn()
    path = tmp_path / "numbers_of_its_own.py"
    path.write_text("\n".join(f"N{k} = {3.0 + 1e-3 * k}" for k in range(1, 100)))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, path.stem, module)
    spec.loader.exec_module(module)
    assert drawn() == before
