"""Read and write tensor files: named arrays in one file, the container of RGL's .bsdf materials.

Little-endian: ``tensor_file`` and a zero, version 1.0, the number of fields; for each name, number
of dimensions, type, offset in the file and shape; then the arrays.

References
----------
Dupuy and Jakob 2018, doi:10.1145/3272127.3275059 (the materials; Mitsuba's ``tensor_io`` reads the
same container).
"""

import math
import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

TENSOR_MAGIC = b"tensor_file\0"
FILE_VERSION = (1, 0)
ALIGNMENT_BYTES = 8
MAX_FIELDS = 4096
TYPE_NAMES = ("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")
"""NumPy's names of the types, whose numbers in the file start at 1."""


class TensorFileError(ValueError):
    """Error for a file that is not a tensor file, or only part of one."""


def read(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    """Read all arrays of a file.

    Returns
    -------
    dict
        By name, in the file's order.

    Raises
    ------
    TensorFileError
        When the file is not a tensor file, of another version, or ends before an array that it
        lists.
    """
    file = Path(path)
    size = file.stat().st_size
    with file.open("rb") as stream:
        if stream.read(len(TENSOR_MAGIC)) != TENSOR_MAGIC:
            raise TensorFileError(f"{file}: is not a tensor file; give an RGL .bsdf")
        version = _unpack(stream, "<BB", file)
        if version != FILE_VERSION:
            raise TensorFileError(f"{file}: got version {version}, expected {FILE_VERSION}")
        (count,) = _unpack(stream, "<I", file)
        if count > MAX_FIELDS:
            raise TensorFileError(f"{file}: got {count} fields, expected at most {MAX_FIELDS}")
        heads = [_head(stream, file) for _ in range(count)]
        arrays: dict[str, NDArray[Any]] = {}
        for name, dtype, offset, shape in heads:
            values = math.prod(shape)
            if offset + values * dtype.itemsize > size:
                raise TensorFileError(
                    f"{file}: truncated: {name} ends at byte {offset + values * dtype.itemsize}, "
                    f"got {size} bytes"
                )
            stream.seek(offset)
            arrays[name] = np.fromfile(stream, dtype, values).reshape(shape)
    return arrays


def write(path: str | os.PathLike[str], fields: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays, in the mapping's order, each at a multiple of 8 bytes.

    Raises
    ------
    TensorFileError
        When the format does not have an array's type.
    """
    arrays = {}
    for name, array in fields.items():
        stored = np.dtype(array.dtype).newbyteorder("<")
        if stored not in [np.dtype(known) for known in TYPE_NAMES]:
            raise TensorFileError(f"{name}: got type {array.dtype}, expected integers or floats")
        arrays[name] = np.ascontiguousarray(array, stored)
    labels = {name: name.encode() for name in arrays}
    place = len(TENSOR_MAGIC) + 6 + sum(13 + len(labels[n]) + 8 * a.ndim for n, a in arrays.items())
    with Path(path).open("wb") as stream:
        stream.write(TENSOR_MAGIC + struct.pack("<BBI", *FILE_VERSION, len(arrays)))
        places = []
        for name, array in arrays.items():
            place = -(-place // ALIGNMENT_BYTES) * ALIGNMENT_BYTES
            places.append(place)
            number = [np.dtype(known) for known in TYPE_NAMES].index(array.dtype) + 1
            label = labels[name]
            stream.write(struct.pack("<H", len(label)) + label)
            stream.write(struct.pack(f"<HBQ{array.ndim}Q", array.ndim, number, place, *array.shape))
            place += array.nbytes
        for start, array in zip(places, arrays.values(), strict=True):
            stream.write(b"\0" * (start - stream.tell()))
            array.tofile(stream)


def _head(stream: BinaryIO, file: Path) -> tuple[str, np.dtype[Any], int, tuple[int, ...]]:
    (length,) = _unpack(stream, "<H", file)
    label = stream.read(length)
    dimensions, number, offset = _unpack(stream, "<HBQ", file)
    shape = _unpack(stream, f"<{dimensions}Q", file)
    if not 1 <= number <= len(TYPE_NAMES):
        raise TensorFileError(
            f"{file}: {label!r}: got type {number}, expected 1 to {len(TYPE_NAMES)}"
        )
    return label.decode("utf-8", "replace"), np.dtype(TYPE_NAMES[number - 1]), offset, shape


def _unpack(stream: BinaryIO, layout: str, file: Path) -> tuple[int, ...]:
    wanted = struct.calcsize(layout)
    content = stream.read(wanted)
    if len(content) != wanted:
        raise TensorFileError(f"{file}: truncated among its fields' names")
    return struct.unpack(layout, content)
