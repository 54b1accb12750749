"""The color of skin as a table over melanin and hemoglobin (Jimenez 2010, eq. 7)."""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib import resources
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline, RectBivariateSpline

from model import spectra
from model.arrays import Float64Array
from model.checks import Checks
from model.fresnel import ETA_SKIN
from model.tissue_optics import (
    PAPER_CONSTANTS,
    SKIN_CONSTANTS,
    TissueConstants,
    two_layer_reflectance,
)
from model.tissue_optics import uncertainty as optics_uncertainty
from model.tissue_optics.constants import with_fractions
from model.tissue_optics.layers import C_HD_MAX, C_M_MAX

SPECTRAL_NODES = 41
"""Nodes along each axis of the stored spectral table, see tools/make_reflectance_table.py."""
COMPUTED_SPECTRAL_NODES = 29
"""Nodes along each axis when the spectral table must be computed first."""
STORED_ANISOTROPIES = (0.0, 0.8)
"""Mean cosines g of scattering for which the spectral table is stored."""
STORED_CONSTANTS: Final = {SKIN_CONSTANTS: "skin", PAPER_CONSTANTS: "papers"}
"""Names in the stored file of the constants for which the spectral table is stored."""
_MIN_SIZE = 8
_CHUNK_POINTS = 32_768


class ColorTableError(ValueError):
    """Error for a color table that cannot be built, or a lookup outside its range."""


