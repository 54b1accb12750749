"""Trace light from a source fiber to fibers on tissue: Monte Carlo scored in their cones.

The quantity is the reflectance in the fiber R_f in 1/mm^2: the power in a detection fiber, divided
by the source's power, the area of the fiber's core and the square of its aperture. Where the light
that leaves is Lambertian, it is the exitance per source power, averaged over the core.

Three methods reduce the variance. Light is scored at every collision instead of at random exits. A
plane stack is translation invariant, so photons start at a point and are scored in rings, with the
exact fraction of point pairs, one in each core, at that distance. And photons are split where few
arrive and terminated by roulette where many do, so that all distances are visited equally; weights
keep the result unbiased.
"""

from dataclasses import dataclass
from math import isfinite
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigsim.arrays import Float32Array, Float64Array, Int64Array
from rigsim.fiber.photon_splitting import (
    WINDOW_CELLS,
    adapt_window,
    scoring_probabilities,
    transport_depth_mm,
    uniform_window,
)
from rigsim.fiber.rings import ring_kernels
from rigsim.fiber.walk import walk_to_fibers
from rigsim.tissue import tissue_mc
from rigsim.tissue.tissue_mc import LayerStack, TransportError

PATH_SCALE_MM: Final = 0.05
"""Path length above which the nodes of a path histogram are logarithmic."""

PATH_STEP: Final = 0.006
"""Relative spacing of those nodes; a reweighted score is off by (sigma path step)^2 / 8 of it."""

MAX_PATH_MM: Final = 20_000.0
"""Longer paths count as this one when they are reweighted: exp(-sigma 20 m) is 0 for all tissue."""

PILOT_FRACTION: Final = 0.01
"""Fraction of photons in each of `PILOT_RUNS` runs, which estimate the arrivals by distance."""

PILOT_RUNS: Final = 3
"""Number of pilots; each reaches farther than the one before."""


@dataclass(frozen=True, slots=True)
class FiberGeometry:
    """A source fiber and detection fibers on the surface."""

    radii_mm: tuple[float, ...]
    """Distances of the detection fibers' axes from the source's, mm, >= 0, at least one."""
    core_mm: float = 0.2
    """Diameter of the detection fibers' cores, mm, > 0."""
    source_core_mm: float = 0.2
    """Diameter of the source fiber's core, mm, >= 0."""
    numerical_aperture: float = 0.22
    """Numerical aperture of the detection fibers, in (0, 1]; 1 in air accepts all angles."""
    source_numerical_aperture: float = 0.22
    """Numerical aperture of the source fiber, in [0, 1]; 0 for parallel light."""

    def __post_init__(self) -> None:
        if not self.radii_mm:
            raise TransportError("radii_mm: expected at least one distance, got none")
        for radius in self.radii_mm:
            _require("radii_mm", radius, isfinite(radius) and radius >= 0.0, "finite, >= 0")
        _require("core_mm", self.core_mm, isfinite(self.core_mm) and self.core_mm > 0.0, "> 0")
        core = self.source_core_mm
        _require("source_core_mm", core, isfinite(core) and core >= 0.0, ">= 0")
        aperture = self.numerical_aperture
        _require("numerical_aperture", aperture, 0.0 < aperture <= 1.0, "in (0, 1]")
        aperture = self.source_numerical_aperture
        _require("source_numerical_aperture", aperture, 0.0 <= aperture <= 1.0, "in [0, 1]")


@dataclass(frozen=True, slots=True)
class SpectralStack:
    """Layers that depend on the wavelength, and the bands in which light is measured."""

    wavelength_nm: tuple[float, ...]
    """Wavelengths, nm, at least one."""
    stacks: tuple[LayerStack, ...]
    """The layers at each wavelength; as many in each."""
    band_weights: Float64Array
    """Weight of each wavelength in each band, >= 0, shape (wavelengths, bands): the light source's
    spectrum times the band's sensitivity, each column of sum 1 for a reflectance."""

    def __post_init__(self) -> None:
        count = len(self.wavelength_nm)
        if not count or len(self.stacks) != count:
            raise TransportError(
                f"stacks: expected one for each of {count} wavelengths (at least one), "
                f"got {len(self.stacks)}"
            )
        if len({len(stack.layers) for stack in self.stacks}) != 1:
            raise TransportError("stacks: expected as many layers at every wavelength")
        weights = np.asarray(self.band_weights, np.float64)
        if weights.ndim != 2 or len(weights) != count or not np.all(weights >= 0.0):
            raise TransportError(
                f"band_weights: expected numbers >= 0 of shape ({count}, bands), got shape "
                f"{weights.shape}"
            )
        if not np.all(np.isfinite(weights)) or not np.all(weights.sum(axis=0) > 0.0):
            raise TransportError("band_weights: expected finite columns that are not all zero")
        object.__setattr__(self, "band_weights", weights)


