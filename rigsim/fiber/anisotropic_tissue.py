"""Anisotropic tissue with aligned fibers, as in abdominal skin: direction-dependent profiles.

Scattering from a direction w into w' has the density ``sigma_s a(w) a(w') p(w . w')`` with ``a(w) =
1 + strength ((w . t)^2 - 1/3)``, t the axis in the surface along which the fibers run and p the
Henyey-Greenstein function. It is the same both ways, so light is reciprocal. As p keeps a
second-order harmonic with the factor g^2, the coefficient is ``sigma_s a(w) (1 + strength g^2 ((w .
t)^2 - 1/3))`` in closed form. With a negative strength light is scattered less along the fibers
than across, so it travels farther along them.
"""

from dataclasses import dataclass
from math import isfinite
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigsim.arrays import Float64Array
from rigsim.fiber import photon_splitting as splitting
from rigsim.fiber import profile as profiles
from rigsim.fiber.anisotropic_walk import walk_anisotropic
from rigsim.fiber.rings import KERNEL_NODES, disc_overlap_area
from rigsim.tissue import tissue_mc
from rigsim.tissue.tissue_mc import TransportError

OVERLAP_NODES: Final = 2000

MAX_HARMONIC: Final = 8
"""Default highest angular harmonic; scattered light has only few."""


@dataclass(frozen=True, slots=True)
class AnisotropicTissue:
    """A half-space under air whose scattering depends on direction."""

    sigma_a_per_mm: float
    """Absorption coefficient, 1/mm, > 0."""
    sigma_s_per_mm: float
    """Scattering coefficient for strength 0, 1/mm, > 0."""
    g: float = 0.8
    """Mean cosine of the Henyey-Greenstein function, -1 < g < 1."""
    eta: float = 1.4
    """Refractive index, >= 1."""
    strength: float = -1.0
    """Weight of the second-order harmonic, -1.5 < strength < 3; 0 for isotropic tissue."""
    axis_rad: float = 0.0
    """Direction of the fibers in the surface, rad from +x towards +y."""

    def __post_init__(self) -> None:
        for name, holds, expected in (
            ("sigma_a_per_mm", 0.0 < self.sigma_a_per_mm < np.inf, "finite, > 0"),
            ("sigma_s_per_mm", 0.0 < self.sigma_s_per_mm < np.inf, "finite, > 0"),
            ("g", -1.0 < self.g < 1.0, "-1 < g < 1"),
            ("eta", 1.0 <= self.eta < np.inf, ">= 1"),
            ("strength", -1.5 < self.strength < 3.0, "-1.5 < strength < 3"),
            ("axis_rad", isfinite(self.axis_rad), "finite"),
        ):
            if not holds:
                raise TransportError(f"{name}: expected {expected}, got {getattr(self, name)}")


