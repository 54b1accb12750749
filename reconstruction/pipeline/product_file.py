"""Store products of stages in a file: arrays as NPZ, the rest as JSON, never as pickle.

The file's only executable part is the choice of a dataclass, which must belong to the packages
`PRODUCT_PACKAGES`. ZIP checksums detect a file that was cut or changed.
"""

import dataclasses
import io
import json
import os
import uuid
import zipfile
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

PRODUCT_PACKAGES: Final = ("capture", "model", "reconstruction")
"""Packages whose dataclasses are stored by their fields."""
_DOCUMENT: Final = "document"


class UnstorableError(TypeError):
    """A product of a type that the file cannot contain."""


class DamagedFileError(ValueError):
    """A file that is not one of this module, or was cut or changed."""


def write_product(path: Path, value: Any) -> int:
    """Write a value to a file atomically; return its size in bytes.

    Parameters
    ----------
    path
        File, in an existing folder; an older one is replaced.
    value
        JSON values, tuples, bytes, NumPy arrays and scalars, mappings with any such keys, and
        dataclasses of `PRODUCT_PACKAGES`, nested.

    Raises
    ------
    UnstorableError
        When the value contains anything else.
    """
    arrays: list[NDArray[Any]] = []
    text = json.dumps(_encode(value, arrays, {})).encode()
    part = path.with_name(f"{path.name}.{uuid.uuid4().hex}.part")
    named = {str(number): array for number, array in enumerate(arrays)}
    try:
        with open(part, "xb") as stream:
            np.savez(stream, **{_DOCUMENT: np.frombuffer(text, np.uint8)}, **named)  # type: ignore[arg-type]
            size = stream.tell()
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return size


def read_product(path: Path) -> Any:
    """Read a value that `write_product` wrote, with the memory layout of its arrays.

    Raises
    ------
    DamagedFileError
        When the file is cut, changed or of another kind.
    """
    try:
        with zipfile.ZipFile(path) as file:
            members = {
                name.removesuffix(".npy"): _read_member(file, name) for name in file.namelist()
            }
        return _decode(json.loads(members[_DOCUMENT].tobytes()), members)
    # damaged headers raise errors of many types, in the ZIP reader as in NumPy's parser
    except Exception as error:
        raise DamagedFileError(
            f"{path}: cannot be read ({error}), expected stored products; remove the file"
        ) from error


def _read_member(file: zipfile.ZipFile, name: str) -> NDArray[Any]:
    # only a member that is read to its end is compared with its checksum
    content = io.BytesIO(file.read(name))
    array: NDArray[Any] = np.lib.format.read_array(content, allow_pickle=False)
    if content.read(1):
        raise ValueError(f"got {name} with bytes after its array, expected none")
    return array


def estimate_bytes(value: Any) -> int:
    """Return the size of a value's arrays and bytes, close to that of its file.

    Raises
    ------
    UnstorableError
        See `write_product`.

    Examples
    --------
    >>> estimate_bytes({"height": np.zeros((4, 2)), "unit": "um"})
    64
    """
    arrays: list[NDArray[Any]] = []
    _encode(value, arrays, {})
    return sum(array.nbytes for array in arrays)


def _encode(value: Any, arrays: list[NDArray[Any]], seen: dict[int, int]) -> Any:
    """Return JSON for a value; its arrays are appended to ``arrays``, each object once."""

    def nested(part: Any) -> Any:
        return _encode(part, arrays, seen)

    def stored(array: NDArray[Any], key: int) -> int:
        if array.dtype.hasobject:
            raise UnstorableError("got an array of objects, expected one of numbers")
        if key not in seen:
            seen[key] = len(arrays)
            arrays.append(array)
        return seen[key]

    if value is None or type(value) in (bool, int, float, str):
        return value
    if type(value) is list:
        return [nested(part) for part in value]
    if type(value) is tuple:
        return {"tuple": [nested(part) for part in value]}
    if isinstance(value, np.ndarray):
        # sums depend on the order of axes in memory, which NPZ alone does not keep
        axes = sorted(range(value.ndim), key=lambda axis: -abs(value.strides[axis]))
        return {"array": stored(value.transpose(axes), id(value)), "axes": axes}
    if isinstance(value, np.generic):
        return {"scalar": stored(np.asarray(value), id(value))}
    if type(value) is bytes:
        return {"bytes": stored(np.frombuffer(value, np.uint8), id(value))}
    if isinstance(value, Mapping):
        return {"mapping": [[nested(key), nested(part)] for key, part in value.items()]}
    kind = type(value)
    if dataclasses.is_dataclass(kind) and kind.__module__.split(".")[0] in PRODUCT_PACKAGES:
        if _find_record_type(kind.__module__, kind.__qualname__) is not kind:
            raise UnstorableError(f"got {kind.__qualname__}, expected a class at module level")
        parts = {field.name: nested(getattr(value, field.name)) for field in _fields(kind)}
        return {"record": f"{kind.__module__}:{kind.__qualname__}", "fields": parts}
    raise UnstorableError(f"got {kind.__module__}.{kind.__qualname__}, expected a storable type")


def _fields(kind: type) -> tuple[dataclasses.Field[Any], ...]:
    found = dataclasses.fields(kind)
    if not all(field.init for field in found):
        raise UnstorableError(f"got {kind.__qualname__}, expected fields that its call takes")
    return found


def _decode(value: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    if isinstance(value, list):
        return [_decode(part, arrays) for part in value]
    if not isinstance(value, dict):
        return value
    match value:
        case {"tuple": parts}:
            return tuple(_decode(part, arrays) for part in parts)
        case {"array": number, "axes": axes}:
            return arrays[str(number)].transpose(np.argsort(axes))
        case {"scalar": number}:
            return arrays[str(number)][()]
        case {"bytes": number}:
            return arrays[str(number)].tobytes()
        case {"mapping": pairs}:
            return {_decode(key, arrays): _decode(part, arrays) for key, part in pairs}
        case {"record": name, "fields": fields}:
            kind = _record_type(name)
            return kind(**{key: _decode(part, arrays) for key, part in fields.items()})
    raise ValueError(f"got an entry with {', '.join(value)}")


def _record_type(name: str) -> Any:
    module, _, kind = name.partition(":")
    if module.split(".")[0] not in PRODUCT_PACKAGES:
        raise ValueError(f"got a record {name!r} of another package")
    found = _find_record_type(module, kind)
    if not (isinstance(found, type) and dataclasses.is_dataclass(found)):
        raise ValueError(f"got {name!r}, expected a dataclass of that module")
    return found


def _find_record_type(module: str, kind: str) -> Any:
    """Return the object of that name if the module defines it at its top level, else None."""
    found = getattr(import_module(module), kind, None)
    place = getattr(found, "__module__", None), getattr(found, "__qualname__", None)
    return found if place == (module, kind) else None