@dataclass(frozen=True, slots=True)
class FiberProfile:
    """Reflectance in the fiber by distance, with one-sigma standard errors."""

    radii_mm: Float64Array
    """Distances of the fibers, mm, shape (F,)."""
    reflectance_per_mm2: Float64Array
    """R_f in 1/mm^2, shape (F,), or (F, bands) of a `SpectralStack`."""
    stderr: Float64Array
    """Standard error of `reflectance_per_mm2`, same shape. Neighbors' errors are correlated."""
    batch_reflectance_per_mm2: Float64Array
    """`reflectance_per_mm2` of each independent batch, shape (batches, F[, bands])."""
    photons: int
    """Photons traced, without the pilots'."""

    @property
    def batches(self) -> int:
        """Return the number of independent batches of the standard errors."""
        return len(self.batch_reflectance_per_mm2)


@dataclass(frozen=True, slots=True)
class FiberPaths:
    """Light in the fibers by its path length through one absorber.

    More of the absorber attenuates a path by exp(-sigma path) without changing collisions, so one
    run serves every higher concentration.
    """

    radii_mm: Float64Array
    """Distances of the fibers, mm, shape (F,)."""
    path_mm: Float64Array
    """Nodes of the path in the counted absorber, mm, increasing from 0, shape (nodes,)."""
    score: Float32Array
    """R_f in 1/mm^2 that took each path, shape (batches, F, nodes[, bands])."""
    photons: int
    """Photons traced."""

    def profile(self, extra_per_mm: float = 0.0) -> FiberProfile:
        """Return the profile with absorption added to that of the run.

        Parameters
        ----------
        extra_per_mm
            Absorption coefficient in 1/mm of the counted absorber at a share of 1, above what the
            run had, >= 0. Noise grows with it, as fewer and fewer paths matter.

        Returns
        -------
        FiberProfile

        Raises
        ------
        TransportError
            When `extra_per_mm` is negative or not finite.
        """
        fine = isfinite(extra_per_mm) and extra_per_mm >= 0.0
        _require("extra_per_mm", extra_per_mm, fine, "a finite number >= 0")
        survival = np.exp(-extra_per_mm * self.path_mm)
        each = np.einsum("bfn...,n->bf...", self.score, survival, dtype=np.float64)
        return mean_and_stderr(self.radii_mm, each, self.photons)


def trace_fiber_profile(
    stack: LayerStack | SpectralStack,
    *,
    radii_mm: ArrayLike,
    photons: int,
    rng: np.random.Generator,
    core_mm: float = 0.2,
    source_core_mm: float = 0.2,
    numerical_aperture: float = 0.22,
    source_numerical_aperture: float = 0.22,
    batches: int = tissue_mc.MIN_BATCHES,
    threads: int = 1,
) -> FiberProfile:
    """Trace light from a source fiber to detection fibers on the same surface.

    Parameters
    ----------
    stack
        Layers and the media around them, at one wavelength or at several in bands. The source
        shines uniformly over its core and over the projected solid angle of its cone.
    radii_mm
        Distances of the detection fibers from the source, mm, >= 0, shape (F,).
    photons
        Photons to trace, rounded up to a multiple of `batches` (times wavelengths).
    rng
        Source of the batches' seeds; a fresh generator of equal seed repeats the result exactly.
    core_mm, source_core_mm
        Diameters of the cores, mm.
    numerical_aperture, source_numerical_aperture
        Apertures of the fibers, n sin(half angle).
    batches
        Independent batches, at least 20.
    threads
        Threads to use; the result does not depend on it.

    Returns
    -------
    FiberProfile
        R_f with standard errors. Light that left the source and was never scattered, only reflected
        by inner interfaces, is included; specular reflection of the surface is not.

    Raises
    ------
    TransportError
        When an argument is out of range; the message names it.

    Examples
    --------
    >>> from math import inf
    >>> from rigsim.tissue.tissue_mc import Layer
    >>> red = LayerStack((Layer(inf, 0.04, 7.5, 0.8, 1.4),))
    >>> near_and_far = trace_fiber_profile(
    ...     red, radii_mm=(0.3, 3.3), photons=4000, rng=np.random.default_rng(0)
    ... )
    >>> bool(near_and_far.reflectance_per_mm2[0] > 10.0 * near_and_far.reflectance_per_mm2[1])
    True
    """
    fibers = FiberGeometry(
        tuple(np.atleast_1d(np.asarray(radii_mm, np.float64)).tolist()),
        core_mm,
        source_core_mm,
        numerical_aperture,
        source_numerical_aperture,
    )
    each, traced = _trace(stack, fibers, photons, rng, batches, threads, None)
    return mean_and_stderr(np.array(fibers.radii_mm), each, traced)


