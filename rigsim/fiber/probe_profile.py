"""Cache Monte Carlo profiles of a tissue under the probe's fibers for a series of captures.

The noise of traced profiles is reduced by smoothing over distance.
"""

import dataclasses
import zlib
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import BSpline

from capture.rig import Fiber, Probe, Rig
from model import spectra
from rigsim.arrays import Float64Array
from rigsim.caching import LruCache
from rigsim.fiber.anisotropic_tissue import trace_anisotropic_profile
from rigsim.fiber.probe_tissue import FibrousTissue, ProbedTissue, TissueError, TissueOptics
from rigsim.fiber.profile import (
    FiberGeometry,
    FiberPaths,
    SpectralStack,
    trace_fiber_paths,
    trace_fiber_profile,
)
from rigsim.fiber.white_fiber import ETA, HENYEY_GREENSTEIN_G, FiberTable

MAX_KEPT_PROFILES: Final = 64
"""Number of cached profiles."""

DIRECTIONS_PER_HALF_TURN: Final = 16
"""Directions over half a turn in which anisotropic tissue is traced; its harmonics up to the 8th
are so that those between follow from them exactly."""

MAX_SHARED_RUNS: Final = 6
"""Number of photon runs that are shared by all scenes of a process: two people at three sites."""

SUCTION_STEP_MBAR: Final = 0.1
"""Step to which suction is rounded: within half of it blood differs by less than a 1000th."""


@dataclass(frozen=True, slots=True, eq=False)
class BandProfile:
    """Reflectance in the fibers in the camera's bands."""

    reflectance_per_mm2: Float64Array
    """R_f in 1/mm^2, shape (F, 3), >= 0."""
    stderr: Float64Array
    """Standard error of the Monte Carlo, same shape."""


_SHARED_RUNS: LruCache[tuple[object, ...], FiberPaths | BandProfile] = LruCache(
    lambda _: MAX_SHARED_RUNS
)


