"""One self-contained HTML page of what was measured, and how far from the truth it is."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from model import store
from model.skin import SkinAppearance, SkinMap
from reconstruction.flash_stages import NOISE_STDERR
from skinrig import (
    bench_table,
    dynamic_section,
    evaluation,
    extremes_section,
    figures,
    microrelief_section,
    page,
    pictures_section,
    population_section,
    sequence_section,
    subsurface_section,
    surface_section,
)
from skinrig.dynamic_appearance import parts_of


class ReportError(ValueError):
    """Nothing at the paths that a report could be made of."""


@dataclass(slots=True)
class Findings:
    """What lies at the paths of a report."""

    appearances: dict[str, Path] = field(default_factory=dict)
    truths: dict[str, Path] = field(default_factory=dict)
    calibrations: list[Path] = field(default_factory=list)
    sessions: list[Path] = field(default_factory=list)
    pictures: list[Path] = field(default_factory=list)
    """Folders of renderings and analyses."""
    documents: list[Path] = field(default_factory=list)
    """JSON documents of commands: benchmarks and the demo's own."""


def discover(paths: Sequence[Path]) -> Findings:
    """Find appearances, truths, calibrations, sessions and documents at or below ``paths``.

    Raises
    ------
    ReportError
        When a path does not exist, or nothing is found at all.
    """
    found = Findings()
    for path in paths:
        if not path.exists():
            raise ReportError(f"{path}: does not exist; give a folder that skinrig wrote")
        below = [path, *sorted(path.iterdir())] if path.is_dir() else [path]
        for entry in below:
            _sort_in(entry, found)
    if not (found.appearances or found.sessions or found.documents or found.pictures):
        raise ReportError(
            f"{', '.join(map(str, paths))}: holds no session, appearance or benchmark; "
            "`skinrig demo` makes all of them"
        )
    return found


def _sort_in(entry: Path, found: Findings) -> None:
    if entry.is_file() and entry.suffix == ".json" and entry.name != store.DOCUMENT:
        if (entry.parent / store.DOCUMENT).is_file():
            return  # of the appearance itself, which its section shows
        text = entry.read_text(encoding="utf-8", errors="replace")
        if '"schema"' in text and '"skinrig.' in text and "session" not in entry.name:
            found.documents.append(entry)
    elif (entry / store.DOCUMENT).is_file():
        kind = store.read_document(entry).parameters.get("kind")
        (found.truths if kind == "truth" else found.appearances)[entry.name] = entry
    elif (entry / "session.json").is_file():
        found.sessions.append(entry)
    elif entry.is_dir() and pictures_section.folder_document(entry) is not None:
        found.pictures.append(entry)
    elif entry.is_dir() and entry.name.startswith("calibration"):
        found.calibrations.append(entry)


def build(paths: Sequence[str | Path], *, title: str = "skinrig report") -> str:
    """Return the report of everything at ``paths`` as HTML, equal for equal input.

    Parameters
    ----------
    paths
        Folders or files that skinrig wrote: a demo's folder, sessions, appearances, truths,
        benchmark documents.
    title
        Heading of the page.
    """
    found = discover([Path(p) for p in paths])
    checks: list[page.Check] = []
    sections: list[str] = []
    appearances = {name: store.read(folder) for name, folder in found.appearances.items()}
    for name, appearance in appearances.items():
        if dynamic_section.is_dynamic(appearance):
            sections.append(_dynamic_section(name, appearance, found, checks))
            continue
        truth_path = _truth_of(appearance, found)
        truth = store.read(truth_path) if truth_path else None
        sections.append(_appearance_section(name, appearance, truth, checks))
    sections += [pictures_section.section(folder, checks) for folder in found.pictures]
    sections.append(population_section.section(appearances))
    documents = [json.loads(p.read_text(encoding="utf-8")) for p in found.documents]
    for document in documents:
        if document["schema"] == "skinrig.bench/2":
            sections.append(_bench_section(document, checks))
        elif document["schema"] == extremes_section.SCHEMA:
            sections.append(extremes_section.section(document, checks))
        else:
            sections.append(_document_section(document))
    for folder in found.calibrations:
        sections.append(_calibration_section(folder))
    if found.sessions:
        sections.append(_session_section(found.sessions))
    missed = [check for check in checks if not check.passed]
    if not checks:
        verdict = "No limit was checked: there is no truth and no benchmark here."
    elif missed:
        verdict = f"{len(missed)} of {len(checks)} checks missed their limit."
    else:
        verdict = f"All {len(checks)} checks kept their limits."
    head = (
        f"<h1>{page.escape(title)}</h1>"
        f'<p class="verdict {"bad" if missed else "good"}">{page.escape(verdict)}</p>'
    )
    if checks:
        head += "<h2>Checks</h2>" + page.checks_table(checks)
    return page.document(title, head + "".join(sections))


