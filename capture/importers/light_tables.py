"""Read vectors of lights from text, JSON and NumPy files."""

import codecs
import io
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Float64Array
from capture.documents import Fault, InputError, read_json

MAX_BYTES = 2**24
VECTOR_KEYS = ("direction", "dir", "light_dir", "position", "pos", "light_pos", "xyz", "vector")
NAME_KEYS = ("image", "file", "filename", "file_path", "name", "frame")
AXIS_NAMES = ("x", "y", "z")
"""Ends of the names of columns."""
COMMENT_MARKS = ("#", "%", "//")
LIST_KEYS = ("lights", "frames", "images", "light_directions", "light_positions", "directions")


class LightListError(InputError):
    """Raised for a light list, or a folder of images with one, that cannot be imported."""


class UnequalCountError(LightListError):
    """Raised for a list that has more or fewer rows than there are images."""


def read_bytes(path: Path) -> bytes:
    """Return the content of a list; refuse what no list is as large as."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise LightListError("is not a light list", where=str(path))
        return path.read_bytes()
    except OSError as exc:
        raise LightListError(f"cannot be read: {exc.strerror}", where=str(path)) from exc


def read_text(path: Path) -> str:
    """Return a text file without its byte order mark: UTF-8, UTF-16 or Windows-1252."""
    data = read_bytes(path)
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace")
    if b"\0" in data:
        raise LightListError(
            "is not a light list",
            where=str(path),
            advice="Save its vectors as text, one line x y z per light, as JSON or as .npy.",
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def read_rows(path: Path) -> list[tuple[int, list[str]]]:
    """Return rows of a text file and their lines from 1; comments and a header are skipped."""
    lines = enumerate(read_text(path).splitlines(), start=1)
    rows = [
        (number, split_row(line))
        for number, line in lines
        if line.strip() and not line.lstrip().startswith(COMMENT_MARKS)
    ]
    heads = [word.strip().casefold() for word in rows[0][1][-3:]] if rows else []
    if len(heads) == 3 and all(map(str.endswith, heads, AXIS_NAMES)):
        return rows[1:]
    return rows


def split_row(line: str) -> list[str]:
    """Return the words of a row: spaces, semicolons or commas separate them.

    Three numbers between spaces are a vector; all in front of them is one name.

    Examples
    --------
    >>> split_row("img 1.png;0,5;0;1"), split_row("0.5,0,1"), split_row("a, b.png 0,5 0 1")
    (['img 1.png', '0,5', '0', '1'], ['0.5', '0', '1'], ['a, b.png', '0,5', '0', '1'])
    """
    words = line.rsplit(maxsplit=3)
    if len(words) >= 3 and all(map(is_number, words[-3:])):
        words[:-3] = [name.rstrip(",;") for name in words[:-3]]
    elif ";" in line:
        words = line.split(";")
    elif re.search(r",\s", line) or line.split()[-1].count(",") > 1:
        words = line.split(",")
    return [word.strip().strip('"') for word in words if word.strip()]


def is_number(word: str) -> bool:
    """Return whether a word is a number, with a decimal point or comma.

    Examples
    --------
    >>> is_number("-0,5"), is_number("1e-3"), is_number("img1")
    (True, True, False)
    """
    try:
        float(word.replace(",", ".") if "." not in word else word)
    except ValueError:
        return False
    return True


def parse_vector(words: Sequence[str], where: str) -> list[float]:
    """Return three finite numbers, not all zero; a decimal comma is accepted."""
    vector = [
        float(word.replace(",", ".") if "." not in word else word)
        for word in words
        if is_number(word)
    ]
    if (
        len(vector) != 3
        or len(words) != 3
        or not all(map(math.isfinite, vector))
        or not any(vector)
    ):
        got = " ".join(words)[:60] or "nothing"
        angles = " For angles write x = cos(elevation) cos(azimuth), y = cos(elevation) "
        angles += "sin(azimuth), z = sin(elevation)."
        raise LightListError(
            "is not a light list",
            where=where,
            faults=[Fault("light", got, "three numbers x y z, not all zero")],
            advice="Give the direction towards the light: x right, y up, z towards the camera."
            + (angles if len(vector) == 2 else ""),
        )
    return vector


def read_light_table(path: Path) -> tuple[list[str], Float64Array]:
    """Read a JSON or NumPy file of light vectors.

    Parameters
    ----------
    path
        ``.npy``: an array (N, 3). ``.json``: a list of vectors, a list of objects with a vector
        and perhaps the name of an image, an object of vectors by name, or an object with one of
        these as ``lights``, ``frames`` or ``images``.

    Returns
    -------
    names : list of str
        Of the images; empty where the file has none.
    vectors : ndarray, shape (N, 3)

    Raises
    ------
    LightListError
        For files of another form.
    """
    data = read_bytes(path)
    rows: Any
    if path.suffix.lower() == ".npy":
        try:
            rows = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False).tolist()
        except (ValueError, EOFError, MemoryError, OverflowError) as exc:
            raise LightListError("is not a NumPy array", where=str(path)) from exc
    else:
        data = data.removeprefix(codecs.BOM_UTF8)
        rows = read_json(data, where=str(path), error=LightListError)
    for key in LIST_KEYS:
        if isinstance(rows, Mapping) and isinstance(rows.get(key), list | dict):
            rows = rows[key]
    entries = list(rows.items()) if isinstance(rows, Mapping) else None
    if entries is None and isinstance(rows, list):
        entries = [_split_entry(row) for row in rows]
    if not entries:
        raise LightListError(
            "is not a light list",
            where=str(path),
            faults=[Fault("lights", type(rows).__name__, "a list or an object of vectors")],
        )
    names = [str(name) for name, _ in entries if name is not None]
    vectors = [
        parse_vector(
            [str(value) for value in row] if isinstance(row, list) else [str(row)],
            f"{path}, light {number}",
        )
        for number, (_, row) in enumerate(entries, start=1)
    ]
    if 0 < len(names) < len(vectors):
        raise LightListError(
            "names only some images",
            where=str(path),
            faults=[Fault("names", f"{len(names)} of {len(vectors)}", "all or none")],
        )
    return names, np.array(vectors)


def _split_entry(row: Any) -> tuple[str | None, Any]:
    """Return the name of an image, None without one, and the vector of an entry."""
    if not isinstance(row, Mapping):
        return None, row
    texts = (row[key] for key in NAME_KEYS if isinstance(row.get(key), str))
    # a lamp can have a name, too: only that of a file has a suffix
    name = next((text for text in texts if Path(text).suffix), None)
    return name, next((row[key] for key in VECTOR_KEYS if key in row), None)
