"""Build the page's trait sliders: edits of BRDF weights, and factors of the albedo.

Surface traits change the weights of the basis BRDFs; the page solves for the nearest non-negative
weights. `LobeTraits.held_error` reports its error relative to `model.traits.lobe_edits`. Albedo
traits are layers of factors, see `AlbedoTraitLayers`.

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
"""Sweeps of coordinate descent, after which errors are within a few percent of a trait."""
MAX_ADDED_LOBES: Final = 4
"""Maximum number of basis BRDFs added by traits; they need one more look-up."""
SAMPLED_TEXELS: Final = 400
"""Number of texels for the choice of added basis BRDFs and for error estimates."""
OPPOSITE_TRAITS: Final = {"caucasian": "asian", "male": "female"}
"""Traits that are the opposite of another trait."""


@dataclass(frozen=True, slots=True, eq=False)
class LobeTraits:
    """Surface traits in terms of a page's basis BRDFs.

    Attributes
    ----------
    lobes
        Basis BRDFs of the face, and those added by traits.
    gram : ndarray of float32, shape (K, K)
        Cosines between the basis BRDFs under the library's metric.
    scale : ndarray of float32, shape (K,)
        Norms of the basis BRDFs; 1 for unused entries.
    pull : mapping of str to ndarray of float32, shape (K,)
        Products of each trait's vector with the normalized basis BRDFs.
    misfit : mapping of str to float
        Fraction of each trait's vector that the basis BRDFs do not represent.
    held_error : mapping of str to (float, float)
        RMS difference of `apply_traits` from `lobe_edits.edit_weights` at amounts -1 and 1,
        relative to the trait's norm. The descent is truncated, and cannot add further basis BRDFs.
    """

    lobes: PageLobes
    gram: Float32Array
    scale: Float32Array
    pull: Mapping[str, Float32Array]
    misfit: Mapping[str, float]
    held_error: Mapping[str, tuple[float, float]]

    def apply_traits(self, weights: Float64Array, amounts: Mapping[str, float]) -> Float32Array:
        """Return the edited weights as the page computes them.

        Non-negative least squares for the target weights by `DESCENT_SWEEPS` sweeps of coordinate
        descent in float32, starting from the given weights.

        Parameters
        ----------
        weights
            (T, K), at least 0.
        amounts
            Amount by trait.
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
    """Select the traits with a slider, in the library's order.

    Traits that are not significant in the permutation test are omitted, and the second of two
    opposite ones.
    """
    return tuple(
        name
        for name, trait in traits.items()
        if trait.confidence.p_value <= MAX_P_VALUE and OPPOSITE_TRAITS.get(name) not in traits
    )


def build_surface_traits(found: PageLobes) -> LobeTraits | None:
    """Build the surface traits of a page; None if its basis BRDFs are of other materials.

    Parameters
    ----------
    found
        Basis BRDFs with their mixtures of materials.
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
    table[..., :count] = found.lobes.table[..., :count]  # the face's own, bit-identical
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
    """Return the page's data of surface traits; basis BRDFs and weights are separate assets."""
    found = {}
    for name, pull in traits.pull.items():
        errors = {"misfit": traits.misfit[name], "held_error": list(traits.held_error[name])}
        found[name] = {"pull": pull.tolist(), **errors}
    numbers = {"gram": traits.gram.reshape(-1).tolist(), "scale": traits.scale.tolist()}
    return {"sweeps": DESCENT_SWEEPS, **numbers, "traits": found}


def _sample_texels(weights: Float32Array) -> Float64Array:
    """Sample at most `SAMPLED_TEXELS` texels with positive weights at equal steps, (n, K)."""
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
"""Maximum side of a factor map; the common map of edits does not have more detail on a face."""
END_AMOUNTS: Final = (-1, 1)
CHECKED_AMOUNT: Final = 0.5
MATCHING_ITERATIONS: Final = 1
"""Iterations of matching. `skinrig edit` uses five: one deviates from these by 0.2 % of R_d for an
edit of 24 % (tan, dome of the demo) in a third of the time."""


@dataclass(frozen=True, slots=True, eq=False)
class AlbedoTraitLayers:
    """Albedo factors of traits at amounts -1 and 1 over a texture.

    Attributes
    ----------
    names
        Names of the traits; layer 2 i is amount -1 of trait i, layer 2 i + 1 is amount 1.
    log_factor : ndarray of float32, shape (L, H, W, 3)
        Logarithm of the factor of R_d at amounts -1 and 1.
    change : mapping of str to float
        RMS of the factor at amount 1, minus 1, over the valid texels.
    between_error : mapping of str to float
        RMS difference of the blended factor at amount 0.5 from the edit, fraction of R_d.
    """

    names: tuple[str, ...]
    log_factor: Float32Array
    change: Mapping[str, float]
    between_error: Mapping[str, float]

    def texture(self) -> Texture:
        """Return the layers as a texture."""
        return Texture(self.log_factor, "u8")

    def facts(self) -> dict[str, Any]:
        """Return the errors and figures that the page displays."""
        return {
            "layers": [{"name": name, "end": end} for name in self.names for end in END_AMOUNTS],
            "traits": {
                name: {"change": self.change[name], "between_error": self.between_error[name]}
                for name in self.names
            },
        }


def build_albedo_traits(source: SceneSource) -> AlbedoTraitLayers | str:
    """Build the albedo traits of a fitted face; return the reason as text if there are none.

    Parameters
    ----------
    source
        Source with an appearance "model" or "dome" that has `position` and `r_d`.
    """
    path = next((source.paths[kind] for kind in ("model", "dome") if kind in source.paths), None)
    if path is None:
        return "albedo edits require a measured albedo: the map R_d of a dome session"
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
    """Upsample a map linearly between texel centers, as the page samples it."""
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
    """Build basis BRDFs with weights, the diffusion profile and trait sliders.

    Parameters
    ----------
    source
        With a fitted appearance "model" or "dome", the assets are those of the face; otherwise the
        mean surface of the population of the packaged traits.

    Raises
    ------
    SkinReflectanceError, SurfaceMixtureError
        If a fitted folder is damaged.
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
