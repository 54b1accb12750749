"""A kernel that is older than what it calls is compiled again before tests run."""

import os

import pytest
from fixtures.stale_kernels import remove_stale_kernels

SOURCES = {
    "model/part.py": "from numba import njit\n",
    "model/whole.py": "from model.part import loop\nfrom numba import njit\n",
    "model/other.py": "from numba import njit\n",
    "model/most.py": "from numba import njit\nfrom model import (  # both\n    part as p,\n)\n",
}


@pytest.fixture
def product(tmp_path):
    (tmp_path / "model" / "__pycache__").mkdir(parents=True)
    for number, (name, text) in enumerate(SOURCES.items()):
        path = tmp_path / name
        path.write_text(text)
        os.utime(path, (1000 + number, 1000 + number))
        for ending in ("nbi", "1.nbc"):
            kernel = path.parent / "__pycache__" / f"{path.stem}.run-7.py311.{ending}"
            kernel.touch()
            os.utime(kernel, (2000, 2000))
    return tmp_path


def test_kernels_newer_than_all_callees_are_kept(product):
    assert remove_stale_kernels(product) == []


def test_changed_part_removes_own_and_caller_kernels(product):
    os.utime(product / "model" / "part.py", (3000, 3000))
    removed = {path.name.partition(".")[0] for path in remove_stale_kernels(product)}
    assert removed == {"part", "whole", "most"}
    assert len(list((product / "model" / "__pycache__").iterdir())) == 2
