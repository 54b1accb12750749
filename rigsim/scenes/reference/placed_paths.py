"""Trace the light in a probe's fibers on skin whose absorption differs from place to place.

A walk from one fiber to another of 0.2 mm would almost never arrive. Here scattering depends on
depth only, so that a path may be shifted and turned: its probability remains, and only the
absorption along it changes. Photons therefore start at a point and are scored in rings, as in
`rigsim.fiber.profile`. Some of the scored paths are laid between both cores: a point of the
source's core and a direction are drawn from those that end in the other core. The absorption of
the voxels along the path, over that of even layers, then gives the ratio of the readings.

The walk is another one than the simulator's: free paths by scattering alone, absorption by Beer's
law along each step, and light into the cone at every collision.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import inf, isfinite
from typing import Final

import numpy as np

from rigsim.arrays import Float64Array, Int64Array
from rigsim.fiber.photon_splitting import (
    WINDOW_CELLS,
    adapt_window,
    transport_depth_mm,
    uniform_window,
)
from rigsim.fiber.profile import FiberGeometry
from rigsim.fiber.rings import ring_kernels
from rigsim.scenes.reference.placed_walk import walk_placed_paths
from rigsim.tissue import tissue_mc
from rigsim.tissue.tissue_mc import LayerStack, TransportError

PILOT_FRACTION: Final = 0.04
"""Fraction of the photons in each of `PILOT_RUNS` runs, which set the splitting."""
PILOT_RUNS: Final = 3
MIN_PILOT: Final = 400
"""Photons of a pilot at least: chance in fewer may split photons without need."""
REACH_PER_RADIUS: Final = 3.0
"""Distance up to which photons are split, over that of the farthest fiber."""


@dataclass(frozen=True, slots=True, eq=False)
class UnevenLayers:
    """Layers of even scattering whose absorption differs from place to place."""

    stack: LayerStack
    """Layers with an even absorption, one refractive index and one g; the last is infinite."""
    sigma_a_per_mm: Float64Array
    """Absorption of each voxel column of each layer, 1/mm, shape (layers, n, n), rows along +y."""
    voxel_mm: float
    """Side of a column, mm; the maps are centered at the origin and continue at their border."""


@dataclass(frozen=True, slots=True)
class HeadPlace:
    """Place of the probe's head on the surface."""

    x_mm: float = 0.0
    """Position of the source fiber along x, mm."""
    y_mm: float = 0.0
    """Position of the source fiber along y, mm."""
    angle_deg: float = 0.0
    """Direction of the row of fibers from +x to +y, degrees."""


@dataclass(frozen=True, slots=True, eq=False)
class PlacedProfile:
    """Readings on even layers, and the ratios of those at each place."""

    even_per_mm2: Float64Array
    """R_f of even layers in 1/mm^2, of independent batches, shape (batches, F)."""
    laid_per_mm2: Float64Array
    """R_f of the paths that were laid into the voxels, of even layers and at each place, shape
    (batches, F, 1 + places)."""

    @property
    def ratio(self) -> Float64Array:
        """R_f at each place over that of even layers, shape (F, places); 1 without light."""
        return _ratio(self.laid_per_mm2.sum(axis=0))

    @property
    def ratio_stderr(self) -> Float64Array:
        """Standard error of `ratio` by leaving out one batch at a time, same shape."""
        total, count = self.laid_per_mm2.sum(axis=0), len(self.laid_per_mm2)
        each = _ratio(total - self.laid_per_mm2)
        return np.asarray(np.sqrt((count - 1.0) * each.var(axis=0)))


def _ratio(laid_per_mm2: Float64Array) -> Float64Array:
    even, placed = laid_per_mm2[..., :1], laid_per_mm2[..., 1:]
    return np.divide(placed, even, out=np.ones_like(placed), where=even > 0.0)