def _truth_of(appearance: SkinAppearance, found: Findings) -> Path | None:
    return found.truths.get(str(appearance.parameters.get("truth", "")))


def _appearance_section(
    name: str,
    appearance: SkinAppearance,
    truth: SkinAppearance | None,
    checks: list[page.Check],
) -> str:
    body = f"<h2>Maps: {page.escape(name)}</h2>"
    pictures = [
        page.color_picture(f"{label}, linear sRGB", appearance.maps[key].values)
        for key, label in (("picture", "crossed polarizers"), ("specular_picture", "specular"))
        if key in appearance.maps
    ]
    if pictures:
        body += f"<div class=maps>{''.join(pictures)}</div>"
    on_mesh = "position" in appearance.maps
    microrelief = microrelief_section.is_microrelief(appearance)
    if on_mesh:
        body += surface_section.section(name, appearance, truth, checks)
    elif microrelief:
        body += microrelief_section.section(name, appearance, truth, checks)
    elif subsurface_section.is_probe(appearance):
        body += subsurface_section.section(name, appearance, truth, checks)
    elif sequence_section.is_sequence(appearance):
        body += sequence_section.section(appearance)
    for key, skin_map in sorted(appearance.maps.items()):
        if skin_map.values.ndim != 2 or key.startswith("_") or on_mesh or microrelief:
            continue
        if key.endswith(NOISE_STDERR):
            continue
        true_map = truth.maps.get(key) if truth is not None else None
        body += page.map_panel(
            key,
            "" if skin_map.unit == "1" else skin_map.unit,
            estimate=skin_map.values,
            standard_error=skin_map.stderr,
            truth=None if true_map is None else true_map.values,
            valid=_shown(skin_map, true_map),
        )
    if truth is not None and "melanin" in truth.maps and not on_mesh:
        body += _errors(name, appearance, truth, checks)
    elif truth is None:
        body += (
            "<p class=note>No truth lies beside these maps: standard errors and residuals are "
            "all there is to judge them by.</p>"
        )
    body += _identifiability(appearance)
    assumed = appearance.parameters.get("assumed")
    if assumed:
        body += "<h3>Assumed</h3>" + page.table(("assumption",), [[text] for text in assumed])  # type: ignore[attr-defined]
    if appearance.left_out:
        body += "<h3>Left out</h3>" + page.table(("what", "why"), appearance.left_out)
    return body + "<h3>Provenance</h3>" + _provenance(appearance)


def _dynamic_section(
    name: str, appearance: SkinAppearance, found: Findings, checks: list[page.Check]
) -> str:
    part = parts_of(appearance).get("facial_color", {})
    truths = {
        state: store.read(found.truths[folder])
        for state, folder in part.get("truth", {}).items()
        if folder in found.truths
    }
    body = f"<h2>Moving face: {page.escape(name)}</h2>"
    body += dynamic_section.section(name, appearance, truths, checks)
    if appearance.left_out:
        body += "<h3>Left out</h3>" + page.table(("what", "why"), appearance.left_out)
    return body + "<h3>Provenance</h3>" + _provenance(appearance)


