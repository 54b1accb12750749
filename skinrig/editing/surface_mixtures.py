"""Read and write basis BRDFs of an appearance as mixtures of named materials."""

import dataclasses
import io
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from model.brdf import tables as brdf_tables
from model.brdf.tables import BrdfBasis
from model.checks.files import read_arrays
from model.skin import SkinAppearance, SkinMap
from model.skin_reflectance import BASIS_FILE, WEIGHT_PREFIX
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import BoolArray, Float64Array

OUTLIER_STRENGTH_RATIO: Final = 6.0
"""Strength relative to the median above which a texel is an outlier, as no sample constrained
it."""


class SurfaceMixtureError(ValueError):
    """Basis BRDFs that are not mixtures of the expected materials."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceMixtures:
    """Weights of basis BRDFs over a texture, and the materials of each basis BRDF.

    Attributes
    ----------
    maps
        K maps of weights, each (H, W).
    mix
        (K, M): weight of each material in each basis BRDF, at least 0.
    materials
        Names of the M materials.
    stored
        All arrays of the file; an edit changes only `mix` and `table`.
    """

    maps: tuple[SkinMap, ...]
    mix: Float64Array
    materials: tuple[str, ...]
    stored: dict[str, NDArray[Any]]

    @property
    def light_radius_rad(self) -> float:
        """Angular radius of the light with which the basis BRDFs are convolved."""
        return float(self.stored["light_radius_rad"])

    @property
    def valid(self) -> BoolArray:
        """Texels with valid weights of all basis BRDFs, (H, W)."""
        return intersect_valid(*self.maps)

    def weights(self) -> Float64Array:
        """Return the weights, clipped below at 0, (H, W, K)."""
        return np.maximum(np.stack([m.values for m in self.maps], axis=-1).astype(np.float64), 0.0)

    def mean(self, strength: Float64Array) -> Float64Array:
        """Return the mean mixture of materials over texels without outliers, (M,).

        Parameters
        ----------
        strength
            (M,): reflected fraction of each material.
        """
        rows = self.weights()[self.valid]
        if not len(rows):
            raise SurfaceMixtureError(
                "basis_weight: got no valid texel, expected some; reconstruct the session again"
            )
        total = rows @ (self.mix @ strength)
        some = total[total > 0]
        if not len(some):
            return np.zeros(len(self.materials))
        usual = total < OUTLIER_STRENGTH_RATIO * float(np.median(some))
        return np.asarray(rows[usual].mean(axis=0) @ self.mix)


def read(appearance: SkinAppearance) -> SurfaceMixtures:
    """Read the basis BRDFs and weights of an appearance.

    Raises
    ------
    SurfaceMixtureError
        If they are missing, or maps and file are inconsistent.
    """
    if BASIS_FILE not in appearance.files:
        raise SurfaceMixtureError(
            f"files: {BASIS_FILE} is missing; create it by `skinrig reconstruct --maps"
            f" {WEIGHT_PREFIX}0`"
        )
    try:
        stored = read_arrays(appearance.files[BASIS_FILE])
        mix = np.asarray(stored["mix"], np.float64)
        names = tuple(str(name) for name in stored["materials"])
        stored["light_radius_rad"], stored["table"]
    except (ValueError, KeyError, TypeError) as error:
        raise SurfaceMixtureError(
            f"{BASIS_FILE}: not readable ({error}); reconstruct the session again"
        ) from error
    if mix.ndim != 2 or mix.shape[1] != len(names) or not np.all(mix >= 0):
        raise SurfaceMixtureError(
            f"{BASIS_FILE}: mix has shape {mix.shape}, expected (K, {len(names)}) of at least 0"
        )
    maps = []
    for k in range(len(mix)):
        if f"{WEIGHT_PREFIX}{k}" not in appearance.maps:
            raise SurfaceMixtureError(
                f"{WEIGHT_PREFIX}{k}: is missing, {BASIS_FILE} has {len(mix)} basis BRDFs; "
                "reconstruct all of them"
            )
        maps.append(appearance.maps[f"{WEIGHT_PREFIX}{k}"])
    return SurfaceMixtures(tuple(maps), mix, names, stored)


def load_materials(
    names: tuple[str, ...], light_radius_rad: float, folder: Any = None
) -> BrdfBasis:
    """Load the material tables of which basis BRDFs are mixtures.

    Parameters
    ----------
    names
        Names of the materials.
    light_radius_rad
        Angular radius of the light with which they are convolved.
    folder
        Folder of the MERL files of the fit; None: the materials of this package.

    Raises
    ------
    SurfaceMixtureError
        If the folder has other materials.
    """
    if folder is None:
        found = brdf_tables.default_basis(light_radius_rad)
    else:
        found = brdf_tables.load(folder, light_radius_rad=light_radius_rad)
    if found.names != names:
        where = "this package" if folder is None else str(folder)
        raise SurfaceMixtureError(
            f"materials: got basis BRDFs of {len(names)} materials ({names[0]}, ...), expected"
            f" those "
            f"of {where}; name the fitted materials with --merl-basis"
        )
    return found


def serialize_mixtures(edited: SurfaceMixtures, materials: BrdfBasis) -> bytes:
    """Serialize edited basis BRDFs with their tables as an .npz file."""
    stream = io.BytesIO()
    arrays = dict(edited.stored)
    arrays["mix"] = edited.mix
    arrays["table"] = materials.mix_materials(edited.mix).table[..., : len(edited.mix)]
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def replace_mixtures(
    appearance: SkinAppearance, edited: SurfaceMixtures, file: bytes
) -> SkinAppearance:
    """Replace the basis BRDFs and weights of an appearance."""
    maps = {n: m for n, m in appearance.maps.items() if not n.startswith(WEIGHT_PREFIX)}
    maps |= {f"{WEIGHT_PREFIX}{k}": one for k, one in enumerate(edited.maps)}
    return dataclasses.replace(appearance, maps=maps, files={**appearance.files, BASIS_FILE: file})
