"""The tool that fetches public data sets, on small git repositories made here."""

import hashlib
import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PATHS = ("a/one.txt", "a/b/two [x] y.bin", "three.npy")
SPEC = importlib.util.spec_from_file_location("fetch_real_sets", ROOT / "tools/fetch_real_sets.py")
TOOL = importlib.util.module_from_spec(SPEC)
sys.modules["fetch_real_sets"] = TOOL  # dataclasses look their module up
SPEC.loader.exec_module(TOOL)

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")


def git(folder, *words):
    who = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "init.defaultBranch=m")
    done = subprocess.run(["git", "-C", folder, *who, *words], check=True, capture_output=True)
    return done.stdout.decode().strip()


def digest(data):
    return hashlib.sha256(data).hexdigest()


@pytest.fixture
def repository(tmp_path):
    """A repository own/sets with three files and a later commit; returns its folder and commit."""
    folder = tmp_path / "hub" / "own" / "sets"
    folder.mkdir(parents=True)
    git(folder, "init", "-q")
    git(folder, "config", "uploadpack.allowFilter", "true")
    git(folder, "config", "uploadpack.allowAnySHA1InWant", "true")
    for number, path in enumerate(PATHS):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(bytes([number, 13, 10, 200]) * 50)
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", "one")
    commit = git(folder, "rev-parse", "HEAD")
    (folder / PATHS[0]).write_bytes(b"later")
    (folder / "large.bin").write_bytes(bytes(4096))
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", "two")
    return folder, commit


@pytest.fixture
def table(tmp_path, repository):
    """Write the table of one set; returns a function that writes it with changed rows."""
    _, commit = repository
    right = {path: digest(bytes([k, 13, 10, 200]) * 50) for k, path in enumerate(PATHS)}

    def write(commit=commit, name="small", **changed):
        file = tmp_path / "sets.toml"
        texts = "".join(f'{key} = "-"\n' for key in ("license", "about", "paper", "truth"))
        file.write_text(f'[{name}]\nrepository = "own/sets"\ncommit = "{commit}"\n{texts}')
        rows = [f'{name},"{path}",200,{sha256}' for path, sha256 in (right | changed).items()]
        file.with_suffix(".csv").write_text("\n".join(["set,path,bytes,sha256", *rows]) + "\n")
        return file

    return write


def run(table, out, *words):
    return TOOL.main(["--table", str(table), "--out", str(out), *words])


def fetched(out):
    return {str(f.relative_to(out)) for f in out.rglob("*") if f.is_file()}


def test_snapshot_gives_exact_files_of_commit(table, tmp_path, capsys):
    out, hub = tmp_path / "out", str(tmp_path / "hub")
    assert run(table(), out, "--from", hub) == 0
    assert "3 files, 3 of them fetched now" in capsys.readouterr().out
    assert fetched(out) == {f"small/{path}" for path in PATHS}
    assert (out / "small" / PATHS[0]).read_bytes() == bytes([0, 13, 10, 200]) * 50
    assert run(table(), out, "--from", hub, "small") == 0
    assert "3 files, 0 of them fetched now" in capsys.readouterr().out


def test_clone_takes_only_listed_files(table, tmp_path, capsys, monkeypatch):
    asked = []
    run_git = TOOL._run_git
    monkeypatch.setattr(
        TOOL, "_run_git", lambda *words, **more: asked.append(words) or run_git(*words, **more)
    )
    removed = []
    monkeypatch.setattr(TOOL.shutil, "rmtree", lambda path, **_: removed.append(Path(path)))
    url = f"file://{tmp_path}/hub/{{repository}}"
    assert run(table(), tmp_path / "out", "--url", url) == 0
    clone = tmp_path / "out" / TOOL.CLONES / "own+sets"
    assert removed[-1] == clone  # once the set is complete
    here = {path for path in fetched(clone) if not path.startswith(".git/")}
    assert here == set(PATHS)
    assert any("--filter=blob:none" in words for words in asked)


