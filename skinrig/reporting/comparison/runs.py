"""Pair the results of two runs and compare their settings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from capture.calibration import store as calibrations
from capture.calibration.record import CalibrationError
from model import store
from model.skin import SkinAppearance
from skinrig.benchmarks import figures as bench_figures
from skinrig.benchmarks.document import SCHEMA
from skinrig.evaluating.session_agreement import SessionAgreement, SessionError, compare_sessions
from skinrig.reporting import folders, page, provenance
from skinrig.reporting import folders as report_folders
from skinrig.reporting.comparison import maps as map_comparison
from skinrig.reporting.comparison.maps import MapDifference
from skinrig.reporting.folders import ReportError, ReportInputs
from skinrig.reporting.sections import bench
from skinrig.reporting.sections import images as pictures

T = TypeVar("T")
Kind = Literal["maps", "benchmark", "pictures", "run", "truth", "other"]
COMPARABLE_KINDS: tuple[Kind, ...] = ("maps", "benchmark", "pictures", "run")
MAX_SAME_POINT_MM = 1.0
"""Maximum median distance of equal texels of two meshes for them to be the same surface points."""


@dataclass(slots=True)
class ComparedRun:
    """One side of a comparison."""

    label: str
    path: Path
    found: ReportInputs
    appearances: dict[str, SkinAppearance]
    checks: list[page.Check] = field(default_factory=list)
    """Checks of the run's own report."""

    @property
    def pictures(self) -> dict[str, Path]:
        """Folders of renderings and analyses by name."""
        return {path.name: path for path in sorted(self.found.pictures)}

    @staticmethod
    def of(label: str, path: Path, truths: Sequence[Path] = ()) -> ComparedRun:
        """Read a run; ``truths`` are added to its own."""
        found = folders.discover([path])
        for truth in truths:
            found.truths.setdefault(truth.name, truth)
        appearances = {name: store.read(folder) for name, folder in found.appearances.items()}
        return ComparedRun(label, path, found, appearances)


def detect_kind(path: Path) -> Kind:
    """Return the kind of results in a path, for comparisons.

    "maps": one APPEARANCE/ folder; "truth": a TRUTH/ folder; "benchmark": a document of `skinrig
    bench`, or a folder with one but without maps; "pictures": a folder of a rendering or an
    analysis; "run": a folder with folders of maps or images.
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


def split_sides(
    paths: Sequence[Path], *, require_comparison: bool | None = None
) -> tuple[ComparedRun, ComparedRun] | None:
    """Return the two runs to compare, or None if the paths are a collection.

    Exactly two paths of one kind are compared: two sets of maps, two benchmarks, two folders of
    images or two folders of runs. Ground truths among the paths apply to both. Other paths are a
    collection, reported one by one.

    Parameters
    ----------
    paths
        Arguments of `skinrig report`.
    require_comparison
        True: compare or fail. False: never compare. None: by the rule above.

    Raises
    ------
    ReportError
        If a comparison is required, and paths are not two of one kind.
    """
    if require_comparison is False:
        return None
    missing = [path for path in paths if not path.exists()]
    if missing:
        raise ReportError(
            f"{missing[0]}: does not exist; give a folder that skinrig wrote [SR-CLI-007]"
        )
    kinds = {path: detect_kind(path) for path in paths}
    truths = [path for path in paths if kinds[path] == "truth"]
    runs = [path for path in paths if kinds[path] != "truth"]
    fits = (
        len(runs) == 2 and kinds[runs[0]] == kinds[runs[1]] and kinds[runs[0]] in COMPARABLE_KINDS
    )
    if not fits:
        if require_comparison:
            given = ", ".join(f"{path} ({kinds[path]})" for path in paths)
            raise ReportError(
                f"--compare: got {given}, expected two of one kind: two folders of maps, two "
                "benchmarks, two folders of images or two folders of runs; ground truths of "
                "either may be added"
            )
        return None
    first, second = _labels(*runs)
    return ComparedRun.of(first, runs[0], truths), ComparedRun.of(second, runs[1], truths)


def _labels(a: Path, b: Path) -> tuple[str, str]:
    """Return distinct labels of two runs: A and B with their folders' names.

    Examples
    --------
    >>> _labels(Path("monday"), Path("tuesday")), _labels(Path("x/demo"), Path("y/demo"))
    (('A: monday', 'B: tuesday'), ('A: x/demo', 'B: y/demo'))
    """
    if a.name != b.name:
        return f"A: {a.name}", f"B: {b.name}"
    return f"A: {a.parent.name}/{a.name}", f"B: {b.parent.name}/{b.name}"


def pair_by_name(one: Mapping[str, T], other: Mapping[str, T]) -> list[tuple[str, T, T]]:
    """Pair the folders of two runs by name; single folders are paired regardless of names."""
    if len(one) == len(other) == 1:
        (name_a, a), (name_b, b) = *one.items(), *other.items()
        return [(name_a if name_a == name_b else f"{name_a} and {name_b}", a, b)]
    return [(name, found, other[name]) for name, found in one.items() if name in other]


def list_unpaired(a: ComparedRun, b: ComparedRun) -> list[tuple[str, str]]:
    """Return folders of maps or images of only one of two runs: name, the run's label."""
    found = []
    for one, other in ((a.appearances, b.appearances), (a.pictures, b.pictures)):
        if not len(one) == len(other) == 1:
            found += [(name, a.label) for name in one if name not in other]
            found += [(name, b.label) for name in other if name not in one]
    return found


