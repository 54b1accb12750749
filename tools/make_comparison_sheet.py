"""Make the sheet of a blind comparison of two sets of faces, and evaluate its answers.

    python tools/make_comparison_sheet.py sheet A B --out sheet.html --key key.json --seed 1
    python tools/make_comparison_sheet.py evaluate key.json answers.csv ...

A and B are folders of images with equal names, such as ``III-left.png``, or of fitted maps. Maps
are rendered under three lights in their camera's RGB; holes, crown and neck are completed. The key
has sides and consent: observers lack it. Maps of measured people need ``--use``.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import json
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import escape
from numpy.typing import NDArray
from PIL import Image, ImageCms, ImageOps
from scipy.stats import binomtest

from model import store
from skinrig.consent import format_consent, merge_consent, require_consent
from skinrig.drawing import png, templates
from skinrig.fusing.finished_face import BACKGROUND_CODES, aim_camera, build_lights, complete_skin
from skinrig.rendering.folder import apply_tone_curve, choose_exposure
from skinrig.rendering.geometry import FittedSurface
from skinrig.rendering.render import render_light_groups
from skinrig.rendering.request import read_model

THREE_LIGHTS_DEG = {"left": -60.0, "front": 0.0, "right": 60.0}
IMAGE_PX = (400, 450)
"""Width and height of the images of a sheet; others are cut to it around their middle."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")
IMAGE_MODES = ("RGB", "RGBA", "L", "LA", "P", "PA", "1")
"""Modes of Pillow that are converted; others have more bits, or inks."""
JPEG_QUALITY = 92
QUESTION = "Which face looks more like a photograph of a person?"
CONFIDENCE = 0.95
ANSWER_COLUMNS = ("sheet", "observer", "trial", "answer")
Faces = dict[str, NDArray[np.uint8]]
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


def read_faces(folder: Path, use: str | None = None) -> tuple[Faces, list[str]]:
    """Return the images of a folder, or of its rendered maps, and the consent of their subjects."""
    if (folder / store.DOCUMENT_FILE).is_file():
        return render_faces(folder, use)
    found: Faces = {}
    for path in sorted(folder.iterdir() if folder.is_dir() else ()):
        if path.suffix.lower() in IMAGE_SUFFIXES:
            if path.stem in found:
                raise ComparisonError(f"{path}: got two images named {path.stem}; rename one")
            with Image.open(path) as image:
                turned = flatten_image(ImageOps.exif_transpose(image), path)
            fitted = ImageOps.fit(turned, IMAGE_PX, Image.Resampling.LANCZOS)
            found[path.stem] = np.asarray(fitted, np.uint8)
    return found, ["unknown: images have no consent record"]


def flatten_image(image: Image.Image, path: Path) -> Image.Image:
    """Return an image as sRGB on the background of rendered faces; raise for other modes."""
    if image.mode not in IMAGE_MODES:
        raise ComparisonError(
            f"{path}: got mode {image.mode}, expected 8 bits per channel, gray or RGB; convert it"
        )
    shown = image.convert("L" if image.mode in ("L", "LA", "1") else "RGB")
    if profile := image.info.get("icc_profile"):
        try:
            own, srgb = io.BytesIO(profile), ImageCms.createProfile("sRGB")
            shown = ImageCms.buildTransform(own, srgb, shown.mode, "RGB").apply(shown)
        except (OSError, ValueError, ImageCms.PyCMSError) as error:
            raise ComparisonError(f"{path}: ICC profile: {error}; convert it to sRGB") from error
    flat = Image.new("RGB", image.size, tuple(int(code) for code in BACKGROUND_CODES))
    flat.paste(shown.convert("RGB"), mask=image.convert("RGBA").getchannel("A"))
    return flat


