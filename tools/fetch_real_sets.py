"""Fetch public data sets at pinned commits, and verify each file's SHA-256.

``real_sets.toml`` describes the sets; ``real_sets.csv`` lists their files. Files go to
OUT/SET/PATH, with PATH as in the repository. A second run fetches only what is missing.
`tools/judge_real_sets.py` judges this package on them. No file of a set belongs in a commit.

Usage: python tools/fetch_real_sets.py --out FOLDER [--from SNAPSHOTS] [SET ...]
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

TABLE = Path(__file__).with_name("real_sets.toml")
URL_FORM = "https://github.com/{repository}.git"
CLONES = ".clones"
"""Folder of partial clones in OUT; a clone is removed once its set is complete."""
SNAPSHOT_ENDS = ("", ".git", "repo", "repo/.git")
"""Where a snapshot's folder has its git directory; "" is the folder itself."""
GIT_SAFE = ("-c", "core.hooksPath=/dev/null", "-c", "protocol.ext.allow=never")
GIT_ENVIRONMENT = {"GIT_TERMINAL_PROMPT": "0", "GIT_LFS_SKIP_SMUDGE": "1", "GIT_NO_LAZY_FETCH": "1"}
MAX_NAMED = 8
"""Faults that an error lists; the others are counted."""


class FetchError(Exception):
    """Raised for a set that cannot be fetched as pinned."""


@dataclass(frozen=True, slots=True)
class PinnedFile:
    """A file of a repository: path, size in bytes and SHA-256 in hexadecimal digits."""

    path: str
    size: int
    sha256: str


@dataclass(frozen=True, slots=True)
class RealSet:
    """A public data set at one commit of its repository."""

    name: str
    repository: str
    commit: str
    license: str
    about: str
    paper: str
    truth: str
    files: tuple[PinnedFile, ...]


def read_sets(table: Path = TABLE) -> tuple[RealSet, ...]:
    """Return the sets of a table; its files are in the CSV file of the same name.

    Raises
    ------
    FetchError
        For tables that cannot be read, for names, commits, paths or digests of another form, and
        for sets without files.
    """
    try:
        return _parse_sets(table)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise FetchError(f"{table}: got {error!r}, expected a table of sets") from error


def _parse_sets(table: Path) -> tuple[RealSet, ...]:
    rows: dict[str, list[PinnedFile]] = {}
    with table.with_suffix(".csv").open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            file = PinnedFile(row["path"], int(row["bytes"]), row["sha256"])
            _require_inside(file.path, table)
            if not re.fullmatch("[0-9a-f]{64}", file.sha256):
                raise FetchError(f"{table}: {file.path}: got {file.sha256!r}, expected a SHA-256")
            rows.setdefault(row["set"], []).append(file)
    sets = []
    for name, entry in tomllib.loads(table.read_text("utf-8")).items():
        for key, form in (("repository", r"[\w.-]+/[\w.-]+"), ("commit", "[0-9a-f]{40}")):
            if not re.fullmatch(form, entry[key]):
                raise FetchError(f"{table}: {name}.{key}: got {entry[key]!r}, expected {form}")
        if not re.fullmatch("[a-z0-9-]+", name) or name not in rows:
            raise FetchError(f"{table}: {name}: expected a name of a-z, 0-9, - that has files")
        sets.append(RealSet(name=name, files=tuple(rows.pop(name)), **entry))
    if rows:
        raise FetchError(f"{table}: no set has the files of {', '.join(rows)}")
    return tuple(sets)


def _require_inside(path: str, where: Path) -> None:
    """Refuse a path that could lead out of the folder of its set."""
    parts = PurePosixPath(path).parts
    bad = not path or path.startswith("/") or {"..", ".git"} & {one.casefold() for one in parts}
    if bad or "\\" in path or ":" in path or path != "/".join(parts):
        raise FetchError(f"{where}: got the path {path!r}, expected one inside its repository")


def fetch_set(one: RealSet, out: Path, *, source: Path | None, url_form: str = URL_FORM) -> int:
    """Fetch the missing files of a set into OUT/SET; return how many were fetched.

    Parameters
    ----------
    one
        The set.
    out
        Folder of the sets.
    source
        Folder of git snapshots, named OWNER+NAME or OWNER/NAME; None: clone the repository.
    url_form
        Address of a repository, with ``{repository}`` for OWNER/NAME.

    Raises
    ------
    FetchError
        For a repository, commit or file that is missing, and for content of another SHA-256. Right
        files are written all the same.
    """
    folder = out / one.name
    for file in one.files:
        resolved = (folder / file.path).resolve()
        if not resolved.is_relative_to(out.resolve()):
            raise FetchError(f"{folder / file.path}: leads out of {out} through a link; remove it")
    wanted = [file for file in one.files if not _is_complete(folder / file.path, file)]
    if not wanted:
        return 0
    clone = out / CLONES / one.repository.replace("/", "+")
    if source is None:
        git_dir = _clone(one, clone, url_form, [file.path for file in wanted])
    else:
        git_dir = _find_snapshot(one, source)
    faults = []
    for file in wanted:
        got = _run_git(git_dir, "cat-file", "blob", f"{one.commit}:{file.path}", check=False)
        if got.returncode:
            faults.append(f"{file.path}: not in {source or one.repository}")
            continue
        digest = hashlib.sha256(got.stdout).hexdigest()
        if digest != file.sha256:
            faults.append(f"{file.path}: got SHA-256 {digest[:12]}, expected {file.sha256[:12]}")
            continue
        _write_whole(folder / file.path, got.stdout)
    if faults:
        more = f"; and {len(faults) - MAX_NAMED} others" if len(faults) > MAX_NAMED else ""
        raise FetchError(
            f"{one.name}: {len(faults)} of {len(wanted)} files differ from commit {one.commit[:12]}"
            f" of {one.repository}: {'; '.join(faults[:MAX_NAMED])}{more}"
        )
    if source is None:
        shutil.rmtree(clone)
    return len(wanted)


