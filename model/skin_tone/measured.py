"""Color of measured skin: percentiles per band of the typology angle, and how to compare with it.

The statistics are those of the International Skin Spectra Archive, made by
`tools/make_skin_percentiles.py`; its spectra include the reflection at the surface, so a diffuse
reflectance is comparable after `sphere_specular` is added.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from model import fresnel
from model.arrays import BoolArray, Float64Array
from model.checks import Checks

TABLE_PERCENTILES = (1.0, 5.0, 25.0, 50.0, 75.0, 95.0, 99.0)
COLOR_QUANTITIES = ("lightness", "a_star", "b_star", "chroma", "hue_deg", "ita_deg")
"""CIE L*, a*, b*, chroma and hue (degrees), and the individual typology angle (degrees)."""
ALL_BANDS = "all"
"""Row of the table over all typology bands."""
SPLIT_SEED = 2025
"""Seed of the split of ISSA's subjects into a half that sets and a half that evaluates."""
SPHERE_INCIDENCE_DEG = 8.0
"""Angle of the beam to the normal in the sphere geometry d/8 and, reversed, 8/d (CIE 15)."""
_TABLE_FILE = "skin_percentiles.csv"


class SkinPercentileError(ValueError):
    """Error for a band or a quantity that the table lacks."""


def sphere_specular(eta: float = fresnel.ETA_SKIN) -> float:
    """Return the surface reflection that a sphere with specular included adds to diffuse skin.

    Parameters
    ----------
    eta
        Refractive index of skin relative to air.

    Returns
    -------
    float
        Reflectance to add to the diffuse reflectance at normal incidence: .0278 at 1.4.

    Notes
    -----
    In geometry d/8 with the specular part included, light comes from all directions and the
    detector sees 8 degrees. By reciprocity that is the reflectance of a beam at 8 degrees, all
    light collected: the Fresnel reflectance at 8 degrees plus the diffuse part. A rough surface
    sends the same energy into other directions of the sphere, as long as facets do not shadow
    each other. The diffuse part enters and leaves the skin as in
    `tissue_optics.layer_stack_reflectance`, which omits the first reflection; between 0 and
    8 degrees its transmittance changes by less than 1e-5. Light that leaves the skin outside the
    aperture is lost in instruments: that error is not in this number.

    Examples
    --------
    >>> round(sphere_specular(), 5)
    0.02778
    """
    return float(fresnel.reflectance(np.cos(np.radians(SPHERE_INCIDENCE_DEG)), eta))


def setting_half(subjects: Sequence[str], *, seed: int = SPLIT_SEED) -> BoolArray:
    """Split records by subject into a half that sets constants and a half that evaluates them.

    Parameters
    ----------
    subjects
        Identity of each record's subject; for ISSA "origin-subject", such as "4-17".
    seed
        Another seed gives an independent split.

    Returns
    -------
    ndarray of bool
        (len(subjects),); True: the record's subject is in the setting half. All records of a
        subject are in one half, for every order and choice of records.

    Examples
    --------
    >>> setting_half(["1-1", "1-2", "1-1", "1-3", "1-4"]).tolist()
    [False, True, False, True, True]
    """
    halves: dict[str, bool] = {}
    for subject in set(subjects):
        digest = hashlib.sha256(f"{seed}:{subject}".encode()).digest()
        halves[subject] = digest[7] % 2 == 0
    return np.array([halves[subject] for subject in subjects], np.bool_)


@dataclass(frozen=True, slots=True, eq=False)
class SkinPercentiles:
    """Percentiles of measured skin color per band of the typology angle.

    Attributes
    ----------
    spectra, subjects
        Numbers of spectra and of subjects per band; a subject can be in several bands.
    values
        Percentiles at `TABLE_PERCENTILES`, (7,), per band and quantity of `COLOR_QUANTITIES`.
    """

    spectra: Mapping[str, int]
    subjects: Mapping[str, int]
    values: Mapping[tuple[str, str], Float64Array]

    def at(self, band: str, quantity: str, percentile: float) -> float:
        """Return a percentile, 1 to 99, of a quantity; linear between the tabulated ones.

        Examples
        --------
        >>> round(measured_skin().at("IV", "lightness", 50.0), 1)
        56.8
        """
        Checks(SkinPercentileError).within("percentile", percentile, "[1, 99]")
        return float(np.interp(percentile, TABLE_PERCENTILES, self._row(band, quantity)))

    def rank(self, band: str, quantity: str, value: ArrayLike) -> Float64Array:
        """Return the percentile of values, any shape: 0 below the first, 100 above the last.

        Examples
        --------
        >>> measured_skin().rank("IV", "lightness", [0.0, 56.76, 99.0]).round(0).tolist()
        [0.0, 50.0, 100.0]
        """
        nodes = self._row(band, quantity)
        found = np.interp(
            np.asarray(value, np.float64), nodes, TABLE_PERCENTILES, left=0.0, right=100.0
        )
        return np.asarray(found)

    def _row(self, band: str, quantity: str) -> Float64Array:
        Checks(SkinPercentileError).choice("quantity", quantity, COLOR_QUANTITIES)
        Checks(SkinPercentileError).choice("band", band, self.spectra)
        return self.values[band, quantity]


@cache
def measured_skin() -> SkinPercentiles:
    """Return the percentiles of measured skin.

    Notes
    -----
    D65, CIE 1931 observer, 400 to 700 nm, specular reflection included.

    References
    ----------
    Lu et al. 2025, The International Skin Spectra Archive, doi:10.1038/s41597-025-04857-5; data
    doi:10.6084/m9.figshare.28228571.v4, CC BY 4.0.

    Examples
    --------
    >>> measured_skin().spectra["III"], measured_skin().subjects["III"]
    (4405, 1486)
    """
    path = resources.files("model").joinpath("data", _TABLE_FILE)
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line[0] != "#"]
    spectra, subjects, values = {}, {}, {}
    for line in lines[1:]:
        band, quantity, spectrum_count, subject_count, *cells = line.split(",")
        spectra[band], subjects[band] = int(spectrum_count), int(subject_count)
        row = np.array([float(cell) for cell in cells])
        row.setflags(write=False)
        values[band, quantity] = row
    return SkinPercentiles(
        MappingProxyType(spectra), MappingProxyType(subjects), MappingProxyType(values)
    )
