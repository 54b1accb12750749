"""Read light lists in use in the field: .lp, text, JSON and NumPy files, chrome balls.

Directions are towards the lights: x right, y up, z towards the camera, as .lp files have them.
"""

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from capture.arrays import BoolArray, Float32Array, Float64Array
from capture.documents import Fault
from capture.importers.image_checks import advise_conversion
from capture.importers.images import read_photo
from capture.importers.light_tables import (
    LightListError,
    UnequalCountError,
    is_number,
    parse_vector,
    read_light_table,
    read_rows,
    read_text,
)
from capture.raw import RawFrame

Kind = Literal["lp", "list", "chrome ball", "images"]

IMAGE_SUFFIXES = frozenset(
    ".png .jpg .jpeg .tif .tiff .exr .dng .nef .cr2 .cr3 .arw .orf .rw2 .raf .pef .srw .kdc".split()
)
BALL_FOLDER_NAMES = ("chrome", "ball", "sphere", "mirror")
LIST_NAMES = tuple(
    f"{stem}.{suffix}"
    for suffix in ("txt", "csv", "json", "npy")
    for stem in (
        *("light_directions", "lights", "light_positions"),
        *("light_dirs", "light_dir", "light_pos", "directions"),
    )
)
"""Names of lists without names of images, the first that exists counts."""
SUFFIX_PATTERN = re.compile(r"\.[a-z0-9]{1,5}$")
"""Suffix of a folded name; what follows another dot is part of the name."""
MAX_LIGHTS = 10_000
UNIT_LENGTH_RANGE = (0.98, 1.02)
"""Range of lengths in which the rows of a list count as rounded unit vectors."""


@dataclass(frozen=True, slots=True)
class LightList:
    """Lights in the order of the images."""

    images: tuple[Path, ...]
    vectors: Float64Array
    """(N, 3), as in the file: unit vectors, or positions."""
    kind: Kind
    file: str
    """Name of the file or folder of the list."""
    intensity: Float64Array | None = None
    """(N, 3), relative strength per channel, where the folder gives it."""
    stderr_deg: Float64Array | None = None
    """(N,), standard error of directions that were estimated from the images."""

    @property
    def directions(self) -> Float64Array:
        """Unit vectors towards the lights, (N, 3)."""
        return np.asarray(self.vectors / np.linalg.norm(self.vectors, axis=1, keepdims=True))

    @property
    def has_unit_vectors(self) -> bool:
        """Whether the rows are directions rather than positions."""
        length = np.linalg.norm(self.vectors, axis=1)
        return bool((length > UNIT_LENGTH_RANGE[0]).all() and (length < UNIT_LENGTH_RANGE[1]).all())


def natural_sort_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """Return a sort key that orders numbers in names by value: 2 before 10.

    Examples
    --------
    >>> sorted(["b.10.png", "b.2.png", "a.png"], key=natural_sort_key)
    ['a.png', 'b.2.png', 'b.10.png']
    """
    parts = re.split(r"(\d+)", name.casefold())
    return tuple((0, int(part)) if part.isdigit() else (1, part) for part in parts if part)


def find_light_list(
    directory: Path, *, lights: Path | None = None, images: Sequence[Path] | None = None
) -> LightList:
    """Find the images of a folder and the lights under which they were taken.

    Parameters
    ----------
    directory : Path
        The folder of the images, or one above it that contains a single such folder.
    lights : Path, optional
        A .lp file, a text, JSON or NumPy file of directions, or a folder of a chrome ball; default:
        the one found in the folder or next to it, in that order.
    images : sequence of Path, optional
        Images to which a list without names belongs, in its order; default: all of the folder.

    Returns
    -------
    LightList

    Raises
    ------
    LightListError
        When images or lights are missing, or their numbers or names do not match.
    """
    if not directory.is_dir():
        raise LightListError(
            "folder not found",
            where=str(directory),
            advice="Name a folder of images.",
            code="SR-IMP-005",
        )
    directory, source = _folder(directory), lights or None
    if source is None:
        source = _source(directory)
    if not source.exists():
        raise LightListError("light list not found", where=str(source))
    pictures = _images_in(directory) if images is None else tuple(images)
    if source.is_dir():
        return LightList(pictures, _from_ball(source, len(pictures)), "chrome ball", source.name)
    if source.suffix.lower() == ".lp":
        return _from_lp(source, directory)
    if source.suffix.lower() in (".json", ".npy"):
        return _from_table(source, directory, pictures)
    return _from_text(source, directory, pictures)


