"""Tabulated Monte Carlo reflectance of layered skin in dimensionless coordinates.

The table is package data made by ``tools/make_skin_reflectance.py``. It is free of wavelengths and
of chromophores: `rigsim.tissue.skin_layers` maps skin of any person at any wavelength to its four
coordinates.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.interpolate import (
    CubicSpline,
    PchipInterpolator,
    RectBivariateSpline,
    RegularGridInterpolator,
)

from rigsim.arrays import Float64Array

_TABLE_FILE: Final = "skin_reflectance_mc.npz"
MIN_RING_FRACTION: Final = 1e-9
"""Fraction assigned to a far ring without photons."""
LATERAL_SCATTERING_STEP: Final = 2
"""Lateral profiles are stored at every second scattering depth."""
MAX_ABSORPTION_DEPTH: Final = 24.0
RING_EDGES: Final = np.concatenate([[0.0], np.geomspace(0.02, 60.0, 48)])
"""Edges of the rings around the point of entry, in reduced mean free paths of the dermis."""


class SkinTransportError(ValueError):
    """Error for skin outside the tabulated range."""


@dataclass(frozen=True, slots=True, eq=False)
class Axes:
    """Nodes of the table."""

    scattering: Float64Array
    """Scattering depth of the epidermis, sigma_s' times thickness."""
    basal: Float64Array
    """Fraction of the epidermis's absorption depth in its basal third."""
    absorption: Float64Array
    """Absorption depth of the epidermis, sigma_a times thickness."""
    dermis: Float64Array
    """Absorption of the dermis over its reduced scattering."""


def _axes(*, basal: int, absorption: int, dermis: int) -> Axes:
    return Axes(
        np.geomspace(0.08, 7.0, 13),
        np.linspace(1.0 / 3.0, 0.6, basal),
        MAX_ABSORPTION_DEPTH * np.linspace(0.0, 1.0, absorption) ** 3,
        np.geomspace(0.004, 40.0, dermis),
    )


TABLE_AXES: Final = _axes(basal=4, absorption=41, dermis=29)
"""Nodes of the reflectance."""
LATERAL_AXES: Final = _axes(basal=2, absorption=11, dermis=15)
"""Nodes of the lateral profiles."""


class SkinCoordinates(NamedTuple):
    """Skin of one scattering depth in the coordinates of `Axes`."""

    scattering: float
    basal: Float64Array
    """Shape (n,), as the next two."""
    absorption: Float64Array
    dermis: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class SkinTransport:
    """Diffuse reflectance of an epidermis on a deep dermis, index 1.4, g 0.8, by Monte Carlo."""

    reflectance: Float64Array
    """Diffuse reflectance at normal incidence without the specular part, in (0, 1), shape
    (scattering, basal, absorption, dermis) of `TABLE_AXES`."""
    standard_error: Float64Array
    """Standard error of `reflectance`, same shape. Errors at different scattering depths are
    independent, those at one depth are strongly correlated (same photons)."""
    lateral: Float64Array
    """Fraction of the reflectance within each ring, shape (scattering, basal, absorption, dermis,
    rings), of every second scattering depth and of `LATERAL_AXES`."""
    provenance: Mapping[str, Any]
    """Recipe version, seed, photons, constants and library versions."""
    _spline: CubicSpline
    """log R along the logarithm of the scattering depth."""
    _lateral_spline: CubicSpline
    """log of the ring fractions, likewise."""

    @classmethod
    def load(cls) -> SkinTransport:
        """Return the packaged table; it is read once."""
        return _load()

    def log_reflectance(self, at: SkinCoordinates) -> Float64Array:
        """Return the logarithm of the diffuse reflectance, shape (n,).

        Raises
        ------
        SkinTransportError
            When a coordinate lies outside the table.
        """
        _require_inside(at)
        tables = self._spline(np.log(at.scattering))
        weights = _lagrange(TABLE_AXES.basal, at.basal)
        x, y = np.cbrt(at.absorption), np.log(at.dermis)
        nodes = np.cbrt(TABLE_AXES.absorption), np.log(TABLE_AXES.dermis)
        found = np.zeros(at.basal.shape)
        for weight, table in zip(weights, tables, strict=True):
            if weight.any():
                found += weight * RectBivariateSpline(*nodes, table).ev(x, y)
        return found

    def relative_error(self, at: SkinCoordinates) -> Float64Array:
        """Return the relative standard error of the reflectance, shape (n,)."""
        lookup = RegularGridInterpolator(
            (
                np.log(TABLE_AXES.scattering),
                TABLE_AXES.basal,
                np.cbrt(TABLE_AXES.absorption),
                np.log(TABLE_AXES.dermis),
            ),
            self.standard_error / self.reflectance,
        )
        depth = np.full(at.basal.shape, np.log(at.scattering))
        place = [depth, at.basal, np.cbrt(at.absorption), np.log(at.dermis)]
        return np.asarray(lookup(np.stack(place, axis=-1)))

    def ring_fractions(self, at: SkinCoordinates, ring_edges: Float64Array) -> Float64Array:
        """Return the fraction of the diffuse reflectance within rings around the point of entry.

        Parameters
        ----------
        at
            One point, n = 1.
        ring_edges
            Increasing radii from 0 in reduced mean free paths of the dermis, shape (rings + 1,).

        Returns
        -------
        ndarray
            Shape (rings,); sums to 1, the last ring has all light beyond it.
        """
        _require_inside(at)
        tables = self._lateral_spline(np.log(at.scattering))
        table = np.tensordot(_lagrange(LATERAL_AXES.basal, at.basal)[:, 0], tables, 1)
        by_absorption, by_dermis = _lateral_weights()
        table = np.tensordot(by_absorption(np.cbrt(at.absorption[0])), table, 1)
        share = np.exp(by_dermis(np.log(at.dermis[0])) @ table)
        inside = np.cumsum(share / share.sum())
        radius = np.clip(ring_edges, 0.0, RING_EDGES[-1])
        within = PchipInterpolator(np.log(RING_EDGES[1:]), inside)(
            np.log(np.maximum(radius, RING_EDGES[1]))
        )
        # Within the first ring the density is even, so what is inside grows with the area.
        within *= np.minimum(radius / RING_EDGES[1], 1.0) ** 2
        within[-1] = 1.0
        return np.maximum(np.diff(within), 0.0)


