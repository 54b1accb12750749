"""Trait sliders for the page: changes of lobe shares, and factors of the albedo.

Surface traits move shares of few lobes to the nearest ones of at least 0, which the page finds
itself. What its way leaves out is measured against `model.traits.lobe_edits` and told:
`LobeTraits.held_error`. Traits of the albedo are in `albedo_trait_assets`.

References
----------
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 11.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from model.brdf import tables as brdf_tables
from model.brdf.tables import BrdfBasis
from model.traits import TraitSpace, lobe_edits, reduced_spaces
from model.traits import storage as trait_storage
from model.traits.vectors import MAX_P_VALUE, TraitVector
from skinrig.appearances import face_textures
from skinrig.arrays import Float32Array, Float64Array, FloatArray
from skinrig.editing import albedo as editing_albedo
from skinrig.editing import masks
from skinrig.traits import regions
from skinrig.viewer.assets import reflectance as reflectance_assets
from skinrig.viewer.assets.reflectance import LOBES_PER_LOOKUP, PageLobes, fill_texels
from skinrig.viewer.scene import Assets, SceneSource, Texture

DESCENT_SWEEPS: Final = 96
"""Of coordinate descent: after as many, errors stay within a few percent of a trait."""
MAX_ADDED_LOBES: Final = 4
"""Lobes that traits may bring: one more look-up for all of them."""
SAMPLED_TEXELS: Final = 400
"""Texels on which lobes are chosen and errors measured."""
OPPOSITE_TRAITS: Final = {"caucasian": "asian", "male": "female"}
"""Traits that are others the other way round."""


@dataclass(frozen=True, slots=True, eq=False)
class LobeTraits:
    """Traits of the surface on the lobes of a page.

    Attributes
    ----------
    lobes
        The face's lobes and those that traits brought.
    gram : ndarray of float32, shape (K, K)
        Cosines between the lobes under the library's metric.
    scale : ndarray of float32, shape (K,)
        Their lengths; 1 where there is none.
    pull : mapping of str to ndarray of float32, shape (K,)
        Products of each trait's vector with the lobes of length 1.
    misfit : mapping of str to float
        Share of each trait's vector that the lobes cannot show.
    held_error : mapping of str to (float, float)
        RMS length by which `apply_traits` misses `lobe_edits.edit_weights` at amounts -1 and 1,
        over the trait's length. It stops before it is there, and may bring no further lobe.
    """

    lobes: PageLobes
    gram: Float32Array
    scale: Float32Array
    pull: Mapping[str, Float32Array]
    misfit: Mapping[str, float]
    held_error: Mapping[str, tuple[float, float]]

    def apply_traits(self, weights: Float64Array, amounts: Mapping[str, float]) -> Float32Array:
        """Return the shares under some traits as the page computes them.

        Least squares over shares of at least 0 by `DESCENT_SWEEPS` sweeps of coordinate descent, in
        float32: the shares nearest to what is asked, from those given.

        Parameters
        ----------
        shares
            (T, K), at least 0.
        amounts
            Trait to amount.
        """
        given = np.asarray(weights, np.float32) * self.scale
        asked = np.zeros(len(self.scale), np.float32)
        for name, amount in amounts.items():
            asked += np.float32(amount) * self.pull[name]
        if not asked.any():
            return np.asarray(weights, np.float32)
        wanted = given @ self.gram + asked
        found = given.copy()
        for _ in range(DESCENT_SWEEPS):
            for k in range(len(self.scale)):
                step = wanted[:, k] - found @ self.gram[:, k]
                found[:, k] = np.maximum(found[:, k] + step, np.float32(0.0))
        return np.asarray(found / self.scale, np.float32)


def select_significant_traits(traits: Mapping[str, TraitVector]) -> tuple[str, ...]:
    """Return the traits that are worth a slider, in the library's order.

    Those that a permutation of the labels brings about as easily are left out, and of two opposite
    ones the second.
    """
    return tuple(
        name
        for name, trait in traits.items()
        if trait.confidence.p_value <= MAX_P_VALUE and OPPOSITE_TRAITS.get(name) not in traits
    )


def build_surface_traits(found: PageLobes) -> LobeTraits | None:
    """Return the surface traits of a page's lobes; None where the lobes are of other materials.

    Parameters
    ----------
    found
        Lobes with what they are mixtures of.
    """
    traits = trait_storage.load_packaged_traits().spaces["surface"]
    materials = brdf_tables.default_basis()
    if found.materials != materials.names or (traits.names and traits.names != materials.names):
        return None
    names = select_significant_traits(traits.traits)
    rows = _sample_texels(found.shares)
    mix = np.asarray(found.mix, np.float64)
    most = -(-len(mix) // LOBES_PER_LOOKUP) * LOBES_PER_LOOKUP + MAX_ADDED_LOBES
    for name in sorted(names, key=lambda one: -_length(traits, one)):
        widened = lobe_edits.edit_weights(_padded(rows, len(mix)), mix, traits, {name: 1.0})
        if len(widened.mix) <= most:
            mix = widened.mix
    times = reduced_spaces.times_metric(mix, traits.metric)
    gram = times @ mix.T
    scale = np.sqrt(np.maximum(np.diag(gram), 0.0))
    scale = np.where(scale > 0.0, scale, 1.0)
    cosines = gram / scale / scale[:, None]
    np.fill_diagonal(cosines, 1.0)
    height, width, count = found.shares.shape
    shares = np.zeros((height, width, len(mix)), np.float32)
    shares[..., :count] = found.shares
    mixed = materials.mix_materials(mix)
    table = np.array(mixed.table)
    table[..., :count] = found.lobes.table[..., :count]  # the face's own, bit for bit
    basis = BrdfBasis(table, mixed.names, found.lobes.light_radius_rad)
    lobes = dataclasses.replace(found, lobes=basis, shares=shares, mix=mix)
    pulls = {name: times @ traits.trait(name).vector / scale for name in names}
    single = {name: pull.astype(np.float32) for name, pull in pulls.items()}
    misfit = {name: _misfit(mix, traits, name) for name in names}
    metric = cosines.astype(np.float32), scale.astype(np.float32)
    made = LobeTraits(lobes, *metric, single, misfit, {})
    tried = _padded(rows, len(mix))
    errors = {
        name: (
            _held_out_error(made, tried, traits, name, -1.0),
            _held_out_error(made, tried, traits, name),
        )
        for name in names
    }
    return dataclasses.replace(made, held_error=errors)


def describe_surface_traits(traits: LobeTraits) -> dict[str, Any]:
    """Return what the page needs to know of surface traits; lobes and shares go with the lobes'."""
    found = {}
    for name, pull in traits.pull.items():
        errors = {"misfit": traits.misfit[name], "held_error": list(traits.held_error[name])}
        found[name] = {"pull": pull.tolist(), **errors}
    numbers = {"gram": traits.gram.reshape(-1).tolist(), "scale": traits.scale.tolist()}
    return {"sweeps": DESCENT_SWEEPS, **numbers, "traits": found}


