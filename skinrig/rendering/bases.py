"""Reduce a model to fewer basis BRDFs, which are mixtures of its own."""

import dataclasses
from typing import Final

import numpy as np

from model.brdf.tables import BrdfBasis
from model.skin_reflectance import SkinReflectance
from reconstruction import brdf_basis
from skinrig.arrays import Float64Array
from skinrig.rendering.camera import RenderingError

FACTORIZED_TEXELS: Final = 5_000
"""Number of random texels that are factorized."""
DESCENT_SWEEPS: Final = 60
"""Sweeps of coordinate descent over the weights; each step optimizes one weight, others fixed."""


def reduce_lobes(model: SkinReflectance, rank: int, *, rng: np.random.Generator) -> SkinReflectance:
    """Return the model with `rank` basis BRDFs that are mixtures of its own.

    The mixtures result from non-negative factorization of a subset of texels. Then every texel gets
    the weights whose BRDF is nearest to its original one, over the tables' nodes by solid angle. A
    fit to the samples would be more accurate: `skinrig reconstruct --rank`.

    Parameters
    ----------
    model
        The model.
    rank
        Number of basis BRDFs, from 1 to those of the model.
    rng
        Generator that draws the texels and seeds the factorization.

    Raises
    ------
    RenderingError
        If the model has fewer basis BRDFs.
    """
    if not 1 <= rank <= model.lobes.size:
        raise RenderingError(
            f"--bases: got {rank}, expected at most {model.lobes.size} of the model; fit more with "
            f"`skinrig reconstruct SESSION --rank {rank} --maps basis_weight_0,r_d,normals`"
        )
    if rank == model.lobes.size:
        return model
    shares = model.weights.reshape(-1, model.lobes.size).astype(np.float64)
    known = np.flatnonzero(model.valid.reshape(-1) & (shares.sum(axis=-1) > 0.0))
    drawn = np.sort(rng.permutation(known)[:FACTORIZED_TEXELS])
    seed = int(rng.integers(2**31))
    _, mix, _ = brdf_basis.reduce(shares[drawn], rank, basis=model.lobes, seed=seed)
    fewer = fit_nearest_weights(shares, mix, model.lobes)
    weights = fewer.reshape(*model.shape, rank).astype(np.float32)
    return dataclasses.replace(model, weights=weights, lobes=model.lobes.mix_materials(mix))


def fit_nearest_weights(weights: Float64Array, mix: Float64Array, lobes: BrdfBasis) -> Float64Array:
    """Fit non-negative weights of mixtures whose BRDFs are nearest to given ones.

    Parameters
    ----------
    weights
        Weights of the basis BRDFs, shape (n, K).
    mix
        Mixtures of the basis BRDFs, shape (R, K).
    lobes
        The K basis BRDFs.

    Returns
    -------
    ndarray of float64
        Shape (n, R), by cyclic coordinate descent, whose error never increases.
    """
    strength = lobes.strength()
    gram = lobes.cosine_similarity() * np.outer(strength, strength)
    square = mix @ gram @ mix.T
    wanted = weights @ gram @ mix.T
    size = np.maximum(np.diag(square), 1e-300)
    found = np.zeros_like(wanted)
    for _ in range(DESCENT_SWEEPS):
        for k in range(len(mix)):
            rest = wanted[:, k] - found @ square[:, k] + found[:, k] * size[k]
            found[:, k] = np.maximum(rest / size[k], 0.0)
    return found