def _provenance(appearance: SkinAppearance) -> str:
    return page.facts(
        {"source": appearance.source, "seed": appearance.seed}
        | {f"input {k}": v[:16] for k, v in sorted(appearance.inputs.items())}
        | dict(sorted(appearance.versions.items()))
    )


NOISE_OF_IDENTIFIABILITY = 0.005
"""Relative noise of each channel that the identifiability plots are drawn for."""


def _identifiability(appearance: SkinAppearance) -> str:
    """Draw where the Cramer-Rao bound says that a chromophore can be seen at all."""
    built = appearance.parameters.get("color_table")
    if not isinstance(built, dict) or "melanin" not in appearance.maps:
        return ""
    from model import color_table
    from model.tissue_optics import ANISOTROPY_SKIN
    from reconstruction import chromophores, model_error

    table = color_table.build(
        str(built["camera"]), str(built["illuminant"]), anisotropy=ANISOTROPY_SKIN
    )
    plots = []
    choices: tuple[tuple[Literal["known"] | None, str], ...] = (
        (None, "shading free"),
        ("known", "shading known"),
    )
    for shading, words in choices:
        found = chromophores.identifiability(
            table,
            shading=shading,
            variance=lambda rgb: np.square(NOISE_OF_IDENTIFIABILITY * rgb),
            model_error=model_error.load(),
            size=48,
        )
        for name, relative in (
            ("melanin", found.stderr_melanin),
            ("hemoglobin", found.stderr_hemoglobin),
        ):
            plots.append(
                figures.sensitivity(f"{name}, {words}", found.c_m, found.c_hd, 100 * relative)
            )
    return (
        "<h3>Identifiability</h3><p class=note>Least relative standard error that any unbiased "
        f"estimator could have, for {100 * NOISE_OF_IDENTIFIABILITY:g} % of noise in each channel "
        f"and the model's error.</p><div class=plots>{''.join(plots)}</div>"
    )


def _shown(estimate: SkinMap, truth: SkinMap | None) -> NDArray[np.bool_] | None:
    masks = [m.valid for m in (estimate, truth) if m is not None and m.valid is not None]
    return np.logical_and.reduce(masks) if masks else None


def _errors(
    name: str, appearance: SkinAppearance, truth: SkinAppearance, checks: list[page.Check]
) -> str:
    rows = evaluation.compare(appearance, truth, rng=np.random.default_rng(0))
    for row in rows:
        if row.band is None and row.against == "blurred":
            checks.append(
                page.Check(
                    f"{name}: {row.name}, median error",
                    100 * row.median_relative,
                    100 * evaluation.limit(row),
                    "<=",
                    "%",
                    f"bound {100 * evaluation.bound(row):.1f} %, {100 * row.masked:.0f} % masked",
                )
            )
    body = "<h3>Errors by melanin band</h3>" + page.table(
        ("map", "truth", "band", "pixels", "masked %", "median |error| %", "68 % interval",
         "bias %", "68 % coverage %", "by noise alone %", "median standard error %", "bound %"),
        [
            (
                row.name, row.against, row.band_name, row.pixels, 100 * row.masked,
                100 * row.median_relative,
                f"{100 * row.interval[0]:.2f} – {100 * row.interval[1]:.2f}",
                100 * row.bias, 100 * row.coverage.share, 100 * row.noise_coverage,
                100 * row.median_stderr, 100 * row.median_bound,
            )
            for row in rows
        ],
    )  # fmt: skip
    banded = [row for row in rows if row.band is not None and row.against == "blurred"]
    labels = list(dict.fromkeys(row.band_name for row in banded))
    series = {
        key: [
            next(
                (100 * r.median_relative for r in banded if (r.name, r.band_name) == (key, label)),
                float("nan"),
            )
            for label in labels
        ]
        for key in dict.fromkeys(row.name for row in banded)
    }
    if labels:
        plot = figures.bars(
            "median error by melanin band",
            labels,
            series,
            unit="%",
            limit=100 * evaluation.MEDIAN_LIMIT,
        )
        body += f"<div class=plots>{plot}</div>"
    return body