def trace_placed_paths(
    skin: UnevenLayers,
    fibers: FiberGeometry,
    places: tuple[HeadPlace, ...],
    *,
    photons: int,
    laid_paths: int,
    rng: np.random.Generator,
    batches: int = tissue_mc.MIN_BATCHES,
) -> PlacedProfile:
    """Trace light from the source fiber to the detection fibers at some places of uneven skin.

    Parameters
    ----------
    skin
        The layers under air.
    fibers
        The fibers, with increasing distances.
    places
        Places of the head.
    photons
        Photons to trace, rounded up to a multiple of the batches.
    laid_paths
        Expected number of paths that are laid into the voxels, for each fiber.
    rng
        Source of the batches' seeds.
    batches
        Independent batches, at least 20.

    Raises
    ------
    TransportError
        Layers differ in refractive index or g, the last one ends, or a path is too long.

    Examples
    --------
    >>> from rigsim.tissue.tissue_mc import Layer
    >>> stack = LayerStack((Layer(inf, 0.1, 10.0, 0.8, 1.4),))
    >>> darker = UnevenLayers(stack, np.full((1, 2, 2), 0.2), 1.0)
    >>> run = trace_placed_paths(
    ...     darker, FiberGeometry((0.5, 2.0)), (HeadPlace(),), photons=2000, laid_paths=200,
    ...     rng=np.random.default_rng(0)
    ... )
    >>> bool((run.ratio[1] < run.ratio[0]).all() and (run.ratio < 1.0).all())
    True
    """
    layers, optics = _layers(skin.stack), skin.stack.layers
    if len({(one.g, one.eta) for one in optics}) > 1 or isfinite(optics[-1].thickness_mm):
        raise TransportError(
            "layers: got several g or eta, or a last layer that ends, expected one g, one eta and "
            "an infinite last layer; change the stack"
        )
    even = np.array([layer.sigma_a_per_mm for layer in optics])
    excess = np.ascontiguousarray(skin.sigma_a_per_mm - even[:, None, None])
    radii = np.array(fibers.radii_mm)
    cores = 0.5 * fibers.source_core_mm, 0.5 * fibers.core_mm
    rings = _rings(fibers)
    farthest = max(float(radii[-1]) + sum(cores), 1.0)
    reach = REACH_PER_RADIUS * farthest
    where = np.array([[p.x_mm, p.y_mm, np.radians(p.angle_deg)] for p in places])
    corner = -0.5 * skin.voxel_mm * excess.shape[1], 1.0 / skin.voxel_mm
    sines = fibers.source_numerical_aperture, fibers.numerical_aperture
    how = (optics[0].g, optics[0].eta / skin.stack.eta_above, *sines, *cores)
    per_mm = (WINDOW_CELLS / reach, 1.0 / transport_depth_mm(tissue_mc.layer_table(skin.stack)))

    def run(
        window: Float64Array, replays: Float64Array, count: int, seed: np.ndarray
    ) -> tuple[Float64Array, ...]:
        tally, visited = np.zeros(len(radii)), np.zeros((2, len(window)))
        found = tally, visited, np.zeros((len(radii), 1 + len(places)))
        fixed = (layers, how, radii, rings, window, per_mm, excess, corner, where)
        if walk_placed_paths(*fixed, replays, count, seed.copy(), found):
            raise TransportError(
                "path: got one with too many collisions, expected absorption; raise sigma_a"
            )
        return found

    count = tissue_mc.photons_per_batch(photons, batches, 1)
    seeds = tissue_mc.batch_seeds(rng, batches + PILOT_RUNS)
    window, pilot = uniform_window(reach, farthest), max(MIN_PILOT, round(PILOT_FRACTION * photons))
    nothing = np.zeros(len(radii))
    tally = nothing
    for seed in seeds[batches:]:
        tally, visited, _ = run(window, nothing, pilot, seed)
        window = adapt_window(visited, window, reach, farthest)
    # a fiber that the last pilot missed has as many paths per light as the dimmest of the others
    seen = tally > 0.0
    expected = np.where(seen, tally, tally[seen].min(initial=inf)) * photons / pilot
    replays = laid_paths / expected
    each = [run(window, replays, count, seed) for seed in seeds[:batches]]
    return PlacedProfile(
        np.stack([tally for tally, _, _ in each]) / count,
        np.stack([laid for _, _, laid in each]) / count,
    )


@lru_cache(maxsize=4)
def _rings(fibers: FiberGeometry) -> tuple[Float64Array, Int64Array, Int64Array]:
    """Return the fibers' ring kernels, which all wavelengths share."""
    return ring_kernels(
        np.array(fibers.radii_mm), 0.5 * fibers.core_mm, 0.5 * fibers.source_core_mm
    )


def _layers(stack: LayerStack) -> Float64Array:
    """Return the table of the walk, see `LAYER_COLUMNS`."""
    rows, top, depth = [], 0.0, 0.0
    for layer in stack.layers:
        bottom = top + layer.thickness_mm
        rows.append([top, bottom, layer.sigma_s_per_mm, layer.sigma_a_per_mm, depth])
        depth += layer.thickness_mm * layer.sigma_s_per_mm
        top = bottom
    return np.array(rows)