def _require_inside(at: SkinCoordinates) -> None:
    for name, values, axis in zip(
        ("scattering depth", "basal fraction", "absorption depth", "dermis absorption"),
        at,
        (TABLE_AXES.scattering, TABLE_AXES.basal, TABLE_AXES.absorption, TABLE_AXES.dermis),
        strict=True,
    ):
        low, high = float(axis[0]), float(axis[-1])
        given = np.atleast_1d(np.asarray(values, np.float64))
        outside = ~((given >= low * (1 - 1e-9)) & (given <= high * (1 + 1e-9)))
        if outside.any():
            raise SkinTransportError(
                f"{name}: got {given[outside][0]:.4g}, expected {low:.4g} to {high:.4g}; "
                "change the skin's properties"
            )


def _lagrange(nodes: Float64Array, at: Float64Array) -> Float64Array:
    """Return the weights of the polynomial through all nodes, shape (nodes, n)."""
    weights = np.ones((nodes.size, np.size(at)))
    for i, own in enumerate(nodes):
        for j, other in enumerate(nodes):
            if i != j:
                weights[i] *= (np.asarray(at) - other) / (own - other)
    weights[np.abs(weights) < 1e-12] = 0.0
    return weights


@cache
def _lateral_weights() -> tuple[CubicSpline, CubicSpline]:
    """Return splines of unit vectors: the nodes' weights in a spline through any values."""
    # Smooth in the absorption itself, so the slope over its cube root is 0 at 0.
    absorption, dermis = np.cbrt(LATERAL_AXES.absorption), np.log(LATERAL_AXES.dermis)
    flat = (1, np.zeros(absorption.size))
    return (
        CubicSpline(absorption, np.eye(absorption.size), bc_type=(flat, "not-a-knot")),
        CubicSpline(dermis, np.eye(dermis.size)),
    )


@cache
def _load() -> SkinTransport:
    source = resources.files("rigsim").joinpath("data", _TABLE_FILE)
    with source.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
        reflectance, error, lateral = (
            stored[name].astype(np.float64)
            for name in ("reflectance", "reflectance_standard_error", "lateral")
        )
        provenance = json.loads(str(stored["provenance"]))
    lateral = np.maximum(lateral / lateral.sum(axis=-1, keepdims=True), MIN_RING_FRACTION)
    for array in (reflectance, error, lateral):
        array.setflags(write=False)
    depth = np.log(TABLE_AXES.scattering)
    return SkinTransport(
        reflectance,
        error,
        lateral,
        provenance,
        CubicSpline(depth, np.log(reflectance)),
        CubicSpline(depth[::LATERAL_SCATTERING_STEP], np.log(lateral)),
    )