def find_images(directory: Path) -> tuple[Path, ...]:
    """Return the images of a folder, or of its only subfolder with images, in natural order.

    Raises
    ------
    LightListError
        When the folder is missing, or several subfolders have images.
    """
    if not directory.is_dir():
        raise LightListError(
            "folder not found",
            where=str(directory),
            advice="Name a folder of images.",
            code="SR-IMP-005",
        )
    return _images_in(_folder(directory))


def _images_in(directory: Path) -> tuple[Path, ...]:
    """Return the images of a folder in natural order, without its masks.

    A ``filenames.txt`` lists them in its own order.
    """
    listed = directory / "filenames.txt"
    if listed.is_file():
        names = [line.strip() for line in read_text(listed).splitlines() if line.strip()]
        return _find_image_files(names, directory, listed)
    images = (
        f for f in _list_files(directory) if f.suffix.lower() in IMAGE_SUFFIXES and not _is_mask(f)
    )
    return tuple(sorted(images, key=lambda file: natural_sort_key(file.name)))


def _list_files(directory: Path) -> list[Path]:
    """Return the files of a folder; hidden ones are what file managers leave."""
    return sorted(f for f in directory.iterdir() if f.is_file() and not f.name.startswith("."))


def _is_mask(file: Path) -> bool:
    """Return whether an image is a mask by its name.

    Examples
    --------
    >>> _is_mask(Path("buddha.mask.png")), _is_mask(Path("damask.png"))
    (True, False)
    """
    return "mask" in re.split(r"[^a-z]+", file.stem.lower())


def find_mask(directory: Path) -> Path | None:
    """Return the mask of a folder of images, None when it has none or several."""
    images = (f for f in _list_files(directory) if f.suffix.lower() in IMAGE_SUFFIXES)
    found = [file for file in images if _is_mask(file)]
    return found[0] if len(found) == 1 else None


def read_mask(path: Path, shape: tuple[int, int]) -> BoolArray:
    """Return where a mask is brighter than half of its brightest pixel, (H, W).

    Raises
    ------
    LightListError
        When its size differs from the images', or it is black.
    """
    values = to_gray(read_photo(path).frame)
    if values.shape != shape:
        got, wanted = f"{values.shape[1]} x {values.shape[0]}", f"{shape[1]} x {shape[0]}"
        raise LightListError.at("does not fit the images", "mask", got, wanted, where=path)
    top = float(values.max())
    if top <= 0:
        raise LightListError("is black", where=str(path), faults=[Fault("mask", "no pixel", "one")])
    return np.asarray(values > 0.5 * top)


def to_gray(frame: RawFrame) -> Float32Array:
    """Return the mean of an imported image's channels, (H, W), DN; each 2 x 2 cell is a pixel."""
    cells = frame.cfa.astype(np.float32)
    if frame.pattern == "MONO":
        return cells
    mean = cells[::2, ::2] + cells[::2, 1::2] + cells[1::2, ::2] + cells[1::2, 1::2]
    mean *= np.float32(0.25)
    return mean


