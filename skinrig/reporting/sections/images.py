"""Report section on renderings and analyses: their images and settings."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from skinrig.drawing import png
from skinrig.reporting import page

DOCUMENT_FILES = ("render.json", "analysis.json")
"""Files that mark a folder of images."""
SCHEMA_PREFIXES = ("skinrig.render/", "skinrig.analyse")
MAX_IMAGE_BYTES = 600_000
"""Larger images stay in their folder, so that a report can be sent by mail."""
FULL_MODEL = "full model"


def folder_document(folder: Path) -> Path | None:
    """Return the document of a folder of renderings or of an analysis, or None."""
    for name in DOCUMENT_FILES:
        path = folder / name
        if path.is_file():
            return path
    return None


def section(folder: Path, checks: list[page.Check]) -> Iterator[page.Block]:
    """Yield the contents of a folder of `skinrig render` or `skinrig analyse`.

    Parameters
    ----------
    folder
        With its document and images.
    checks
        Checks of the report; a comparison with photographs adds one.
    """
    path = folder_document(folder)
    if path is None:
        return
    document = json.loads(path.read_text(encoding="utf-8"))
    if not str(document.get("schema", "")).startswith(SCHEMA_PREFIXES):
        return
    yield page.Heading(_heading(document), 2, folder.name)
    if FULL_MODEL in document:
        yield from _comparison(folder.name, document, checks)
    elif "view" in document:
        yield page.build_facts_table(
            {
                "view": document["view"].get("name", ""),
                "lights": ", ".join(document.get("lights", {})),
                "subsurface scattering": document.get("subsurface", ""),
                "basis BRDFs": document.get("lobes", ""),
                "unit": document.get("unit", ""),
            },
            caption="Settings of the rendering",
        )
    for one in document.get("datasets", ()):
        yield from _data_set(one)
    yield from _images(folder)
    if document.get("assumed"):
        yield page.Heading("Assumptions")
        yield page.build_assumptions_table(document["assumed"])


def _heading(document: Mapping[str, Any]) -> str:
    if FULL_MODEL in document:
        return "Renderings and photographs"
    return "Rendering" if "view" in document else "Analysis"


def _comparison(
    name: str, document: Mapping[str, Any], checks: list[page.Check]
) -> Iterator[page.Block]:
    full = document[FULL_MODEL]
    what = f"{name}: luminance of held-out photographs, median error"
    note = f"noise alone: {100 * full['noise']:.2f} %"
    judged = 100 * full["median"], 100 * document["limit"]
    checks.append(page.Check(what, *judged, "<=", "%", note))
    kinds = {f"{kind} held out": row for kind, row in document["by_kind"].items()}
    models = {FULL_MODEL: full, **kinds, **document["ablation"]}
    yield page.build_view("photographs", models=models, bands=document["by_band"])


def _data_set(one: Mapping[str, Any]) -> Iterator[page.Block]:
    ranks: Sequence[float] = one.get("ranks", ())
    if not ranks:
        return
    head = [name for name in ("error", "normalized", "held_out_error") if name in one]
    rows = [
        (rank, *(float("nan") if one[key][k] is None else one[key][k] for key in head))
        for k, rank in enumerate(ranks)
    ]
    caption = f"Errors by number of basis BRDFs: {one.get('name', '')}"
    yield page.build_table(
        ("basis BRDFs", *(n.replace("_", " ") for n in head)), rows, caption=caption
    )


def _images(folder: Path) -> Iterator[page.Block]:
    figures = []
    kept = []
    for path in sorted(folder.glob("*.png")):
        data = path.read_bytes()
        if len(data) > MAX_IMAGE_BYTES:
            kept.append(path.name)
            continue
        title = path.stem.replace("-", " ")
        figures.append(page.Image(title, png.to_webp_url(data), title))
    yield page.Images(figures)
    if kept:
        yield page.build_note(f"Too large for this report: {', '.join(kept)}.")