class ProfileCache:
    """Profiles of one tissue under one probe.

    A photon run depends on the rig, the optics, the photons and the seed alone. Scenes of one
    process therefore share it: a forecast and the sessions that confirm it trace photons once.

    Parameters
    ----------
    rig
        The nominal rig; it must have a probe, one view and one light.
    tissue
        Tissue under the probe.
    photons
        Photons for one site and angle.
    seed
        Seed of the photons; a profile depends only on it and the tissue, not on earlier calls.
    threads
        Threads of the photons; the result does not depend on it.
    """

    def __init__(
        self, rig: Rig, tissue: ProbedTissue, *, photons: int, seed: int, threads: int = 2
    ) -> None:
        if rig.probe is None or len(rig.views) != 1 or len(rig.lights) != 1:
            raise TissueError(f"rig {rig.name!r}: expected a contact probe, one view and one light")
        self.rig, self.tissue = rig, tissue
        self.photons, self.seed, self.threads = photons, seed, threads
        self.probe: Probe = rig.probe
        self._by_turn: Float64Array | None = None
        self._profiles: LruCache[tuple[object, ...], BandProfile] = LruCache(
            lambda _: MAX_KEPT_PROFILES
        )

    def profile(self, site: str, angle_deg: float = 0.0, suction_mbar: float = 0.0) -> BandProfile:
        """Return the fibers' reflectance at a site.

        Parameters
        ----------
        site
            Name of the site.
        angle_deg
            Rotation of the head about its axis, degrees.
        suction_mbar
            Suction under the head, mbar.

        Returns
        -------
        BandProfile
            The same for equal arguments and seeds.

        Raises
        ------
        TissueError
            The tissue has no such site.
        """
        suction = SUCTION_STEP_MBAR * round(suction_mbar / SUCTION_STEP_MBAR)

        def make() -> BandProfile:
            if isinstance(self.tissue, FibrousTissue):
                return self._profile_at_angle(self.tissue, angle_deg)
            return self._compute(self.tissue.optics(site, angle_deg, suction))

        return self._profiles.get((site, angle_deg, suction), make)

    def _profile_at_angle(self, tissue: FibrousTissue, angle_deg: float) -> BandProfile:
        """Return the profile along one direction, by the Fourier series of the traced ones."""
        if self._by_turn is None:
            run = trace_anisotropic_profile(
                tissue.medium(),
                probe_fibers(self.probe),
                azimuth_rad=np.pi * np.arange(DIRECTIONS_PER_HALF_TURN) / DIRECTIONS_PER_HALF_TURN,
                photons=self.photons,
                rng=np.random.default_rng([self.seed, zlib.crc32(repr(tissue).encode())]),
                threads=self.threads,
            )
            self._by_turn = run.batch_reflectance_per_mm2
        order = np.fft.rfftfreq(DIRECTIONS_PER_HALF_TURN, 1.0 / DIRECTIONS_PER_HALF_TURN)
        share = (
            np.where((order == 0) | (2 * order == DIRECTIONS_PER_HALF_TURN), 1.0, 2.0)
            / DIRECTIONS_PER_HALF_TURN
        )
        wave = share * np.exp(2j * order * np.radians(angle_deg))
        each = (np.fft.rfft(self._by_turn, axis=-1) @ wave).real
        value, error = smooth_profile(np.array(self.probe.radius_mm), each[..., None])
        return BandProfile(np.repeat(value, 3, axis=1), np.repeat(error, 3, axis=1))

    def _compute(self, optics: TissueOptics) -> BandProfile:
        absorber = None if optics.absorber is None else optics.absorber.tobytes()
        own = self.rig, self.photons, self.seed
        key = (*own, optics.wavelength_nm, optics.stacks, absorber)
        run = _SHARED_RUNS.get(key, lambda: self._trace(optics))
        if isinstance(run, BandProfile):
            return run
        made = run.profile(optics.amount)
        value, error = smooth_profile(made.radii_mm, made.batch_reflectance_per_mm2)
        return BandProfile(value, error)

    def _trace(self, optics: TissueOptics) -> FiberPaths | BandProfile:
        words = repr((optics.wavelength_nm, optics.stacks)).encode()
        rng = np.random.default_rng([self.seed, zlib.crc32(words)])
        stack = optics.stacks[0] if not optics.wavelength_nm else self.spectral_stack(optics)
        kind = probe_fibers(self.probe)
        if optics.absorber is not None:
            return trace_fiber_paths(
                stack,
                kind,
                photons=self.photons,
                rng=rng,
                absorber=optics.absorber,
                threads=self.threads,
            )
        stored = self._look_up(optics, kind)
        if stored is not None:
            return stored
        if not any(layer.sigma_s_per_mm for one in optics.stacks for layer in one.layers):
            nothing = np.zeros((len(self.probe.fibers), 3))
            return BandProfile(nothing, nothing)
        made = trace_fiber_profile(
            stack, photons=self.photons, rng=rng, threads=self.threads, **dataclasses.asdict(kind)
        )
        value, error = made.reflectance_per_mm2, made.stderr
        if value.ndim == 1:
            value, error = (np.repeat(a[:, None], 3, axis=1) for a in (value, error))
        return BandProfile(value, error)

    def _look_up(self, optics: TissueOptics, kind: FiberGeometry) -> BandProfile | None:
        """Return the profile of a homogeneous medium from the stored table."""
        table = FiberTable.load()
        each = []
        for stack in optics.stacks:
            layer = stack.layers[0]
            scattering = layer.sigma_s_per_mm * (1.0 - layer.g)
            if (
                len(stack.layers) > 1
                or abs(layer.g - HENYEY_GREENSTEIN_G) > 1e-12
                or (layer.eta, stack.eta_above) != (ETA, 1.0)
                or not table.covers(layer.sigma_a_per_mm, scattering, kind)
            ):
                return None
            each.append(table.profile(layer.sigma_a_per_mm, scattering, kind))
        weights = np.ones((1, 3))
        if optics.wavelength_nm:
            weights = self.spectral_stack(optics).band_weights
        # errors of similar media are fully correlated (same photons): add them linearly
        value, error = (np.stack(part).T @ weights for part in zip(*each, strict=True))
        return BandProfile(value, error)

    def spectral_stack(self, optics: TissueOptics) -> SpectralStack:
        """Return the stacks with the camera's bands under the probe's light."""
        weights = spectra.band_weights(
            self.rig.views[0].spectral_sensitivity,
            self.rig.lights[0].illuminant,
            optics.wavelength_nm,
        )
        return SpectralStack(optics.wavelength_nm, optics.stacks, weights)


