"""Traits of the albedo for the page: end points of the editor, blended along the logarithm.

Matching an albedo to other statistics takes seconds, so it is done beforehand, for more and for
less of each trait. Between the ends the page goes along the logarithm of the factor. What that
misses is measured at half a trait, against an edit by half, and told.

References
----------
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 11.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from skinrig.appearances import face_textures
from skinrig.arrays import BoolArray, Float32Array, FloatArray
from skinrig.editing import albedo as editing_albedo
from skinrig.editing import masks
from skinrig.traits import regions
from skinrig.viewer.assets.reflectance import filled
from skinrig.viewer.assets.traits import distinct_from_chance
from skinrig.viewer.scene import SceneSource, Texture

MAX_FACTOR_PX: Final = 128
"""Most texels a side of a factor's map; the common map that edits are made on has no more detail
over a face than this."""
END_AMOUNTS: Final = (-1, 1)
CHECKED_AMOUNT: Final = 0.5
MATCHING_ITERATIONS: Final = 1
"""Of matching. `skinrig edit` makes five: one is off those by 0.2 % of R_d for an edit by 24 %
(tan, the demo's dome), and takes a third of the time."""


@dataclass(frozen=True, slots=True, eq=False)
class AlbedoTraits:
    """End points of traits over a texture.

    Attributes
    ----------
    names
        Of the traits; layer 2 i is less of trait i, layer 2 i + 1 more.
    log_factor : ndarray of float32, shape (L, H, W, 3)
        Logarithm of the factor of R_d at amounts -1 and 1.
    change : mapping of str to float
        RMS of the factor at 1 less 1, over the valid texels.
    between_error : mapping of str to float
        RMS by which the blend at half the trait misses the edit by half, in shares of R_d.
    """

    names: tuple[str, ...]
    log_factor: Float32Array
    change: Mapping[str, float]
    between_error: Mapping[str, float]

    def factor(self, amounts: Mapping[str, float]) -> Float32Array:
        """Return the factor of the albedo under some traits, (H, W, 3), as the page computes it."""
        total = np.zeros(self.log_factor.shape[1:], np.float32)
        for i, name in enumerate(self.names):
            amount = float(amounts.get(name, 0.0))
            total += np.float32(abs(amount)) * self.log_factor[2 * i + (amount > 0.0)]
        return np.exp(total)

    def texture(self) -> Texture:
        """Return the layers as a texture."""
        return Texture(self.log_factor, "u8")

    def facts(self) -> dict[str, Any]:
        """Return what the page says of them."""
        return {
            "layers": [{"name": name, "end": end} for name in self.names for end in END_AMOUNTS],
            "traits": {
                name: {"change": self.change[name], "between_error": self.between_error[name]}
                for name in self.names
            },
        }


def albedo_traits(source: SceneSource) -> AlbedoTraits | str:
    """Return the albedo traits of a fitted face, or why there are none.

    Parameters
    ----------
    source
        With the folder of an appearance "model" or "dome" that holds `position` and `r_d`.
    """
    path = next((source.paths[kind] for kind in ("model", "dome") if kind in source.paths), None)
    if path is None:
        return "edits of an albedo need one that was measured: the map R_d of a dome's session"
    face = face_textures.read(path)
    if not {"position", "r_d"} <= set(face.appearance.maps):
        return f"{path.name} has no maps position and r_d"
    library, _ = regions.load(None)
    parts = regions.parts_of(library)
    space = parts.albedo["face"]
    names = distinct_from_chance(space.traits.traits)
    r_d = face.r_d.values
    valid = face_textures.valid_of(face.r_d)
    chart = face.chart(parts.frame)
    region = masks.feathered("face", parts.frame)

    def log_factor(name: str, amount: float) -> Float32Array:
        found = editing_albedo.edit_albedo(
            r_d,
            valid,
            chart,
            space,
            {name: amount},
            region=region > 0.0,
            share=region,
            iterations=MATCHING_ITERATIONS,
            rng=np.random.default_rng([0, names.index(name)]),
        )
        return np.log(found.factor).astype(np.float32)

    layers, change, between = [], {}, {}
    for name in names:
        less, more = (log_factor(name, float(end)) for end in END_AMOUNTS)
        half = np.exp(log_factor(name, CHECKED_AMOUNT))
        layers += [_coarse(less, valid), _coarse(more, valid)]
        change[name] = _rms(np.exp(more[valid]) - 1.0)
        shown = _refined(np.exp(CHECKED_AMOUNT * layers[-1]), valid.shape)
        between[name] = _rms((shown - half)[valid])
    return AlbedoTraits(names, np.stack(layers), change, between)


def _coarse(values: Float32Array, valid: BoolArray) -> Float32Array:
    return filled(values, valid, MAX_FACTOR_PX)


def _refined(values: Float32Array, shape: tuple[int, ...]) -> Float32Array:
    """Return a map at more texels, linear between the centres, as the page samples it."""
    for axis, size in enumerate(shape[:2]):
        old = values.shape[axis]
        place = np.clip((np.arange(size) + 0.5) * old / size - 0.5, 0.0, old - 1.0)
        low = np.minimum(place.astype(np.intp), max(old - 2, 0))
        part = (place - low).astype(np.float32).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        high = np.minimum(low + 1, old - 1)
        values = values.take(low, axis) * (1.0 - part) + values.take(high, axis) * part
    return values


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values.astype(np.float64)))))
