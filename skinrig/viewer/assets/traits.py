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
from skinrig.arrays import Float32Array, Float64Array
from skinrig.viewer.assets.compact_brdf import LOBES_PER_LOOKUP
from skinrig.viewer.assets.reflectance import PageLobes

DESCENT_SWEEPS: Final = 96
"""Of coordinate descent: after as many, errors stay within a few percent of a trait."""
MAX_ADDED_LOBES: Final = 4
"""Lobes that traits may bring: one more look-up for all of them."""
SAMPLED_TEXELS: Final = 400
"""Texels on which lobes are chosen and errors measured."""
SLIDER_ENDS: Final = (-1.0, 1.0)
"""Ends of a slider."""
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
        RMS length by which `projected` misses `lobe_edits.edit_weights` at amounts -1 and 1, over
        the trait's length. It stops before it is there, and may bring no further lobe.
    """

    lobes: PageLobes
    gram: Float32Array
    scale: Float32Array
    pull: Mapping[str, Float32Array]
    misfit: Mapping[str, float]
    held_error: Mapping[str, tuple[float, float]]

    def projected(self, shares: Float64Array, amounts: Mapping[str, float]) -> Float32Array:
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
        given = np.asarray(shares, np.float32) * self.scale
        asked = np.zeros(len(self.scale), np.float32)
        for name, amount in amounts.items():
            asked += np.float32(amount) * self.pull[name]
        if not asked.any():
            return np.asarray(shares, np.float32)
        wanted = given @ self.gram + asked
        found = given.copy()
        for _ in range(DESCENT_SWEEPS):
            for k in range(len(self.scale)):
                step = wanted[:, k] - found @ self.gram[:, k]
                found[:, k] = np.maximum(found[:, k] + step, np.float32(0.0))
        return np.asarray(found / self.scale, np.float32)


def distinct_from_chance(traits: Mapping[str, TraitVector]) -> tuple[str, ...]:
    """Return the traits that are worth a slider, in the library's order.

    Those that a permutation of the labels brings about as easily are left out, and of two opposite
    ones the second.
    """
    return tuple(
        name
        for name, trait in traits.items()
        if trait.confidence.p_value <= MAX_P_VALUE and OPPOSITE_TRAITS.get(name) not in traits
    )


def surface_traits(found: PageLobes, space: TraitSpace | None = None) -> LobeTraits | None:
    """Return the surface traits of a page's lobes; None where the lobes are of other materials.

    Parameters
    ----------
    found
        Lobes with what they are mixtures of.
    space
        Traits of mean mixtures; None: those of the package.
    """
    traits = trait_storage.default().spaces["surface"] if space is None else space
    materials = brdf_tables.default()
    if found.materials != materials.names or (traits.names and traits.names != materials.names):
        return None
    names = distinct_from_chance(traits.traits)
    rows = _some(found.shares)
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
    mixed = materials.mixed(mix)
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
        name: (_held_error(made, tried, traits, name, -1.0), _held_error(made, tried, traits, name))
        for name in names
    }
    return dataclasses.replace(made, held_error=errors)


def surface_facts(traits: LobeTraits) -> dict[str, Any]:
    """Return what the page needs to know of surface traits; lobes and shares go with the lobes'."""
    found = {}
    for name, pull in traits.pull.items():
        errors = {"misfit": traits.misfit[name], "held_error": list(traits.held_error[name])}
        found[name] = {"pull": pull.tolist(), **errors}
    numbers = {"gram": traits.gram.reshape(-1).tolist(), "scale": traits.scale.tolist()}
    return {"sweeps": DESCENT_SWEEPS, **numbers, "traits": found}


def _some(shares: Float32Array) -> Float64Array:
    """Return at most `SAMPLED_TEXELS` texels with any share, evenly taken, (n, K)."""
    rows = shares.reshape(-1, shares.shape[-1]).astype(np.float64)
    rows = rows[rows.sum(axis=1) > 0.0]
    if not len(rows):
        return np.ones((1, shares.shape[-1]))
    return rows[:: -(-len(rows) // SAMPLED_TEXELS)]


def _padded(rows: Float64Array, count: int) -> Float64Array:
    return np.pad(rows, ((0, 0), (0, count - rows.shape[1])))


def _length(space: TraitSpace, name: str) -> float:
    return float(reduced_spaces.lengths(space.trait(name).vector, space.metric))


def _misfit(mix: Float64Array, space: TraitSpace, name: str) -> float:
    frame = reduced_spaces.framed(np.eye(mix.shape[1]), space.metric)
    vector = space.trait(name).vector @ frame
    z = np.linalg.lstsq((mix @ frame).T, vector, rcond=1e-10)[0]
    return float(np.linalg.norm(z @ mix @ frame - vector) / np.linalg.norm(vector))


def _held_error(
    made: LobeTraits, rows: Float64Array, space: TraitSpace, name: str, amount: float = 1.0
) -> float:
    page = made.projected(rows, {name: amount}).astype(np.float64) @ made.lobes.mix
    edited = lobe_edits.edit_weights(rows, made.lobes.mix, space, {name: amount})
    off = reduced_spaces.lengths(page - edited.weights @ edited.mix, space.metric)
    return float(np.sqrt(np.mean(np.square(off)))) / _length(space, name)
