"""Spectral data of skin, cameras, lights and observers, and their band averages.

The tables are CSV files in ``model/data``; each file's header names its source and units.
Everything is sampled by linear interpolation at the wavelengths that the caller asks for.
"""

from functools import cache, lru_cache
from importlib import resources

import numpy as np
from numpy.typing import ArrayLike

from model import led_spectra
from model.arrays import Float64Array
from model.checks import Checks

MAX_WAVELENGTH_NM = 1e6
"""Upper limit of wavelengths, nm."""

WAVELENGTH_NM: Float64Array = np.arange(400.0, 701.0, 10.0)
"""Default sampling of the visible spectrum in nm: 400 to 700 in steps of 10, 31 samples."""
WAVELENGTH_NM.setflags(write=False)

HEMOGLOBIN_MOLAR_MASS_G_PER_MOL = 64_500.0  # Prahl 1998, molar mass behind the table
HEMOGLOBIN_IN_BLOOD_G_PER_L = 150.0  # Prahl 1998, whole blood

# Exponents and factors of the melanins' absorption, wavelength in nm, result in 1/mm:
# Donner and Jensen 2006, doi:10.2312/EGWR/EGSR06/409-417.
EUMELANIN_FACTOR_PER_MM, EUMELANIN_EXPONENT = 6.6e10, -3.33
PHEOMELANIN_FACTOR_PER_MM, PHEOMELANIN_EXPONENT = 2.9e14, -4.75
# Absorption of bloodless, melanin-free skin, 1/mm: Jacques 1998 (OMLC), Donner and Jensen 2006.
BASELINE_OFFSET_PER_MM, BASELINE_FACTOR_PER_MM = 0.0244, 8.53
BASELINE_ORIGIN_NM, BASELINE_SCALE_NM = 154.0, 66.2
# Reduced scattering of the epidermis, 1/mm: Mie part and Rayleigh part. Public codes use
# 2.0e11 to 2.22e11 for the Rayleigh factor; 2.2e11 is taken here.
MIE_FACTOR_PER_MM, MIE_EXPONENT = 14.74, -0.22
RAYLEIGH_FACTOR_PER_MM, RAYLEIGH_EXPONENT = 2.2e11, -4.0

FLASH_TEMPERATURE_K = 6_000.0  # temperature of the tube's plasma continuum
FLASH_CUTOFF_NM, FLASH_CUTOFF_WIDTH_NM = 395.0, 8.0  # ultraviolet-absorbing envelope

_CAMERA_FILES = {
    "Nikon 5100 (NPL)": "camera_nikon_5100_npl.csv",
    "Sigma SDMerill (NPL)": "camera_sigma_sdmerill_npl.csv",
}
_DAYLIGHT_NOMINAL_K = {"D50": 5000.0, "D55": 5500.0, "D65": 6500.0}


LINEAR_SRGB = "linear sRGB"
"""Name of the pseudo camera whose channels are the sRGB primaries."""
XYZ_TO_LINEAR_SRGB: Float64Array = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)
"""XYZ under D65 to linear sRGB, IEC 61966-2-1:1999."""


class SpectrumNameError(KeyError, ValueError):
    """Error for a name without a stored spectrum."""

    def __str__(self) -> str:
        return str(self.args[0])


def hemoglobin_extinction(
    wavelength_nm: ArrayLike = WAVELENGTH_NM,
) -> tuple[Float64Array, Float64Array]:
    """Return the molar extinction of oxygenated and of deoxygenated hemoglobin.

    Parameters
    ----------
    wavelength_nm
        Wavelengths in nm, any shape, 380 to 780.

    Returns
    -------
    tuple of ndarray
        Decadic molar extinctions in 1/(cm mol/l): oxygenated, deoxygenated; shaped like the input.

    References
    ----------
    S. Prahl, Tabulated molar extinction coefficient for hemoglobin in water, OMLC 1998.

    Examples
    --------
    >>> oxy, deoxy = hemoglobin_extinction([540.0])
    >>> float(oxy[0]), float(deoxy[0])
    (53236.0, 46592.0)
    """
    values = _sampled("hemoglobin_extinction.csv", wavelength_nm, outside=None)
    return values[..., 0], values[..., 1]


def eumelanin_absorption(wavelength_nm: ArrayLike = WAVELENGTH_NM) -> Float64Array:
    """Return the absorption of eumelanin in 1/mm at wavelengths in nm (any shape).

    References
    ----------
    Donner and Jensen 2006, doi:10.2312/EGWR/EGSR06/409-417.

    Examples
    --------
    >>> round(float(eumelanin_absorption(500.0)), 2)
    67.92
    """
    wavelength = _wavelengths(wavelength_nm)
    return np.asarray(EUMELANIN_FACTOR_PER_MM * wavelength**EUMELANIN_EXPONENT)