def test_interrupted_clone_and_file_are_completed(table, tmp_path, capsys):
    out = tmp_path / "out"
    (out / TOOL.CLONES / "own+sets.part" / ".git").mkdir(parents=True)  # killed while cloning
    (out / "small/a").mkdir(parents=True)
    (out / "small/a/one.txt.part").write_bytes(b"half")
    (out / "small/three.npy").write_bytes(b"another version")
    assert run(table(), out, "--url", f"file://{tmp_path}/hub/{{repository}}") == 0
    assert fetched(out) == {f"small/{path}" for path in PATHS}
    assert (out / "small/three.npy").read_bytes() == bytes([2, 13, 10, 200]) * 50


def test_wrong_digest_names_file_and_keeps_others(table, tmp_path, capsys):
    out = tmp_path / "out"
    wrong = table(**{PATHS[0]: digest(b"other")})
    assert run(wrong, out, "--from", str(tmp_path / "hub")) == 1
    shown = capsys.readouterr().err
    assert f"{PATHS[0]}: got SHA-256" in shown
    assert f"expected {digest(b'other')[:12]}" in shown
    assert fetched(out) == {f"small/{path}" for path in PATHS[1:]}


def test_missing_file_is_named(table, tmp_path, capsys):
    absent = table(**{"large.bin": digest(bytes(4096))})  # of the later commit
    assert run(absent, tmp_path / "out", "--from", str(tmp_path / "hub")) == 1
    assert "large.bin: not in" in capsys.readouterr().err


def test_missing_commit_and_repository_are_named(table, tmp_path, capsys):
    out, url = tmp_path / "out", f"file://{tmp_path}/nowhere/{{repository}}"
    assert run(table(commit="0" * 40), out, "--from", str(tmp_path / "hub")) == 1
    assert "no snapshot of own/sets with commit 000000000000" in capsys.readouterr().err
    assert run(table(), out, "--url", url) == 1
    assert "git clone: " in capsys.readouterr().err


@pytest.mark.parametrize(
    "path", ["../x", "/x", "a/../../x", ".git/config", "a\\\\x", "C:x", "a//x", "./x"]
)
def test_paths_out_of_set_are_refused(table, tmp_path, path, capsys):
    assert run(table(**{path: digest(b"")}), tmp_path / "out") == 1
    assert "expected one inside its repository" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_link_out_of_folder_is_refused(table, tmp_path, capsys):
    out = tmp_path / "out"
    (out / "small").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    (out / "small/a").symlink_to(tmp_path / "elsewhere")
    assert run(table(), out, "--from", str(tmp_path / "hub")) == 1
    assert "through a link" in capsys.readouterr().err
    assert not list((tmp_path / "elsewhere").iterdir())


def test_link_in_repository_is_never_followed(repository, table, tmp_path, capsys):
    folder, _ = repository
    (folder / "link").symlink_to("/etc/hostname")
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", "three")
    (folder / PATHS[0]).write_bytes(bytes([0, 13, 10, 200]) * 50)
    git(folder, "commit", "-q", "-a", "-m", "four")
    changed = table(commit=git(folder, "rev-parse", "HEAD"), link=digest(b"/etc/hostname"))
    assert run(changed, tmp_path / "out", "--from", str(tmp_path / "hub")) == 0
    assert (tmp_path / "out/small/link").read_bytes() == b"/etc/hostname"
    assert not (tmp_path / "out/small/link").is_symlink()


def test_packaged_table_describes_all_sets(capsys):
    assert TOOL.main(["--list"]) == 0
    shown = capsys.readouterr().out
    sets = TOOL.read_sets()
    assert len(sets) == 5
    for one in sets:
        assert f"{one.repository} at {one.commit}" in shown
        assert len({file.path for file in one.files}) == len(one.files)
        assert one.license