def probe_fibers(probe: Probe) -> FiberGeometry:
    """Return the probe's fibers for the photon walk.

    Raises
    ------
    TissueError
        The detection fibers are not all alike.
    """
    first: Fiber = probe.fibers[0]
    for fiber in probe.fibers:
        if (fiber.core_mm, fiber.numerical_aperture) != (first.core_mm, first.numerical_aperture):
            raise TissueError(f"fiber {fiber.name!r}: expected all detection fibers alike")
    return FiberGeometry(
        probe.radius_mm,
        first.core_mm,
        probe.source_core_mm,
        first.numerical_aperture,
        probe.source_numerical_aperture,
    )


SPLINE_PIECES = 6
"""Pieces of the cubic spline through the logarithm of a profile."""
MAX_RELATIVE_ERROR = 0.3
"""Largest relative error of a fiber in the spline's fit."""
MIN_SPLINE_FIBERS = 14
"""Smallest number of fibers for a spline."""


def smooth_profile(
    radii_mm: Float64Array, batches: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return profiles smoothed over distance, with jackknife errors.

    Parameters
    ----------
    radii_mm
        Distances of the fibers, mm, increasing, shape (F,).
    batches
        Reflectance of independent batches of photons, >= 0, shape (B, F, bands).

    Returns
    -------
    reflectance, stderr : ndarray
        Shape (F, bands): exp of a cubic spline fitted to log reflectance; its errors by leaving
        out one batch at a time. Fibers with more than `MAX_RELATIVE_ERROR` of relative error, and
        all where fewer than `MIN_SPLINE_FIBERS` have less, stay as they were.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> radii = 0.3 + 0.25 * np.arange(28)
    >>> true = np.exp(-0.6 * radii) / radii**2
    >>> noisy = true[:, None] * rng.normal(1.0, 0.1, (20, 28, 1))
    >>> smooth, error = smooth_profile(radii, noisy)
    >>> bool(np.abs(smooth[:, 0] / true - 1.0).max() < 0.06), bool((error < 0.03 * smooth).all())
    (True, True)
    """
    count = len(batches)
    mean = batches.mean(axis=0)
    error = batches.std(axis=0, ddof=1) / np.sqrt(count)
    value, spread = mean.copy(), error.copy()
    for band in range(mean.shape[1]):
        use = (mean[:, band] > 0.0) & (error[:, band] < MAX_RELATIVE_ERROR * mean[:, band])
        if int(use.sum()) < MIN_SPLINE_FIBERS:
            continue
        axis = np.log(radii_mm[use] + 0.3)
        inner = np.linspace(axis[0], axis[-1], SPLINE_PIECES + 1)[1:-1]
        knots = np.concatenate([[axis[0]] * 4, inner, [axis[-1]] * 4])
        basis = BSpline.design_matrix(axis, knots, 3).toarray()
        relative = error[use, band] / mean[use, band]
        # single errors are themselves uncertain: their trend weighs
        trend = np.exp(np.polyval(np.polyfit(axis, np.log(relative), 2), axis))
        one = batches[:, use, band]
        beta = _fit(basis, one.mean(axis=0), trend)
        value[use, band] = np.exp(basis @ beta)
        rest = (one.sum(axis=0) - one) / (count - 1)
        left = np.array([basis @ _fit(basis, r, trend) for r in rest])
        scatter = ((left - left.mean(axis=0)) ** 2).sum(axis=0)
        spread[use, band] = value[use, band] * np.sqrt((count - 1.0) / count * scatter)
    return value, spread


def _fit(basis: Float64Array, mean: Float64Array, relative: Float64Array) -> Float64Array:
    """Return coefficients of the logarithm by Gauss-Newton on relative residuals."""
    beta = np.linalg.lstsq(basis / relative[:, None], np.log(mean) / relative, rcond=None)[0]
    for _ in range(4):
        residual = mean / np.exp(basis @ beta) - 1.0
        step = np.linalg.lstsq(basis / relative[:, None], residual / relative, rcond=None)[0]
        beta = beta + step
    return np.asarray(beta)
