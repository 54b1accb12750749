"""Phantom of known optics: certificate, and expected reflectance in each fiber."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from capture.arrays import Float64Array
from capture.calibration.record import CalibrationError
from capture.documents import Document, FaultCollector, parse_document, read_json, short_repr

SCHEMA: Final = "skinrig.phantom/1"


class CertificateError(CalibrationError):
    """Raised for a phantom's certificate that cannot be used."""


@dataclass(frozen=True, slots=True)
class CertificateUncertainty(Document):
    """Relative standard uncertainties (68 %), each common to all wavelengths."""

    sigma_a: float
    """Standard uncertainty of the absorption coefficients, 0 <= u < 0.5."""
    sigma_s_prime: float
    """Standard uncertainty of the reduced scattering coefficients, 0 <= u < 0.5."""

    def __post_init__(self) -> None:
        checks = FaultCollector("Uncertainty of a phantom", CertificateError)
        for name in ("sigma_a", "sigma_s_prime"):
            value = getattr(self, name)
            checks.check(name, value, 0 <= value < 0.5, "relative, 0 <= u < 0.5")
        checks.close()


@dataclass(frozen=True, slots=True, kw_only=True)
class PhantomCertificate(Document):
    """Certified optics of a homogeneous block, large and thick compared with the probe.

    Examples
    --------
    >>> paper = PhantomCertificate(
    ...     eta=1.4, g=0.7, wavelength_nm=(400.0, 700.0), sigma_a_per_mm=(0.02, 0.01),
    ...     sigma_s_prime_per_mm=(1.8, 1.2),
    ...     uncertainty=CertificateUncertainty(sigma_a=0.03, sigma_s_prime=0.02))
    >>> paper.at([550.0])[1].round(3).tolist()
    [1.429]
    """

    eta: float
    """Refractive index, 1 to 2."""
    g: float
    """Mean cosine of scattering, -1 < g < 1."""
    wavelength_nm: tuple[float, ...]
    """Ascending, nm."""
    sigma_a_per_mm: tuple[float, ...]
    """Absorption coefficient at each wavelength, 1/mm, > 0."""
    sigma_s_prime_per_mm: tuple[float, ...]
    """Reduced scattering coefficient at each wavelength, 1/mm, > 0."""
    uncertainty: CertificateUncertainty
    name: str = ""
    """Label on the block."""

    def __post_init__(self) -> None:
        checks = FaultCollector("Phantom", CertificateError)
        checks.check("eta", self.eta, 1 <= self.eta <= 2, "1 to 2")
        checks.check("g", self.g, -1 < self.g < 1, "-1 < g < 1")
        count = len(self.wavelength_nm)
        checks.check("wavelength_nm", count, count >= 1, "at least one")
        rising = all(
            a < b for a, b in zip(self.wavelength_nm, self.wavelength_nm[1:], strict=False)
        )
        inside = all(100 <= w <= 3000 for w in self.wavelength_nm)
        checks.check("wavelength_nm", self.wavelength_nm, rising and inside, "ascending, in nm")
        for field_name in ("sigma_a_per_mm", "sigma_s_prime_per_mm"):
            values = getattr(self, field_name)
            checks.check(field_name, len(values), len(values) == count, f"{count} numbers")
            good = all(0 < v < 1e3 for v in values)
            checks.check(field_name, values, good, "numbers > 0, in 1/mm")
        checks.close()

    def at(self, wavelength_nm: Any) -> tuple[Float64Array, Float64Array]:
        """Return sigma_a and sigma_s' at wavelengths, 1/mm.

        Both are interpolated as powers of the wavelength; a certificate of one wavelength is valid
        for all.

        Raises
        ------
        CertificateError
            When a wavelength is outside the range of several.
        """
        wanted = np.asarray(wavelength_nm, np.float64)
        known = np.array(self.wavelength_nm)
        if len(known) > 1 and ((wanted < known[0] - 1e-9) | (wanted > known[-1] + 1e-9)).any():
            raise CertificateError.at(
                "phantom's certificate does not reach far enough",
                "wavelength_nm",
                f"{known[0]:g} to {known[-1]:g} nm",
                f"{wanted.min():g} to {wanted.max():g} nm, the camera's range",
            )
        x = np.log(np.clip(wanted, known[0], known[-1]))
        sigma_a, sigma_s = (
            np.exp(np.interp(x, np.log(known), np.log(np.array(values))))
            for values in (self.sigma_a_per_mm, self.sigma_s_prime_per_mm)
        )
        return sigma_a, sigma_s


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedReflectance:
    """Expected reflectance of the phantom in each fiber of a perfect probe.

    Attributes
    ----------
    per_mm2 : ndarray of float64, shape (F, C)
        Reflectance in the fiber, 1/mm^2, > 0, averaged over each color's band.
    stderr : ndarray of float64, shape (F, C)
        1/mm^2; independent between fibers.
    common : ndarray of float64, shape (T, F, C)
        Relative changes, one pattern for each of T causes at one standard uncertainty:
        uncertainties of the certificate move all fibers together.
    """

    per_mm2: Float64Array
    stderr: Float64Array
    common: Float64Array = field(default_factory=lambda: np.zeros((0, 0, 0)))

    def __post_init__(self) -> None:
        value = np.array(self.per_mm2, np.float64)
        stderr = np.array(self.stderr, np.float64)
        common = np.array(self.common, np.float64)
        common = np.zeros((0, *value.shape)) if common.shape[0] == 0 else common
        checks = FaultCollector("ExpectedReflectance", CertificateError)
        checks.check("per_mm2", value.shape, value.ndim == 2, "(fibers, colors)")
        good = bool(np.isfinite(value).all() and (value > 0).all())
        checks.check("per_mm2", short_repr(value.tolist()), good, "finite numbers > 0")
        checks.check("stderr", stderr.shape, stderr.shape == value.shape, f"shape {value.shape}")
        good = bool(np.isfinite(stderr).all() and (stderr >= 0).all())
        checks.check("stderr", short_repr(stderr.tolist()), good, "finite numbers >= 0")
        fits = common.shape[1:] == value.shape and bool(np.isfinite(common).all())
        checks.check("common", common.shape, fits, f"finite, shape (T, {value.shape})")
        checks.close()
        for name, array in (("per_mm2", value), ("stderr", stderr), ("common", common)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)


def read_certificate(path: str | Path) -> PhantomCertificate:
    """Read a phantom's certificate, a JSON file of schema ``skinrig.phantom/1``.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    PhantomCertificate

    Raises
    ------
    CertificateError
        With every fault's path, the value found and the value expected.
    """
    where = str(path)
    try:
        text = Path(path).read_bytes()
    except OSError as exc:
        raise CertificateError(f"cannot be read ({exc.strerror})", where=where) from exc
    data = read_json(text, where=where, error=CertificateError)
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        found = data.get("schema") if isinstance(data, dict) else type(data).__name__
        raise CertificateError.at(
            "is not a phantom's certificate", "schema", short_repr(found), repr(SCHEMA), where=where
        )
    body = {key: value for key, value in data.items() if key != "schema"}
    return parse_document(PhantomCertificate, body, where=where, error=CertificateError)
