"""Read and write trait spaces as one npz file of arrays with a JSON document inside.

Spaces of long samples can be stored in fewer bits. The resulting error of each trait's vector is
measured while writing and stored in the document.
"""

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from model.arrays import Float64Array
from model.checks import Checks
from model.checks.files import decode_json, read_arrays
from model.traits import feasible_sets, reduced_spaces
from model.traits.space import TraitSpace
from model.traits.vectors import Confidence, TraitError, TraitVector

Precision = Literal["float64", "float32", "float16", "int8"]
Source = Literal["simulated", "measured"]

SCHEMA = "skinrig.traits/1"
PACKAGED_FILE = "trait_space.npz"
_SPACE_KEYS = ("kind", "samples", "lost", "seed")
_TRAIT_KEYS = ("name", "kind", "members", "others")
SCALE_BLOCK = 256
"""Numbers per common scale in 8 bits."""
_MIN_REDUCED_LENGTH = 1024  # samples of at least this length are stored in fewer bits


class TraitFileError(ValueError):
    """Error for a file without trait spaces, or with damaged ones."""


@dataclass(frozen=True, slots=True, eq=False)
class TraitLibrary:
    """Trait spaces of several kinds of samples, learned from one population.

    Attributes
    ----------
    spaces : mapping of str to TraitSpace
        By kind of sample, such as "surface" and "albedo".
    source : {"simulated", "measured"}
        Origin of the population.
    parameters : mapping of str to JSON values
        How the samples were made.
    files : mapping of str to bytes
        Files of the samples, such as a texture space.
    """

    spaces: Mapping[str, TraitSpace]
    source: Source
    parameters: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise for another source."""
        Checks(TraitError).choice("source", self.source, ("simulated", "measured"))

    @property
    def names(self) -> tuple[str, ...]:
        """Return all traits of all spaces in alphabetical order."""
        return tuple(sorted({name for space in self.spaces.values() for name in space.traits}))

    def to_bytes(self, *, precision: Precision = "float32") -> bytes:
        """Return the library as one npz file.

        Parameters
        ----------
        precision : {"float64", "float32", "float16", "int8"}
            Precision of long samples (1024 numbers and more); shorter ones are stored in float64.
            "int8": each run of 256 numbers in steps of 1/127 of its largest.

        Examples
        --------
        >>> space = TraitSpace.fit([[0.2, 1.0], [0.6, 1.0]], {"red": [False, True]})
        >>> stored = TraitLibrary({"color": space}, "simulated").to_bytes()
        >>> from_bytes(stored).names
        ('red',)
        """
        arrays: dict[str, NDArray[Any]] = {}
        document: dict[str, Any] = {
            "schema": SCHEMA,
            "source": self.source,
            "parameters": dict(self.parameters),
            "files": sorted(self.files),
            "spaces": {},
        }
        for name, space in self.spaces.items():
            used: Precision = precision if len(space.center) >= _MIN_REDUCED_LENGTH else "float64"
            document["spaces"][name] = _packed(f"{name}/", space, used, arrays)
        for name, content in self.files.items():
            arrays[f"files/{name}"] = np.frombuffer(content, np.uint8)
        try:
            text = json.dumps(document, sort_keys=True, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise TraitError(f"parameters: cannot be written as JSON: {error}") from error
        arrays["document"] = np.frombuffer(text.encode("utf-8"), np.uint8)
        stream = io.BytesIO()
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
        return stream.getvalue()

    def save(self, path: str | Path, *, precision: Precision = "float32") -> None:
        """Write the file for `load`; ``path`` is used unchanged."""
        Path(path).write_bytes(self.to_bytes(precision=precision))


@cache
def load_packaged_traits() -> TraitLibrary:
    """Return the packaged traits, learned from a simulated population.

    `tools/make_trait_space.py` makes them; `parameters` describes the population and the cosines to
    the simulator's ground truth.
    """
    return from_bytes(resources.files("model").joinpath("data", PACKAGED_FILE).read_bytes())


def load(path: str | Path) -> TraitLibrary:
    """Read a file of trait spaces.

    Raises
    ------
    TraitFileError
        For a file that cannot be read or does not contain any.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise TraitFileError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        return from_bytes(content)
    except TraitFileError as error:
        raise TraitFileError(f"{path}: {error}") from error


def from_bytes(content: bytes) -> TraitLibrary:
    """Return the library that `TraitLibrary.to_bytes` stored.

    Raises
    ------
    TraitFileError
        For bytes that do not contain any, or another version's.
    """
    try:
        arrays = read_arrays(content)
        document = decode_json(arrays["document"].tobytes())
        schema = document["schema"]
    except (KeyError, ValueError, TypeError) as error:
        raise TraitFileError(
            "got no trait spaces, expected a file of `skinrig fit traits`"
        ) from error
    if schema != SCHEMA:
        raise TraitFileError(
            f"schema: got {schema!r}, expected {SCHEMA!r}; another version wrote it"
        )
    try:
        return TraitLibrary(
            {
                name: _unpacked(f"{name}/", entry, arrays)
                for name, entry in document["spaces"].items()
            },
            document["source"],
            document["parameters"],
            {name: arrays[f"files/{name}"].tobytes() for name in document["files"]},
        )
    except (KeyError, ValueError, TypeError, IndexError, AttributeError) as error:
        raise TraitFileError(f"damaged: {error}") from error


