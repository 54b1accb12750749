"""A fitted model with one of its parts taken out, to show what the part buys."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from model.skin_reflectance import SkinReflectance
from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import Mesh
from skinrig.arrays import Float32Array


def without_parts(model: SkinReflectance, mesh: Mesh) -> Mapping[str, SkinReflectance]:
    """Return the models that have less, by what they have instead.

    Parameters
    ----------
    model
        The whole.
    mesh
        That it lies on; its own normals are those of the scan.

    Returns
    -------
    mapping
        "one lobe": the mixture of lobes that the face has on average, of each texel's own strength;
        "scanned normals": those of the mesh; "even albedo": the face's mean R_d everywhere.
    """
    flat = unwrap(mesh, model.valid.shape[0]).normal
    length = np.linalg.norm(flat, axis=-1, keepdims=True)
    normals = np.where(length > 0.5, flat / np.maximum(length, 1e-9), model.normals)
    mean = model.r_d[model.valid].mean(axis=0, dtype=np.float64)
    return {
        "one lobe": dataclasses.replace(model, weights=one_lobe(model)),
        "scanned normals": dataclasses.replace(model, normals=normals.astype(np.float32)),
        "even albedo": dataclasses.replace(
            model, r_d=np.broadcast_to(mean, model.r_d.shape).astype(np.float32), r_d_stderr=None
        ),
    }


def one_lobe(model: SkinReflectance) -> Float32Array:
    """Return weights of one common mixture, scaled at each texel to reflect most like its own.

    Returns
    -------
    ndarray of float32, shape (H, W, K)
        The least squares over the lobes' grid, directions counting by solid angle.
    """
    strength = model.lobes.strength()
    gram = model.lobes.kinship() * np.outer(strength, strength)
    shares = model.weights.astype(np.float64)
    common = shares[model.valid].mean(axis=0)
    size = float(common @ gram @ common)
    scale = shares @ gram @ common / size if size > 0 else np.zeros(shares.shape[:2])
    return (scale[..., None] * common).astype(np.float32)