def render_faces(folder: Path, use: str | None) -> tuple[Faces, list[str]]:
    """Return fitted maps under three lights, at one exposure, by light, and their consent."""
    appearance, model = read_model(folder)
    require_consent(appearance, use, folder=str(folder))
    whole = complete_skin(appearance, model, seed=0)
    surface = FittedSurface.of(whole.model, whole.person.mesh)
    lights = [[light] for light in build_lights(THREE_LIGHTS_DEG)]
    found = render_light_groups(surface, aim_camera(IMAGE_PX), lights)
    front = found[list(THREE_LIGHTS_DEG).index("front")]
    exposure = choose_exposure(front.radiance, front.coverage)
    shown = [apply_tone_curve(one.radiance, exposure) for one in found]
    consent = format_consent(merge_consent(appearance))
    return dict(zip(THREE_LIGHTS_DEG, shown, strict=True)), consent


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


def make_sheet(
    a: Path, b: Path, *, seed: int, repeats: int = 2, use: str | None = None
) -> tuple[str, dict[str, Any]]:
    """Return the page and the key; raise if the folders have no image, or different names."""
    for name, value, least in (("--repeats", repeats, 1), ("--seed", seed, 0)):
        if value < least:
            raise ComparisonError(f"{name}: got {value}, expected {least} or more; enter another")
    faces, agreed = {}, {}
    for side, folder in (("A", a), ("B", b)):
        faces[side], agreed[side] = read_faces(folder, use)
    names, others = (", ".join(faces[side]) or "none" for side in "AB")
    if not faces["A"] or names != others:
        got = f"{a}, {b}: got images {names} and {others}"
        raise ComparisonError(f"{got}, expected equal names; rename them")
    trials = arrange_trials(sorted(faces["A"]), repeats, seed)
    key: dict[str, Any] = {"A": str(a), "B": str(b), "trials": trials}
    key |= {"seed": seed, "consent": agreed}
    digest = hashlib.sha256(json.dumps(key).encode())
    for image in (side[name] for side in faces.values() for name in sorted(side)):
        digest.update(image.tobytes())
    key["sheet"] = digest.hexdigest()[:12]
    return _draw_page(key["sheet"], trials, faces), key


