"""Compare the image folders of two runs: renderings and analyses.

Images are compared by their OpenEXR files where both have one, since those are linear; otherwise by
the codes of their PNG files, whose exposure may differ between runs.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from model import store
from skinrig.arrays import Float64Array
from skinrig.reporting import map_images, page, provenance
from skinrig.reporting.comparison import runs
from skinrig.reporting.comparison.runs import ComparedRun, pair_by_name
from skinrig.reporting.sections import images as image_section

MAX_DRAWN_IMAGES = 4
"""Images of a folder that are drawn: those with the largest differences."""
IGNORED_ENTRIES = ("seconds", "out", "files", "schema", "consent")
"""Entries of a record that may differ between equal renderings, or are shown elsewhere."""
MAX_CODE = 255.0
SCALE_PERCENTILE = 98.0


@dataclass(frozen=True, slots=True, eq=False)
class ImageDifference:
    """One image of two runs.

    Attributes
    ----------
    name
        Of the files, without suffix.
    kind
        "linear" or "8-bit codes".
    a, b
        Values, (H, W, C); codes over 255.
    """

    name: str
    kind: str
    a: Float64Array
    b: Float64Array

    @property
    def difference(self) -> Float64Array:
        """B minus A, mean over the channels, (H, W)."""
        return np.asarray((self.b - self.a).mean(axis=-1))

    @property
    def relative_rms(self) -> float:
        """Root mean square of B minus A over that of A; NaN where A is black or infinite."""
        return _ratio(_rms(self.b - self.a), _rms(self.a))

    @property
    def mean_ratio(self) -> float:
        """Mean of B over that of A; NaN where A is black."""
        return _ratio(float(self.b.mean()), float(self.a.mean()))

    @property
    def largest(self) -> float:
        """Largest absolute difference of a channel."""
        return float(np.abs(self.b - self.a).max(initial=0.0))

    @property
    def equal(self) -> bool:
        """Whether all values are equal."""
        return bool(np.array_equal(self.a, self.b))


def compare_folders(a: Path, b: Path) -> tuple[list[ImageDifference], list[tuple[str, str]]]:
    """Return the images of two folders, and those that cannot be subtracted with the reason.

    Parameters
    ----------
    a, b
        Folders that `skinrig render` or `skinrig analyse` wrote.
    """
    found, refused = [], []
    names = [
        {p.stem for p in folder.glob("*.*") if p.suffix in (".exr", ".png")} for folder in (a, b)
    ]
    for name in sorted(names[0] | names[1]):
        try:
            if name not in names[0] & names[1]:
                raise ValueError(f"only in {'A' if name in names[0] else 'B'}")
            found.append(_difference(name, a, b))
        except ValueError as error:
            refused.append((name, str(error)))
    return found, refused


def _difference(name: str, a: Path, b: Path) -> ImageDifference:
    """Return an image of two folders; raise ValueError where it cannot be subtracted."""
    both = [s for s in ("exr", "png") if all((f / f"{name}.{s}").is_file() for f in (a, b))]
    if not both:
        raise ValueError("one is OpenEXR, the other PNG")
    read = _linear if both[0] == "exr" else _codes
    try:
        one, other = (read(folder / f"{name}.{both[0]}") for folder in (a, b))
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot be read: {error}") from error
    if one.shape != other.shape:
        raise ValueError(f"sizes {_size(one)} and {_size(other)}")
    if not (np.isfinite(one).all() and np.isfinite(other).all()):
        raise ValueError("values that are not finite")
    return ImageDifference(name, "linear" if both[0] == "exr" else "8-bit codes", one, other)


def summarize_images(a: ComparedRun, b: ComparedRun) -> str:
    """Return the number of differing images in a sentence; empty without common images."""
    both = [
        one
        for _, path_a, path_b in pair_by_name(a.pictures, b.pictures)
        for one in compare_folders(path_a, path_b)[0]
    ]
    if not both:
        return ""
    differ = sum(not one.equal for one in both)
    return f"{differ} of {len(both)} images differ."


def section(a: ComparedRun, b: ComparedRun) -> Iterator[page.Block]:
    """Yield the images of two runs with their differences, and differing records."""
    for name, path_a, path_b in pair_by_name(a.pictures, b.pictures):
        found, refused = compare_folders(path_a, path_b)
        yield page.Heading(f"Images: {name}", level=2)
        if found:
            order = sorted(found, key=lambda one: (-np.nan_to_num(one.relative_rms), one.name))
            yield page.build_view("compared_images", pictures=order)
            drawn = [one for one in order if not one.equal]
            for one in drawn[:MAX_DRAWN_IMAGES]:
                yield page.Heading(one.name)
                yield page.Images(list(_draw_difference(a, b, one)))
            if drawn[MAX_DRAWN_IMAGES:]:
                rest = ", ".join(one.name for one in drawn[MAX_DRAWN_IMAGES:])
                yield page.build_note(f"Images with smaller differences are not drawn: {rest}.")
        if refused:
            yield page.build_table(
                ("image", "reason"), refused, caption="Images that were not subtracted"
            )
        yield _records(a, b, path_a, path_b)


def _draw_difference(
    a: ComparedRun, b: ComparedRun, difference: ImageDifference
) -> Iterator[page.Image]:
    """Draw A | B | B − A: linear ones at one brightness for both."""
    bright = (
        float(np.percentile(np.concatenate([difference.a, difference.b]), SCALE_PERCENTILE)) or 1.0
    )
    for label, values in ((a.label, difference.a), (b.label, difference.b)):
        shown = np.broadcast_to(values, (*values.shape[:2], 3))
        if difference.kind == "linear":
            shown = np.clip(shown / bright, 0.0, 1.0)
            yield map_images.draw_color_image(label, shown, width=200, of=difference.name)
        else:
            small = map_images.shrink(np.rint(MAX_CODE * shown).astype(np.uint8), 200)
            yield map_images.draw_plain_image(
                label, np.ascontiguousarray(small), alt=f"{difference.name}, {label}"
            )
    every = np.ones(difference.difference.shape, bool)
    reach = (
        map_images.compute_percentile_reach(difference.difference, every, SCALE_PERCENTILE)
        or difference.largest
        or 1.0
    )
    drawing = map_images.MapDrawing(difference.name, width=200)
    yield drawing.draw_signed("B − A, mean of the channels", difference.difference, reach)


def _records(a: ComparedRun, b: ComparedRun, path_a: Path, path_b: Path) -> page.Block:
    sides = [provenance.flatten_settings(_document(path)) for path in (path_a, path_b)]
    rows = runs.find_differing_entries(*sides)
    if not rows:
        return page.build_note("Settings and records are equal.")
    return page.build_table(
        ("entry", a.label, b.label),
        rows,
        caption="Differing entries of the records, without run times",
    )


def _document(folder: Path) -> Mapping[str, Any]:
    path = image_section.folder_document(folder)
    found = {} if path is None else json.loads(path.read_text(encoding="utf-8"))
    return {key: value for key, value in found.items() if key not in IGNORED_ENTRIES}


def _linear(path: Path) -> Float64Array:
    return np.atleast_3d(store.read_exr(path).astype(np.float64))


def _codes(path: Path) -> Float64Array:
    import cv2

    read = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if read is None:
        raise ValueError("not an image")
    top = float(np.iinfo(read.dtype).max)
    layers = np.atleast_3d(read.astype(np.float64))
    return layers[..., [2, 1, 0]] / top if layers.shape[-1] >= 3 else layers / top


def _size(image: Float64Array) -> str:
    return " x ".join(str(n) for n in image.shape)


def _rms(values: Float64Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _ratio(value: float, over: float) -> float:
    return value / over if over > 0.0 else float("nan")
