"""Simulate light transport in plane layers of tissue by Monte Carlo.

A pencil beam is incident normally on a stack of homogeneous layers. Photons scatter by the
Henyey-Greenstein phase function with its real asymmetry, refract and reflect at every change of the
refractive index, and lose weight to absorption at each collision; Russian roulette ends photons of
low weight without bias. The random numbers of a batch depend on nothing but the caller's generator
and the batch's index, so a result is the same for any number of threads.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import inf, isfinite
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigsim.arrays import Float64Array
from rigsim.tissue import photon_lanes
from rigsim.tissue.photon_walk import TALLY_COUNT, walk

_T = TypeVar("_T")

MIN_LANE_PHOTONS = 100_000  # photons from which Dr.Jit is faster, including its start
MIN_BATCHES = 20  # with fewer, the standard error itself is uncertain by more than 16 %


class TransportError(ValueError):
    """Error for a layer stack or a request that cannot be simulated."""


@dataclass(frozen=True, slots=True)
class Layer:
    """One homogeneous layer of scattering and absorbing material."""

    thickness_mm: float
    """Thickness in mm, > 0; infinite for the last layer of a semi-infinite stack."""
    sigma_a_per_mm: float
    """Absorption coefficient in 1/mm, >= 0."""
    sigma_s_per_mm: float
    """Scattering coefficient (not the reduced one) in 1/mm, >= 0."""
    g: float
    """Mean cosine of the Henyey-Greenstein phase function, -1 < g < 1."""
    eta: float
    """Refractive index, >= 1."""

    def __post_init__(self) -> None:
        _require("thickness_mm", self.thickness_mm, self.thickness_mm > 0.0, "> 0")
        for name in ("sigma_a_per_mm", "sigma_s_per_mm"):
            value = getattr(self, name)
            _require(name, value, isfinite(value) and value >= 0.0, "a finite number >= 0")
        _require("g", self.g, -1.0 < self.g < 1.0, "-1 < g < 1")
        _require("eta", self.eta, isfinite(self.eta) and self.eta >= 1.0, ">= 1")


@dataclass(frozen=True, slots=True)
class LayerStack:
    """Plane layers from the lit side down, and the media above and below them."""

    layers: tuple[Layer, ...]
    """At least one layer, top first; only the last may be infinitely thick."""
    eta_above: float = 1.0
    """Refractive index of the medium that the beam comes from, >= 1."""
    eta_below: float = 1.0
    """Refractive index of the medium under the last layer, >= 1; unused when that is infinite."""

    def __post_init__(self) -> None:
        if not self.layers:
            raise TransportError("layers: expected at least one layer, got none")
        for index, layer in enumerate(self.layers[:-1]):
            if layer.thickness_mm == inf:
                raise TransportError(
                    f"layers[{index}].thickness_mm: only the last layer may be infinite, got inf"
                )
        last = self.layers[-1]
        if last.thickness_mm == inf and not last.sigma_a_per_mm > 0.0:
            raise TransportError(
                "layers[-1].sigma_a_per_mm: a semi-infinite layer must absorb, or photons wander "
                "for ever; expected > 0, got 0"
            )
        for name in ("eta_above", "eta_below"):
            value = getattr(self, name)
            _require(name, value, isfinite(value) and value >= 1.0, ">= 1")

    @property
    def specular_reflectance(self) -> float:
        """Return the Fresnel reflectance of the first surface at normal incidence."""
        eta = self.layers[0].eta
        return float(((eta - self.eta_above) / (eta + self.eta_above)) ** 2)


@dataclass(frozen=True, slots=True)
class TransportResult:
    """Reflected, transmitted and absorbed fractions of a pencil beam, with standard errors.

    All fractions are of the incident power, including the specular reflection of the first surface,
    so that they sum to 1 within the error of the roulette.
    """

    specular: float
    """Reflected by the surfaces without ever being scattered, in [0, 1]. The back surface of a
    finite stack is included; `model.tissue_optics.adding_doubling` counts its part as diffuse."""
    reflectance: float
    """Diffuse reflectance: scattered light that exits upwards, without the specular part, in [0,
    1]."""
    reflectance_stderr: float
    """Standard error of `reflectance`."""
    transmittance: float
    """Transmittance, scattered or not, in [0, 1]; 0 for a semi-infinite stack."""
    transmittance_stderr: float
    """Standard error of `transmittance`."""
    absorbed: Float64Array
    """Absorbed in each layer, shape (layers,)."""
    absorbed_stderr: Float64Array
    """Standard error of `absorbed`, shape (layers,)."""
    roulette: float
    """Weight removed minus weight added by the roulette: 0 within its error."""
    ring_edges_mm: Float64Array
    """Edges of the scoring rings around the beam in mm, shape (rings + 1,)."""
    ring_reflectance: Float64Array
    """Part of `reflectance` that left within each ring, shape (rings,)."""
    ring_reflectance_stderr: Float64Array
    """Standard error of `ring_reflectance`, shape (rings,)."""
    photons: int
    """Photons traced."""
    batches: int
    """Independent batches behind the standard errors."""

    @property
    def reflectance_per_mm2(self) -> Float64Array:
        """Return the mean radial density R(r) of each ring in 1/mm^2, shape (rings,)."""
        return np.asarray(self.ring_reflectance / _ring_areas(self.ring_edges_mm))

    @property
    def reflectance_per_mm2_stderr(self) -> Float64Array:
        """Return the standard error of `reflectance_per_mm2` in 1/mm^2, shape (rings,)."""
        return np.asarray(self.ring_reflectance_stderr / _ring_areas(self.ring_edges_mm))

    @property
    def balance(self) -> float:
        """Return the sum of all parts, including roulette: 1 up to rounding."""
        parts = (self.specular, self.reflectance, self.transmittance, self.roulette)
        return float(sum(parts) + self.absorbed.sum())


@dataclass(frozen=True, slots=True)
class EscapePaths:
    """Photons of one batch that exited upwards, for reweighting to other absorptions.

    A photon that left with `weight` in a stack of absorption sigma_a leaves with ``weight *
    exp(-sum((sigma_a' - sigma_a) * path_mm))`` in one of absorption sigma_a' and equal scattering:
    both have the same collisions, and this factor is the ratio of the path probabilities.
    """

    weight: Float64Array
    """Weight relative to one incident photon, shape (n,)."""
    radius_mm: Float64Array
    """Distance of the exit point from the beam in mm, shape (n,)."""
    path_mm: Float64Array
    """Path length in each layer in mm, shape (n, layers)."""
    photons: int
    """Photons that were traced for them."""


def trace_photons(
    stack: LayerStack,
    *,
    photons: int,
    rng: np.random.Generator,
    ring_edges_mm: ArrayLike = (0.0, inf),
    batches: int = MIN_BATCHES,
    threads: int = 1,
    engine: Literal["numba", "drjit", "auto"] = "numba",
) -> TransportResult:
    """Trace a pencil beam at normal incidence on a stack of layers.

    Parameters
    ----------
    stack
        The layers and the media around them.
    photons
        Photons to trace, rounded up to a multiple of `batches`.
    rng
        Source of the batches' seeds; a fresh generator of equal seed repeats the result exactly.
    ring_edges_mm
        Increasing radii in mm, the last may be infinite, shape (rings + 1,).
    batches
        Independent batches, at least 20.
    threads
        Threads to use; the result does not depend on it. Dr.Jit uses those of the renderer.
    engine
        ``"drjit"`` traces photons in the lanes of the processor's vectors, in float32: about five
        times as many per second, and a second to start. ``"auto"`` selects it where available and
        for enough photons, else ``"numba"``. The engines draw different random numbers.

    Returns
    -------
    TransportResult
        Reflectance, transmittance, absorption and radial profile with standard errors.

    Raises
    ------
    TransportError
        When an argument is out of range; the message names it.

    References
    ----------
    Wang, Jacques, Zheng 1995, MCML - Monte Carlo modeling of light transport in multi-layered
    tissues, doi:10.1016/0169-2607(95)01640-F.

    Examples
    --------
    >>> slab = LayerStack((Layer(0.2, 1.0, 9.0, 0.75, 1.0),))  # van de Hulst: R .09739, T .66096
    >>> run = trace_photons(slab, photons=20_000, rng=np.random.default_rng(1))
    >>> abs(run.reflectance - 0.09739) < 4 * run.reflectance_stderr
    True
    >>> round(run.balance, 9)
    1.0
    """
    edges = _ring_edges(ring_edges_mm)
    count = photons_per_batch(photons, batches, threads)
    if engine not in ("numba", "drjit", "auto"):
        raise TransportError(f"engine: expected numba, drjit or auto, got {engine!r}")
    table = layer_table(stack)
    n_layers = len(stack.layers)
    seeds = batch_seeds(rng, batches)
    if engine == "drjit" or (engine == "auto" and photons >= MIN_LANE_PHOTONS and _lanes_work()):
        tallies, count = _walk_lanes(table, edges * edges, count, seeds)
    else:
        tallies = np.zeros((batches, TALLY_COUNT + n_layers + edges.size - 1))
        no_events = np.zeros((0, 2 + n_layers))

        def run(batch: int) -> None:
            walk(table, edges * edges, count, seeds[batch], tallies[batch], no_events)

        run_in_threads(run, batches, threads)
    tallies /= count
    mean = tallies.mean(axis=0)
    error = tallies.std(axis=0, ddof=1) / np.sqrt(batches)
    transmitted = tallies[:, 2] + tallies[:, 3]
    layer_part = slice(TALLY_COUNT, TALLY_COUNT + n_layers)
    ring_part = slice(TALLY_COUNT + n_layers, None)
    return TransportResult(
        specular=stack.specular_reflectance + float(mean[1]),
        reflectance=float(mean[0]),
        reflectance_stderr=float(error[0]),
        transmittance=float(transmitted.mean()),
        transmittance_stderr=float(transmitted.std(ddof=1) / np.sqrt(batches)),
        absorbed=mean[layer_part],
        absorbed_stderr=error[layer_part],
        roulette=float(mean[4]),
        ring_edges_mm=edges,
        ring_reflectance=mean[ring_part],
        ring_reflectance_stderr=error[ring_part],
        photons=count * batches,
        batches=batches,
    )


def trace_escape_paths(
    stack: LayerStack,
    *,
    photons: int,
    rng: np.random.Generator,
    batches: int = MIN_BATCHES,
    threads: int = 1,
) -> tuple[EscapePaths, ...]:
    """Trace a pencil beam and store the paths of the diffusely reflected photons.

    Parameters
    ----------
    stack, photons, rng, batches, threads
        As in `trace_photons`. Take the smallest absorption of interest: reweighting to a smaller
        one than that of `stack` multiplies the weights of long paths and the noise explodes.

    Returns
    -------
    tuple of EscapePaths
        One per batch; ``sum(weight) / photons`` of a batch is its diffuse reflectance.

    Raises
    ------
    TransportError
        When an argument is out of range; the message names it.

    Examples
    --------
    >>> skin = LayerStack((Layer(inf, 0.1, 10.0, 0.8, 1.4),))
    >>> batches = trace_escape_paths(skin, photons=2000, rng=np.random.default_rng(0))
    >>> len(batches), batches[0].path_mm.shape[1]
    (20, 1)
    """
    count = photons_per_batch(photons, batches, threads)
    table = layer_table(stack)
    n_layers = len(stack.layers)
    seeds = batch_seeds(rng, batches)
    edges2 = np.array([0.0, inf])

    def run(batch: int) -> EscapePaths:
        tally = np.zeros(TALLY_COUNT + n_layers + 1)
        events = np.empty((count, 2 + n_layers))
        kept = events[: walk(table, edges2, count, seeds[batch], tally, events)].copy()
        return EscapePaths(kept[:, 0], np.sqrt(kept[:, 1]), kept[:, 2:], count)

    return tuple(run_in_threads(run, batches, threads))


def _lanes_work() -> bool:

    return photon_lanes.is_usable()


def _walk_lanes(
    table: Float64Array, edges2: Float64Array, count: int, seeds: NDArray[np.uint64]
) -> tuple[Float64Array, int]:

    if not photon_lanes.is_usable():
        raise TransportError("engine: expected numba or auto, as Dr.Jit finds no LLVM; got drjit")
    run = photon_lanes.walk_lanes(table, edges2, count, seeds)
    return run.tally, run.photons


def layer_table(stack: LayerStack) -> Float64Array:
    """Return the table of layers and surrounding media for `rigsim.tissue.photon_walk.walk`.

    Columns top, bottom, sigma_t, albedo, g, eta; shape (layers + 2, 6).
    """
    depths = np.cumsum([0.0, *(layer.thickness_mm for layer in stack.layers)])
    rows = [[-inf, 0.0, 0.0, 0.0, 0.0, stack.eta_above]]
    for layer, top, bottom in zip(stack.layers, depths[:-1], depths[1:], strict=True):
        sigma_t = layer.sigma_a_per_mm + layer.sigma_s_per_mm
        albedo = layer.sigma_s_per_mm / sigma_t if sigma_t > 0.0 else 1.0
        rows.append([top, bottom, sigma_t, albedo, layer.g, layer.eta])
    rows.append([depths[-1], inf, 0.0, 0.0, 0.0, stack.eta_below])
    return np.array(rows, dtype=np.float64)


def batch_seeds(rng: np.random.Generator, batches: int) -> NDArray[np.uint64]:
    """Return the initial states of the batches' generators, shape (batches, 4)."""
    return rng.integers(1, 2**64, size=(batches, 4), dtype=np.uint64)


def run_in_threads(run: Callable[[int], _T], batches: int, threads: int) -> list[_T]:
    """Return the results of `run` for each batch, in order; it must release the GIL."""
    if threads == 1:
        return [run(batch) for batch in range(batches)]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(run, range(batches)))


def photons_per_batch(photons: int, batches: int, threads: int) -> int:
    """Check a request and return its photons in each batch, rounded up.

    Raises
    ------
    TransportError
        When one of the three arguments is too small.
    """
    _require("photons", photons, photons >= 1, ">= 1")
    _require("batches", batches, batches >= MIN_BATCHES, f">= {MIN_BATCHES}")
    _require("threads", threads, threads >= 1, ">= 1")
    return -(-photons // batches)


def _ring_edges(edges_mm: ArrayLike) -> Float64Array:
    edges = np.array(edges_mm, dtype=np.float64)
    if edges.ndim != 1 or edges.size < 2 or not np.all(np.diff(edges) > 0.0) or edges[0] < 0.0:
        raise TransportError(
            "ring_edges_mm: expected at least two increasing radii >= 0 on one axis, "
            f"got {edges.tolist()}"
        )
    return edges


def _ring_areas(edges_mm: Sequence[float] | Float64Array) -> Float64Array:
    return np.asarray(np.pi * np.diff(np.square(edges_mm)))


def _require(name: str, value: float, holds: bool, expected: str) -> None:
    if not holds:
        raise TransportError(f"{name}: expected {expected}, got {value}")
