"""Kernels compile where neither the installation nor the home can be written."""

import os
import stat
import subprocess
import sys

import pytest

from skinrig import kernel_cache

KERNEL = """
import os, sys
from pathlib import Path
from skinrig import kernel_cache
place = kernel_cache.provide_kernel_cache(os.environ, Path("/proc/packages"))
print(place, flush=True)
import numba
@numba.njit(cache=True)
def twice(x):
    return 2 * x
print(twice(3), bool(list(Path(place).rglob("*.nbc"))))
"""


@pytest.fixture
def read_only(monkeypatch):
    """Nothing below the given folders can be written; root's rights notwithstanding."""

    def make(*folders):
        real = os.access

        def access(path, mode, **told):
            inside = any(str(path).startswith(str(folder)) for folder in folders)
            return not (inside and mode & os.W_OK) and real(path, mode, **told)

        monkeypatch.setattr(os, "access", access)

    return make


def test_cache_is_unchanged_with_writable_installation_or_home(tmp_path, read_only):
    home, packages = tmp_path / "home", tmp_path / "packages"
    home.mkdir()
    packages.mkdir()
    told = {"HOME": str(home)}
    assert kernel_cache.provide_kernel_cache(told, packages) is None
    read_only(packages)
    assert kernel_cache.provide_kernel_cache(told, packages) is None
    assert told == {"HOME": str(home)}


def test_named_cache_folder_is_kept(read_only):
    read_only("/")
    told = {"HOME": "/nowhere", "NUMBA_CACHE_DIR": "/kernels"}
    assert kernel_cache.provide_kernel_cache(told) is None
    assert told["NUMBA_CACHE_DIR"] == "/kernels"


def test_cache_folder_is_not_writable_by_other_users(tmp_path, read_only):
    read_only(tmp_path)
    told = {"HOME": str(tmp_path)}
    place = kernel_cache.provide_kernel_cache(told, tmp_path)
    assert told["NUMBA_CACHE_DIR"] == str(place)
    assert stat.S_IMODE(place.stat().st_mode) == 0o700
    assert kernel_cache.provide_kernel_cache({"HOME": str(tmp_path)}, tmp_path) != place


def test_kernels_are_cached_until_process_ends(tmp_path):
    told = {**os.environ, "HOME": "/proc", "XDG_CACHE_HOME": "/proc/none"}
    told.pop("NUMBA_CACHE_DIR", None)
    script = tmp_path / "script.py"
    script.write_text(KERNEL)
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, env=told, check=True
    )
    place, rest = done.stdout.splitlines()
    assert rest == "6 True"
    assert not os.path.exists(place)


def test_import_lets_waiting_threads_sleep():
    program = "import os, skinrig; print(os.environ['OMP_WAIT_POLICY'])"
    for given, expected in (({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE")):
        plain = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
        done = subprocess.run(
            [sys.executable, "-c", program], env=plain | given, capture_output=True, text=True
        )
        assert done.stdout.strip() == expected