def _packed(
    prefix: str, space: TraitSpace, precision: Precision, arrays: dict[str, NDArray[Any]]
) -> dict[str, Any]:
    names = list(space.traits)
    found = list(space.traits.values())
    values: dict[str, Float64Array] = {
        "center": space.center,
        "basis": space.basis,
        "vectors": np.array([t.vector for t in found]).reshape(len(found), -1),
        "stderr": np.array([t.stderr for t in found]).reshape(len(found), -1),
    }
    for key, value in values.items():
        # The center is not a small difference like the directions: 8 bits would change it visibly.
        bits: Precision = "float16" if precision == "int8" and key == "center" else precision
        arrays.update(_encoded(prefix + key, value, bits))
    arrays[prefix + "coordinates"] = np.array([t.coordinates for t in found])
    if space.metric is not None:
        arrays[prefix + "metric"] = space.metric
    errors = {}
    back = _decoded(prefix + "vectors", arrays)
    for k, name in enumerate(names):
        size = float(reduced_spaces.metric_lengths(found[k].vector, space.metric))
        read = back[k] if precision == "float64" else space.feasible.tangent(back[k])
        gap = read - found[k].vector
        miss = float(reduced_spaces.metric_lengths(gap, space.metric))
        errors[name] = miss / size if size > 0.0 else 0.0
    return {
        **{key: getattr(space, key) for key in _SPACE_KEYS},
        "feasible": space.feasible.document(),
        "names": list(space.names),
        "notes": dict(space.notes),
        "precision": precision,
        "storage_error": errors,
        "traits": [
            {
                **{key: getattr(t, key) for key in _TRAIT_KEYS},
                "p_value": t.confidence.p_value,
                "expected_cosine": t.confidence.expected_cosine,
                "bootstrap_cosine": list(t.confidence.bootstrap_cosine),
                "relative_noise": None
                if np.isinf(t.confidence.relative_noise)
                else t.confidence.relative_noise,
                "confounded": [[name, r] for name, r in t.confounded],
                "warnings": list(t.warnings),
            }
            for t in found
        ],
    }


def _unpacked(
    prefix: str, entry: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> TraitSpace:
    feasible = feasible_sets.from_document(entry["feasible"])
    center, basis, vectors, stderr = (
        _decoded(prefix + key, arrays) for key in ("center", "basis", "vectors", "stderr")
    )
    if entry["precision"] != "float64":
        center = feasible.project(center)
        vectors = np.array([feasible.tangent(v) for v in vectors]).reshape(vectors.shape)
    coordinates = arrays[prefix + "coordinates"]
    traits = {}
    for k, one in enumerate(entry["traits"]):
        noise = one["relative_noise"]
        low, middle, high = one["bootstrap_cosine"]
        traits[one["name"]] = TraitVector(
            **{key: one[key] for key in _TRAIT_KEYS},
            vector=vectors[k],
            stderr=stderr[k],
            coordinates=coordinates[k],
            confidence=Confidence(
                one["p_value"],
                one["expected_cosine"],
                (low, middle, high),
                float("inf") if noise is None else noise,
            ),
            confounded=tuple((name, r) for name, r in one["confounded"]),
            warnings=tuple(one["warnings"]),
        )
    metric = arrays.get(prefix + "metric")
    return TraitSpace(
        **{key: entry[key] for key in _SPACE_KEYS},
        center=center,
        basis=basis,
        traits=traits,
        feasible=feasible,
        metric=None if metric is None else np.asarray(metric, np.float64),
        names=tuple(entry["names"]),
        notes=entry["notes"],
        storage_error=entry["storage_error"],
    )


def _encoded(key: str, values: Float64Array, precision: Precision) -> dict[str, NDArray[Any]]:
    if precision != "int8":
        return {key: values.astype(precision)}
    width = values.shape[-1]
    padded = np.zeros((*values.shape[:-1], -(-width // SCALE_BLOCK) * SCALE_BLOCK))
    padded[..., :width] = values
    runs = padded.reshape(*values.shape[:-1], -1, SCALE_BLOCK)
    scale = (np.abs(runs).max(axis=-1, keepdims=True) / 127.0).astype(np.float32)
    steps = np.rint(runs / np.where(scale > 0.0, scale, 1.0)).astype(np.int8)
    return {key: steps.reshape(padded.shape)[..., :width], f"{key}/scale": scale[..., 0]}


def _decoded(key: str, arrays: Mapping[str, NDArray[Any]]) -> Float64Array:
    values = arrays[key].astype(np.float64)
    scale = arrays.get(f"{key}/scale")
    if scale is None:
        return values
    return np.asarray(values * np.repeat(scale, SCALE_BLOCK, axis=-1)[..., : values.shape[-1]])
