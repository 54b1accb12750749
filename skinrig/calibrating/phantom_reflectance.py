"""Predict the readings of a fiber probe on a phantom from the phantom's certificate."""

from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from capture.calibration.fiber.phantom import (
    CertificateError,
    ExpectedReflectance,
    PhantomCertificate,
    read_certificate,
)
from capture.rig import Rig
from model import photon_table, spectra
from skinrig.arrays import Float64Array


def expected_reflectance(certificate: PhantomCertificate, rig: Rig) -> ExpectedReflectance:
    """Predict the reflectance that a perfect probe's fibers collect, averaged over camera bands.

    Parameters
    ----------
    certificate
        Certificate of the phantom.
    rig
        With a probe, a light of known illuminant and a camera of known sensitivity.

    Returns
    -------
    ExpectedReflectance
        With two errors common to all fibers: the certificate's absorption and its scattering.

    Raises
    ------
    CertificateError
        If the phantom's coefficients are outside the photon table.

    Examples
    --------
    >>> from capture.calibration.fiber.phantom import CertificateUncertainty
    >>> from capture.rig import load_rig
    >>> paper = PhantomCertificate(
    ...     eta=1.4, g=0.8, wavelength_nm=(550.0,), sigma_a_per_mm=(0.01,),
    ...     sigma_s_prime_per_mm=(1.2,),
    ...     uncertainty=CertificateUncertainty(sigma_a=0.02, sigma_s_prime=0.02))
    >>> expected = expected_reflectance(paper, load_rig("probe"))
    >>> expected.per_mm2.shape, expected.common.shape
    ((28, 3), (2, 28, 3))
    """
    if rig.probe is None:
        raise CertificateError(f"rig {rig.name!r}: has no probe, expected one; use the probe rig")
    probe = rig.probe
    light, camera = rig.lights[0].illuminant, rig.views[0].spectral_sensitivity
    # one certified wavelength means a gray phantom: the same coefficients at every wavelength
    gray = len(certificate.wavelength_nm) == 1
    wavelength = np.array([550.0]) if gray else np.asarray(spectra.WAVELENGTH_NM, np.float64)
    weights = (
        np.ones((1, 3)) if gray else spectra.band_weights(camera, light, wavelength_nm=wavelength)
    )
    sigma_a, sigma_s = certificate.at(wavelength)
    how: dict[str, Any] = {"eta": certificate.eta, "g": certificate.g, "collection": "fiber"}
    at = (np.array(probe.radius_mm), sigma_a[:, None], sigma_s[:, None])
    cores: dict[str, Any] = {"core_mm": probe.fibers[0].core_mm}
    cores["source_core_mm"] = probe.source_core_mm
    try:
        inside = photon_table.is_in_domain(*at, **how)
        slopes = photon_table.derivatives(*at, **(cores | how))
        own = photon_table.relative_error(*at, **how)
    except photon_table.TableDomainError as exc:
        raise CertificateError(f"phantom: {exc}") from exc
    if not inside[:, :3].any():
        raise CertificateError(
            "phantom: its coefficients are outside the photon table"
            f" (sigma_a {sigma_a.min():g} to {sigma_a.max():g}, sigma_s'"
            f" {sigma_s.min():g} to {sigma_s.max():g} per mm); use a phantom with optics like skin"
        )

    def band(values: Float64Array) -> Float64Array:
        return np.asarray(values.T @ weights)

    value = slopes.reflectance_per_mm2
    mean = band(value)
    # errors of the table at neighboring wavelengths are fully correlated: their weighted sum is
    # taken, not the root of the sum of squares
    stderr = band(value * np.where(np.isfinite(own), np.minimum(own, 1.0), 1.0))
    # first-order propagation: dR/R = (dR/d ln sigma) u_rel(sigma) / R, with dR/d ln sigma
    # = sigma dR/d sigma; one relative uncertainty holds for all wavelengths and fibers
    relative = certificate.uncertainty
    by_a = band(slopes.by_sigma_a * sigma_a[:, None]) * relative.sigma_a / mean
    by_s = band(slopes.by_sigma_s_prime * sigma_s[:, None]) * relative.sigma_s_prime / mean
    return ExpectedReflectance(mean, stderr, np.stack([by_a, by_s]))


def packaged_certificate() -> PhantomCertificate:
    """Return the certificate of the simulated phantom."""
    return read_certificate(Path(str(files("rigsim"))) / "data" / "phantom.json")