def _draw_page(sheet: str, trials: Sequence[dict[str, Any]], faces: dict[str, Faces]) -> str:
    parts = []
    for one in trials:
        number, sides = one["trial"], (one["left"], "B" if one["left"] == "A" else "A")
        cells = []
        for place, side in zip(("left", "right"), sides, strict=True):
            address = png.encode_jpeg_url(faces[side][one["pair"]], quality=JPEG_QUALITY)
            cells.append(
                f'<label><img alt="{place} face of trial {number}" src="{address}"><br><input '
                f'type="radio" name="trial-{number}" value="{place}" required> {place}</label>'
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
{"".join(parts)}<p><button>Save the answers</button></p></form></main>
<script>{PAGE_SCRIPT}</script></body></html>
"""


def read_answers(path: Path, sheet: str) -> list[dict[str, str]]:
    """Read the answers of a CSV file; raise if they are not of this sheet."""
    with path.open(encoding="utf-8-sig", newline="") as text:
        table = csv.DictReader(text)
        if tuple(table.fieldnames or ()) != ANSWER_COLUMNS:
            expected = ", ".join(ANSWER_COLUMNS)
            raise ComparisonError(f"{path}: got columns {table.fieldnames}, expected {expected}")
        rows = list(table)
    if foreign := {row["sheet"] for row in rows} - {sheet}:
        raise ComparisonError(f"{path}: got answers to sheet {foreign.pop()}, expected {sheet}")
    return rows


def read_key(path: Path) -> dict[str, Any]:
    """Read the key of a sheet; raise if it is another file."""
    try:
        key = json.loads(path.read_text(encoding="utf-8"))
        sides = {one["left"] for one in key["trials"] if (one["trial"], one["pair"])}
        if not isinstance(key["sheet"], str) or not sides or not sides <= {"A", "B"}:
            raise ValueError(f"sheet {key['sheet']!r} with sides {sorted(sides)}")
    except (ValueError, KeyError, TypeError) as error:
        raise ComparisonError(f"{path}: not a sheet's key ({error!r}); give another") from error
    return dict(key)


def evaluate(key: dict[str, Any], answers: Sequence[dict[str, str]]) -> dict[str, Any]:
    """Return how often A was chosen, and a sign test over observers.

    An observer prefers the side that it chose more often. Observers are independent; answers of one
    observer are not, so that they have no interval. An invalid, unknown or repeated answer raises.
    """
    trials = {str(one["trial"]): one for one in key["trials"]}
    for row in answers:
        if row["trial"] not in trials or row["answer"] not in ("left", "right"):
            what = f"got {row['answer']!r} for trial {row['trial']!r}"
            raise ComparisonError(f"answers: {what}, expected left or right for 1 to {len(trials)}")
    twice = [k for k, n in Counter((r["observer"], r["trial"]) for r in answers).items() if n > 1]
    if twice or not answers:
        what = f"two answers of {twice[0][0]!r} to trial {twice[0][1]}" if twice else "none"
        raise ComparisonError(f"answers: got {what}, expected one per observer and trial")

    def count_groups(groups: Sequence[str]) -> dict[str, dict[str, Any]]:
        rows = list(zip(groups, answers, strict=True))
        return {k: _count([row for n, row in rows if n == k], trials) for k in sorted(set(groups))}

    observers = count_groups([row["observer"] for row in answers])
    for one in observers.values():
        one["missing_trials"] = len(trials) - one["answers"]
    return {
        **_count(answers, trials),
        "missing_trials": len(trials) * len(observers) - len(answers),
        "sign_test": _test_signs([one["fraction"] for one in observers.values()]),
        "observers": observers,
        "pairs": count_groups([trials[row["trial"]]["pair"] for row in answers]),
    }


def _count(rows: Sequence[dict[str, str]], trials: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the number of answers, of those for A, and the fractions for A and for the left."""
    left = sum(row["answer"] == "left" for row in rows)
    a = sum((r["answer"] == "left") == (trials[r["trial"]]["left"] == "A") for r in rows)
    n = len(rows)
    return {"answers": n, "chose_a": a, "fraction": a / n, "fraction_left": left / n}


def _test_signs(fractions: Sequence[float]) -> dict[str, Any]:
    """Return the sign test over observers, and the exact interval of those who prefer A."""
    for_a, for_b = (sum(sign * (f - 0.5) > 0 for f in fractions) for sign in (1, -1))
    signs = {"prefer_a": for_a, "prefer_b": for_b, "ties": len(fractions) - for_a - for_b}
    if for_a + for_b == 0:
        return {**signs, "interval_95": None, "p_value": None}
    test = binomtest(for_a, for_a + for_b)
    interval = test.proportion_ci(CONFIDENCE, method="exact")
    return {**signs, "interval_95": [float(x) for x in interval], "p_value": float(test.pvalue)}


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
    sheet.add_argument("--use", help="purpose of the sheet, which measured people agreed to")
    judged = parts.add_parser("evaluate")
    judged.add_argument("key", type=Path)
    judged.add_argument("answers", type=Path, nargs="+")
    given = parser.parse_args(arguments)
    try:
        if given.part == "sheet":
            options = {name: getattr(given, name) for name in ("seed", "repeats", "use")}
            page, key = make_sheet(*given.folders, **options)
            given.out.write_text(page, encoding="utf-8")
            given.key.write_text(json.dumps(key, indent=1) + "\n", encoding="utf-8")
        else:
            key = read_key(given.key)
            rows = [row for path in given.answers for row in read_answers(path, key["sheet"])]
            print(json.dumps(evaluate(key, rows), indent=1))
    except (ValueError, OSError, csv.Error) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
