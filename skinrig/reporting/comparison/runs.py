"""Two runs beside each other: which results belong together, and what they were made with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from model import store
from model.skin import SkinAppearance
from skinrig.reporting import folders, page
from skinrig.reporting.comparison import maps as map_comparison
from skinrig.reporting.comparison.maps import MapDifference
from skinrig.reporting.folders import Findings, ReportError
from skinrig.reporting.sections import bench
from skinrig.reporting.sections import images as pictures

T = TypeVar("T")
Kind = Literal["maps", "benchmark", "pictures", "run", "truth", "other"]
COMPARABLE_KINDS: tuple[Kind, ...] = ("maps", "benchmark", "pictures", "run")
MAX_SAME_POINT_MM = 1.0
"""Texels of two meshes whose median distance is larger are not the same places."""


@dataclass(slots=True)
class Run:
    """One side of a comparison."""

    label: str
    path: Path
    found: Findings
    appearances: dict[str, SkinAppearance]
    checks: list[page.Check] = field(default_factory=list)
    """What its own report would judge."""

    @property
    def pictures(self) -> dict[str, Path]:
        """Folders of renderings and analyses by name."""
        return {path.name: path for path in sorted(self.found.pictures)}

    @staticmethod
    def of(label: str, path: Path, truths: Sequence[Path] = ()) -> Run:
        """Read a run; ``truths`` serve it beside its own."""
        found = folders.discover([path])
        for truth in truths:
            found.truths.setdefault(truth.name, truth)
        appearances = {name: store.read(folder) for name, folder in found.appearances.items()}
        return Run(label, path, found, appearances)


def kind_of(path: Path) -> Kind:
    """Return what a path holds, as far as comparing goes.

    "maps": one APPEARANCE/ folder; "truth": a TRUTH/ folder; "benchmark": a document of `skinrig
    bench`, or a folder that holds one and no maps; "pictures": a folder of a rendering or an
    analysis; "run": a folder with folders of maps or of pictures.
    """
    if (path / store.DOCUMENT_FILE).is_file():
        kind = store.read_document(path).parameters.get("kind")
        return "truth" if kind == "truth" else "maps"
    if path.is_file():
        return "benchmark" if _is_bench(path) else "other"
    if not path.is_dir():
        return "other"
    if pictures.folder_document(path) is not None:
        return "pictures"
    if any(
        (entry / store.DOCUMENT_FILE).is_file() or pictures.folder_document(entry) is not None
        for entry in path.iterdir()
    ):
        return "run"
    return "benchmark" if any(_is_bench(one) for one in sorted(path.glob("*.json"))) else "other"


def _is_bench(path: Path) -> bool:
    try:
        return bench.is_bench(folders.read_json(path))
    except ReportError:
        return False


def sides(paths: Sequence[Path], *, insist: bool | None = None) -> tuple[Run, Run] | None:
    """Return the two runs that paths ask to compare, or None where they are a collection.

    Exactly two paths of one kind, be it two sets of maps, two benchmarks, two folders of pictures
    or two folders of runs, are compared; truths given beside them serve both. Everything else is a
    collection, shown one after the other.

    Parameters
    ----------
    paths
        As given to `skinrig report`.
    insist
        True: compare or fail. False: never compare. None: by the rule above.

    Raises
    ------
    ReportError
        When a comparison is insisted on, and paths are not two of one kind.
    """
    if insist is False:
        return None
    missing = [path for path in paths if not path.exists()]
    if missing:
        raise ReportError(f"{missing[0]}: does not exist; give a folder that skinrig wrote")
    kinds = {path: kind_of(path) for path in paths}
    truths = [path for path in paths if kinds[path] == "truth"]
    runs = [path for path in paths if kinds[path] != "truth"]
    fits = (
        len(runs) == 2 and kinds[runs[0]] == kinds[runs[1]] and kinds[runs[0]] in COMPARABLE_KINDS
    )
    if not fits:
        if insist:
            told = ", ".join(f"{path} ({kinds[path]})" for path in paths)
            raise ReportError(
                f"--compare: got {told}, expected two of one kind: two folders of maps, two "
                "benchmarks, two folders of pictures or two folders of runs; truths beside them "
                "are welcome"
            )
        return None
    first, second = _labels(*runs)
    return Run.of(first, runs[0], truths), Run.of(second, runs[1], truths)


def _labels(a: Path, b: Path) -> tuple[str, str]:
    """Return names that tell two runs apart: their folders', or A and B before equal ones.

    Examples
    --------
    >>> _labels(Path("monday"), Path("tuesday")), _labels(Path("x/demo"), Path("y/demo"))
    (('A: monday', 'B: tuesday'), ('A: x/demo', 'B: y/demo'))
    """
    if a.name != b.name:
        return f"A: {a.name}", f"B: {b.name}"
    return f"A: {a.parent.name}/{a.name}", f"B: {b.parent.name}/{b.name}"


def paired(one: Mapping[str, T], other: Mapping[str, T]) -> list[tuple[str, T, T]]:
    """Return what belongs together of two runs: by name of its folder, or the only ones."""
    if len(one) == len(other) == 1:
        (name_a, a), (name_b, b) = *one.items(), *other.items()
        return [(name_a if name_a == name_b else f"{name_a} and {name_b}", a, b)]
    return [(name, found, other[name]) for name, found in one.items() if name in other]


def alone(a: Run, b: Run) -> list[tuple[str, str]]:
    """Return folders of maps or pictures that only one of two runs has: name, the run's label."""
    found = []
    for one, other in ((a.appearances, b.appearances), (a.pictures, b.pictures)):
        if not len(one) == len(other) == 1:
            found += [(name, a.label) for name in one if name not in other]
            found += [(name, b.label) for name in other if name not in one]
    return found


@dataclass(frozen=True, slots=True)
class Pair:
    """Maps of two runs that belong together, and how they differ."""

    name: str
    a: SkinAppearance
    b: SkinAppearance
    differences: tuple[MapDifference, ...]
    refused: tuple[tuple[str, str], ...]
    """Maps that cannot be subtracted, and why."""


def compared(a: Run, b: Run) -> list[Pair]:
    """Return the pairs of two runs with the differences of every map that both have."""
    found = []
    for name, one, other in paired(a.appearances, b.appearances):
        differences, refused = [], []
        apart = _apart_mm(one, other)
        for key in sorted(set(one.maps) | set(other.maps)):
            if key.startswith("_"):
                continue
            if key not in one.maps or key not in other.maps:
                refused.append((key, f"only in {a.label if key in one.maps else b.label}"))
                continue
            if apart > MAX_SAME_POINT_MM:
                refused.append((key, f"texels of the two meshes lie {apart:.1f} mm apart"))
                continue
            try:
                differences.append(map_comparison.compare(key, one.maps[key], other.maps[key]))
            except ValueError as error:
                refused.append((key, str(error)))
        found.append(Pair(name, one, other, tuple(differences), tuple(refused)))
    return found


def _apart_mm(a: SkinAppearance, b: SkinAppearance) -> float:
    """Return the median distance of texels of the same index; 0 where there is no mesh."""
    places = [one.maps.get("position") for one in (a, b)]
    if places[0] is None or places[1] is None:
        return 0.0
    one, other = places[0], places[1]
    if one.values.shape != other.values.shape:
        return 0.0  # each map is then refused by its own shape
    both = one.mask & other.mask
    if not both.any():
        return float("inf")
    return float(np.median(np.linalg.norm(one.values[both] - other.values[both], axis=-1)))