def pheomelanin_absorption(wavelength_nm: ArrayLike = WAVELENGTH_NM) -> Float64Array:
    """Return the absorption of pheomelanin in 1/mm at wavelengths in nm (any shape).

    References
    ----------
    Donner and Jensen 2006, doi:10.2312/EGWR/EGSR06/409-417.

    Examples
    --------
    >>> round(float(pheomelanin_absorption(500.0)), 2)
    43.88
    """
    wavelength = _wavelengths(wavelength_nm)
    return np.asarray(PHEOMELANIN_FACTOR_PER_MM * wavelength**PHEOMELANIN_EXPONENT)


def baseline_absorption(wavelength_nm: ArrayLike = WAVELENGTH_NM) -> Float64Array:
    """Return the absorption in 1/mm of skin without blood and melanin, wavelengths in nm.

    References
    ----------
    Donner and Jensen 2006, doi:10.2312/EGWR/EGSR06/409-417.

    Examples
    --------
    >>> round(float(baseline_absorption(500.0)), 4)
    0.0702
    """
    wavelength = _wavelengths(wavelength_nm)
    decay = np.exp(-(wavelength - BASELINE_ORIGIN_NM) / BASELINE_SCALE_NM)
    return np.asarray(BASELINE_OFFSET_PER_MM + BASELINE_FACTOR_PER_MM * decay)


def reduced_scattering(wavelength_nm: ArrayLike = WAVELENGTH_NM) -> Float64Array:
    """Return the reduced scattering of the epidermis in 1/mm, wavelengths in nm (any shape).

    The dermis has half of it (Donner et al. 2008, doi:10.1145/1409060.1409093).

    Examples
    --------
    >>> round(float(reduced_scattering(500.0)), 3)
    7.276
    """
    wavelength = _wavelengths(wavelength_nm)
    mie = MIE_FACTOR_PER_MM * wavelength**MIE_EXPONENT
    rayleigh = RAYLEIGH_FACTOR_PER_MM * wavelength**RAYLEIGH_EXPONENT
    return np.asarray(mie + rayleigh)


def camera_sensitivity(name: str, wavelength_nm: ArrayLike = WAVELENGTH_NM) -> Float64Array:
    """Return the relative spectral sensitivity of a camera's three channels.

    Parameters
    ----------
    name
        "Nikon 5100 (NPL)", "Sigma SDMerill (NPL)", or "linear sRGB": the color matching functions
        of the sRGB primaries, negative in places, for images that are already colorimetric;
        under D65 its white-balanced RGB is linear sRGB.
    wavelength_nm
        Wavelengths in nm, shape (n,). Outside the measured range the sensitivity is zero.

    Returns
    -------
    ndarray
        Shape (n, 3): red, green, blue; dimensionless, one scale for all channels.

    Raises
    ------
    SpectrumNameError
        When no camera of that name is stored.

    References
    ----------
    Darrodi et al. 2015, doi:10.1364/JOSAA.32.000381; IEC 61966-2-1:1999.
    """
    if name == LINEAR_SRGB:
        return np.asarray(color_matching_functions(wavelength_nm) @ XYZ_TO_LINEAR_SRGB.T)
    if name not in _CAMERA_FILES:
        raise SpectrumNameError(_unknown("camera", name, camera_names()))
    return _sampled(_CAMERA_FILES[name], wavelength_nm, outside=0.0)


def camera_names() -> tuple[str, ...]:
    """Return the camera names of `camera_sensitivity`."""
    return (*_CAMERA_FILES, LINEAR_SRGB)


def illuminant_names() -> tuple[str, ...]:
    """Return the light names of `illuminant`."""
    return (*_DAYLIGHT_NOMINAL_K, "A", "E", "LED-B3", "xenon flash")