def _folder(directory: Path) -> Path:
    """Return the folder of the images: this one, or its only subfolder without a chrome ball."""
    if _images_in(directory):
        return directory
    below = [
        folder
        for folder in sorted(directory.iterdir())
        if folder.is_dir() and not _is_ball(folder) and _images_in(folder)
    ]
    if len(below) != 1:
        others = Counter(file.suffix or file.name for file in _list_files(directory))
        files = ", ".join(f"{count} {suffix}" for suffix, count in others.most_common(5))
        got = ", ".join(folder.name for folder in below) or "no images"
        advice = [text for suffix in others if (text := advise_conversion(f"a{suffix}"))]
        raise LightListError(
            "is not a folder of one object under many lights",
            where=str(directory),
            faults=[Fault("folders with images", f"{got} ({files})" if files else got, "one")],
            advice=advice[0] if advice else "Name the folder that contains the object's images.",
        )
    return below[0]


def _is_ball(folder: Path) -> bool:
    return any(word in folder.name.lower() for word in BALL_FOLDER_NAMES)


def _source(directory: Path) -> Path:
    for folder in (directory, directory.parent):
        files = {file.name.casefold(): file for file in _list_files(folder)}
        lists = [file for name, file in files.items() if name.endswith(".lp")]
        if len(lists) > 1:
            raise LightListError(
                "has several light lists",
                where=str(folder),
                faults=[Fault("*.lp", ", ".join(f.name for f in lists), "one")],
                advice="Name one with --lights.",
            )
        named = (files[name] for name in LIST_NAMES if name in files)
        found = next((*lists, *named).__iter__(), None)
        if found is not None:
            return found
    for folder in (directory, directory.parent):
        for ball in sorted(f for f in folder.iterdir() if f.is_dir() and _is_ball(f)):
            if ball != directory and _images_in(ball):
                return ball
    raise LightListError(
        "has no light list",
        where=str(directory),
        faults=[Fault("lights", "none", "*.lp, lights.txt, light_directions.json or chrome/")],
        advice="Put one next to the images, name it with --lights, or use --lights estimate.",
        code="SR-IMP-006",
    )


def _from_lp(path: Path, directory: Path) -> LightList:
    """Read an .lp file: a count, then a file name and x y z in each line."""
    names, vectors = [], []
    for number, words in _read_counted(path):
        where = f"{path}, line {number}"
        vectors.append(parse_vector(words[-3:], where))
        if len(words) != 4:
            raise LightListError(
                "is not a light list",
                where=where,
                faults=[Fault("columns", f"{len(words)}: {' '.join(words)[:60]}", "name x y z")],
                advice="Remove other columns. With decimal commas, separate columns by semicolons.",
            )
        names.append(words[0])
    pictures = _find_image_files(names, directory, path)
    return _list_named(path, directory, pictures, np.array(vectors))


def _list_named(
    path: Path, directory: Path, pictures: tuple[Path, ...], vectors: Float64Array
) -> LightList:
    """Return the lights of a list with names; its rows are those of the intensities, too."""
    if len(set(pictures)) < len(pictures):
        raise LightListError("contains an image twice", where=str(path))
    intensity = read_intensities(directory, len(vectors))
    return LightList(pictures, vectors, "lp", path.name, intensity)


def _read_counted(path: Path) -> list[tuple[int, list[str]]]:
    """Return the rows of a list without its count, which must be right."""
    rows = read_rows(path)
    count = None
    if rows and len(rows[0][1]) == 1 and rows[0][1][0].isdigit():
        count, rows = int(rows[0][1][0]), rows[1:]
    if not rows or (count is not None and count != len(rows)) or len(rows) > MAX_LIGHTS:
        expected = "one line per image" if count is None else f"{count}, as in its first line"
        raise LightListError.at(
            "is not a complete light list", "lines", str(len(rows)), expected, where=path
        )
    return rows