@dataclass(frozen=True, slots=True, eq=False)
class ColorTable:
    """White-balanced camera RGB of skin over the cube roots of its chromophores.

    Between its nodes the table is a cubic spline along both axes, so that its derivatives are
    continuous and belong exactly to its values.
    """

    camera: str
    """Name of the camera's spectral sensitivities."""
    illuminant: str
    """Name of the light's spectrum."""
    rgb: Float64Array
    """Shape (size, size, 3): [i, j] is the color at C_m = c_m_max (i/(size-1))^3 and
    C_hd = c_hd_max (j/(size-1))^3; each channel of a perfect white reflector is 1."""
    c_m_max: float = C_M_MAX
    """Volume fraction of melanin at the end of the first axis."""
    c_hd_max: float = C_HD_MAX
    """Volume fraction of dermal blood at the end of the second axis."""
    anisotropy: float = 0.0
    """Mean cosine g of scattering behind the table."""
    constants: TissueConstants = SKIN_CONSTANTS
    """Thickness, scattering and other optics behind the table."""
    optics_covariance: Float64Array | None = None
    """Shape (n, n, 3, 3): covariance of log color by optics that a color does not determine, at
    nodes evenly in the cube roots; None: the optics are exactly known."""
    cells: Float64Array = field(init=False, repr=False)
    """Shape (size-1, size-1, 3, 4, 4): coefficients of x^p y^q in each cell at [..., p, q], with
    x and y the fractions of the way across the cell."""

    def __post_init__(self) -> None:
        """Check the table's shape and compute the spline's cells."""
        rgb = np.asarray(self.rgb, dtype=np.float64)
        size = rgb.shape[0] if rgb.ndim else 0
        if rgb.shape != (size, size, 3) or size < _MIN_SIZE:
            raise ColorTableError(
                f"rgb: expected (size, size, 3) with size >= {_MIN_SIZE}, got {rgb.shape}"
            )
        Checks(ColorTableError).within("rgb", rgb, "(0, inf)")
        if self.optics_covariance is not None:
            covariance = np.array(self.optics_covariance, dtype=np.float64)
            nodes = max(covariance.shape[0] if covariance.ndim else 0, 2)
            Checks(ColorTableError).shape("optics_covariance", covariance, (nodes, nodes, 3, 3))
            covariance.setflags(write=False)
            object.__setattr__(self, "optics_covariance", covariance)
        rgb = rgb.copy()
        rgb.setflags(write=False)
        cells = _spline_cells(rgb)
        cells.setflags(write=False)
        object.__setattr__(self, "rgb", rgb)
        object.__setattr__(self, "cells", cells)

    @property
    def size(self) -> int:
        """Return the number of nodes along each axis."""
        return int(self.rgb.shape[0])

    def lookup(self, c_m: ArrayLike, c_hd: ArrayLike) -> Float64Array:
        """Return the color of skin with these chromophores.

        Parameters
        ----------
        c_m, c_hd
            Volume fractions of melanin and dermal blood within the table's range, broadcast.

        Returns
        -------
        ndarray
            Shape (..., 3), white-balanced camera RGB of the diffuse reflectance.

        Raises
        ------
        ColorTableError
            When a fraction lies outside the table.
        """
        return self._evaluate(c_m, c_hd)[0]

    def jacobian(self, c_m: ArrayLike, c_hd: ArrayLike) -> Float64Array:
        """Return the derivatives of the color by both volume fractions.

        Parameters
        ----------
        c_m, c_hd
            Volume fractions within the table's range and above 0, broadcast. (At 0 the cube root
            has no derivative.)

        Returns
        -------
        ndarray
            Shape (..., 3, 2): derivative of each channel by C_m and by C_hd.

        Raises
        ------
        ColorTableError
            When a fraction lies outside the table or is 0.
        """
        melanin, blood = np.asarray(c_m, dtype=np.float64), np.asarray(c_hd, dtype=np.float64)
        for name, fraction in (("c_m", melanin), ("c_hd", blood)):
            Checks(ColorTableError).within(name, fraction, "(0, inf)")
        _, by_i, by_j = self._evaluate(melanin, blood)
        # i = (size - 1) cbrt(c / c_max), so di/dc = i / (3 c)
        last = self.size - 1
        di_dc = last * np.cbrt(melanin / self.c_m_max) / (3.0 * melanin)
        dj_dc = last * np.cbrt(blood / self.c_hd_max) / (3.0 * blood)
        return np.stack(
            np.broadcast_arrays(by_i * di_dc[..., None], by_j * dj_dc[..., None]), axis=-1
        )

    def log_covariance(self, c_m: ArrayLike, c_hd: ArrayLike) -> Float64Array:
        """Return the covariance of log color by unknown optics.

        `model.tissue_optics.uncertainty` defines it.

        Parameters
        ----------
        c_m, c_hd
            Volume fractions within the table's range, broadcast.

        Returns
        -------
        ndarray
            Shape (..., 3, 3), interpolated linearly in the cube roots; 0 where the table's optics
            are exactly known.

        Raises
        ------
        ColorTableError
            When a fraction lies outside the table.

        Examples
        --------
        >>> table = build("Nikon 5100 (NPL)", "D65")
        >>> bool(0.1 < table.log_covariance(0.02, 0.02)[1, 1] ** 0.5 < 0.3)
        True
        """
        nodes = self.optics_covariance
        size = 2 if nodes is None else nodes.shape[0]
        i, j = Checks(ColorTableError).broadcast_together(
            c_m=_node_index("c_m", c_m, self.c_m_max, size),
            c_hd=_node_index("c_hd", c_hd, self.c_hd_max, size),
        )
        if nodes is None:
            return np.zeros((*i.shape, 3, 3))
        row, column = (np.minimum(x.astype(np.intp), size - 2) for x in (i, j))
        x, y = (i - row)[..., None, None], (j - column)[..., None, None]
        below = (1.0 - y) * nodes[row, column] + y * nodes[row, column + 1]
        above = (1.0 - y) * nodes[row + 1, column] + y * nodes[row + 1, column + 1]
        return np.asarray((1.0 - x) * below + x * above)

    def melanin_optical_depth(self, c_m: ArrayLike) -> Float64Array:
        """Return the optical depth of melanin at 550 nm, C_m times thickness times absorption.

        A color determines this product. The volume fraction presumes the thickness of `constants`.

        Parameters
        ----------
        c_m
            Volume fraction of melanin, any shape.

        Examples
        --------
        >>> round(float(build("Nikon 5100 (NPL)", "D65").melanin_optical_depth(0.02)), 4)
        0.0812
        """
        return np.asarray(self.constants.melanin_depth_factor * np.asarray(c_m, dtype=np.float64))

    def _evaluate(
        self, c_m: ArrayLike, c_hd: ArrayLike
    ) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Return the color and its derivatives by the two fractional node indices."""
        i, j = Checks(ColorTableError).broadcast_together(
            c_m=_node_index("c_m", c_m, self.c_m_max, self.size),
            c_hd=_node_index("c_hd", c_hd, self.c_hd_max, self.size),
        )
        shape = i.shape
        i, j = i.ravel(), j.ravel()
        out = np.empty((3, i.size, 3))
        for start in range(0, i.size, _CHUNK_POINTS):
            part = slice(start, start + _CHUNK_POINTS)
            row = np.minimum(i[part].astype(np.intp), self.size - 2)
            column = np.minimum(j[part].astype(np.intp), self.size - 2)
            cell = self.cells[row, column]
            x, dx = _powers(i[part] - row)
            y, dy = _powers(j[part] - column)
            for k, (a, b) in enumerate(((x, y), (dx, y), (x, dy))):
                out[k, part] = np.einsum("ncpq,np,nq->nc", cell, a, b)
        value, by_i, by_j = out.reshape(3, *shape, 3)
        return value, by_i, by_j


def build(
    camera: str,
    illuminant: str,
    *,
    size: int = 128,
    anisotropy: float = 0.0,
    constants: TissueConstants = SKIN_CONSTANTS,
    beta_m: float | None = None,
    oxygenation: float | None = None,
    eta: float = ETA_SKIN,
    exact_optics: bool = False,
) -> ColorTable:
    """Build the color table of a camera under a light.

    Parameters
    ----------
    camera, illuminant
        Names known to `model.spectra`, e.g. "Nikon 5100 (NPL)", "D65".
    size
        Nodes along each axis, a whole number, at least 8. Against 512 nodes the color between
        them is within 4 % with 8 nodes, 0.3 % with 16, 4e-5 with 32 and 4e-7 with 128.
    anisotropy
        Mean cosine g of scattering, in [0, 1). The paper's model has 0; skin has
        `model.tissue_optics.layers.ANISOTROPY_SKIN`, and where melanin exceeds a few percent it
        matters.
    constants, beta_m, oxygenation, eta
        As in `model.tissue_optics.two_layer_reflectance`. For other values than the defaults, or a
        g that is not stored, the spectra are computed first: 1 s (g = 0) to 5 s instead of 0.1.
    exact_optics
        Whether the optics count as known exactly, as in simulated skin of the same constants. Else
        `ColorTable.optics_covariance` states what colors of real skin differ by.

    Returns
    -------
    ColorTable
        Within 1e-4 (relative) of the reflectance of `two_layer_reflectance` averaged over the
        camera's bands. The axis of melanin presumes the constants' thickness of the epidermis.

    Raises
    ------
    SpectrumNameError
        For an unknown camera or light.
    ColorTableError
        For a size that is not a whole number, 8 or more.

    References
    ----------
    Jimenez et al. 2010, doi:10.1145/1866158.1866167, eq. (7) and Table 1.

    Examples
    --------
    >>> table = build("Nikon 5100 (NPL)", "D65")
    >>> table.lookup(0.02, 0.02).round(2).tolist()
    [0.35, 0.25, 0.22]
    """
    if not isinstance(size, int | np.integer) or size < _MIN_SIZE:
        raise ColorTableError(
            f"size: expected a whole number of nodes, at least {_MIN_SIZE}, got {size}"
        )
    weights = spectra.band_weights(camera, illuminant)
    constants = with_fractions(constants, beta_m, oxygenation)
    log_reflectance = _log_spectra(anisotropy, constants, eta)
    axes = spectral_axes(log_reflectance.shape[0])
    fine = spectral_axes(size)
    rgb = np.zeros((size, size, 3))
    for band, weight in enumerate(weights):
        spline = RectBivariateSpline(*axes, log_reflectance[..., band], s=0)
        rgb += np.exp(spline(*fine))[..., None] * weight
    covariance = None
    if not exact_optics:
        few = spectral_axes(optics_uncertainty.COVARIANCE_NODES)
        splines = [
            RectBivariateSpline(*axes, values, s=0) for values in np.moveaxis(log_reflectance, 2, 0)
        ]
        nodes = np.exp(np.stack([spline(*few) for spline in splines], axis=-1))
        covariance = optics_uncertainty.log_color_covariance(camera, illuminant, nodes)
    return ColorTable(
        camera,
        illuminant,
        rgb,
        anisotropy=anisotropy,
        constants=constants,
        optics_covariance=covariance,
    )


@lru_cache(maxsize=16)
def with_exact_optics(table: ColorTable) -> ColorTable:
    """Return a table whose optics count as known exactly, the same object for the same table.

    Examples
    --------
    >>> with_exact_optics(build("Nikon 5100 (NPL)", "D65")).optics_covariance is None
    True
    """
    return table if table.optics_covariance is None else replace(table, optics_covariance=None)


def spectral_reflectance(
    c_m: ArrayLike, c_hd: ArrayLike, *, anisotropy: float = 0.0
) -> Float64Array:
    """Return the spectra that the color tables average, by their splines.

    Parameters
    ----------
    c_m, c_hd
        Volume fractions, Jimenez 2010, Table 1: 0 to 0.5 and 0 to 0.32; broadcast together.
    anisotropy
        See :func:`build`; a g that is not stored takes seconds.

    Returns
    -------
    ndarray, shape (*fractions, 31)
        Diffuse reflectance at normal incidence without the specular part, at
        `model.spectra.WAVELENGTH_NM`.

    Raises
    ------
    ColorTableError
        For fractions outside the table, or not finite.

    Examples
    --------
    >>> spectral_reflectance(0.02, 0.02)[[5, 15, 25]].round(2).tolist()
    [0.19, 0.24, 0.46]
    """
    melanin, blood = Checks(ColorTableError).broadcast_together(c_m=c_m, c_hd=c_hd)
    for name, values, most in (("c_m", melanin, C_M_MAX), ("c_hd", blood, C_HD_MAX)):
        Checks(ColorTableError).within(name, values, f"[0, {most}]")
    log_reflectance = _log_spectra(anisotropy, SKIN_CONSTANTS, ETA_SKIN)
    axes = spectral_axes(log_reflectance.shape[0])
    place = np.cbrt(melanin).reshape(-1), np.cbrt(blood).reshape(-1)
    found = np.empty((melanin.size, log_reflectance.shape[2]))
    for band in range(found.shape[1]):
        found[:, band] = RectBivariateSpline(*axes, log_reflectance[..., band], s=0).ev(*place)
    return np.exp(found).reshape(*melanin.shape, -1)


def spectral_axes(nodes: int) -> tuple[Float64Array, Float64Array]:
    """Return the cube roots of C_m and of C_hd along the axes, from 0 to Table 1's ends."""
    u = np.linspace(0.0, np.cbrt(C_M_MAX), nodes)  # eq. (7)
    v = np.linspace(0.0, np.cbrt(C_HD_MAX), nodes)
    return u, v


