"""Light that entered skin at many points, gathered where it leaves: the dipole over a tree.

Each source of light stands for an area of the surface; distant ones are taken together, as far as
a bound on the error allows. A node of the tree counts with its light, the first moments of the
light and its area, so that what is left out are second derivatives of the dipole times second
moments of the node: that product, from the node's nearest point on, is the bound.

Albedo measured from pictures holds the scattering already. So the light that the dipole brings
together is divided by what even light would bring (post-scatter normalization): under even light
exactly R_d times what entered leaves again, on curved, folded and bounded surfaces as on a plane.
The sum without this division is there too: it falls off towards holes and edges, where light would
be lost, and grows in folds, where the dipole of a plane counts both sides.

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
from model.checks import FINITE, Checks
from model.dipole import gather_kernels as dipole_gather_kernels
from model.dipole import source_tree_kernels
from model.dipole.direct_sum import SOURCE_RADIUS_PER_SIDE, DipoleMedia

GATHER_TOL = 0.1
"""Largest error that exit points may have over the brightest light that entered, if all nodes erred
to the same side by as much as they can. Measured errors are a hundred times smaller."""
N_TOL_SHARING_NODES = 30.0
"""Nodes that share the tolerance: so many come near their bounds."""
_CHUNK_POINTS = 1 << 14


class GatherError(ValueError):
    """Sources or exit points that light cannot be gathered from or at."""


@dataclass(frozen=True, slots=True, eq=False)
class SourceTree:
    """Points of a surface in a tree, for any light that enters there.

    Attributes
    ----------
    center_mm : ndarray, shape (3,)
        Origin of the tree's own coordinates.
    order : ndarray of int
        Sources in the tree's order; those without area are left out.
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
        """Build the tree.

        Parameters
        ----------
        source_mm
            Points of the surface, (S, 3), mm.
        source_area_mm2
            Area that each stands for, (S,), mm^2, at least 0.

        Raises
        ------
        GatherError
            For other shapes, a place that is not finite or an area that is negative.
        """
        place = np.asarray(source_mm, np.float64)
        area = np.asarray(source_area_mm2, np.float64)
        _expect("source_mm", place, (len(place), 3))
        _expect("source_area_mm2", area, (len(place),), "[0, inf)")
        # an area that float32 does not hold sends nothing
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
    """What leaves at exit points.

    Attributes
    ----------
    exitance : ndarray of float64, shape (Q, 3)
        In the unit of what entered.
    bound : ndarray of float32, shape (Q,)
        No more than this, over the brightest light that entered and R_d, the tree adds to the
        error of light and of mass.
    work : ndarray of int32, shape (Q,)
        Nodes and sources that were summed.
    """

    exitance: Float64Array
    bound: Float32Array
    work: Int32Array


class GatherSettings(TypedDict, total=False):
    """What `exitance` leaves to `gather`."""

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
    """Return the radiant exitance below the surface at points, from light that entered at others.

    Parameters
    ----------
    source_mm
        Points of the surface, (S, 3), mm, e.g. texels.
    source_area_mm2
        Area that each stands for, (S,), mm^2; 0: none, the source is left out.
    entered
        Irradiance times F_t of its direction, (S, 3), W/mm^2: what passed the surface. Its largest
        is 0 or at least 1e-30: the tree holds single precision.
    at_mm
        Exit points, (Q, 3), mm, on the same surface.
    r_d, translucency_mm
        R_d and 1/sigma_tr, mm, at the exit points, broadcast to (Q, 3). R_d above 1, which no
        medium has, scales light that does not spread; nothing is clamped.
    eta
        Refractive index of the skin over that of air.
    normalize
        Divide by what even light would bring: see above.
    tolerance
        Worst error over the brightest light that entered, see `GATHER_TOL`, above 0.
    entered_at
        What enters at the exit points themselves, (Q, 3): taken for the light that comes out
        nearer than the sources can tell. None: what enters at the sources near by.
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
    """Return what leaves, as `exitance`, for a tree that is used for several lights or views."""
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
        here.flags.writeable = False  # what may be written would have the kernel compiled anew
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
    name: str, values: Float64Array, shape: tuple[int, ...], interval: str = FINITE
) -> None:
    Checks(GatherError).shape(name, values, shape)
    Checks(GatherError).within(f"{name} (leave points without it out)", values, interval)


def _broadcast(name: str, given: ArrayLike, count: int) -> Float64Array:
    values = np.asarray(given, np.float64)
    _expect(name, values, values.shape)
    return Checks(GatherError).broadcast(name, values, (count, 3))
