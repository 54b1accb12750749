"""Factors of standard errors that give intervals their coverage in each band of skin tone.

Standard errors are those of linearized optics and normal priors. Optics of skin are not linear, and
the lightest people vary less than a normal prior. The factors are the quotient of the errors that
occur to those that are stated, on skins with optics that the estimator does not assume.

The data file is made by ``tools/make_interval_skins.py``.
"""

from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import special

from model import color_table, skin_tone
from model.color_table import ColorTable
from model.fresnel import ETA_SKIN, normal_reflectance
from model.tissue_optics import uncertainty as optics_uncertainty
from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.chromophores.pixel_checks import ChromophoreError

SKINS_FILE = "data/interval_skins.npz"
CHANNEL_NOISE: Final = 0.01
"""Relative noise of each channel of the skins' colors."""
NODES_PER_AXIS: Final = optics_uncertainty.COVARIANCE_NODES
"""Nodes of the factors along each axis of a color table, evenly in the axes' cube roots."""
FACTOR_CANDIDATES: Final = np.geomspace(0.5, 2.0, 141)
NOMINAL_COVERAGES: Final = (0.6827, 0.95)
"""Nominal coverages that a factor serves."""
COVERAGE_MARGINS: Final = ((0.08, 0.08), (0.05, 0.03))
"""Weights of coverages below and above nominal: deviations that count alike."""
MIN_BAND_SKINS: Final = 50
"""Number of skins with an estimate below which a band's factor is 1."""
FACTOR_TURNS: Final = 4
"""Turns of the fit, as skins lie between the centers of the bands."""


@dataclass(frozen=True, slots=True, eq=False)
class IntervalSkins:
    """Spectra and chromophores of n skins, by bands of the individual typology angle."""

    reflectance: Float64Array
    """(n, w): diffuse reflectance."""
    wavelength_nm: Float64Array
    """(w,): wavelengths in nm."""
    typology_angle_deg: Float64Array
    """(n,): individual typology angle, specular reflection included, degrees."""
    melanin_optical_depth: Float64Array
    """(n,): optical depth of melanin at 550 nm."""
    hemoglobin: Float64Array
    """(n,): volume fraction of blood in the dermis."""

    @property
    def band(self) -> NDArray[np.intp]:
        """Return the index of each skin's band, 0 for the lightest, (n,)."""
        return skin_tone.ita_band(self.typology_angle_deg).astype(np.intp) - 1


@lru_cache(maxsize=1)
def load_interval_skins() -> IntervalSkins:
    """Return the skins of the package."""
    source = resources.files("reconstruction").joinpath(SKINS_FILE)
    with source.open("rb") as stream, np.load(stream) as stored:
        names = IntervalSkins.__dataclass_fields__
        return IntervalSkins(**{name: stored[name].astype(np.float64) for name in names})


def coverage_factor(deviation: Float64Array) -> float:
    """Return the factor of standard errors that gives 68 and 95 % intervals their coverage.

    Parameters
    ----------
    deviation
        (n,): errors over their standard errors.

    Returns
    -------
    float
        Candidate with the smallest largest deviation of both coverages from nominal, over
        `COVERAGE_MARGINS`.

    Examples
    --------
    >>> normal = special.ndtri((np.arange(4000) + 0.5) / 4000)
    >>> 1.45 < coverage_factor(1.5 * normal) < 1.55
    True
    """
    worst = np.zeros(FACTOR_CANDIDATES.size)
    size = np.sort(np.abs(deviation))
    for nominal, (below, above) in zip(NOMINAL_COVERAGES, COVERAGE_MARGINS, strict=True):
        ends = FACTOR_CANDIDATES * special.ndtri(0.5 + 0.5 * nominal)
        excess = np.searchsorted(size, ends) / size.size - nominal
        worst = np.maximum(worst, np.maximum(-excess / below, excess / above))
    return float(FACTOR_CANDIDATES[worst.argmin()])


def fit_band_factors(
    deviation: Float64Array, skins: IntervalSkins, valid: BoolArray, angle_deg: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return the typology angle of each band's estimates, degrees, and the factors there.

    Parameters
    ----------
    deviation
        (n, k): errors of k quantities over their standard errors.
    skins
        The n skins.
    valid
        (n,): skins with an estimate.
    angle_deg
        (n,): typology angles of the model's skin with the estimated chromophores, degrees. Factors
        depend on them, as the skins' own are unknown; light skin of type I has smaller ones.

    Returns
    -------
    ndarray, shape (bands,)
        Angles, decreasing: medians of the estimates, of the skins themselves where there are fewer
        than `MIN_BAND_SKINS`.
    ndarray, shape (bands, k)
        Factors; between the angles they are interpolated linearly.

    Raises
    ------
    ChromophoreError
        If the angles do not decrease from band to band: no factor belongs to an angle then.
    """
    bands, band = range(len(skin_tone.ITA_BANDS)), skins.band
    within = [valid & (band == k) for k in bands]
    centers = np.array(
        [
            np.median(angle_deg[chosen])
            if np.count_nonzero(chosen) >= MIN_BAND_SKINS
            else np.median(skins.typology_angle_deg[band == k])
            for k, chosen in enumerate(within)
        ]
    )
    if not (np.diff(centers) < 0.0).all():
        raise ChromophoreError(
            f"typology angles of the bands: got {centers.round(1).tolist()} degrees, expected "
            "decreasing ones; check the camera's and the light's spectra"
        )
    factors = np.ones((centers.size, deviation.shape[1]))
    for _ in range(FACTOR_TURNS):
        left = deviation / interpolate_factors(angle_deg, centers, factors)
        for k in bands:
            chosen = left[within[k]]
            if len(chosen) >= MIN_BAND_SKINS:
                factors[k] *= [coverage_factor(column) for column in chosen.T]
    return centers, factors


def interpolate_factors(
    angle_deg: Float64Array, centers_deg: Float64Array, factors: Float64Array
) -> Float64Array:
    """Return factors (..., k) at typology angles (...), constant beyond the outermost centers."""
    columns = [np.interp(-angle_deg, -centers_deg, column) for column in factors.T]
    return np.stack(columns, axis=-1)


def node_typology_angles(table: ColorTable) -> Float64Array:
    """Return typology angles of a table's skins at the factors' nodes, degrees, (nodes, nodes)."""
    c_m, c_hd = (axis**3 for axis in color_table.spectral_axes(NODES_PER_AXIS))
    reflectance = color_table.spectral_reflectance(
        np.minimum(c_m, table.c_m_max)[:, None],
        np.minimum(c_hd, table.c_hd_max),
        anisotropy=table.anisotropy,
    )
    return optics_uncertainty.typology_angle(reflectance + normal_reflectance(ETA_SKIN))
