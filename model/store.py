"""Read and write APPEARANCE/ folders: one EXR file per map, other files, one sealed JSON document.

``appearance.json`` lists each file with its SHA-256 and contains a hash of its own content. A
folder is written completely or not at all. TRUTH/ folders have the same format.
"""

import hashlib
import io
import json
import math
import os
import re
import shutil
import uuid
from collections.abc import Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError

from model.arrays import Float32Array
from model.checks import Checks
from model.checks.files import decode_json, require_plausible_size
from model.skin import SkinAppearance, SkinMap

SCHEMA = "skinrig.appearance/2"
READABLE_SCHEMAS = (SCHEMA, "skinrig.appearance/1")
FORMER_MAP_NAMES = {"picture": "image", "specular_picture": "specular_image"}
"""Present name of a map by its name in version 1, which is read as if it had the present one."""
DOCUMENT_FILE = "appearance.json"
_NAME_PATTERN = re.compile(r"[a-z][a-z0-9_]{0,63}")


class StoreError(ValueError):
    """Error for an APPEARANCE/ folder that cannot be read or written."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class _FileEntry(_Strict):
    file: str
    sha256: str


class _MapEntry(_Strict):
    unit: str
    shape: list[int]
    description: str
    values: _FileEntry
    stderr: _FileEntry | None
    valid: _FileEntry | None


class _Document(_Strict):
    schema_: Literal["skinrig.appearance/2", "skinrig.appearance/1"] = Field(alias="schema")
    source: Literal["measured", "simulated"]
    seed: int | None
    maps: dict[str, _MapEntry]
    files: dict[str, str] = Field(default_factory=dict)
    parameters: dict[str, JsonValue]
    inputs: dict[str, str]
    versions: dict[str, str]
    left_out: list[tuple[str, str]]
    seal: str


def write(path: str | Path, appearance: SkinAppearance) -> Path:
    """Write an appearance as a folder, replacing an older one only when the new is complete.

    Parameters
    ----------
    path
        The folder. An existing APPEARANCE/ is replaced; any other existing folder is refused.
    appearance
        What to write.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    StoreError
        When ``path`` exists and is something else, or a map's name cannot be a file's.
    """
    target = Path(path)
    require_free(target)
    for name in appearance.maps:
        if not _NAME_PATTERN.fullmatch(name):
            raise StoreError(f"map name: got {name!r}, expected lower case letters, digits and _")
    target.parent.mkdir(parents=True, exist_ok=True)
    fresh = target.with_name(f".{target.name}.{uuid.uuid4().hex}.part")
    fresh.mkdir()
    try:
        document: dict[str, Any] = {
            "schema": SCHEMA,
            "source": appearance.source,
            "seed": appearance.seed,
            "maps": {n: _write_map(fresh, n, m) for n, m in sorted(appearance.maps.items())},
            "files": {n: _write_file(fresh / n, d) for n, d in sorted(appearance.files.items())},
            "parameters": dict(appearance.parameters),
            "inputs": dict(appearance.inputs),
            "versions": dict(appearance.versions),
            "left_out": [list(item) for item in appearance.left_out],
        }
        try:
            document["seal"] = _seal(document)
            text = json.dumps(document, indent=1, sort_keys=True, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise StoreError(f"parameters: cannot be written as JSON: {error}") from error
        _write_synced(fresh / DOCUMENT_FILE, text.encode("utf-8") + b"\n")
        _replace(fresh, target)
    except BaseException:
        shutil.rmtree(fresh, ignore_errors=True)
        raise
    return target


def require_free(path: str | Path) -> None:
    """Raise for a folder that `write` would refuse, before any computation.

    Parameters
    ----------
    path
        A new or empty folder, or an APPEARANCE/ folder.

    Raises
    ------
    StoreError
        When ``path`` exists and is something else, or its parent folder cannot be written to.
    """
    target = Path(path)
    if target.name in ("", ".."):
        raise StoreError(
            f"{target}: got a folder without a name of its own, expected one; give its full path"
        )
    if target.exists() and not (target / DOCUMENT_FILE).is_file() and any(_entries(target)):
        raise StoreError(
            f"{target}: exists and is not an APPEARANCE/ folder; nothing was written: name another"
            " [SR-REC-004]"
        )
    parent = next(folder for folder in target.absolute().parents if folder.exists())
    if not parent.is_dir():
        raise StoreError(f"{target}: {parent} is a file, expected a folder; name another")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise StoreError(
            f"{target}: {parent} cannot be written to; name another, or give the right"
        )


def read(path: str | Path, *, map_names: tuple[str, ...] | None = None) -> SkinAppearance:
    """Read an APPEARANCE/ or TRUTH/ folder and check every file that is read.

    Parameters
    ----------
    path
        The folder.
    only
        Names of the maps to load; None loads all.

    Raises
    ------
    StoreError
        When the folder is missing, damaged, of another schema version, or lacks a wanted map; names
        the file.
    """
    folder = Path(path)
    document = read_document(folder)
    names = tuple(document.maps) if map_names is None else map_names
    missing = [name for name in names if name not in document.maps]
    if missing:
        raise StoreError(
            f"{folder}: has no map {missing[0]!r}; it has {', '.join(sorted(document.maps))}: "
            "choose one of these [SR-REC-020]"
        )
    return SkinAppearance(
        maps={name: _read_map(folder, document.maps[name]) for name in names},
        source=document.source,
        parameters=document.parameters,
        inputs=document.inputs,
        versions=document.versions,
        left_out=tuple(document.left_out),
        files={
            name: _read_file(_inside(folder, name), sha) for name, sha in document.files.items()
        },
        seed=document.seed,
    )


def read_document(folder: Path) -> _Document:
    """Read and check ``appearance.json`` without loading any map."""
    path = folder / DOCUMENT_FILE
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise StoreError(
            f"{folder}: is not an APPEARANCE/ folder ({error.strerror}: {DOCUMENT_FILE}); "
            "`skinrig reconstruct` makes one [SR-REC-005]"
        ) from error
    try:
        loaded = decode_json(raw)
    except ValueError as error:
        raise StoreError(f"{path}: is not JSON ({error}); the folder is damaged") from error
    version = loaded.get("schema") if isinstance(loaded, dict) else None
    if version not in READABLE_SCHEMAS:
        raise StoreError(
            f"{path}: got schema {version!r}, expected one of {', '.join(READABLE_SCHEMAS)}; "
            "use the version of skinrig that wrote it"
        )
    try:
        document = _Document.model_validate_json(raw)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise StoreError(f"{path}: {where}: {first['msg']}") from error
    if _seal({k: v for k, v in loaded.items() if k != "seal"}) != document.seal:
        raise _changed_error(path, "seal")
    if version != SCHEMA:
        maps = {FORMER_MAP_NAMES.get(name, name): entry for name, entry in document.maps.items()}
        document = document.model_copy(update={"maps": maps})
    return document


def _entries(folder: Path) -> list[Path]:
    return list(folder.iterdir()) if folder.is_dir() else [folder]


def _seal(document: Mapping[str, Any]) -> str:
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def _write_synced(path: Path, data: bytes) -> None:
    with open(path, "xb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


def _replace(fresh: Path, target: Path) -> None:
    """Move ``fresh`` to ``target``; an older folder is kept until the new one is in place."""
    old = None
    if target.exists():
        old = target.with_name(f".{target.name}.{uuid.uuid4().hex}.old")
        os.rename(target, old)
    try:
        os.rename(fresh, target)
    except OSError:
        if old is not None:
            os.rename(old, target)
        raise
    if old is not None:
        shutil.rmtree(old, ignore_errors=True)


def _write_map(folder: Path, name: str, skin_map: SkinMap) -> dict[str, Any]:
    def one(suffix: str, image: NDArray[Any] | None) -> dict[str, str] | None:
        if image is None:
            return None
        file = f"{name}{suffix}.exr"
        write_exr(folder / file, image.astype(np.float32))
        return {"file": file, "sha256": _digest(folder / file)}

    return {
        "unit": skin_map.unit,
        "shape": list(skin_map.values.shape),
        "description": skin_map.description,
        "values": one("", skin_map.values),
        "stderr": one(".stderr", skin_map.stderr),
        "valid": one(".valid", skin_map.valid),
    }


def _read_map(folder: Path, entry: _MapEntry) -> SkinMap:
    def one(file: _FileEntry | None, shape: tuple[int, ...]) -> Float32Array | None:
        if file is None:
            return None
        path = _inside(folder, file.file)
        if _digest(path) != file.sha256:
            raise _changed_error(path, "hash")
        image = read_exr(path)
        Checks(StoreError).shape(str(path), image, shape)
        return image

    shape = tuple(entry.shape)
    values = one(entry.values, shape)
    valid = one(entry.valid, shape[:2])
    return SkinMap(
        values=values if values is not None else np.zeros(shape, np.float32),
        unit=entry.unit,
        stderr=one(entry.stderr, shape),
        valid=None if valid is None else valid > 0.5,
        description=entry.description,
    )


def _write_file(path: Path, data: bytes) -> str:
    _write_synced(path, data)
    return hashlib.sha256(data).hexdigest()


def _inside(folder: Path, name: str) -> Path:
    """Return the path of a file that a document names; it must be a plain name in the folder."""
    if Path(name).name != name or name.startswith("."):
        raise StoreError(f"{folder}: got file name {name!r}, expected a plain name")
    path = folder / name
    if path.is_symlink() or not path.is_file():
        raise StoreError(f"{path}: is missing; the folder is damaged")
    return path


def _read_file(path: Path, sha256: str) -> bytes:
    data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != sha256:
        raise _changed_error(path, "hash")
    return data


def _changed_error(path: Path, check: str) -> StoreError:
    return StoreError(
        f"{path}: was changed after it was written (its {check} does not fit); compute it again "
        "into a new folder [SR-REC-003]"
    )


def _digest(path: Path) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def write_exr(
    path: str | Path, image: Float32Array, *, attributes: Mapping[str, str] | None = None
) -> None:
    """Write (H, W) as channel Y or (H, W, 3) as RGB, float32, compressed without loss.

    Texts of `attributes` are written to the header.
    """
    import OpenEXR

    header: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        **(attributes or {}),
    }
    channel = "Y" if image.ndim == 2 else "RGB"
    pixels = np.ascontiguousarray(image, np.float32)
    with OpenEXR.File(header, {channel: pixels}) as file:
        try:
            file.write(str(path))
        except RuntimeError as error:  # the library's error for a full disk
            raise StoreError(f"{path}: cannot be written ({error}); is the disk full?") from error


EXR_MAGIC = b"v/1\x01"
"""First bytes of an OpenEXR file (technical introduction to OpenEXR, file layout)."""


def read_exr(path: str | Path) -> Float32Array:
    """Read an EXR file with channel Y or RGB as float32 (H, W) or (H, W, 3).

    Raises
    ------
    StoreError
        When the file is not an EXR of these channels.
    """
    return read_exr_with_attributes(path)[0]


def read_exr_with_attributes(path: str | Path) -> tuple[Float32Array, dict[str, str]]:
    """Read an EXR file like `read_exr`, and the texts of its header.

    Raises
    ------
    StoreError
        When the file is not an EXR of these channels.
    """
    import OpenEXR

    # checked here: the library's message is less specific, and it prints a line of its own
    try:
        with Path(path).open("rb") as stream:
            magic = stream.read(len(EXR_MAGIC))
    except OSError as error:
        raise StoreError(f"{path}: {error.strerror}, expected an OpenEXR image") from error
    if magic != EXR_MAGIC:
        raise StoreError(f"{path}: begins with {magic!r}, expected an OpenEXR image")
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            low, high = file.header()["dataWindow"]
            count = math.prod(int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
            require_plausible_size(4 * count, Path(path).stat().st_size)
        # the library prints what it cannot read, on stdout, and goes on
        with redirect_stdout(io.StringIO()) as printed, OpenEXR.File(str(path)) as file:
            if printed.getvalue():
                raise ValueError(printed.getvalue().strip())
            channels = file.channels()
            name = "RGB" if "RGB" in channels else "Y"
            if name not in channels:
                raise StoreError(
                    f"{path}: got channels {sorted(channels)}, expected Y or R, G and B"
                )
            pixels = np.array(channels[name].pixels, np.float32)
            texts = {k: v for k, v in file.header().items() if isinstance(v, str)}
    except StoreError:
        raise
    except Exception as error:  # the library raises bare RuntimeErrors of several kinds
        raise StoreError(f"{path}: cannot be read as EXR ({error})") from error
    return pixels, texts