def _is_complete(path: Path, file: PinnedFile) -> bool:
    if not path.is_file() or path.stat().st_size != file.size:
        return False
    return hashlib.sha256(path.read_bytes()).hexdigest() == file.sha256


def _write_whole(path: Path, data: bytes) -> None:
    """Write a file under its name only once it is whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.write_bytes(data)
    part.replace(path)


def _run_git(
    git_dir: Path | None, *words: str, data: bytes | None = None, check: bool = True
) -> subprocess.CompletedProcess[bytes]:
    place = () if git_dir is None else (f"--git-dir={git_dir}",)
    environment = os.environ | GIT_ENVIRONMENT
    if {"clone", "checkout", "fetch"} & set(words):
        del environment["GIT_NO_LAZY_FETCH"]
    try:
        done = subprocess.run(
            ["git", *GIT_SAFE, *place, *words],
            input=data or b"",
            capture_output=True,
            env=environment,
            check=False,
        )
    except FileNotFoundError as error:
        raise FetchError("git: not found; install git") from error
    if check and done.returncode:
        lines = done.stderr.decode("utf-8", "replace").strip().splitlines() or ["no message"]
        raise FetchError(f"git {next(w for w in words if w[0] != '-')}: {lines[-1]}")
    return done


def _has_commit(git_dir: Path, commit: str) -> bool:
    done = _run_git(git_dir, "cat-file", "-e", f"{commit}^{{commit}}", check=False)
    return done.returncode == 0


def _find_snapshot(one: RealSet, source: Path) -> Path:
    """Return the git directory of a snapshot that has the pinned commit."""
    owner, name = one.repository.split("/")
    for folder in (f"{owner}+{name}", f"{owner}/{name}", name):
        for end in SNAPSHOT_ENDS:
            git_dir = source / folder / end
            if (git_dir / "HEAD").is_file() and _has_commit(git_dir, one.commit):
                return git_dir
    raise FetchError(
        f"{one.name}: {source} has no snapshot of {one.repository} with commit {one.commit[:12]}; "
        f"expected {owner}+{name} or {owner}/{name}; leave --from out to clone it"
    )


def _clone(one: RealSet, clone: Path, url_form: str, paths: Iterable[str]) -> Path:
    """Clone a repository without its files, then the wanted files; return the git directory."""
    git_dir = clone / ".git"
    url = url_form.format(repository=one.repository)
    if not git_dir.is_dir():
        part = clone.with_name(clone.name + ".part")
        shutil.rmtree(part, ignore_errors=True)
        part.parent.mkdir(parents=True, exist_ok=True)
        _run_git(None, "clone", "--quiet", "--filter=blob:none", "--no-checkout", url, str(part))
        part.replace(clone)
    if not _has_commit(git_dir, one.commit):
        _run_git(git_dir, "fetch", "--quiet", "--filter=blob:none", "origin", one.commit)
    patterns = "".join("/" + re.sub(r"([*?\[\]\\ ])", r"\\\1", path) + "\n" for path in paths)
    work = f"--work-tree={clone}"
    _run_git(
        git_dir, work, "sparse-checkout", "set", "--no-cone", "--stdin", data=patterns.encode()
    )
    (git_dir / "index.lock").unlink(missing_ok=True)  # of a killed run
    _run_git(git_dir, work, "checkout", "--quiet", "--force", "--detach", one.commit)
    return git_dir


def main(argv: Sequence[str] | None = None) -> int:
    """Fetch the named sets, all by default; return 0, or 1 if a set is incomplete."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="*", metavar="SET", help="names of sets; default: all")
    parser.add_argument("--out", type=Path, help="folder of the sets")
    parser.add_argument("--from", dest="source", type=Path, help="folder of git snapshots")
    parser.add_argument("--url", default=URL_FORM, help="address with {repository}")
    parser.add_argument("--list", action="store_true", help="describe the sets and fetch nothing")
    parser.add_argument("--table", type=Path, default=TABLE, help=argparse.SUPPRESS)
    given = parser.parse_args(argv)
    try:
        sets = {one.name: one for one in read_sets(given.table)}
    except FetchError as error:
        print(error, file=sys.stderr)
        return 1
    unknown = [name for name in given.sets if name not in sets]
    if unknown:
        parser.error(f"{', '.join(unknown)}: not a set; expected {', '.join(sets)}")
    chosen = [sets[name] for name in given.sets or sets]
    if given.list:
        for one in chosen:
            size = sum(file.size for file in one.files) / 2**20
            print(f"{one.name}: {one.about}\n  {one.repository} at {one.commit}")
            print(f"  {len(one.files)} files, {size:.0f} MiB; license: {one.license}")
            print(f"  {one.paper}\n  truth: {one.truth}")
        return 0
    if given.out is None:
        parser.error("--out: expected a folder for the sets")
    failed = False
    for one in chosen:
        try:
            count = fetch_set(one, given.out, source=given.source, url_form=given.url)
        except (FetchError, OSError) as error:
            failed = True
            print(error, file=sys.stderr)
        else:
            print(f"{one.name}: {len(one.files)} files, {count} of them fetched now", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