def illuminant(name: str, wavelength_nm: ArrayLike = WAVELENGTH_NM) -> Float64Array:
    """Return the relative spectral power of a light.

    Parameters
    ----------
    name
        "D50", "D55", "D65" (CIE daylight), "A", "E" (equal energy), "LED-B3" (white LED), "xenon
        flash", or a narrow-band LED by center and full width at half maximum, such as
        "LED-590-20".
    wavelength_nm
        Wavelengths in nm, shape (n,), 380 to 780 for daylight; "LED-B3" is 0 outside that range.

    Returns
    -------
    ndarray
        Shape (n,), relative power per wavelength interval, 100 at 560 nm; of a narrow-band LED 100
        at its center.

    Raises
    ------
    SpectrumNameError
        When no light of that name is stored.

    Notes
    -----
    "xenon flash" is a smooth description of a photographic flash tube, not a measurement: a black
    body of 6000 K behind an envelope that absorbs the ultraviolet (logistic edge at 395 nm).
    Its correlated color temperature is about 5950 K. The weak visible xenon lines are omitted.
    Narrow-band LEDs are Gaussian, this project's choice; measured ones are slightly skewed.

    References
    ----------
    CIE 015:2018 Colorimetry, doi:10.25039/TR.015.2018.

    Examples
    --------
    >>> illuminant("D65", [560.0, 600.0]).round(1).tolist()
    [100.0, 90.0]
    """
    wavelength = _wavelengths(wavelength_nm)
    if name in _DAYLIGHT_NOMINAL_K:
        return _daylight(_DAYLIGHT_NOMINAL_K[name], wavelength)
    if name == "A":
        # CIE 015:2018: c2 = 1.435e7 nm K and 2848 K are the defining constants.
        return _black_body(wavelength, 1.435e7, 2848.0)
    if name == "E":
        return np.full(wavelength.shape, 100.0)
    if name == "LED-B3":
        power = _sampled("cie_led_b3.csv", wavelength, outside=0.0)[..., 0]
        return np.asarray(100.0 * power / _sampled("cie_led_b3.csv", 560.0, outside=0.0)[..., 0])
    if name == "xenon flash":

        def envelope(nm: Float64Array) -> Float64Array:
            return np.asarray(1.0 / (1.0 + np.exp(-(nm - FLASH_CUTOFF_NM) / FLASH_CUTOFF_WIDTH_NM)))

        body = _black_body(wavelength, 1.4388e7, FLASH_TEMPERATURE_K)
        return np.asarray(body * envelope(wavelength) / envelope(np.array(560.0)))
    if led_spectra.is_led(name):
        return led_spectra.spectrum(name, wavelength)
    raise SpectrumNameError(_unknown("light", name, illuminant_names()))


def sampling(light_name: str) -> Float64Array:
    """Return wavelengths in nm that resolve a light: `WAVELENGTH_NM`, or those of an LED, finer.

    Examples
    --------
    >>> nm = sampling("LED-590-20")
    >>> nm.size, nm[[0, 16, -1]].tolist(), sampling("D55").size
    (33, [558.0, 590.0, 622.0], 31)
    """
    return led_spectra.samples(light_name) if led_spectra.is_led(light_name) else WAVELENGTH_NM


def color_matching_functions(wavelength_nm: ArrayLike = WAVELENGTH_NM) -> Float64Array:
    """Return the CIE 1931 2-degree color matching functions, shape (n, 3), wavelengths in nm.

    References
    ----------
    CIE 015:2018 Colorimetry, doi:10.25039/TR.015.2018.
    """
    return _sampled("cie_1931_2_degree.csv", wavelength_nm, outside=0.0)


def band_weights(
    camera: str, illuminant_name: str, wavelength_nm: ArrayLike = WAVELENGTH_NM
) -> Float64Array:
    """Return weights that turn a sampled reflectance into white-balanced camera RGB.

    Parameters
    ----------
    camera, illuminant_name
        Names known to `camera_sensitivity` and `illuminant`.
    wavelength_nm
        Sampling of the reflectance in nm, shape (n,), increasing.

    Returns
    -------
    ndarray
        Shape (n, 3); every column sums to 1, so that a perfect white gives (1, 1, 1).

    Notes
    -----
    Between samples the reflectance is taken as linear; sensitivity and light are integrated in
    steps of 1 nm from the first to the last sample, and nothing is counted outside them.
    """
    return _band_weights(camera, illuminant_name, _increasing(wavelength_nm)).copy()


def band_average(
    spectra: ArrayLike,
    camera: str,
    illuminant_name: str,
    *,
    wavelength_nm: ArrayLike = WAVELENGTH_NM,
) -> Float64Array:
    """Return the white-balanced camera RGB of reflectance spectra.

    Parameters
    ----------
    spectra
        Reflectances, shape (..., n), dimensionless.
    camera, illuminant_name
        Names known to `camera_sensitivity` and `illuminant`.
    wavelength_nm
        The n wavelengths in nm.

    Returns
    -------
    ndarray
        Shape (..., 3), each channel divided by that of a perfect white.

    Examples
    --------
    >>> band_average(np.full(31, 0.5), "Nikon 5100 (NPL)", "D55").round(12).tolist()
    [0.5, 0.5, 0.5]
    """
    values = np.asarray(spectra, dtype=np.float64)
    weights = band_weights(camera, illuminant_name, wavelength_nm)
    Checks().shape("spectra", values, ("...", weights.shape[0]))
    return np.asarray(values @ weights)


