"""An output that cannot be written is refused before the work for it begins."""

import errno
import shutil
import tempfile
from collections import namedtuple

import pytest

from skinrig.atomic_file import MIN_FREE_BYTES, require_writable
from skinrig.cli import main
from skinrig.errors import UnusableError

Usage = namedtuple("Usage", "total used free")
COMMANDS = [
    ["simulate", "flash", "--subject", "IV"],
    ["simulate", "dome"],
    ["calibrate", "white", "no-session"],
    ["reconstruct", "no-session", "--maps", "melanin"],
    ["import", "photos", "no-photos"],
    ["edit", "no-maps", "--trait", "tan=1"],
]


@pytest.mark.parametrize("argv", COMMANDS, ids=lambda argv: " ".join(argv[:2]))
def test_unwritable_output_is_refused_first(argv, capsys):
    assert main([*argv, "--out", "/proc/x"]) == 3
    err = capsys.readouterr().err
    assert "/proc cannot be written to" in err
    assert len(err.splitlines()) == 1


def test_full_disk_is_refused_first(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(2**40, 2**40, MIN_FREE_BYTES - 1))
    assert main(["simulate", "flash", "--out", str(tmp_path / "s")]) == 3
    assert "got 1048575 bytes free, expected at least 1048576" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_place_below_file_is_refused(tmp_path):
    (tmp_path / "a").write_text("x")
    with pytest.raises(UnusableError, match="cannot be written to"):
        require_writable(tmp_path / "a" / "b")


def test_existing_folder_itself_is_tried(tmp_path, monkeypatch):
    out = tmp_path / "out"
    out.mkdir()
    make = tempfile.TemporaryDirectory

    def refuse_out(*, prefix, dir):
        if dir == out:
            raise PermissionError(errno.EACCES, "Permission denied")
        return make(prefix=prefix, dir=dir)

    monkeypatch.setattr(tempfile, "TemporaryDirectory", refuse_out)
    with pytest.raises(UnusableError, match=r"out cannot be written to \(Permission"):
        require_writable(out)
    require_writable(tmp_path / "other")


def test_check_leaves_nothing_behind(tmp_path):
    require_writable(tmp_path / "deep" / "out")
    assert list(tmp_path.iterdir()) == []


def test_impossible_stance_is_refused_before_face(tmp_path, monkeypatch, capsys):
    def made(*_, **__):
        raise AssertionError("the face was made before the check")

    monkeypatch.setattr("rigsim.population.files.load_subject", made)
    argv = ["simulate", "flash", "--camera-offset-mm", "1e9", "--out", str(tmp_path / "s")]
    assert main(argv) == 3
    assert "nearer: got 1e+09 mm" in capsys.readouterr().err