def trace_fiber_paths(
    stack: LayerStack | SpectralStack,
    fibers: FiberGeometry,
    *,
    photons: int,
    rng: np.random.Generator,
    absorber: ArrayLike | None = None,
    batches: int = tissue_mc.MIN_BATCHES,
    threads: int = 1,
) -> FiberPaths:
    """Trace light as `trace_fiber_profile` and store its paths through one absorber.

    Parameters
    ----------
    stack, photons, rng, batches, threads
        As in `trace_fiber_profile`. Take the smallest absorption of interest.
    fibers
        The fibers.
    absorber
        Share of the counted absorber in each layer, >= 0 and somewhere > 0, shape (layers,) or
        (wavelengths, layers): 1 everywhere (the default) for absorption that is added to all
        layers, or blood's fraction times its absorption for a change of blood.

    Returns
    -------
    FiberPaths

    Raises
    ------
    TransportError
        When an argument is out of range; the message names it.

    Examples
    --------
    >>> from math import inf
    >>> from rigsim.tissue.tissue_mc import Layer
    >>> clear = LayerStack((Layer(inf, 0.01, 7.5, 0.8, 1.4),))
    >>> paths = trace_fiber_paths(
    ...     clear, FiberGeometry((0.3, 3.3)), photons=4000, rng=np.random.default_rng(0)
    ... )
    >>> light, dark = paths.profile(0.0), paths.profile(0.24)
    >>> bool((light.reflectance_per_mm2 > dark.reflectance_per_mm2).all())
    True
    """
    spectral = _spectral(stack)
    shape = (len(spectral.stacks), len(spectral.stacks[0].layers))
    shares = np.ones(shape) if absorber is None else np.asarray(absorber, np.float64)
    if shares.ndim not in (1, 2) or not np.all(np.isfinite(shares)) or not np.all(shares >= 0.0):
        raise TransportError(f"absorber: expected finite numbers >= 0 for {shape[1]} layers")
    try:
        shares = np.broadcast_to(shares, shape)
    except ValueError as error:
        raise TransportError(
            f"absorber: expected shape {shape[1:]} or {shape}, got {shares.shape}"
        ) from error
    if not shares.max() > 0.0:
        raise TransportError("absorber: expected a share > 0 in some layer, got none")
    each, traced = _trace(stack, fibers, photons, rng, batches, threads, shares / shares.max())
    nodes = PATH_SCALE_MM * np.expm1(PATH_STEP * np.arange(_path_nodes())) * shares.max()
    return FiberPaths(np.array(fibers.radii_mm), nodes, each.astype(np.float32), traced)


def _path_nodes() -> int:
    return int(np.ceil(np.log1p(MAX_PATH_MM / PATH_SCALE_MM) / PATH_STEP)) + 1


def _spectral(stack: LayerStack | SpectralStack) -> SpectralStack:
    if isinstance(stack, SpectralStack):
        return stack
    return SpectralStack((0.0,), (stack,), np.ones((1, 1)))


def mean_and_stderr(radii_mm: Float64Array, batches: Float64Array, photons: int) -> FiberProfile:
    """Return mean and standard error of independent batches, shape (batches, F, ...)."""
    error = batches.std(axis=0, ddof=1) / np.sqrt(len(batches))
    return FiberProfile(radii_mm, batches.mean(axis=0), error, batches, photons)