@dataclass(frozen=True, slots=True)
class MapsPair:
    """Corresponding maps of two runs with their differences."""

    name: str
    a: SkinAppearance
    b: SkinAppearance
    differences: tuple[MapDifference, ...]
    refused: tuple[tuple[str, str], ...]
    """Maps that cannot be subtracted, and why."""
    agreement: SessionAgreement | None = None
    """Verdict on the person and the state; None: of the same frames, or not comparable."""
    not_agreed: str = ""
    """Reason for the missing verdict."""


def compare_maps_of_runs(a: ComparedRun, b: ComparedRun) -> list[MapsPair]:
    """Return the pairs of two runs with the differences of every map that both have."""
    found = []
    for name, one, other in pair_by_name(a.appearances, b.appearances):
        differences, refused = [], []
        apart = _apart_mm(one, other)
        for key in sorted(set(one.maps) | set(other.maps)):
            if key.startswith("_"):
                continue
            try:
                if key not in one.maps or key not in other.maps:
                    raise ValueError(f"only in {a.label if key in one.maps else b.label}")
                if apart > MAX_SAME_POINT_MM:
                    raise ValueError(f"texels of the two meshes differ by {apart:.1f} mm")
                differences.append(map_comparison.compare_maps(key, one.maps[key], other.maps[key]))
            except ValueError as error:
                refused.append((key, str(error)))
        agreement, reason = judge_sessions(one, other)
        found.append(
            MapsPair(name, one, other, tuple(differences), tuple(refused), agreement, reason)
        )
    return found


def judge_sessions(a: SkinAppearance, b: SkinAppearance) -> tuple[SessionAgreement | None, str]:
    """Return the verdict on person and state of two sessions, or None with the reason."""
    if "session" in a.inputs and a.inputs.get("session") == b.inputs.get("session"):
        return None, "both are of the same frames"
    try:
        return compare_sessions(a, b), ""
    except SessionError as error:
        return None, str(error)


def _apart_mm(a: SkinAppearance, b: SkinAppearance) -> float:
    """Return the median distance of texels of the same index, mm; 0 without a mesh."""
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


MAX_LISTED_DRIFTS = 3
"""Quantities listed for each kind of calibration."""


def compare_settings(a: ComparedRun, b: ComparedRun, pair: MapsPair) -> Iterator[page.Block]:
    """Yield the settings that differ."""
    sides = []
    for side in (pair.a, pair.b):
        listed = {
            f"parameter {k}": v for k, v in provenance.flatten_settings(side.parameters).items()
        }
        listed |= {f"input {k}": provenance.shorten_digest(v) for k, v in side.inputs.items()}
        listed |= {f"version of {k}": v for k, v in side.versions.items()}
        listed |= {"source": side.source, "seed": str(side.seed)}
        listed |= {f"omitted: {what}": why for what, why in side.left_out}
        sides.append(listed)
    rows = find_differing_entries(*sides)
    stages = [row for row in rows if row[0].startswith("parameter stages.")]
    rest = [row for row in rows if not row[0].startswith("parameter stages.")]
    yield page.Heading("Differing settings")
    if not rows:
        yield page.build_note("Parameters, inputs, versions and seeds are equal.")
        return
    if rest:
        yield page.build_table(("setting", a.label, b.label), rest, caption="Settings that differ")
    if stages:
        names = ", ".join(row[0].removeprefix("parameter stages.") for row in stages)
        yield page.build_note(f"Stages with different code, settings or inputs: {names}.")


