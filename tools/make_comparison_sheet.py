"""Make the sheet of a blind comparison of two sets of faces, and evaluate its answers.

    python tools/make_comparison_sheet.py sheet A B --out sheet.html --key key.json --seed 1
    python tools/make_comparison_sheet.py evaluate key.json answers.csv ...

A and B are folders of images with equal names, such as ``III-left.png``, or of fitted maps. Maps
are rendered under three lights in their camera's RGB. The key has the sides: observers lack it.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import escape
from numpy.typing import NDArray
from PIL import Image, ImageOps
from scipy.stats import binomtest

from model import store
from skinrig.drawing import png, templates
from skinrig.fusing.finished_face import aim_camera, build_lights
from skinrig.rendering.folder import apply_tone_curve, choose_exposure
from skinrig.rendering.geometry import FittedSurface, read_own_mesh
from skinrig.rendering.hole_patches import close_holes
from skinrig.rendering.render import render_light_groups
from skinrig.rendering.request import read_model

THREE_LIGHTS_DEG = {"left": -60.0, "front": 0.0, "right": 60.0}
IMAGE_PX = (400, 450)
"""Width and height of the images of a sheet; others are cut to it around their middle."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")
JPEG_QUALITY = 92
QUESTION = "Which face looks more like a photograph of a person?"
CONFIDENCE = 0.95
ANSWER_COLUMNS = ("sheet", "observer", "trial", "answer")
PAGE_STYLE = """:root{color-scheme:light dark}
body{font:16px/1.5 system-ui,sans-serif;max-width:54rem;margin:0 auto;padding:1rem}
fieldset{margin:2rem 0;border:1px solid #888}
.pair{display:grid;grid-template-columns:1fr 1fr;gap:.5rem;text-align:center}
.pair img{width:100%;height:auto}
input[type=radio]{width:1.5rem;height:1.5rem}"""
PAGE_SCRIPT = """"use strict";
document.querySelector("form").addEventListener("submit", (event) => {
  event.preventDefault();
  const form = event.target;
  const field = (text) => `"${text.replaceAll('"', '""')}"`;
  const rows = [...form.querySelectorAll("input[type=radio]:checked")].map((one) =>
    [form.dataset.sheet, field(form.observer.value), one.name.slice(6), one.value].join(","));
  const text = ["sheet,observer,trial,answer", ...rows].join("\\n") + "\\n";
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  link.download = "answers.csv";
  link.click();
});"""


class ComparisonError(ValueError):
    """Folders or answers that cannot be compared."""


def read_faces(folder: Path) -> dict[str, NDArray[np.uint8]]:
    """Return the images of a folder, (H, W, 3), by name; fitted maps are rendered."""
    if (folder / store.DOCUMENT_FILE).is_file():
        return render_faces(folder)
    found = {}
    for path in sorted(folder.iterdir() if folder.is_dir() else ()):
        if path.suffix.lower() in IMAGE_SUFFIXES:
            with Image.open(path) as image:
                turned = ImageOps.exif_transpose(image).convert("RGB")
            fitted = ImageOps.fit(turned, IMAGE_PX, Image.Resampling.LANCZOS)
            found[path.stem] = np.asarray(fitted, np.uint8)
    return found


def render_faces(folder: Path) -> dict[str, NDArray[np.uint8]]:
    """Return fitted maps under three lights, at one exposure, by light; holes are closed."""
    appearance, model = read_model(folder)
    surface = FittedSurface.of(model, close_holes(read_own_mesh(appearance)).mesh)
    groups = [[light] for light in build_lights(THREE_LIGHTS_DEG)]
    found = render_light_groups(surface, aim_camera(IMAGE_PX), groups)
    front = found[list(THREE_LIGHTS_DEG).index("front")]
    exposure = choose_exposure(front.radiance, front.coverage)
    shown = [apply_tone_curve(one.radiance, exposure) for one in found]
    return dict(zip(THREE_LIGHTS_DEG, shown, strict=True))


def arrange_trials(names: Sequence[str], repeats: int, seed: int) -> list[dict[str, Any]]:
    """Return trials of pairs in random order; of two trials of a pair, each side has A once."""
    rng = np.random.default_rng(seed)
    first = np.arange(len(names)) % 2 == rng.integers(2)
    rng.shuffle(first)
    trials = [
        {"pair": name, "left": "A" if bool(first[k]) ^ (turn % 2 == 1) else "B"}
        for turn in range(repeats)
        for k, name in enumerate(names)
    ]
    return [{"trial": n, **trials[k]} for n, k in enumerate(rng.permutation(len(trials)), 1)]


def make_sheet(a: Path, b: Path, *, seed: int, repeats: int = 2) -> tuple[str, dict[str, Any]]:
    """Return the page and the key; raise if the folders have no image, or different names."""
    faces = {"A": read_faces(a), "B": read_faces(b)}
    if not faces["A"] or faces["A"].keys() != faces["B"].keys():
        raise ComparisonError(
            f"{a}, {b}: got images {', '.join(faces['A']) or 'none'} and "
            f"{', '.join(faces['B']) or 'none'}, expected equal names; rename them"
        )
    if repeats < 1:
        raise ComparisonError(f"--repeats: got {repeats}, expected 1 or more; enter another")
    trials = arrange_trials(sorted(faces["A"]), repeats, seed)
    key: dict[str, Any] = {"A": str(a), "B": str(b), "seed": seed, "trials": trials}
    # the identity contains the images, so that answers to another sheet are found
    digest = hashlib.sha256(json.dumps(key).encode())
    for side in faces.values():
        for name in sorted(side):
            digest.update(side[name].tobytes())
    key["sheet"] = digest.hexdigest()[:12]
    return _draw_page(key["sheet"], trials, faces), key


