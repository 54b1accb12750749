"""Gather laterally scattered light at exit points: the dipole summed over a tree of sources.

Each source represents an area of the surface; distant sources are merged as far as a bound on the
error allows. A node of the tree contributes its light, the light's first moments and its area. The
first omitted term of the Taylor series is the dipole's second derivatives times the node's second
moments; that product, bounded from the node's nearest point on, is the error bound.

Albedo measured from images already includes the scattering. So the gathered light is divided by the
sum under even light (post-scatter normalization): under even light the exitance is exactly R_d
times the entered light, on curved, folded and bounded surfaces as on a plane. The sum without this
division is available too: it falls off towards holes and edges, where light is lost, and grows in
folds, where the planar dipole counts both sides.

References
----------
Jensen and Buhler 2002, doi:10.1145/566570.566619.
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 9 (the dome of 2005).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model import fresnel
from model.arrays import Float32Array, Float64Array, Int32Array
from model.checks import FINITE_RANGE, Checks
from model.dipole import gather_kernels as dipole_gather_kernels
from model.dipole import source_tree_kernels
from model.dipole.direct_sum import SOURCE_RADIUS_PER_SIDE, DipoleMedia

GATHER_TOL = 0.1
"""Limit of the error at exit points over the brightest light that entered, if all nodes erred
in the same direction by their bounds. Measured errors are a hundred times smaller."""
N_TOL_SHARING_NODES = 30.0
"""Nodes that share the tolerance: about this many come near their bounds."""
_CHUNK_POINTS = 1 << 14


class GatherError(ValueError):
    """Error for sources or exit points that light cannot be gathered from or at."""


@dataclass(frozen=True, slots=True, eq=False)
class SourceTree:
    """Points of a surface in a tree that serves any illumination of them.

    Attributes
    ----------
    center_mm : ndarray, shape (3,)
        Origin of the tree's own coordinates.
    order : ndarray of int
        Sources in the tree's order; those without area are omitted.
    position, reach, area : ndarray of float32
        (S, 3), (S,), (S,): mm, mm, mm^2, in the tree's order.
    node_summary, low, high, skip : ndarray
        Nodes; see `model.dipole.source_tree_kernels`.
    size : int
        Number of sources given.
    """

    center_mm: Float64Array
    order: NDArray[np.intp]
    position: Float32Array
    reach: Float32Array
    area: Float32Array
    node_summary: Float32Array
    low: Int32Array
    high: Int32Array
    skip: Int32Array
    size: int

    @staticmethod
    def of(source_mm: ArrayLike, source_area_mm2: ArrayLike) -> SourceTree:
        """Build the tree over source points.

        Parameters
        ----------
        source_mm
            Points of the surface, (S, 3), mm.
        source_area_mm2
            Area that each represents, (S,), mm^2, at least 0.

        Raises
        ------
        GatherError
            For other shapes, a position that is not finite or an area that is negative.
        """
        place = np.asarray(source_mm, np.float64)
        area = np.asarray(source_area_mm2, np.float64)
        _expect("source_mm", place, (len(place), 3))
        _expect("source_area_mm2", area, (len(place),), "[0, inf)")
        # an area that underflows in float32 contributes no light
        size, some = len(place), np.flatnonzero(area.astype(np.float32) > 0.0)
        place, area = place[some], area[some]
        center = place.mean(axis=0) if len(some) else np.zeros(3)
        near = (place - center).astype(np.float32)
        if not len(some):
            none = np.zeros(0, np.int32)
            seen = np.zeros((0, source_tree_kernels.NODE_COLUMNS), np.float32)
            empty = np.zeros(0, np.float32)
            return SourceTree(center, some, near, empty, empty, seen, none, none, none, size)
        order, low, high, skip = source_tree_kernels.split_sources(
            near, source_tree_kernels.LEAF_SIZE
        )
        near, area = near[order], area[order].astype(np.float32)
        reach = (SOURCE_RADIUS_PER_SIDE * np.sqrt(area)).astype(np.float32)
        seen = source_tree_kernels.summarize_nodes(near, area, reach, low, high)
        return SourceTree(center, some[order], near, reach, area, seen, low, high, skip, size)


@dataclass(frozen=True, slots=True, eq=False)
class GatherResult:
    """Exitance at exit points, with its error bound and cost.

    Attributes
    ----------
    exitance : ndarray of float64, shape (Q, 3)
        In the unit of the entered light.
    bound : ndarray of float32, shape (Q,)
        Upper bound of the error that the tree adds to light and mass, over R_d and the brightest
        light that entered.
    work : ndarray of int32, shape (Q,)
        Nodes and sources that were summed.
    """

    exitance: Float64Array
    bound: Float32Array
    work: Int32Array


class GatherSettings(TypedDict, total=False):
    """Options that `exitance` passes to `gather`."""

    eta: float
    normalize: bool
    tolerance: float
    entered_at: ArrayLike | None
    workers: int


def exitance(
    source_mm: ArrayLike,
    source_area_mm2: ArrayLike,
    entered: ArrayLike,
    exit_mm: ArrayLike,
    r_d: ArrayLike,
    translucency_mm: ArrayLike,
    **gathering: Unpack[GatherSettings],
) -> Float64Array:
    """Return the radiant exitance below the surface at points for light that entered at others.

    Parameters
    ----------
    source_mm
        Points of the surface, (S, 3), mm, e.g. texels.
    source_area_mm2
        Area that each represents, (S,), mm^2; a source of area 0 is omitted.
    entered
        Irradiance times F_t of its direction, (S, 3), W/mm^2: the light below the surface. Its
        maximum is 0 or at least 1e-30, as the tree uses single precision.
    at_mm
        Exit points, (Q, 3), mm, on the same surface.
    r_d, translucency_mm
        R_d and 1/sigma_tr, mm, at the exit points, broadcast to (Q, 3). R_d above 1, which no
        medium has, scales light without lateral scattering; it is not clamped.
    eta
        Refractive index of the skin over that of air.
    normalize
        Divide by the sum under even light: see above.
    tolerance
        Worst error over the brightest light that entered, see `GATHER_TOL`, above 0.
    entered_at
        Light that enters at the exit points themselves, (Q, 3): used for light that exits closer
        than the sources resolve. None: that of the nearby sources.
    workers
        Threads.

    Returns
    -------
    ndarray of float64, shape (Q, 3)
        W/mm^2, before F_t of the view. Without any source: 0.

    Raises
    ------
    GatherError
        For shapes that do not fit, values that are not finite, a translucency or tolerance that
        is not above 0.

    Examples
    --------
    >>> grid = np.arange(-9.5, 10.0)
    >>> points = np.stack([*np.meshgrid(grid, grid), np.zeros((20, 20))], axis=-1).reshape(-1, 3)
    >>> light = np.full((400, 3), 2.0)
    >>> out = exitance(points, np.ones(400), light, points[:5], (0.6, 0.3, 0.2), (2.0, 1.0, 0.5))
    >>> out[0].round(5).tolist()
    [1.2, 0.6, 0.4]
    """
    tree = SourceTree.of(source_mm, source_area_mm2)
    return gather(tree, entered, exit_mm, r_d, translucency_mm, **gathering).exitance


def gather(
    tree: SourceTree,
    entered: ArrayLike,
    exit_mm: ArrayLike,
    r_d: ArrayLike,
    translucency_mm: ArrayLike,
    *,
    eta: float = fresnel.ETA_SKIN,
    normalize: bool = True,
    tolerance: float = GATHER_TOL,
    entered_at: ArrayLike | None = None,
    workers: int = 1,
) -> GatherResult:
    """Return the exitance for a tree that is reused for several lights or views."""
    light = np.asarray(entered, np.float64)
    at = np.asarray(exit_mm, np.float64)
    _expect("entered", light, (tree.size, 3))
    _expect("exit_mm", at, (len(at), 3))
    albedo = _broadcast("r_d", r_d, len(at))
    length = _broadcast("translucency_mm", translucency_mm, len(at))
    own = np.full((1, 3), np.nan)
    if entered_at is not None:
        own = np.asarray(entered_at, np.float64)
        _expect("entered_at", own, at.shape)
    Checks(GatherError).within("tolerance", tolerance, "(0, inf)")
    Checks(GatherError).within("translucency_mm", length, "(0, inf)")
    Checks(GatherError).within("workers", workers, "[1, inf)")
    found = np.zeros((len(at), 3))
    bound, work = np.zeros(len(at), np.float32), np.zeros(len(at), np.int32)
    if not len(tree.order):
        return GatherResult(found, bound, work)
    light = light[tree.order]
    moments = source_tree_kernels.light_moments(
        tree.position, tree.area, light, tree.low, tree.high, tree.node_summary
    )
    own = np.broadcast_to(own, at.shape)

    def one(start: int) -> None:
        part = slice(start, start + _CHUNK_POINTS)
        media = DipoleMedia.of(albedo[part], length[part], eta=eta)
        here = np.ascontiguousarray(own[part]).view()
        here.flags.writeable = False  # as in the compiled signature; else numba compiles again
        dipole_gather_kernels.gather(
            (at[part] - tree.center_mm).astype(np.float32),
            media.sigma_tr_per_mm,
            media.depth_mm,
            media.height_mm,
            media.scale,
            here,
            tolerance / N_TOL_SHARING_NODES,
            normalize,
            tree.position,
            tree.reach,
            tree.area,
            light,
            tree.node_summary,
            moments,
            tree.low,
            tree.high,
            tree.skip,
            found[part],
            bound[part],
            work[part],
        )
        found[part] *= albedo[part]

    starts = range(0, len(at), _CHUNK_POINTS)
    if workers == 1:
        for start in starts:
            one(start)
    else:
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(one, starts))
    return GatherResult(found, bound, work)


def _expect(
    name: str, values: Float64Array, shape: tuple[int, ...], interval: str = FINITE_RANGE
) -> None:
    Checks(GatherError).shape(name, values, shape)
    Checks(GatherError).within(f"{name} (leave points without it out)", values, interval)


def _broadcast(name: str, given: ArrayLike, count: int) -> Float64Array:
    values = np.asarray(given, np.float64)
    _expect(name, values, values.shape)
    return Checks(GatherError).broadcast(name, values, (count, 3))
