"""XYZ, Lab, white points and color differences of CIE 15, on arrays."""

import csv
from importlib.resources import files

import numpy as np
from numpy.typing import ArrayLike

from capture.arrays import Float64Array

WHITE_XYZ: dict[str, tuple[float, float, float]] = {  # 2 degree observer, Y = 1; ASTM E308-01
    "A": (1.09850, 1.0, 0.35585),
    "D50": (0.96422, 1.0, 0.82521),
    "D55": (0.95682, 1.0, 0.92149),
    "D65": (0.95047, 1.0, 1.08883),
    "E": (1.0, 1.0, 1.0),
}

# Cone responses of the Bradford adaptation: Lam 1985; as in ICC.1:2010 annex E
_BRADFORD_CONES = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)

# Primaries of IEC 61966-2-1 (sRGB) as chromaticities x, y
_SRGB_XY = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))

_LAB_CUBE_ROOT_START = (6.0 / 29.0) ** 3  # CIE 15:2004, threshold of the cube root


def white_point(illuminant: str) -> Float64Array:
    """Return XYZ of the perfect diffuser, Y = 1, shape (3,).

    Examples
    --------
    >>> white_point("D50").tolist()
    [0.96422, 1.0, 0.82521]
    """
    if illuminant not in WHITE_XYZ:
        raise ValueError(f"illuminant: got {illuminant!r}, expected one of {sorted(WHITE_XYZ)}")
    return np.array(WHITE_XYZ[illuminant])


def lab_from_xyz(xyz: ArrayLike, white: ArrayLike) -> Float64Array:
    """Return CIE L*a*b* of XYZ, shape (..., 3), for a white of the same scale."""
    t = np.asarray(xyz, dtype=np.float64) / np.asarray(white, dtype=np.float64)
    f = np.where(t > _LAB_CUBE_ROOT_START, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def xyz_from_lab(lab: ArrayLike, white: ArrayLike) -> Float64Array:
    """Return XYZ of CIE L*a*b*, shape (..., 3), in the scale of the white.

    Examples
    --------
    >>> xyz_from_lab([100.0, 0.0, 0.0], white_point("D65")).tolist()
    [0.95047, 1.0, 1.08883]
    """
    lab = np.asarray(lab, dtype=np.float64)
    y = (lab[..., 0] + 16) / 116
    f = np.stack([y + lab[..., 1] / 500, y, y - lab[..., 2] / 200], axis=-1)
    t = np.where(f > 6 / 29, f**3, 3 * (6 / 29) ** 2 * (f - 4 / 29))
    return t * np.asarray(white, dtype=np.float64)


def lab_jacobian(xyz: ArrayLike, white: ArrayLike) -> Float64Array:
    """Return d(Lab)/d(XYZ), shape (..., 3, 3)."""
    w = np.asarray(white, dtype=np.float64)
    t = np.asarray(xyz, dtype=np.float64) / w
    slope = np.where(
        t > _LAB_CUBE_ROOT_START,
        1 / (3 * np.cbrt(np.maximum(t, _LAB_CUBE_ROOT_START)) ** 2),
        1 / (3 * (6 / 29) ** 2),
    )
    mix = np.array([[0.0, 116.0, 0.0], [500.0, -500.0, 0.0], [0.0, 200.0, -200.0]])
    return mix * (slope / w)[..., None, :]


def delta_e_2000(lab_a: ArrayLike, lab_b: ArrayLike) -> Float64Array:
    """Return the color difference CIEDE2000 (CIE 142-2001) of Lab colors, shape (...)."""
    from colour import delta_E  # takes a second to import, so only where it is used

    return np.asarray(delta_E(np.asarray(lab_a), np.asarray(lab_b), method="CIE 2000"))


def _adapt(xyz: ArrayLike, source_white: ArrayLike, target_white: ArrayLike) -> Float64Array:
    """Return XYZ adapted to another white by the Bradford transform, shape (..., 3)."""
    source = _BRADFORD_CONES @ np.asarray(source_white, dtype=np.float64)
    target = _BRADFORD_CONES @ np.asarray(target_white, dtype=np.float64)
    matrix = np.linalg.solve(_BRADFORD_CONES, (target / source)[:, None] * _BRADFORD_CONES)
    return np.asarray(xyz, dtype=np.float64) @ matrix.T


def xyz_to_linear_srgb(xyz: ArrayLike, *, illuminant: str = "D65") -> Float64Array:
    """Return linear sRGB (D65) of XYZ under an illuminant, shape (..., 3), white = (1, 1, 1).

    Examples
    --------
    >>> xyz_to_linear_srgb(white_point("D50"), illuminant="D50").round(6).tolist()
    [1.0, 1.0, 1.0]
    """
    white = white_point("D65")
    primaries = np.array([[x / y, 1.0, (1 - x - y) / y] for x, y in _SRGB_XY]).T
    to_xyz = primaries * np.linalg.solve(primaries, white)
    return _adapt(xyz, white_point(illuminant), white) @ np.linalg.inv(to_xyz).T


def _chart_rows() -> list[dict[str, str]]:
    text = files("capture.calibration").joinpath("color_checker_classic.csv").read_text("utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines))


def chart_reference(illuminant: str = "D50") -> Float64Array:
    """Return XYZ (Y of the perfect diffuser = 1) of the ColorChecker Classic, shape (24, 3).

    Row-major from dark skin to black. The published values are for D50; for another illuminant
    they are adapted by the Bradford transform, which is an approximation of a few Delta E for
    saturated patches: where the patches' spectra are known, integrate those instead.
    """
    lab = np.array([[float(row[k]) for k in "Lab"] for row in _chart_rows()])
    d50 = white_point("D50")
    return _adapt(xyz_from_lab(lab, d50), d50, white_point(illuminant))


def chart_spectra(wavelength_nm: ArrayLike) -> Float64Array:
    """Return reflectance spectra of the ColorChecker Classic, shape (24, n).

    Parameters
    ----------
    wavelength_nm
        The n wavelengths in nm, 380 to 730; linear between samples 10 nm apart.

    References
    ----------
    BabelColor average of 30 charts: D. Pascale 2006, RGB coordinates of the ColorChecker.

    Examples
    --------
    >>> chart_spectra([450.0, 650.0])[18].round(2).tolist()
    [0.88, 0.92]
    """
    from colour import SDS_COLOURCHECKERS  # takes a second to import, so only where it is used

    nodes = np.asarray(wavelength_nm, dtype=np.float64)
    patches = SDS_COLOURCHECKERS["BabelColor Average"].values()
    return np.array([np.interp(nodes, patch.wavelengths, patch.values) for patch in patches])