def _trace(
    stack: LayerStack | SpectralStack,
    fibers: FiberGeometry,
    photons: int,
    rng: np.random.Generator,
    batches: int,
    threads: int,
    absorber: Float64Array | None,
) -> tuple[Float64Array, int]:
    """Return scores by batch, shape (batches, F[, nodes][, bands]), and the photons traced."""
    spectral = _spectral(stack)
    tissue_mc.photons_per_batch(photons, batches, threads)
    order = np.argsort(fibers.radii_mm, kind="stable")
    rings = ring_kernels(
        np.array(fibers.radii_mm)[order], 0.5 * fibers.core_mm, 0.5 * fibers.source_core_mm
    )
    shares = spectral.band_weights.max(axis=1)
    shares = shares / shares.sum()
    nodes = (_path_nodes(),) if absorber is not None else ()
    bands = spectral.band_weights.shape[1:]
    total = np.zeros((batches, len(order), *nodes, *bands))
    traced = 0
    for index, layers in enumerate(spectral.stacks):
        seeds = tissue_mc.batch_seeds(rng, batches + PILOT_RUNS)
        if not shares[index] > 0.0:
            continue
        count = -(-round(photons * float(shares[index])) // batches) or 1
        traced += count * batches
        row = None if absorber is None else absorber[index]
        plan = _Plan(layers, fibers, rings, row)
        for batch, score in enumerate(plan.trace(count, batches, seeds, threads)):
            for band in range(bands[0]):
                weight = spectral.band_weights[index, band]
                total[batch, ..., band] += weight / count * score
    back = np.empty_like(total)
    back[:, order] = total
    return (back if isinstance(stack, SpectralStack) else back[..., 0]), traced


Rings = tuple[Float64Array, Int64Array, Int64Array]


class _Plan:
    """Input of the walk for one stack and its fibers."""

    def __init__(
        self, stack: LayerStack, fibers: FiberGeometry, rings: Rings, absorber: Float64Array | None
    ) -> None:
        self.fibers, self.rings = fibers, rings
        table = tissue_mc.layer_table(stack)
        depth = np.zeros(len(table))
        share = np.zeros(len(table))
        with np.errstate(invalid="ignore"):
            thickness = table[1:-1, 1] - table[1:-1, 0]
            optical = np.where(table[1:-1, 2] > 0.0, thickness * table[1:-1, 2], 0.0)
        depth[2:] = np.cumsum(optical)
        if absorber is not None:
            share[1:-1] = absorber
        self.table = np.column_stack([table, depth, share])
        self.counts_paths = absorber is not None
        farthest = max(fibers.radii_mm) + 0.5 * (fibers.core_mm + fibers.source_core_mm)
        self.reach_mm = 3.0 * max(farthest, 1.0)
        self.farthest_mm = max(farthest, 1.0)
        self.chances, self.chances_per_mm = scoring_probabilities(self.table)
        self.deeper_per_mm = 1.0 / transport_depth_mm(self.table)

    def trace(
        self, count: int, batches: int, seeds: NDArray[np.uint64], threads: int
    ) -> list[Float64Array]:
        """Return the sums of each batch's scores, with the splitting of the pilots."""
        window = uniform_window(self.reach_mm, self.farthest_mm)
        pilot = max(200, round(PILOT_FRACTION * count * batches))
        for seed in seeds[batches:]:
            visited = self._run(window, pilot, seed)[1]
            window = adapt_window(visited, window, self.reach_mm, self.farthest_mm)
        return tissue_mc.run_in_threads(
            lambda batch: self._run(window, count, seeds[batch])[0], batches, threads
        )

    def _run(
        self, window: Float64Array, photons: int, seed: NDArray[np.uint64]
    ) -> tuple[Float64Array, Float64Array]:
        """Return the sums of the fibers' scores and of the weights at each distance."""
        fibers = len(self.rings[0])
        tally = np.zeros(fibers)
        histogram = np.zeros((fibers, _path_nodes()) if self.counts_paths else (0, 0))
        visited = np.zeros((2, len(window)))
        sines = self.fibers.source_numerical_aperture, self.fibers.numerical_aperture
        per_mm = WINDOW_CELLS / self.reach_mm, self.deeper_per_mm, self.chances_per_mm
        paths, found = (PATH_STEP, PATH_SCALE_MM), (tally, histogram, visited)
        how = (self.rings, window, self.chances, per_mm, paths, photons, seed.copy())
        walk_to_fibers(self.table, sines, *how, found)
        return (histogram if self.counts_paths else tally), visited


def _require(name: str, value: float, holds: bool, expected: str) -> None:
    if not holds:
        raise TransportError(f"{name}: expected {expected}, got {value}")