def camera_white(camera: str, illuminant_name: str) -> Float64Array:
    """Return the camera RGB of a perfect white, not balanced, largest channel 1, shape (3,).

    Divide camera RGB by it to get the white-balanced RGB of `band_average` (up to one scale).
    """
    wavelength = np.arange(380.0, 781.0, 1.0)
    light = illuminant(illuminant_name, wavelength)
    raw = light @ camera_sensitivity(camera, wavelength)
    return np.asarray(raw / raw.max())


@cache
def _table(file_name: str) -> tuple[Float64Array, Float64Array]:
    text = resources.files("model").joinpath("data", file_name).read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    values = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    return values[:, 0], values[:, 1:]


def _sampled(file_name: str, wavelength_nm: ArrayLike, *, outside: float | None) -> Float64Array:
    """Interpolate a table linearly; `outside` is the value beyond it, None raises an error."""
    nodes, values = _table(file_name)
    wavelength = _wavelengths(wavelength_nm)
    if outside is None:
        what = f"wavelength_nm in the table {file_name}"
        Checks().within(what, wavelength, f"[{nodes[0]}, {nodes[-1]}]")
    columns = [
        np.interp(wavelength, nodes, values[:, k], left=outside, right=outside)
        for k in range(values.shape[1])
    ]
    return np.stack(columns, axis=-1)


@lru_cache(maxsize=64)
def _band_weights(camera: str, light_name: str, grid: tuple[float, ...]) -> Float64Array:
    nodes = np.array(grid)
    fine = np.linspace(nodes[0], nodes[-1], round(nodes[-1] - nodes[0]) + 1)
    response = illuminant(light_name, fine)[:, None] * camera_sensitivity(camera, fine)
    response[[0, -1]] *= 0.5  # trapezoid rule
    # Hat functions of the samples at the fine wavelengths: linear interpolation as a matrix.
    right = np.clip(np.searchsorted(nodes, fine, side="right"), 1, nodes.size - 1)
    fraction = (fine - nodes[right - 1]) / (nodes[right] - nodes[right - 1])
    weights = np.zeros((nodes.size, 3))
    np.add.at(weights, right - 1, (1.0 - fraction)[:, None] * response)
    np.add.at(weights, right, fraction[:, None] * response)
    return np.asarray(weights / weights.sum(axis=0))


def _wavelengths(wavelength_nm: ArrayLike) -> Float64Array:
    wavelength = np.asarray(wavelength_nm, dtype=np.float64)
    Checks().within("wavelength_nm", wavelength, f"(0, {MAX_WAVELENGTH_NM}]")
    return wavelength


def _increasing(wavelength_nm: ArrayLike) -> tuple[float, ...]:
    grid = np.asarray(wavelength_nm, dtype=np.float64)
    if grid.ndim != 1 or grid.size < 2 or not np.all(np.diff(grid) > 0):
        raise ValueError(
            "wavelength_nm: expected at least two increasing wavelengths on one axis, "
            f"got shape {grid.shape}"
        )
    return tuple(_wavelengths(grid).tolist())


def _daylight(nominal_k: float, wavelength: Float64Array) -> Float64Array:
    # CIE 015:2018, section 4.1.2; the nominal temperature is corrected for the change of c2.
    t = nominal_k * 1.4388 / 1.4380
    if t <= 7000.0:
        x = -4.6070e9 / t**3 + 2.9678e6 / t**2 + 0.09911e3 / t + 0.244063
    else:
        x = -2.0064e9 / t**3 + 1.9018e6 / t**2 + 0.24748e3 / t + 0.237040
    y = -3.0 * x**2 + 2.870 * x - 0.275
    m = 0.0241 + 0.2562 * x - 0.7341 * y
    m1 = round((-1.3515 - 1.7703 * x + 5.9114 * y) / m, 3)
    m2 = round((0.0300 - 31.4424 * x + 30.0717 * y) / m, 3)
    components = _sampled("cie_daylight_components.csv", wavelength, outside=None)
    return np.asarray(components @ np.array([1.0, m1, m2]))


def _black_body(wavelength: Float64Array, c2_nm_k: float, temperature_k: float) -> Float64Array:
    def relative(nm: Float64Array) -> Float64Array:
        return np.asarray(nm**-5.0 / np.expm1(c2_nm_k / (nm * temperature_k)))

    return 100.0 * relative(wavelength) / relative(np.array(560.0))


def _unknown(kind: str, name: str, known: tuple[str, ...]) -> str:
    return f"{kind} {name!r} is not stored; use one of {', '.join(known)}"
