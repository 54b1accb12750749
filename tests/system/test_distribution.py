"""The wheel has every module and data file of the packages, and starts where it is unpacked."""

import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("capture", "model", "reconstruction", "rigsim", "skinrig")
MAX_WHEEL_BYTES = 25_000_000
START = "import sys; from skinrig.cli import main; sys.exit(main(sys.argv[1:]))"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel of the source distribution, both by the installed build backend."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        if (ROOT / name).is_file():
            (source / name).write_bytes((ROOT / name).read_bytes())
    for package in PACKAGES:
        (source / package).symlink_to(ROOT / package, target_is_directory=True)
    pack = "import sys; from setuptools import build_meta; build_meta.build_sdist(sys.argv[1])"
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-index"]
    command += ["--no-build-isolation", "--disable-pip-version-check", "-w", str(folder)]
    for make in ([sys.executable, "-c", pack, str(folder)], command):
        sources = [str(path) for path in folder.glob("*.tar.gz")]
        done = subprocess.run(
            [*make, *sources], cwd=source, capture_output=True, text=True, timeout=250
        )
        assert done.returncode == 0, done.stderr[-2000:]
    return next(folder.glob("*.whl"))


def list_package_files():
    """Return the files of the packages, but caches."""
    return {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


@pytest.mark.long
def test_wheel_has_every_file(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert list_package_files() - names == set()
    assert names - list_package_files() == set()
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert wheel.name.startswith(f"skinrig-{version}-")
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert wheel.stat().st_size < MAX_WHEEL_BYTES


@pytest.mark.long
def test_unpacked_wheel_starts_without_checkout(wheel, tmp_path):
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "unpacked")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "unpacked")}
    for arguments in (["--version"], ["simulate", "flash", "--help"]):
        done = subprocess.run(
            [sys.executable, "-P", "-c", START, *arguments],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert done.returncode == 0, done.stderr[-2000:]
    where = "import skinrig; print(skinrig.__file__)"
    imported_from = subprocess.check_output(
        [sys.executable, "-P", "-c", where], cwd=tmp_path, env=environment, text=True
    )
    assert str(tmp_path) in imported_from
