"""Read vectors of lights from text, JSON and NumPy files."""

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Float64Array
from capture.documents import Fault, InputError, read_json

MAX_BYTES = 2**24
VECTOR_KEYS = ("direction", "dir", "light_dir", "position", "pos", "light_pos", "xyz", "vector")
NAME_KEYS = ("image", "file", "filename", "file_path", "name", "frame")
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
    """Return a text file without its byte order mark."""
    data = read_bytes(path)
    if b"\0" in data:
        raise LightListError("is not a light list", where=str(path))
    return data.decode("utf-8-sig", "replace")


def parse_vector(words: Sequence[str], where: str) -> list[float]:
    """Return three finite numbers, not all zero; a decimal comma is accepted."""
    try:
        vector = [float(word.replace(",", ".") if "." not in word else word) for word in words]
    except ValueError:
        vector = []
    if len(vector) != 3 or not all(map(math.isfinite, vector)) or not any(vector):
        got = " ".join(words)[:60] or "nothing"
        raise LightListError(
            "is not a light list", where=where, faults=[Fault("light", got, "three numbers x y z")]
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