def _draw_page(
    sheet: str, trials: Sequence[dict[str, Any]], faces: dict[str, dict[str, NDArray[np.uint8]]]
) -> str:
    parts = []
    for one in trials:
        number, sides = one["trial"], (one["left"], "B" if one["left"] == "A" else "A")
        cells = []
        for place, side in zip(("left", "right"), sides, strict=True):
            address = png.encode_jpeg_url(faces[side][one["pair"]], quality=JPEG_QUALITY)
            cells.append(
                f'<label><img alt="{place} face of trial {number}" src="{address}"><br>'
                f'<input type="radio" name="trial-{number}" value="{place}" required> {place}'
                "</label>"
            )
        legend = f"<legend>Trial {number} of {len(trials)}</legend>"
        parts.append(f'<fieldset>{legend}<div class="pair">{"".join(cells)}</div></fieldset>')
    style, script = templates.hash_inline(PAGE_STYLE), templates.hash_inline(PAGE_SCRIPT)
    policy = f"default-src 'none'; img-src data:; style-src '{style}'; script-src '{script}'"
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{policy}; base-uri 'none'">
<title>Comparison of faces</title><style>{PAGE_STYLE}</style></head>
<body><main><h1>{escape(QUESTION)}</h1>
<p>Choose one face per pair, also when you are not sure. Then save the answers.</p>
<form data-sheet="{sheet}">
<p><label>Your code: <input name="observer" required maxlength="20"></label></p>
{"".join(parts)}
<p><button>Save the answers</button></p></form></main>
<script>{PAGE_SCRIPT}</script></body></html>
"""


def read_answers(path: Path, sheet: str) -> list[dict[str, str]]:
    """Read the answers of a CSV file; raise if they are not of this sheet."""
    with path.open(encoding="utf-8-sig", newline="") as text:
        table = csv.DictReader(text)
        if tuple(table.fieldnames or ()) != ANSWER_COLUMNS:
            raise ComparisonError(
                f"{path}: got columns {table.fieldnames}, expected {', '.join(ANSWER_COLUMNS)}"
            )
        rows = list(table)
    if foreign := {row["sheet"] for row in rows} - {sheet}:
        raise ComparisonError(f"{path}: got answers to sheet {foreign.pop()}, expected {sheet}")
    return rows


def evaluate(key: dict[str, Any], answers: Sequence[dict[str, str]]) -> dict[str, Any]:
    """Return how often A was chosen, with its exact binomial interval (Clopper-Pearson).

    The interval counts answers as independent; those of one observer, or to one pair, are not:
    both have counts of their own. An invalid, unknown or repeated answer raises.
    """
    trials = {str(one["trial"]): one for one in key["trials"]}
    for row in answers:
        if row["trial"] not in trials or row["answer"] not in ("left", "right"):
            raise ComparisonError(
                f"answers: got {row['answer']!r} for trial {row['trial']!r}, expected left or "
                f"right for 1 to {len(trials)}"
            )
    twice = [k for k, n in Counter((r["observer"], r["trial"]) for r in answers).items() if n > 1]
    if twice or not answers:
        what = f"two answers of {twice[0][0]!r} to trial {twice[0][1]}" if twice else "none"
        raise ComparisonError(f"answers: got {what}, expected one per observer and trial")
    chose_a = [
        (row["answer"] == "left") == (trials[row["trial"]]["left"] == "A") for row in answers
    ]
    found = _count(chose_a)
    for kind, groups in (
        ("observers", [row["observer"] for row in answers]),
        ("pairs", [trials[row["trial"]]["pair"] for row in answers]),
    ):
        found[kind] = {
            one: _count([a for a, group in zip(chose_a, groups, strict=True) if group == one])
            for one in sorted(set(groups))
        }
    return found


def _count(chose_a: Sequence[bool]) -> dict[str, Any]:
    test = binomtest(sum(chose_a), len(chose_a))
    low, high = test.proportion_ci(CONFIDENCE, method="exact")
    found = {
        "answers": len(chose_a),
        "chose_a": sum(chose_a),
        "fraction": sum(chose_a) / len(chose_a),
    }
    return {**found, "interval_95": [float(low), float(high)], "p_value": float(test.pvalue)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Make a sheet, or print the evaluation of answers as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = parser.add_subparsers(dest="part", required=True)
    sheet = parts.add_parser("sheet")
    sheet.add_argument("folders", type=Path, nargs=2)
    sheet.add_argument("--out", type=Path, default=Path("sheet.html"))
    sheet.add_argument("--key", type=Path, default=Path("key.json"))
    sheet.add_argument("--seed", type=int, required=True)
    sheet.add_argument("--repeats", type=int, default=2)
    judged = parts.add_parser("evaluate")
    judged.add_argument("key", type=Path)
    judged.add_argument("answers", type=Path, nargs="+")
    given = parser.parse_args(arguments)
    try:
        if given.part == "sheet":
            page, key = make_sheet(*given.folders, seed=given.seed, repeats=given.repeats)
            given.out.write_text(page, encoding="utf-8")
            given.key.write_text(json.dumps(key, indent=1) + "\n", encoding="utf-8")
        else:
            key = json.loads(given.key.read_text(encoding="utf-8"))
            rows = [row for path in given.answers for row in read_answers(path, key["sheet"])]
            print(json.dumps(evaluate(key, rows), indent=1))
    except ComparisonError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