def find_differing_entries(
    a: Mapping[str, str], b: Mapping[str, str]
) -> list[tuple[str, str, str]]:
    """Return the entries that differ, with a dash where one lacks them."""
    return [
        (key, a.get(key, "–"), b.get(key, "–"))
        for key in sorted({*a, *b})
        if a.get(key) != b.get(key)
    ]


def compare_benchmarks(a: ComparedRun, b: ComparedRun) -> Iterator[page.Block]:
    """Yield seconds and errors of common settings, and one plot per stage."""
    documents = [_bench_of(run) for run in (a, b)]
    if documents[0] is None or documents[1] is None:
        return
    rows, plots = [], []
    for name, stage in documents[0]["stages"].items():
        other = documents[1]["stages"].get(name)
        if other is None or stage.get("size") != other.get("size"):
            continue
        rows += _settings_of_stage(name, stage, other)
        if stage["points"] and other["points"]:
            plots.append(
                bench_figures.plot_compared_fronts(name, (a.label, stage), (b.label, other))
            )
    if not rows:
        return
    machines = find_differing_entries(
        *(
            provenance.flatten_settings(document.get("machine", {}))
            for document in documents
            if document
        )
    )
    yield page.Heading("Error against run time", level=2)
    yield page.Plots(plots)
    if machines:
        yield page.build_table(
            ("machine", a.label, b.label),
            machines,
            caption="The machines differ: their speed is part of the seconds",
        )
    yield page.build_view("compared_benchmarks", settings=rows)


def _bench_of(run: ComparedRun) -> dict[str, Any] | None:
    for path in run.found.documents:
        document = report_folders.read_json(path)
        if document["schema"] == SCHEMA:
            return document
    return None


def _settings_of_stage(
    name: str, stage: Mapping[str, Any], other: Mapping[str, Any]
) -> list[tuple[object, ...]]:
    known = {str(point["knobs"]): point for point in other["points"]}
    rows: list[tuple[object, ...]] = []
    for point in stage["points"]:
        match = known.get(str(point["knobs"]))
        if match is not None:
            (low, high), (low_b, high_b) = point["error_interval"], match["error_interval"]
            rows.append((name, point, match, high < low_b or high_b < low))
    return rows


def compare_seconds(a: ComparedRun, b: ComparedRun) -> Iterator[page.Block]:
    """Yield the seconds of steps that the documents of both record."""
    sides = [dict(_steps(run)) for run in (a, b)]
    common = [step for step in sides[0] if step in sides[1]]
    if not common:
        return
    rows: list[tuple[object, ...]] = [
        (step, sides[0][step], sides[1][step], sides[1][step] - sides[0][step]) for step in common
    ]
    total = [sum(side[step] for step in common) for side in sides]
    rows.append(("sum", total[0], total[1], total[1] - total[0]))
    yield page.Heading("Seconds", level=2)
    yield page.build_table(
        ("step", a.label, b.label, "difference"),
        rows,
        caption="Wall-clock seconds of common steps; other load on the machine adds to them",
    )


def _steps(run: ComparedRun) -> Iterator[tuple[str, float]]:
    for path in run.found.documents:
        for entry in report_folders.read_json(path).get("tables", ()):
            if list(entry["head"]) == ["step", "seconds"]:
                yield from ((str(step), float(seconds)) for step, seconds in entry["rows"])


def compare_calibrations(a: ComparedRun, b: ComparedRun) -> Iterator[page.Block]:
    """Yield the largest changes between calibrations of the same folder and kind."""
    folders: dict[str, Path] = {path.name: path for path in b.found.calibrations}
    rows: list[tuple[object, ...]] = []
    for folder in a.found.calibrations:
        if folder.name not in folders:
            continue
        for path in sorted(folder.glob("*.json")):
            try:
                old = calibrations.load(folder, path.stem)
                new = calibrations.load(folders[folder.name], path.stem)
                moved = [one for one in calibrations.measure_drift(old, new) if one.change != 0.0]
            except (CalibrationError, ValueError) as error:
                rows.append((f"{folder.name}, {path.stem}", "", "", "", "", "", str(error)))
                continue
            for one in moved[:MAX_LISTED_DRIFTS]:
                apart = float("nan") if one.sigmas is None else one.sigmas
                moves = (one.serial, one.name, one.old, one.new, apart, f"{len(moved)} changed")
                rows.append((f"{folder.name}, {path.stem}", *moves))
    if not rows:
        return
    yield page.Heading("Changed calibrations", level=2)
    yield page.build_table(
        (
            "calibration",
            "device",
            "quantity",
            "A",
            "B",
            "in combined standard uncertainties",
            "remark",
        ),
        rows,
        caption="Largest changes of each kind",
    )