def _sample_texels(weights: Float32Array) -> Float64Array:
    """Return at most `SAMPLED_TEXELS` texels with any share, evenly taken, (n, K)."""
    rows = weights.reshape(-1, weights.shape[-1]).astype(np.float64)
    rows = rows[rows.sum(axis=1) > 0.0]
    if not len(rows):
        return np.ones((1, weights.shape[-1]))
    return rows[:: -(-len(rows) // SAMPLED_TEXELS)]


def _padded(rows: Float64Array, count: int) -> Float64Array:
    return np.pad(rows, ((0, 0), (0, count - rows.shape[1])))


def _length(space: TraitSpace, name: str) -> float:
    return float(reduced_spaces.metric_lengths(space.trait(name).vector, space.metric))


def _misfit(mix: Float64Array, space: TraitSpace, name: str) -> float:
    frame = reduced_spaces.to_euclidean_frame(np.eye(mix.shape[1]), space.metric)
    vector = space.trait(name).vector @ frame
    z = np.linalg.lstsq((mix @ frame).T, vector, rcond=1e-10)[0]
    return float(np.linalg.norm(z @ mix @ frame - vector) / np.linalg.norm(vector))


def _held_out_error(
    made: LobeTraits, rows: Float64Array, space: TraitSpace, name: str, amount: float = 1.0
) -> float:
    page = made.apply_traits(rows, {name: amount}).astype(np.float64) @ made.lobes.mix
    edited = lobe_edits.edit_weights(rows, made.lobes.mix, space, {name: amount})
    off = reduced_spaces.metric_lengths(page - edited.weights @ edited.mix, space.metric)
    return float(np.sqrt(np.mean(np.square(off)))) / _length(space, name)


MAX_FACTOR_PX: Final = 128
"""Most texels a side of a factor's map; the common map that edits are made on has no more detail
over a face than this."""
END_AMOUNTS: Final = (-1, 1)
CHECKED_AMOUNT: Final = 0.5
MATCHING_ITERATIONS: Final = 1
"""Of matching. `skinrig edit` makes five: one is off those by 0.2 % of R_d for an edit by 24 %
(tan, the demo's dome), and takes a third of the time."""


@dataclass(frozen=True, slots=True, eq=False)
class AlbedoTraitLayers:
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


def build_albedo_traits(source: SceneSource) -> AlbedoTraitLayers | str:
    """Return the albedo traits of a fitted face, or why there are none.

    Parameters
    ----------
    source
        With the folder of an appearance "model" or "dome" that holds `position` and `r_d`.
    """
    path = next((source.paths[kind] for kind in ("model", "dome") if kind in source.paths), None)
    if path is None:
        return "albedo edits need a measured albedo: the map R_d of a dome session"
    face = face_textures.read(path)
    if not {"position", "r_d"} <= set(face.appearance.maps):
        return f"{path.name} has no maps position and r_d"
    library, _ = regions.load(None)
    parts = regions.open_library(library)
    space = parts.albedo["face"]
    names = select_significant_traits(space.traits.traits)
    r_d = face.r_d.values
    valid = face.r_d.mask
    chart = face.chart(parts.frame)
    region = masks.feather_region("face", parts.frame)

    def log_factor(name: str, amount: float) -> Float32Array:
        found = editing_albedo.edit_albedo(
            r_d,
            valid,
            chart,
            space,
            {name: amount},
            region=region > 0.0,
            weight=region,
            iterations=MATCHING_ITERATIONS,
            rng=np.random.default_rng([0, names.index(name)]),
        )
        return np.log(found.factor).astype(np.float32)

    layers, change, between = [], {}, {}
    for name in names:
        less, more = (log_factor(name, float(end)) for end in END_AMOUNTS)
        half = np.exp(log_factor(name, CHECKED_AMOUNT))
        layers += [fill_texels(one, valid, MAX_FACTOR_PX) for one in (less, more)]
        change[name] = _rms(np.exp(more[valid]) - 1.0)
        shown = _upsample(np.exp(CHECKED_AMOUNT * layers[-1]), valid.shape)
        between[name] = _rms((shown - half)[valid])
    return AlbedoTraitLayers(names, np.stack(layers), change, between)


def _upsample(values: Float32Array, shape: tuple[int, ...]) -> Float32Array:
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


def build_assets(source: SceneSource) -> Assets:
    """Return lobes with their shares, a diffusion profile, and trait sliders.

    Parameters
    ----------
    source
        A fitted appearance "model" or "dome" gives the face's own; others show the mean surface of
        the population that the packaged traits were learned from.

    Raises
    ------
    SkinReflectanceError, SurfaceMixtureError
        For a fitted folder that is damaged.
    """
    found = reflectance_assets.read_lobes(source)
    left_out: dict[str, str] = {}
    textures: dict[str, Texture] = {}
    facts: dict[str, Any] = {}
    names: list[str] = []
    surface = build_surface_traits(found)
    if surface is None:
        left_out["traits of the surface"] = (
            "the basis BRDFs of this fit differ from those of the traits"
        )
    else:
        found = surface.lobes
        facts["surface_traits"] = describe_surface_traits(surface)
        names += surface.pull
    albedo = build_albedo_traits(source)
    if isinstance(albedo, str):
        left_out["traits of the albedo"] = albedo
    else:
        textures["albedo_traits"] = albedo.texture()
        facts["albedo_traits"] = albedo.facts()
        names += [name for name in albedo.names if name not in names]
    base = reflectance_assets.build_lobe_assets(source, found)
    return {
        "textures": {**base["textures"], **textures},
        "params": {"traits": dict.fromkeys(names, 0.0)},
        "facts": {**base["facts"], **facts},
        "left_out": (*base["left_out"], *left_out.items()),
    }
