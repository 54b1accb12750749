"""Evaluate a face with wrinkles for any weights, and convert it to maps of an appearance.

Maps are `wrinkle_base` (n_x/n_z, n_y/n_z, 0), `wrinkle_map` in the same form and
`wrinkle_mask_<zone>` of the first wrinkle map, `wrinkle_<k>_map` and `wrinkle_<k>_mask_<zone>`
of others, zones numbered from 0; and the file `wrinkles.json` with names, tables and the clamp.
A model by differences of normals also has `wrinkle_difference`, which replaces the first map.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from model.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from model.checks import Checks
from model.checks.files import decode_json
from model.skin import SkinMap
from model.wrinkles import differences as wrinkle_differences
from model.wrinkles import partial_derivatives as wrinkles
from model.wrinkles.expressions import (
    ZONE_SUM_LIMITS,
    Clamp,
    ExpressionTable,
    Weights,
    WrinkleError,
    as_table,
    clamp_sums,
    zone_sums,
)
from model.wrinkles.partial_derivatives import WrinkleLayer

SCHEMA = "skinrig.wrinkles/1"
WRINKLE_FILE = "wrinkles.json"
DIFFERENCE_MAP = "wrinkle_difference"
DERIVATIVE_FRAME = "tangent space, +X right, +Y up; derivatives n_x/n_z, n_y/n_z"
NO_ERRORS: Mapping[str, tuple[float, ...]] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class WrinkledNormals:
    """Normals of a model for given weights.

    Attributes
    ----------
    normals : ndarray, shape (H, W, 3)
        Tangent-space unit normals; 0 where not valid.
    valid : ndarray of bool, shape (H, W)
        The base was measured there; holes of a wrinkle map add nothing and are not counted.
    zone_sums, zone_weights : tuple of ndarray, shape (Z,)
        Each layer's sums over blend shapes before and after the clamp.
    clamped_fraction : float
        Fraction of the texture in zones whose sum was clamped: the largest one of all layers.
    """

    normals: FloatArray
    valid: BoolArray
    zone_sums: tuple[Float64Array, ...]
    zone_weights: tuple[Float64Array, ...]
    clamped_fraction: float


@dataclass(frozen=True, slots=True)
class WrinkleModel:
    """A base map with wrinkle maps on top.

    Attributes
    ----------
    base : ndarray, shape (H, W, 2)
        Derivatives of the neutral face; 0 where not valid.
    layers : tuple of Layer
        Wrinkle maps with masks and tables.
    clamp : {"unit", "signed"}
        Range of a zone's sum over blend shapes.
    valid : ndarray of bool, shape (H, W), optional
        Where the base was measured; by default where it is finite.
    base_stderr : ndarray, shape (H, W, 2), optional
        Standard error of `base`.
    weight_stderr : mapping of str to tuple of float
        Standard error of the rows of the first layer's table that were fitted; infinite for a
        weight that was not determined.
    difference : ndarray, shape (h, w, 3), optional
        Difference of normals in [0, 1] of the only layer, as in `model.wrinkles.differences`. If
        given, it is evaluated instead of the layer's derivatives.
    """

    base: FloatArray
    layers: tuple[WrinkleLayer, ...]
    clamp: Clamp = "unit"
    valid: BoolArray | None = None
    base_stderr: FloatArray | None = None
    weight_stderr: Mapping[str, tuple[float, ...]] = field(default_factory=lambda: NO_ERRORS)
    difference: FloatArray | None = None

    def __post_init__(self) -> None:
        """Raise for shapes that do not fit; set unmeasured values to 0."""
        base = np.asarray(self.base)
        Checks(WrinkleError).shape("base", base, ("H", "W", 2))
        finite = np.asarray(np.isfinite(base).all(axis=2))
        valid = finite if self.valid is None else np.asarray(self.valid)
        Checks(WrinkleError).mask("valid", valid, base.shape[:2])
        Checks(WrinkleError).within("base at valid pixels", base[valid])
        Checks(WrinkleError).shape("base_stderr", self.base_stderr, base.shape)
        Checks(WrinkleError).choice("clamp", self.clamp, ZONE_SUM_LIMITS)
        object.__setattr__(self, "base", np.where(valid[..., None], base, base.dtype.type(0)))
        object.__setattr__(self, "valid", valid)
        object.__setattr__(self, "layers", tuple(self.layers))
        if self.difference is not None:
            single = len(self.layers) == 1
            Checks(WrinkleError).require(single, "layers", len(self.layers), "1 with differences")
            Checks(WrinkleError).shape("difference", np.asarray(self.difference), ("h", "w", 3))
            Checks(WrinkleError).within("difference", self.difference, "[0, 1]")
        errors = {name: tuple(map(float, row)) for name, row in self.weight_stderr.items()}
        object.__setattr__(self, "weight_stderr", MappingProxyType(errors))

    def evaluate(self, weights: Weights) -> WrinkledNormals:
        """Return the normals of the face for given weights.

        Parameters
        ----------
        weights : mapping of str to float, or array_like, shape (Z,)
            Blend shapes by name, or sums of the zones, as in `wrinkles.combine_layers`.

        Examples
        --------
        >>> layer = WrinkleLayer(np.full((2, 2, 2), 0.5), np.ones((8, 1, 1)))
        >>> face = WrinkleModel(np.zeros((4, 4, 2)), (layer,)).evaluate({"anger": 1.0})
        >>> face.zone_weights[0].tolist(), face.clamped_fraction
        ([0.0, 0.0, 0.0, 0.0, 0.8, 0.8, 1.0, 0.0], 1.0)
        """
        assert self.valid is not None  # noqa: S101
        sums = tuple(zone_sums(weights, layer.table) for layer in self.layers)
        held = tuple(clamp_sums(one, self.clamp) for one in sums)
        if self.difference is None:
            normals = wrinkles.combine_layers(self.base, self.layers, weights, clamp=self.clamp)
        else:
            (layer,) = self.layers
            normals = wrinkle_differences.combine(
                wrinkles.decode(self.base),
                self.difference,
                layer.masks,
                weights,
                clamp=self.clamp,
                table=layer.table,
            )
        normals[~self.valid] = 0.0
        parts = [
            float((layer.masks[before != after] > 0).any(axis=0).mean())
            for layer, before, after in zip(self.layers, sums, held, strict=True)
        ]
        return WrinkledNormals(normals, self.valid, sums, held, max(parts, default=0.0))

    def to_maps(self) -> tuple[dict[str, SkinMap], bytes]:
        """Return the maps and the bytes of `WRINKLE_FILE` for :meth:`from_maps`."""
        maps = {"wrinkle_base": _map(self.base, self.base_stderr, self.valid, "neutral")}
        layers: list[dict[str, Any]] = []
        for k, layer in enumerate(self.layers):
            table = as_table(layer.table)
            head = "wrinkle" if k == 0 else f"wrinkle_{k}"
            maps[f"{head}_map"] = _map(layer.wrinkle, layer.stderr, layer.valid, "what to add")
            names = [f"{head}_mask_{z}" for z in range(len(layer.masks))]
            zones = [*table.zones, *names][: len(names)]
            for name, mask, zone in zip(names, layer.masks, zones, strict=True):
                maps[name] = SkinMap(mask.astype(np.float32), "1", description=f"zone {zone}")
            layers.append(
                {
                    "map": f"{head}_map",
                    "masks": names,
                    "zones": list(table.zones),
                    "rows": {name: list(row) for name, row in table.rows.items()},
                    "source": table.source,
                }
            )
        if self.difference is not None:
            # stored without the bias of 0.5
            signed = (2.0 * self.difference - 1.0).astype(np.float32)
            note = "difference of tangent-space normals at full strength"
            maps[DIFFERENCE_MAP] = SkinMap(signed, "1", description=note)
        errors = {
            name: [value if math.isfinite(value) else None for value in row]
            for name, row in self.weight_stderr.items()
        }
        document = {
            "schema": SCHEMA,
            "frame": DERIVATIVE_FRAME,
            "clamp": self.clamp,
            "layers": layers,
            "weight_stderr": errors,
        }
        return maps, (json.dumps(document, indent=1, sort_keys=True) + "\n").encode()

    @classmethod
    def from_maps(cls, maps: Mapping[str, SkinMap], document: bytes) -> WrinkleModel:
        """Read a model from the maps and file of :meth:`to_maps`.

        Raises
        ------
        WrinkleError
            For a document of another kind, or a missing map.
        """
        try:
            given: Any = decode_json(document)
        except ValueError as error:
            raise WrinkleError(f"{WRINKLE_FILE}: got text that is not JSON: {error}") from error
        schema = given.get("schema") if isinstance(given, dict) else type(given).__name__
        if schema != SCHEMA:
            raise WrinkleError(f"{WRINKLE_FILE}: schema: got {schema!r}, expected {SCHEMA!r}")
        try:
            layers = tuple(_layer(entry, maps) for entry in given["layers"])
            errors = {
                name: tuple(math.inf if value is None else float(value) for value in row)
                for name, row in given["weight_stderr"].items()
            }
            base = _require_map(maps, "wrinkle_base")
            signed = maps.get(DIFFERENCE_MAP)
            return cls(
                base.values[..., :2],
                layers,
                given["clamp"],
                base.valid,
                None if base.stderr is None else base.stderr[..., :2],
                errors,
                None if signed is None else 0.5 + 0.5 * signed.values,
            )
        except WrinkleError:
            raise
        except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
            raise WrinkleError(
                f"{WRINKLE_FILE}: got keys or values of a wrong kind: {error!r}"
            ) from error


def _map(
    derivatives: FloatArray, stderr: FloatArray | None, valid: BoolArray | None, description: str
) -> SkinMap:
    def three(values: FloatArray) -> Float32Array:
        padding = ((0, 0), (0, 0), (0, 1))
        return np.pad(np.asarray(values, np.float32), padding)

    error = None if stderr is None else three(stderr)
    return SkinMap(three(derivatives), "1", error, valid, f"{description}: {DERIVATIVE_FRAME}")


def _layer(entry: Mapping[str, Any], maps: Mapping[str, SkinMap]) -> WrinkleLayer:
    wrinkle = _require_map(maps, entry["map"])
    masks = np.stack([_require_map(maps, name).values for name in entry["masks"]])
    table = ExpressionTable(tuple(entry["zones"]), entry["rows"], str(entry["source"]))
    stderr = None if wrinkle.stderr is None else wrinkle.stderr[..., :2]
    return WrinkleLayer(wrinkle.values[..., :2], masks, table, stderr, wrinkle.valid)


def _require_map(maps: Mapping[str, SkinMap], name: str) -> SkinMap:
    if name not in maps:
        raise WrinkleError(f"{WRINKLE_FILE}: map {name!r} is missing; export the model again")
    return maps[name]
