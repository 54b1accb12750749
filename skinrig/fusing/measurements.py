"""Signals of one person on one texture, and what the person's skin has in common."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from reconstruction.chromophores.model_error import load_covariance
from reconstruction.fusion.person import POPULATION_MEAN, PersonSkin, Regions, estimate_person
from reconstruction.fusion.regions import hide_signals, summarize_regions
from reconstruction.fusion.signals import FusionError, RigBands, residual_covariance
from reconstruction.fusion.texels import OffsetModel, RigColors
from skinrig.appearances.texel_placement import TexelPlacement
from skinrig.arrays import BoolArray, Float32Array, Float64Array
from skinrig.fitting import probe_sites
from skinrig.fusing.texel_colors import ColorSource, Texels

LOCAL_SHARE: Final = 0.25
"""Variance over places of a face of what the model leaves unexplained, over that over people.

Residuals of measured spectra are known between people only; a quarter is assumed within a face."""
SITE_SIGMA_TR_SD: Final = 0.05
"""Deviation of log sigma_tr between sites of a face that tissue does not explain."""
MAX_SAMPLED_TEXELS: Final = 40_000
"""Texels that the person's common properties are estimated from, evenly over the texture."""


@dataclass(slots=True, eq=False)
class Measurements:
    """Signals of one person on one texture, ready for the estimators.

    Attributes
    ----------
    colors
        Colors by rig, of H x W texels.
    shape
        Rows and columns of the texture.
    sites
        Sites of a probe on the texture.
    position_mm
        (H W, 3): surface points; None without a mesh.
    assumed, left_out
        What was assumed and omitted.
    probe_bands
        Channels of a probe with sites; None without.
    placement
        Places of the texels in the flash rig's image; None if it is the texture, or missing.
    independent
        Whether all errors count as independent: covariances are left out.
    """

    colors: tuple[ColorSource, ...]
    shape: tuple[int, int]
    sites: tuple[probe_sites.ProbeSite, ...] = ()
    position_mm: Float32Array | None = None
    assumed: tuple[str, ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()
    probe_bands: RigBands | None = None
    placement: TexelPlacement | None = None
    independent: bool = False

    @property
    def rigs(self) -> tuple[RigBands, ...]:
        """Bands of all signals: colors first, then the probe."""
        own = tuple(one.bands for one in self.colors)
        return own if self.probe_bands is None else (*own, self.probe_bands)

    @property
    def count(self) -> int:
        """Number of texels."""
        return self.shape[0] * self.shape[1]

    def sampled(self) -> BoolArray:
        """Return evenly chosen texels with a color, at most `MAX_SAMPLED_TEXELS`, (H W,)."""
        known = np.zeros(self.count, bool)
        for one in self.colors:
            known |= one.valid
        places = np.flatnonzero(known)
        few = places[:: max(1, -(-places.size // MAX_SAMPLED_TEXELS))]
        chosen = np.zeros(self.count, bool)
        chosen[few] = True
        return chosen

    def texel_colors(self, texels: Texels) -> list[RigColors]:
        """Return the colors of some texels by all rigs, numbered row by row."""
        found = [one.colors(k, texels) for k, one in enumerate(self.colors)]
        return [one.without_covariance() for one in found] if self.independent else found

    def errors(self, log_skin: Float64Array) -> OffsetModel:
        """Return the covariances of the signals' errors for a face of typical melanin and blood.

        Parameters
        ----------
        log_skin
            (2,): log melanin optical depth and log blood.
        """
        unexplained = residual_covariance(self.rigs, log_skin)
        calibration = np.zeros_like(unexplained)
        simulated = np.zeros_like(unexplained)
        for k, one in enumerate(self.colors):
            at = slice(3 * k, 3 * k + 3)
            calibration[at, at] = one.calibration
            simulated[at, at] = load_covariance()
        local = LOCAL_SHARE * unexplained + simulated
        if self.probe_bands is not None:
            local[-3:, -3:] = SITE_SIGMA_TR_SD**2 * np.eye(3)
            calibration[-3:, -3:] = 1e-6 * np.eye(3)
        found = OffsetModel(unexplained, calibration, local)
        return found.without_covariance() if self.independent else found

    def regions(self, errors: OffsetModel) -> Regions:
        """Return the signals of the whole face and of the probe's sites.

        Parameters
        ----------
        errors
            Covariances of the signals' errors.
        """
        chosen = self.sampled()
        colors = self.texel_colors(chosen)
        whole, _ = summarize_regions(colors, np.zeros(int(chosen.sum()), np.intp), errors)
        parts = [whole]
        for site in self.sites:
            if self.position_mm is None:
                break
            away = np.linalg.norm(self.position_mm - np.array(site.position_mm), axis=-1)
            near = away < probe_sites.SITE_RADIUS_MM
            colors = self.texel_colors(near)
            value, stderr = np.array(site.sigma_tr_per_mm), np.array(site.stderr_per_mm)
            parts.append(summarize_site(value, stderr, colors, errors))
        return Regions(
            np.concatenate([part.values for part in parts]),
            np.concatenate([part.covariance for part in parts]),
        )

    def estimate_person(
        self, regions: Regions | None = None, known: Sequence[int] = ()
    ) -> tuple[PersonSkin, OffsetModel]:
        """Estimate what the person's skin has in common.

        Parameters
        ----------
        regions
            Signals; None: those of `regions`.
        known
            Properties that count as typical, see `reconstruction.fusion.person.estimate_person`.
        """
        errors = self.errors(POPULATION_MEAN)
        given = self.regions(errors) if regions is None else regions
        first = estimate_person(self.rigs, given, errors.offset_covariance, known=known)
        # again with the errors of skin of this color
        errors = self.errors(first.mean)
        given = self.regions(errors) if regions is None else regions
        person = estimate_person(
            self.rigs, given, errors.offset_covariance, start=first, known=known
        )
        return person, errors


def summarize_site(
    sigma_tr_per_mm: Float64Array,
    stderr_per_mm: Float64Array,
    colors: Sequence[RigColors],
    errors: OffsetModel,
) -> Regions:
    """Return the signals of a probe's site: colors around it, where there are enough, and sigma_tr.

    Parameters
    ----------
    sigma_tr_per_mm, stderr_per_mm
        (3,): of the probe; channels that are not finite and positive are not known.
    colors
        Colors of the texels around the site.
    errors
        Covariances of the signals' errors; the probe's signals are the last.
    """
    size = len(errors.local)
    try:
        labels = np.ones(len(colors[0].valid), np.intp) if colors else np.zeros(0, np.intp)
        found, _ = summarize_regions(colors, labels, errors)
        value, covariance = found.values[0], found.covariance[0]
    except FusionError:
        value = np.zeros(size)
        covariance = hide_signals(errors.local, np.ones(size, bool))
    sigma_tr, stderr = np.asarray(sigma_tr_per_mm), np.asarray(stderr_per_mm)
    good = np.isfinite(sigma_tr) & np.isfinite(stderr) & (sigma_tr > 0.0)
    at = np.arange(size - 3, size)[good]
    covariance[at, at] = np.square(stderr[good] / sigma_tr[good]) + SITE_SIGMA_TR_SD**2
    value[at] = np.log(sigma_tr[good])
    return Regions(value[None], covariance[None])
