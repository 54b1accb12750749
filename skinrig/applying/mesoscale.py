"""Read the displacement map of a scan, and check it before relief is grown."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from model import store
from model.displacement_synthesis.split import MAX_MESOSCALE_TEXEL_UM
from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import Mesh
from skinrig.applying.expression import ApplyError
from skinrig.arrays import BoolArray, Float64Array

NPY_EXPECTED: Final = "expected a .npy file of heights, um; write the map again by numpy.save"


def read_mesoscale(
    path: Path, mesh: Mesh, scale_um: Float64Array, size_px: int
) -> tuple[Any, BoolArray]:
    """Read a scan's displacement map over the texture of a mesh.

    Parameters
    ----------
    path
        A .npy or an EXR file of heights, um.
    mesh
        Mesh with the texture's coordinates.
    scale_um : (h, w)
        Length of the texture's side on the skin, um, at any resolution.
    size_px
        Maximum side of the map, that of the relief.

    Returns
    -------
    height_um : (M, M)
        Heights, um; those of a .npy file are memory-mapped.
    valid : (M, M) bool
        Texels on the mesh.

    Raises
    ------
    ApplyError, model.store.StoreError
        If the file is unreadable, or its map is not square, too large, too coarse or empty.
    """
    given = _read_heights(path)
    if given.ndim != 2 or given.shape[0] != given.shape[1] or len(given) > size_px:
        shape = " x ".join(str(n) for n in given.shape)
        raise ApplyError(
            f"{path}: got a map of {shape}, expected a square one of one channel with at most "
            f"{size_px} pixels per side"
        )
    texel_um = float(np.median(scale_um)) / len(given)
    if texel_um > MAX_MESOSCALE_TEXEL_UM:
        raise ApplyError(
            f"{path}: got texels of {texel_um:.4g} um, expected at most "
            f"{MAX_MESOSCALE_TEXEL_UM:.4g} um; give a finer map"
        )
    valid = unwrap(mesh, len(given)).covered
    if not np.isfinite(given[valid]).any():
        raise ApplyError(
            f"{path}: got no valid texel on the mesh, expected some; export it for this mesh"
        )
    return given, valid


def _read_heights(path: Path) -> Any:
    if path.suffix != ".npy":
        return store.read_exr(path)
    try:
        # reads no pickle; memory mapping refuses a header that exceeds the file
        given = np.lib.format.open_memmap(path, mode="r")
    except Exception as error:  # header errors have no common base
        got = getattr(error, "strerror", None) or "an empty, damaged or pickled file"
        raise ApplyError(f"{path}: got {got}, {NPY_EXPECTED}") from error
    if given.dtype.kind not in "fiu":
        raise ApplyError(f"{path}: got {given.dtype}, {NPY_EXPECTED}")
    return given