def trace_anisotropic_profile(
    tissue: AnisotropicTissue,
    fibers: profiles.FiberGeometry,
    *,
    azimuth_rad: ArrayLike,
    photons: int,
    rng: np.random.Generator,
    harmonics: int | None = MAX_HARMONIC,
    batches: int = tissue_mc.MIN_BATCHES,
    threads: int = 1,
) -> profiles.FiberProfile:
    """Trace light to lines of fibers on the tissue in several directions.

    Parameters
    ----------
    tissue
        The tissue.
    fibers
        The fibers of one line.
    azimuth_rad
        Directions of the line, rad from +x towards +y, shape (A,).
    photons, rng, batches, threads
        As in `rigsim.fiber.profile.trace_fiber_profile`.
    harmonics
        Even order up to which the dependence on the direction is scored, in rings, by its Fourier
        series: the tissue's mirror symmetry leaves even ones only. ``None`` scores fibers at their
        positions (and mirror images): without a series, but with ten and more times the noise far
        away.

    Returns
    -------
    FiberProfile
        `reflectance_per_mm2` of shape (F, A).

    Raises
    ------
    TransportError
        When the request makes no sense; the message names the field.

    Examples
    --------
    >>> run = trace_anisotropic_profile(
    ...     AnisotropicTissue(0.05, 7.5), profiles.FiberGeometry((0.3, 1.8)),
    ...     azimuth_rad=(0.0, 1.5708),
    ...     photons=4000, rng=np.random.default_rng(0),
    ... )
    >>> bool(run.reflectance_per_mm2[1, 0] > run.reflectance_per_mm2[1, 1])  # farther along
    True
    """
    angles = np.atleast_1d(np.asarray(azimuth_rad, np.float64))
    if angles.ndim != 1 or not angles.size or not np.all(np.isfinite(angles)):
        raise TransportError("azimuth_rad: expected finite angles on one axis, at least one")
    count = tissue_mc.photons_per_batch(photons, batches, threads)
    radii = np.array(fibers.radii_mm)
    order = np.argsort(np.repeat(radii, angles.size), kind="stable")
    far = np.repeat(radii, angles.size)[order]
    way = np.tile(angles - tissue.axis_rad, radii.size)[order]
    places = np.ascontiguousarray(np.stack([far * np.cos(way), far * np.sin(way)], axis=1))
    both = 0.5 * (fibers.core_mm + fibers.source_core_mm)
    overlap, per_mm = _overlap(fibers)
    bins_per_mm = 2000.0 / (far[-1] + both)
    edges = np.arange(2001) / bins_per_mm
    starts = np.searchsorted(far + both, edges[:-1], side="right")
    counts = np.maximum(np.searchsorted(far - both, edges[1:], side="left") - starts, 0)
    farthest = max(float(far[-1]) + both, 1.0)
    reach = 3.0 * farthest
    medium = np.array(
        [tissue.sigma_a_per_mm, tissue.sigma_s_per_mm, tissue.g, tissue.eta, tissue.strength]
    )
    deeper = tissue.sigma_a_per_mm + tissue.sigma_s_per_mm * (1.0 - tissue.g)
    seeds = tissue_mc.batch_seeds(rng, batches + profiles.PILOT_RUNS)

    if harmonics is None:
        rings, shape = np.zeros((0, 2, 1)), (far.size, 1)
    else:
        if harmonics < 0 or harmonics % 2:
            raise TransportError(f"harmonics: expected even and >= 0, or None, got {harmonics}")
        line = np.sort(radii)
        rings = np.stack([_harmonics(radius, fibers, harmonics) for radius in line])
        shape = (line.size, rings.shape[2])
        starts = np.searchsorted(line + both, edges[:-1], side="right")
        counts = np.maximum(np.searchsorted(line - both, edges[1:], side="left") - starts, 0)

    def run(
        window: Float64Array, traced: int, seed: NDArray[np.uint64]
    ) -> tuple[Float64Array, ...]:
        tally = np.zeros(shape)
        visited = np.zeros((2, window.size))
        bins = starts.astype(np.int64), counts.astype(np.int64), bins_per_mm
        how = (bins, rings, window, (splitting.WINDOW_CELLS / reach, deeper), traced, seed.copy())
        walk_anisotropic(medium, sines, (places, overlap, per_mm), *how, (tally, visited))
        return tally / traced, visited

    sines = fibers.source_numerical_aperture, fibers.numerical_aperture
    window = splitting.uniform_window(reach, farthest)
    for seed in seeds[batches:]:
        pilot = max(200, round(profiles.PILOT_FRACTION * count * batches))
        window = splitting.adapt_window(run(window, pilot, seed)[1], window, reach, farthest)
    rows = tissue_mc.run_in_threads(
        lambda batch: run(window, count, seeds[batch])[0], batches, threads
    )
    each = np.empty((batches, radii.size, angles.size))
    if harmonics is None:
        flat = each.reshape(batches, far.size)  # shares the memory
        flat[:, order] = np.array(rows)[..., 0]
    else:
        orders = np.arange(0, harmonics + 4, 2)[: rings.shape[2]]
        turns = np.cos(np.outer(orders, angles - tissue.axis_rad))
        each[:, np.argsort(radii, kind="stable")] = np.array(rows) @ turns
    return profiles.mean_and_stderr(radii, each, count * batches)


def _overlap(fibers: profiles.FiberGeometry) -> tuple[Float64Array, float]:
    """Return the density of (point in one core - point in the other) and its nodes per mm."""
    detector, source = 0.5 * fibers.core_mm, 0.5 * fibers.source_core_mm
    if source == 0.0:
        raise TransportError("source_core_mm: expected > 0 on anisotropic tissue, got 0")
    apart = np.linspace(0.0, detector + source, OVERLAP_NODES)
    area = disc_overlap_area(apart, detector, source)
    density = area / (np.pi * detector**2 * np.pi * source**2)
    density[-1] = 0.0
    return density, (OVERLAP_NODES - 1) / apart[-1]


def _harmonics(radius_mm: float, fibers: profiles.FiberGeometry, max_harmonic: int) -> Float64Array:
    """Return the even harmonics of a fiber's density over the direction to the exit, by radius."""
    detector, source = 0.5 * fibers.core_mm, 0.5 * fibers.source_core_mm
    both = detector + source
    low = max(0.0, radius_mm - both)
    rho = np.linspace(low, radius_mm + both, KERNEL_NODES)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (rho**2 + radius_mm**2 - both**2) / (2.0 * rho * radius_mm)
    half = np.arccos(np.clip(np.nan_to_num(cosine, nan=-1.0), -1.0, 1.0))
    half = np.where(rho + radius_mm <= both, np.pi, half)
    nodes, weights = np.polynomial.legendre.leggauss(128)
    angle = 0.5 * half[:, None] * (nodes + 1.0)
    apart = np.sqrt(
        np.maximum(
            rho[:, None] ** 2 + radius_mm**2 - 2.0 * rho[:, None] * radius_mm * np.cos(angle), 0.0
        )
    )
    area = disc_overlap_area(apart, detector, source)
    density = area / (np.pi * detector**2 * np.pi * source**2)
    orders = np.arange(0, max_harmonic + 1, 2)
    parts = np.einsum("rn,n,rnk->rk", density, weights, np.cos(angle[..., None] * orders))
    parts *= (0.5 * half / np.pi)[:, None] * np.where(orders == 0, 1.0, 2.0)
    table = np.zeros((2 + rho.size, orders.size + 1))
    table[0, :2] = low, (rho.size - 1) / (rho[-1] - rho[0])
    table[1:-1, :-1] = parts
    return table
