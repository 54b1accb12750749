"""Edit basis BRDFs and weights by traits: `model.traits.lobe_edits` on an appearance's maps."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from model.skin import SkinMap
from model.traits import TraitSpace, lobe_edits
from skinrig.arrays import FloatArray
from skinrig.editing.surface_mixtures import SurfaceMixtures


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceEditResult:
    """Edited basis BRDFs and weights, with the residual of the edit.

    Attributes
    ----------
    mixtures
        Weights and basis BRDFs: those of the source first, then those added by traits.
    clipped
        Fraction of the change clipped by non-negativity, RMS over the texels.
    misfit
        Fraction of each trait's vector that the basis BRDFs do not represent.
    """

    mixtures: SurfaceMixtures
    clipped: float
    misfit: Mapping[str, float]


def edit_surface(
    source: SurfaceMixtures,
    space: TraitSpace,
    amounts: Mapping[str, float],
    *,
    weight: FloatArray | None = None,
) -> SurfaceEditResult:
    """Edit the basis BRDFs and weights of a face by traits.

    Parameters
    ----------
    source
        Basis BRDFs and weights of the face.
    space
        Traits of mean mixtures of the same materials.
    amounts
        Amount by trait.
    weight
        (H, W), 0 to 1: weight of the amounts per texel; texels of 0 stay bit-identical.

    Raises
    ------
    model.traits.vectors.TraitError
        For other materials, or more than 15 basis BRDFs.
    """
    weights = source.weights()
    shape = weights.shape[:2]
    part = np.ones(shape) if weight is None else np.asarray(weight, np.float64)
    asked = {name: amount * part.reshape(-1) for name, amount in amounts.items()}
    rows = weights.reshape(-1, weights.shape[2])
    found = lobe_edits.edit_weights(rows, source.mix, space, asked, materials=source.materials)
    if not any(amounts.values()):
        return SurfaceEditResult(source, 0.0, {})
    new = np.asarray(found.weights).reshape(*shape, -1).astype(np.float32)
    noise = _noise(space, amounts)
    maps = [
        dataclasses.replace(old, values=np.where(part > 0, new[..., k], old.values))
        for k, old in enumerate(source.maps)
    ]
    valid = source.valid if source.maps[0].valid is not None else None
    for share_k in np.moveaxis(new, -1, 0)[len(maps) :]:
        error = (noise * share_k).astype(np.float32)
        maps.append(SkinMap(share_k, "1", error, valid, "weight of a basis BRDF added by a trait"))
    edited = dataclasses.replace(source, maps=tuple(maps), mix=found.mix)
    counted = source.valid.reshape(-1) & (part.reshape(-1) > 0)
    moved, clipped = found.moved[counted], found.clipped[counted]
    size = float(np.sqrt(np.mean(moved**2))) if len(moved) else 0.0
    lost = float(np.sqrt(np.mean(clipped**2))) / size if size > 0 else 0.0
    return SurfaceEditResult(edited, lost, dict(found.misfit))


def _noise(space: TraitSpace, amounts: Mapping[str, float]) -> float:
    """Return the relative error of the traits' vectors; 1 if unknown."""
    worst = max(
        (space.trait(n).confidence.relative_noise for n, a in amounts.items() if a), default=0.0
    )
    return float(worst) if np.isfinite(worst) else 1.0
