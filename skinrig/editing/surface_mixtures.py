"""The lobes of an appearance as mixtures of named materials, and a face's mean mixture."""

import dataclasses
import io
import zipfile
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from model.brdf import tables as brdf_tables
from model.brdf.tables import BrdfBasis
from model.skin import SkinAppearance, SkinMap
from model.skin_reflectance import BASIS_FILE, WEIGHT_PREFIX
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import BoolArray, Float64Array

OUTLIER_STRENGTH_RATIO: Final = 6.0
"""Times the usual strength from which on a texel does not count: no sample held its lobes down."""


class SurfaceMixtureError(ValueError):
    """Lobes that cannot be read as mixtures of materials."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceMixtures:
    """Shares of common lobes over a texture, and what each lobe is made of.

    Attributes
    ----------
    maps
        K maps of shares, each (H, W).
    mix
        (K, M): materials in each lobe, at least 0.
    materials
        Their M names.
    stored
        All arrays of the file, which an edit keeps but for `mix` and `table`.
    """

    maps: tuple[SkinMap, ...]
    mix: Float64Array
    materials: tuple[str, ...]
    stored: dict[str, NDArray[Any]]

    @property
    def light_radius_rad(self) -> float:
        """Angular radius of the light that the lobes are convolved with."""
        return float(self.stored["light_radius_rad"])

    @property
    def valid(self) -> BoolArray:
        """Texels where all shares are known, (H, W)."""
        return intersect_valid(*self.maps)

    def weights(self) -> Float64Array:
        """Return the shares at least 0, (H, W, K)."""
        return np.maximum(np.stack([m.values for m in self.maps], axis=-1).astype(np.float64), 0.0)

    def mean(self, strength: Float64Array) -> Float64Array:
        """Return the mean mixture of materials over texels of no unusual strength, (M,).

        Parameters
        ----------
        strength
            (M,): how much each material reflects.
        """
        rows = self.weights()[self.valid]
        if not len(rows):
            raise SurfaceMixtureError("basis_weight: no texel is valid")
        total = rows @ (self.mix @ strength)
        some = total[total > 0]
        if not len(some):
            return np.zeros(len(self.materials))
        usual = total < OUTLIER_STRENGTH_RATIO * float(np.median(some))
        return np.asarray(rows[usual].mean(axis=0) @ self.mix)


def read(appearance: SkinAppearance) -> SurfaceMixtures:
    """Return the lobes of an appearance.

    Raises
    ------
    SurfaceMixtureError
        Where there are none, or maps and file do not fit each other.
    """
    if BASIS_FILE not in appearance.files:
        raise SurfaceMixtureError(
            f"files: got no {BASIS_FILE}; `skinrig reconstruct --maps {WEIGHT_PREFIX}0` makes it"
        )
    try:
        with np.load(io.BytesIO(appearance.files[BASIS_FILE]), allow_pickle=False) as file:
            stored = {name: file[name] for name in file.files}
        mix = np.asarray(stored["mix"], np.float64)
        names = tuple(str(name) for name in stored["materials"])
        stored["light_radius_rad"], stored["table"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise SurfaceMixtureError(f"{BASIS_FILE}: cannot be read: {error}") from error
    if mix.ndim != 2 or mix.shape[1] != len(names) or not np.all(mix >= 0):
        raise SurfaceMixtureError(
            f"{BASIS_FILE}: mix has shape {mix.shape}, expected (K, {len(names)}) of at least 0"
        )
    maps = []
    for k in range(len(mix)):
        if f"{WEIGHT_PREFIX}{k}" not in appearance.maps:
            raise SurfaceMixtureError(
                f"{WEIGHT_PREFIX}{k}: is missing, {BASIS_FILE} has {len(mix)} lobes; reconstruct "
                "all of them"
            )
        maps.append(appearance.maps[f"{WEIGHT_PREFIX}{k}"])
    return SurfaceMixtures(tuple(maps), mix, names, stored)


def load_materials(
    names: tuple[str, ...], light_radius_rad: float, folder: Any = None
) -> BrdfBasis:
    """Return the tables that lobes are mixtures of.

    Parameters
    ----------
    names
        Of the materials.
    light_radius_rad
        Of the light that they are convolved with.
    folder
        MERL files that the lobes were fitted with; None: the materials of this package.

    Raises
    ------
    SurfaceMixtureError
        When they are others.
    """
    if folder is None:
        found = brdf_tables.default_basis(light_radius_rad)
    else:
        found = brdf_tables.load(folder, light_radius_rad=light_radius_rad)
    if found.names != names:
        where = "this package" if folder is None else str(folder)
        raise SurfaceMixtureError(
            f"materials: the lobes are mixtures of {len(names)} materials ({names[0]}, ...) that "
            f"are not those of {where}; name the fitted materials with --merl-basis"
        )
    return found


def serialize_mixtures(edited: SurfaceMixtures, materials: BrdfBasis) -> bytes:
    """Return the file that goes with edited lobes, tables and all."""
    stream = io.BytesIO()
    arrays = dict(edited.stored)
    arrays["mix"] = edited.mix
    arrays["table"] = materials.mix_materials(edited.mix).table[..., : len(edited.mix)]
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def replace_mixtures(
    appearance: SkinAppearance, edited: SurfaceMixtures, file: bytes
) -> SkinAppearance:
    """Return an appearance with other lobes."""
    maps = {n: m for n, m in appearance.maps.items() if not n.startswith(WEIGHT_PREFIX)}
    maps |= {f"{WEIGHT_PREFIX}{k}": one for k, one in enumerate(edited.maps)}
    return dataclasses.replace(appearance, maps=maps, files={**appearance.files, BASIS_FILE: file})
