"""Measure how a mesh's texture coordinates distort areas and angles.

The paper (Weyrich et al. 2005, section 4) maps faces by the area-preserving parameterization of
Desbrun et al. 2002: each texel then covers an equal area of skin. The singular values of the map
from the texture to the surface give both distortions of each triangle.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from model import store
from rigsim.geometry.mesh import Mesh
from skinrig.arrays import Float64Array
from skinrig.atomic_file import write_atomically
from skinrig.errors import UnusableError
from skinrig.rendering.geometry import read_mesh, read_own_mesh

OUTPUT_FILE: Final = "parameterization.json"
AREA_PERCENTILES: Final = (5, 50, 95)


def measure_stretch(vertices_mm: ArrayLike, faces: ArrayLike, uv: ArrayLike) -> Float64Array:
    """Return singular values of each triangle's map from texture to surface, and its area.

    Parameters
    ----------
    vertices_mm, uv
        (V, 3) mm and (V, 2).
    faces
        Triangles, (F, 3).

    Returns
    -------
    ndarray, shape (F, 3)
        Larger and smaller length on the skin per unit of texture, mm, and area, mm^2; NaN for a
        triangle without area in the texture.

    Examples
    --------
    >>> square = [[0, 0, 0], [2, 0, 0], [0, 1, 0]]
    >>> measure_stretch(square, [[0, 1, 2]], [[0, 0], [1, 0], [0, 1]]).round(6).tolist()
    [[2.0, 1.0, 1.0]]
    """
    points, texture = np.asarray(vertices_mm, np.float64), np.asarray(uv, np.float64)
    triangles = np.asarray(faces, np.int64)
    a, b = (points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2))
    p, q = (texture[triangles[:, k]] - texture[triangles[:, 0]] for k in (1, 2))
    determinant = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        by_u = (a * q[:, 1:] - b * p[:, 1:]) / determinant[:, None]
        by_v = (b * p[:, :1] - a * q[:, :1]) / determinant[:, None]
    e, f, g = ((x * y).sum(axis=1) for x, y in ((by_u, by_u), (by_u, by_v), (by_v, by_v)))
    middle, spread = 0.5 * (e + g), np.hypot(0.5 * (e - g), f)
    area = 0.5 * np.linalg.norm(np.cross(a, b), axis=1)
    values = np.sqrt(np.stack([middle + spread, np.maximum(middle - spread, 0.0)], axis=1))
    found = np.column_stack([values, area])
    found[np.abs(determinant) < 1e-300] = np.nan
    return found


def analyze_parameterization(out: Path, source: Path) -> dict[str, Any]:
    """Measure the distortion of a mesh and write `OUTPUT_FILE`.

    Parameters
    ----------
    out
        Folder to write.
    source
        Mesh with texture coordinates, or APPEARANCE/ folder with one.

    Returns
    -------
    dict
        JSON values, weighted by area on the skin: percentiles of area per texel over the median and
        of the ratio of both singular values, and the standard deviation of the area's logarithm.

    Raises
    ------
    UnusableError, GeometryError, MeshFileError, StoreError
        For a source without a mesh, or a mesh without texture coordinates.
    """
    mesh = _read(source)
    stretch = measure_stretch(mesh.vertices_mm, mesh.faces, mesh.uv)
    good = np.isfinite(stretch).all(axis=1) & (stretch[:, 1] > 0) & (stretch[:, 2] > 0)
    if not good.any():
        raise UnusableError(f"{source}: got no triangle with an area in the texture, expected some")
    large, small, area = stretch[good].T
    log_area = np.log(large * small)
    middle = _percentile(log_area, area, 50)
    document = {
        "schema": "skinrig.parameterization/1",
        "source": str(source),
        "triangles": len(stretch),
        "degenerate": int(np.count_nonzero(~good)),
        "log_area_sd": float(np.sqrt(np.cov(log_area, aweights=area))),
        "area_over_median": {
            str(p): float(np.exp(_percentile(log_area, area, p) - middle)) for p in AREA_PERCENTILES
        },
        "angle_ratio": {str(p): _percentile(large / small, area, p) for p in AREA_PERCENTILES},
    }
    write_atomically(out / OUTPUT_FILE, json.dumps(document, indent=1))
    return document


def _read(source: Path) -> Mesh:
    if not source.is_dir():
        return read_mesh(source)
    return read_own_mesh(store.read(source))


def _percentile(values: Float64Array, weights: Float64Array, percent: float) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.01 * percent * total[-1])])
