"""Decode JSON texts and NumPy archives of strangers: limits first, one error.

A file may declare more than it contains. Nothing is allocated before the declared size has been
compared with the stored one, and pickled objects are never loaded.
"""

import io
import json
import math
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

MAX_EXPANSION = 1100
"""Largest ratio of unpacked to packed bytes; that of deflate is 1032 (RFC 1951)."""
READABLE_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compressions that numpy writes, and for which `MAX_EXPANSION` holds."""
HEADER_ERRORS = (
    *(MemoryError, OverflowError, SyntaxError, TypeError, KeyError, RecursionError),
    tokenize.TokenError,
)
"""What NumPy raises for a damaged header of an array, besides ValueError."""
MIN_UNPACKED_BYTES = 2**20
"""Unpacked size that any file may have."""


def decode_json(text: str | bytes) -> Any:
    """Decode JSON without NaN, infinities and doubled keys.

    Raises
    ------
    ValueError
        For any other text, and for one that is nested too deeply.

    Examples
    --------
    >>> decode_json('{"a": [1, 2]}')
    {'a': [1, 2]}
    >>> decode_json('{"a": 1, "a": 2}')
    Traceback (most recent call last):
        ...
    ValueError: key 'a' is twice in one object
    >>> decode_json('{"a": 1e999}')
    Traceback (most recent call last):
        ...
    ValueError: got 1e999, expected a finite number
    """

    def parse_finite(digits: str) -> float:
        value = float(digits)
        return value if math.isfinite(value) else refuse_constant(digits)

    def refuse_constant(name: str) -> NoReturn:
        raise ValueError(f"got {name}, expected a finite number")

    def refuse_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        table: dict[str, Any] = {}
        for key, value in pairs:
            if key in table:
                raise ValueError(f"key {key!r} is twice in one object")
            table[key] = value
        return table

    try:
        decoded = text.decode("utf-8") if isinstance(text, bytes) else text
        return json.loads(
            decoded,
            parse_float=parse_finite,
            parse_constant=refuse_constant,
            object_pairs_hook=refuse_doubles,
        )
    except RecursionError as error:
        raise ValueError("is nested too deeply") from error


def require_plausible_size(unpacked_bytes: int, packed_bytes: int) -> None:
    """Raise ValueError when data declare more bytes than their packed form can store."""
    limit = MAX_EXPANSION * packed_bytes + MIN_UNPACKED_BYTES
    if not 0 <= unpacked_bytes <= limit:
        raise ValueError(
            f"declares {unpacked_bytes} bytes, {packed_bytes} stored bytes hold at most {limit}"
        )


def read_arrays(source: str | Path | bytes) -> dict[str, NDArray[Any]]:
    """Read all arrays of an .npz archive.

    Parameters
    ----------
    source
        Path of the archive, or its content.

    Returns
    -------
    dict of str to ndarray
        Arrays by name.

    Raises
    ------
    ValueError
        For a damaged archive, a compression that numpy does not write, pickled objects, a name
        twice, or sizes that do not fit.
    OSError
        When the file cannot be read.

    Examples
    --------
    >>> content = io.BytesIO()
    >>> np.savez_compressed(content, a=np.arange(3))
    >>> read_arrays(content.getvalue())["a"].tolist()
    [0, 1, 2]
    """
    try:
        with zipfile.ZipFile(io.BytesIO(source) if isinstance(source, bytes) else source) as found:
            entries = found.infolist()
            names = [entry.filename.removesuffix(".npy") for entry in entries]
            if len(set(names)) != len(names):
                raise ValueError("an array is twice in it")
            for entry in entries:
                if entry.compress_type not in READABLE_COMPRESSIONS:
                    raise ValueError(
                        f"{entry.filename}: got compression {entry.compress_type}, expected none "
                        "or deflate; write it with numpy"
                    )
            packed = sum(entry.compress_size for entry in entries)
            require_plausible_size(sum(entry.file_size for entry in entries), packed)
            return {
                name: _read_array(found, entry) for name, entry in zip(names, entries, strict=True)
            }
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(f"is not a readable archive: {error}") from error
    except HEADER_ERRORS as error:
        raise ValueError(f"has an unreadable array: {error!r}") from error


def map_array(path: Path) -> NDArray[Any]:
    """Map an .npy file into memory, read-only.

    Raises
    ------
    ValueError
        For another file, a damaged header, pickled objects, or a size that does not fit.
    OSError
        When the file cannot be read.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "heights.npy"
    >>> np.save(path, np.zeros((2, 3), np.float32))
    >>> map_array(path).shape
    (2, 3)
    """
    stored_bytes = path.stat().st_size
    try:
        with path.open("rb") as stream:
            header = _read_header(stream, path.name, stored_bytes)
            offset = stream.tell()
    except HEADER_ERRORS as error:
        raise ValueError(f"has an unreadable header: {error!r}") from error
    if header.stored_bytes != stored_bytes - offset:
        raise ValueError(
            f"got {stored_bytes - offset} bytes of values, expected {header.stored_bytes}"
        )
    if not header.stored_bytes:
        return np.empty(header.shape, header.dtype)
    order: Literal["C", "F"] = "F" if header.is_fortran else "C"
    return np.memmap(path, header.dtype, "r", offset, header.shape, order)


class _Header(NamedTuple):
    shape: tuple[int, ...]
    is_fortran: bool
    dtype: np.dtype[Any]

    @property
    def stored_bytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


def _read_header(stream: IO[bytes], name: str, most_bytes: int) -> _Header:
    """Read the header of one array, of which the file has at most some bytes."""
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        header = _Header(*np.lib.format.read_array_header_1_0(stream))
    elif version == (2, 0):
        header = _Header(*np.lib.format.read_array_header_2_0(stream))
    else:
        raise ValueError(f"{name}: got version {version}, expected 1.0 or 2.0")
    if header.dtype.hasobject:
        raise ValueError(f"{name}: contains pickled objects")
    if any(length < 0 for length in header.shape):
        raise ValueError(f"{name}: got shape {header.shape}")
    if header.stored_bytes > most_bytes:
        raise ValueError(f"{name}: declares {header.stored_bytes} bytes, its file has {most_bytes}")
    return header


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    with archive.open(entry) as stream:
        header = _read_header(stream, entry.filename, entry.file_size)
        data = stream.read()
    if len(data) != header.stored_bytes:
        raise ValueError(f"{entry.filename}: got {len(data)} bytes, expected {header.stored_bytes}")
    flat = np.frombuffer(data, header.dtype).copy()
    return flat.reshape(header.shape, order="F" if header.is_fortran else "C")