@lru_cache(maxsize=8)
def _log_spectra(anisotropy: float, constants: TissueConstants, eta: float) -> Float64Array:
    """Return log reflectance over (C_m, C_hd, wavelength), stored or computed."""
    name = STORED_CONSTANTS.get(constants)
    if name is not None and eta == ETA_SKIN and anisotropy in STORED_ANISOTROPIES:
        source = resources.files("model").joinpath("data", "two_layer_reflectance.npz")
        with source.open("rb") as stream, np.load(stream) as stored:
            return np.asarray(stored[f"{name}_g{anisotropy:g}"], dtype=np.float64)
    u, v = spectral_axes(COMPUTED_SPECTRAL_NODES)
    reflectance = two_layer_reflectance(
        spectra.WAVELENGTH_NM,
        u[:, None] ** 3,
        v[None, :] ** 3,
        constants=constants,
        eta=eta,
        anisotropy=anisotropy,
    )
    return np.asarray(np.log(reflectance))


def _spline_cells(rgb: Float64Array) -> Float64Array:
    """Return the tensor cubic spline through the nodes as one polynomial per cell."""
    nodes = np.arange(rgb.shape[0])
    along_i = CubicSpline(nodes, rgb, axis=0).c[::-1]  # (p, cell i, node j, channel)
    both = CubicSpline(nodes, along_i, axis=2).c[::-1]  # (q, cell j, p, cell i, channel)
    return np.ascontiguousarray(np.transpose(both, (3, 1, 4, 2, 0)))


def _node_index(name: str, fraction: ArrayLike, largest: float, size: int) -> Float64Array:
    values = np.asarray(fraction, dtype=np.float64)
    Checks(ColorTableError).within(name, values, f"[0, {largest * (1.0 + 1e-12)}]")
    return np.asarray((size - 1) * np.cbrt(values / largest))


def _powers(x: Float64Array) -> tuple[Float64Array, Float64Array]:
    one = np.ones_like(x)
    zero = np.zeros_like(x)
    return (
        np.stack([one, x, x**2, x**3], axis=-1),
        np.stack([zero, one, 2.0 * x, 3.0 * x**2], axis=-1),
    )