def _bench_section(document: Mapping[str, Any], checks: list[page.Check]) -> str:
    body = "<h2>Error against run time</h2>"
    plots, rows = [], []
    for name, stage in document["stages"].items():
        if stage["points"]:
            plots.append(figures.error_against_seconds(name, stage))
        for limit in stage["limits"]:
            got = float("nan") if limit["got"] is None else limit["got"]
            checks.append(
                page.Check(
                    f"{name}: {limit['name']}", got, limit["bound"], limit["sense"], limit["unit"]
                )
            )
        rows += [
            (
                name, ", ".join(f"{k} {v}" for k, v in point["knobs"].items()), point["seconds"],
                point["cold_seconds"],
                "" if point["peak_memory_mb"] is None else point["peak_memory_mb"],
                point["error"],
                "" if point["cramer_rao_bound"] is None else point["cramer_rao_bound"],
                "" if point.get("efficiency") is None else point["efficiency"],
                "knee" if point["knee"] else "front" if point["on_front"] else "",
            )
            for point in stage["points"]
        ]  # fmt: skip
    body += f"<div class=plots>{''.join(plots)}</div>"
    body += page.table(
        ("stage", "setting", "seconds", "cold s", "peak MB", "error", "Cramér-Rao", "efficiency",
         ""),
        rows,
    )  # fmt: skip
    bands = bench_table.bands(document)
    if bands:
        body += page.table(bench_table.BAND_COLUMNS, bands)
    body += (
        "<p class=note>Errors are in the unit on each plot's axis. Efficiency is variance over the "
        "Cramér-Rao bound: 1 is perfect.</p>"
    )
    if document.get("not_judged"):
        body += (
            "<p class=note>Measured at small size, so that limits were not judged: "
            f"{page.escape(', '.join(document['not_judged']))}.</p>"
        )
    return body


def _document_section(document: Mapping[str, Any]) -> str:
    tables = document.get("tables", [])
    body = f"<h2>{page.escape(document.get('title', document['schema']))}</h2>"
    for entry in tables:
        body += f"<h3>{page.escape(entry['title'])}</h3>"
        body += page.table(entry["head"], entry["rows"])
    return body


LONG_TABLE = 30
"""Rows beyond which a table is folded away."""


def _calibration_section(folder: Path) -> str:
    body = f"<h2>Calibration: {page.escape(folder.name)}</h2>"
    for path in sorted(folder.glob("*.json")):
        document = json.loads(path.read_text(encoding="utf-8"))
        body += f"<h3>{page.escape(document.get('kind', path.stem))}</h3>"
        body += (
            f"<p class=note>made {page.escape(document.get('created'))}, valid until "
            f"{page.escape(document.get('valid_until'))}, {page.escape(document.get('source'))}</p>"
        )
        rows = [
            (serial, name, *_quantity(entry))
            for serial, names in sorted(document.get("values", {}).items())
            for name, entry in sorted(names.items())
            if len(entry["value"]) <= 12
        ]
        table = page.table(("device", "quantity", "value", "standard error"), rows)
        body += table if len(rows) <= LONG_TABLE else page.folded(f"{len(rows)} quantities", table)
    return body


def _quantity(entry: Mapping[str, Any]) -> tuple[str, str]:
    def text(values: Sequence[float] | None) -> str:
        return "" if values is None else ", ".join(f"{v:.5g}" for v in values)

    return text(entry["value"]), text(entry["stderr"])


def _session_section(sessions: Sequence[Path]) -> str:
    rows = []
    for path in sessions:
        frames = list((path / "frames").glob("*"))
        rows.append((path.name, len(frames), sum(f.stat().st_size for f in frames) / 1e6))
    return "<h2>Sessions</h2>" + page.table(("session", "frames", "MB"), rows)