def _find_image_files(names: Sequence[str], directory: Path, source: Path) -> tuple[Path, ...]:
    """Return the files of entries: by name, without its folder, or with another suffix."""
    files = {_fold(file.name): file for file in _list_files(directory)}
    by_stem: dict[str, list[Path]] = {}
    for file in files.values():
        if file.suffix.lower() in IMAGE_SUFFIXES:
            by_stem.setdefault(_fold(file.stem), []).append(file)
    found = []
    for name in names:
        base = _fold(re.split(r"[\\/]", name)[-1])
        alike = by_stem.get(SUFFIX_PATTERN.sub("", base), [])
        if base not in files and len(alike) != 1:
            raise LightListError(
                "names a missing image",
                where=str(source),
                faults=[Fault("picture", repr(name), f"a file in {directory}")],
                advice="Correct the name in the list, or add the file.",
                code="SR-IMP-008",
            )
        found.append(files[base] if base in files else alike[0])
    return tuple(found)


def _fold(name: str) -> str:
    """Return a name as file systems compare it: case and composed letters do not differ."""
    return unicodedata.normalize("NFC", name).casefold()


def _from_text(path: Path, directory: Path, pictures: tuple[Path, ...]) -> LightList:
    """Read rows x y z, with or without a count, for these images; names make them an .lp file."""
    rows = _read_counted(path)
    if all(len(words) > 3 and not is_number(words[0]) for _, words in rows):
        return _from_lp(path, directory)
    vectors = np.array([parse_vector(words, f"{path}, line {number}") for number, words in rows])
    _require_one_each(path, pictures, vectors)
    return LightList(pictures, vectors, "list", path.name, read_intensities(directory, len(rows)))


def read_intensities(directory: Path, count: int) -> Float64Array | None:
    """Read the strengths (N, 3) of a folder's ``light_intensities.txt``; None without one."""
    strengths = directory / "light_intensities.txt"
    if not strengths.is_file():
        return None
    lines = read_rows(strengths)
    intensity = np.array([parse_vector(row, f"{strengths}, line {k}") for k, row in lines])
    if intensity.shape != (count, 3) or (intensity <= 0).any():
        raise LightListError(
            "does not fit the lights",
            where=str(strengths),
            faults=[Fault("rows", str(len(lines)), f"{count} of numbers > 0")],
        )
    return intensity


def _require_one_each(path: Path, pictures: tuple[Path, ...], vectors: Float64Array) -> None:
    if len(pictures) != len(vectors):
        stems = Counter(picture.stem for picture in pictures)
        twice = [f.name for f in pictures if stems[f.stem] > 1][:2]
        advice = "Move images that do not belong to the series away, or name the mask *mask*."
        if twice:
            advice = f"{' and '.join(twice)} look like one shot: keep one format. {advice}"
        raise UnequalCountError(
            "does not fit the images",
            where=str(path),
            faults=[Fault("lights", str(len(vectors)), f"{len(pictures)}, one per image")],
            advice=advice,
            code="SR-IMP-007",
        )


def _from_table(path: Path, directory: Path, pictures: tuple[Path, ...]) -> LightList:
    """Read vectors from JSON or NumPy, with names of images where the file has them."""
    names, vectors = read_light_table(path)
    if names:
        named = _find_image_files(names, directory, path)
        return _list_named(path, directory, named, vectors)
    _require_one_each(path, pictures, vectors)
    intensity = read_intensities(directory, len(vectors))
    return LightList(pictures, vectors, "list", path.name, intensity)


def _from_ball(folder: Path, count: int) -> Float64Array:
    from capture.calibration.lights.chrome_ball import ChromeBallError, directions_from_chrome_ball

    pictures, mask = _images_in(folder), find_mask(folder)
    if len(pictures) != count or mask is None:
        got = f"{len(pictures)} images, {'a' if mask else 'no'} mask"
        raise LightListError.at(
            "does not fit the images", "ball", got, f"{count} images and one mask", where=folder
        )
    grays = [to_gray(read_photo(picture).frame) for picture in pictures]
    try:
        return np.asarray(directions_from_chrome_ball(grays, read_mask(mask, grays[0].shape)))
    except ChromeBallError as exc:
        raise LightListError(str(exc), where=str(folder)) from exc
