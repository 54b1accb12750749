"""Table the moments that a gradient sphere's lights give of a surface's lobe, by its normal.

Under a sphere of lights the first moments of a reflection point along its lobe, and the mirror
direction follows. With a finite number of lights, a hole, unequal light and a lobe skewed by
Fresnel and shadowing, the moments point elsewhere. Both are the same sum over the lights, tabled
here by the normal, so that the estimator can find the normal of an observed vector.

Normals and observed vectors are written as positions in an equal-area disc about the view (Lambert
azimuthal): a position ``u`` is 2 sin(tilt / 2) long and points to the azimuth of the normal.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import spline_filter

from model import fresnel
from model.brdf import microfacet
from model.checks import Checks
from model.vectors import unit_vectors
from reconstruction.arrays import Float64Array
from reconstruction.gradient_normals.sphere_lights import (
    SphereLights,
    SphereLightsError,
    disc_from_normal,
    normal_from_disc,
    require_unit_vectors,
    view_frame,
)
from reconstruction.polarization import fresnel_amplitudes

TABLE_REACH = 1.3
"""Radius of the positions in tables: tilts up to 81 degrees."""
MARGIN_LINES = 4
"""Grid lines around them."""
FINEST, COARSEST = 0.0125, 0.04
"""Spacing of grid lines; a lobe's roughness has four of them in between."""
FIELD_MM = 1.0
"""Step of the differences by which the tables depend on a point's position in the field."""

INTERIOR_SHAPE_STDERR = 0.05
"""Standard error of the observed position of a matte interior, over its length. Shallow light of
real skin leaves more obliquely than Lambert's law states; voxel skin of types I to VI, drawn with
other seeds than the validation's, is off by this (docs/validation/voxel-skin.md)."""

F_X, F_Y, SCALE, CONCENTRATION, SYS_XX, SYS_XY, SYS_YY = range(7)
"""Layers of a table: observed position (2); full light over a white diffuser's; length of the mean
vector to the lights; covariance of the observed position from the lights' errors (3)."""
TABLE_LAYERS = 7
FIELD_LAYERS = 4
"""Further layers for lights at a finite distance: change of the observed position, 1/mm."""


@dataclass(frozen=True, slots=True)
class LobeResponseTable:
    """Table of observed position and light by the normal's position; spline coefficients.

    Attributes
    ----------
    coefficients : ndarray of float64, shape (G, G, K)
        Cubic B-splines on a grid of positions, first axis along the frame's second direction.
    frame : ndarray, shape (3, 3)
        Rows: right, up and the view, in the rig frame.
    """

    coefficients: Float64Array
    min_coordinate: float
    step: float
    frame: Float64Array

    def __post_init__(self) -> None:
        self.coefficients.flags.writeable = False  # of one kind: what reads them is compiled once


def facet_reflectance(lights: SphereLights, view: Float64Array, eta: float) -> Float64Array:
    """Return the reflection of facets that mirror each light, through the analyzer, (L,).

    Over the light's own irradiance, after its film; the same for every normal, as the facet is.

    Raises
    ------
    SphereLightsError
        For a view that is not a unit vector or within 0.06 degrees of the analyzer's axis, or a
        refractive index outside 1...4.
    """
    view, eta = require_unit_vectors("view", np.asarray(view, np.float64)[None])[0], _index(eta)
    if abs(float(view @ np.asarray(lights.analyzer))) > 1.0 - 5e-7:
        raise SphereLightsError(
            f"view: got {view.tolist()}, along the analyzer's axis {list(lights.analyzer)},"
            " expected one across it; correct the rig's analyzer axis"
        )
    light = lights.directions
    facet = light + view
    length = np.linalg.norm(facet, axis=1, keepdims=True)
    facet = np.where(length > 1e-9, facet / np.maximum(length, 1e-9), view)
    cosine = np.clip(np.sum(facet * light, axis=1), 1e-6, 1.0)
    r_s, r_p = fresnel_amplitudes(cosine, eta)
    s = np.cross(facet, light)
    size = np.linalg.norm(s, axis=1, keepdims=True)
    # a light along the view: s and p are equal, and any direction across serves
    s = np.where(size > 1e-9, s / np.maximum(size, 1e-9), view_frame(view)[0])
    p_in, p_out = np.cross(-light, s), np.cross(np.broadcast_to(view, s.shape), s)
    a_s, a_p = s @ np.asarray(lights.analyzer), p_out @ np.asarray(lights.analyzer)
    if len(lights.polarizers):
        e_s = np.sum(lights.polarizers * s, axis=1)
        e_p = np.sum(lights.polarizers * p_in, axis=1)
        return np.asarray((a_s * r_s * e_s + a_p * r_p * e_p) ** 2)
    # the field that becomes the analyzer's, of unit length: 1 / (a_s^2 / r_s^2 + a_p^2 / r_p^2)
    lost = (a_s * r_p) ** 2 + (a_p * r_s) ** 2
    return np.asarray((r_s * r_p) ** 2 / np.maximum(lost, 1e-300))


def specular_response(
    lights: SphereLights,
    *,
    view: ArrayLike,
    alpha: float,
    eta: float,
    near: bool = False,
    alpha_stderr: float = 0.0,
) -> LobeResponseTable:
    """Return the table of a rough dielectric surface, parallel less crossed.

    Parameters
    ----------
    lights
        The sphere.
    view : array_like, shape (3,)
        Unit vector to the camera.
    alpha : float
        GGX roughness of the facets.
    eta : float
        Refractive index of the surface.
    near : bool
        Add the layers by which a point's position in the field counts.
    alpha_stderr : float
        Standard error of `alpha`; enters the systematic covariance.

    Raises
    ------
    SphereLightsError
        For a roughness or index outside its range.
    """
    Checks(SphereLightsError).within("alpha", alpha, "[0.02, 1]")
    Checks(SphereLightsError).within("alpha_stderr", alpha_stderr, "[0, inf)")
    way = _direction(view)
    return _cached(lights, way, float(alpha), _index(eta), near, float(alpha_stderr))


def diffuse_response(
    lights: SphereLights, *, view: ArrayLike, eta: float, near: bool = False
) -> LobeResponseTable:
    """Return the table of a matte interior below a smooth surface: Lambert, Fresnel on entry."""
    return _cached(lights, _direction(view), np.nan, _index(eta), near, 0.0)


def _direction(view: ArrayLike) -> tuple[float, ...]:
    return tuple(require_unit_vectors("view", np.asarray(view, np.float64)[None])[0].tolist())


def _index(eta: float) -> float:
    Checks(SphereLightsError).within("eta", eta, "(1, 4)")
    return float(eta)


@lru_cache(maxsize=48)
def _cached(
    lights: SphereLights,
    view: tuple[float, ...],
    alpha: float,
    eta: float,
    near: bool,
    alpha_stderr: float,
) -> LobeResponseTable:
    # directions rounded twice, as all tables so far were made of
    lights, frame = replace(lights), view_frame(view)
    matte = np.isnan(alpha)
    step = 0.05 if matte else float(np.clip(alpha / 4.0, FINEST, COARSEST))
    lines = int(np.ceil(TABLE_REACH / step)) + MARGIN_LINES
    axis = step * np.arange(-lines, lines + 1)
    places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    # beyond the horizon's side of the disc: as at its end, so that splines stay calm
    length = np.linalg.norm(places, axis=1, keepdims=True)
    places = places * np.minimum(1.0, 1.38 / np.maximum(length, 1e-9))
    normals = normal_from_disc(places) @ frame
    see = _diffuse_sums(lights, frame, eta) if matte else specular_sums(lights, frame, alpha, eta)
    layers = np.empty((len(places), TABLE_LAYERS + (FIELD_LAYERS if near else 0)))
    for start in range(0, len(places), 2048):
        part = slice(start, start + 2048)

        def seen(
            point_mm: Float64Array, see: Sums = see, normals: Float64Array = normals[part]
        ) -> Float64Array:
            return _layers(lights, frame, see(normals, point_mm), not matte)

        layers[part, :TABLE_LAYERS] = seen(np.zeros(3))
        for k in (0, 1) if near else ():
            before, after = (seen(sign * FIELD_MM * frame[k])[:, :2] for sign in (-1.0, 1.0))
            first = TABLE_LAYERS + 2 * k
            layers[part, first : first + 2] = (after - before) / (2.0 * FIELD_MM)
        if alpha_stderr > 0.0:
            step_a = 0.02 * alpha
            before, after = (
                seen(np.zeros(3), specular_sums(lights, frame, a, eta))[:, :2]
                for a in (alpha - step_a, alpha + step_a)
            )
            move = (after - before) / (2.0 * step_a) * alpha_stderr
            layers[part, SYS_XX] += move[:, 0] ** 2
            layers[part, SYS_XY] += move[:, 0] * move[:, 1]
            layers[part, SYS_YY] += move[:, 1] ** 2
    if matte:
        move = INTERIOR_SHAPE_STDERR * layers[:, :2]
        layers[:, SYS_XX] += move[:, 0] ** 2
        layers[:, SYS_XY] += move[:, 0] * move[:, 1]
        layers[:, SYS_YY] += move[:, 1] ** 2
    layers[:, :2] -= places  # the deviation from the normal's own position is smooth
    grid = layers.reshape(len(axis), len(axis), -1)
    coefficients = np.stack(
        [spline_filter(grid[..., k], order=3, mode="mirror") for k in range(grid.shape[2])], axis=-1
    )
    return LobeResponseTable(coefficients, float(axis[0]), step, frame)


Sums = Callable[[Float64Array, Float64Array], Float64Array]


def _local(lights: SphereLights, point_mm: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return directions to the lights, and their intensities, from a point near the origin."""
    if not np.isfinite(lights.distance_mm):
        return lights.directions, lights.intensities
    way = lights.directions * lights.distance_mm - point_mm
    distance = np.linalg.norm(way, axis=1)
    return way / distance[:, None], lights.intensities * (lights.distance_mm / distance) ** 2


def _white(lights: SphereLights, frame: Float64Array) -> float:
    """Return the light of a white diffuser that faces the view under full light."""
    facing = np.maximum(lights.directions @ frame[2], 0.0)
    return float(np.sum(lights.intensities * facing) / np.pi)


def specular_sums(lights: SphereLights, frame: Float64Array, alpha: float, eta: float) -> Sums:
    """Return a function of each light's part of a rough surface's reflection.

    Parameters
    ----------
    lights
        The sphere.
    frame : ndarray, shape (3, 3)
        Rows: right, up and the view, in the rig frame.
    alpha, eta : float
        GGX roughness and refractive index, not checked here.

    Returns
    -------
    function of normals (P, 3) and a position (3,), mm, that returns an array (P, L)
        Parallel less crossed light over that of a white diffuser that faces the view.
    """
    view = frame[2]
    mirrored = facet_reflectance(lights, view, eta) * (1.0 - lights.leakage)
    # the analyzer halves the white diffuser's light but not the polarized reflection's
    mirrored = mirrored * 2.0 / max(_white(lights, frame), 1e-300)

    def each(normals: Float64Array, point_mm: Float64Array) -> Float64Array:
        ways, strength = _local(lights, point_mm)
        half = unit_vectors(ways + view, min_length=1e-9)
        mu_l, mu_v, mu_h = normals @ ways.T, normals @ view, normals @ half.T
        lobe = microfacet.facet_density(mu_h, alpha)
        lobe *= microfacet.visibility(mu_l, mu_v[:, None], alpha)
        return np.asarray(lobe * np.maximum(mu_l, 0.0) * (strength * mirrored))

    return each


def _diffuse_sums(lights: SphereLights, frame: Float64Array, eta: float) -> Sums:
    white = max(_white(lights, frame), 1e-300)
    mean = 1.0 - fresnel.diffuse_external(eta)

    def each(normals: Float64Array, point_mm: Float64Array) -> Float64Array:
        ways, strength = _local(lights, point_mm)
        mu = normals @ ways.T
        c = np.clip(mu, 1e-6, 1.0)
        t_s, t_p = (1.0 - r**2 for r in fresnel_amplitudes(c, eta))
        share_s: Float64Array | float = 0.5
        if len(lights.polarizers):
            # s is along n x l: its part of the field, squared, by the triple product
            across = np.einsum("lk,plk->pl", lights.polarizers, np.cross(normals[:, None], ways))
            sine2 = 1.0 - c**2
            share_s = np.where(sine2 > 1e-9, across**2 / np.maximum(sine2, 1e-9), 0.5)
        entry = (t_s * share_s + t_p * (1.0 - share_s)) / mean
        return np.asarray(entry * np.maximum(mu, 0.0) * (strength / (np.pi * white)))

    return each


def _layers(
    lights: SphereLights, frame: Float64Array, each: Float64Array, mirror: bool
) -> Float64Array:
    """Return the layers (P, LAYERS) from each light's contribution (P, L)."""
    axes = lights.programmed if len(lights.programmed) else lights.directions
    axes = axes @ frame.T
    full = each.sum(axis=1)
    vector = each @ axes
    place, slope = direction_from_moments(vector, mirror)
    some = np.maximum(lights.intensities, 1e-300)
    # relative variance of each light's part; parallel less crossed is proportional to 1 - leakage
    doubt = (lights.intensity_stderr / some) ** 2
    if mirror:
        passing = np.maximum(np.abs(1.0 - lights.leakage), 1e-9)
        doubt = doubt + (lights.leakage_stderr / passing) ** 2
    out = np.zeros((len(each), TABLE_LAYERS))
    out[:, [F_X, F_Y]] = place
    out[:, SCALE] = full
    out[:, CONCENTRATION] = np.linalg.norm(vector, axis=1) / np.maximum(full, 1e-300)
    if doubt.any():
        # independent lights: sum over them of the outer square of derivative times deviation
        move = np.einsum("pij,lj->pil", slope, axes) * (each * np.sqrt(doubt))[:, None]
        out[:, SYS_XX] = np.sum(move[:, 0] ** 2, axis=1)
        out[:, SYS_XY] = np.sum(move[:, 0] * move[:, 1], axis=1)
        out[:, SYS_YY] = np.sum(move[:, 1] ** 2, axis=1)
    return out


def direction_from_moments(vector: Float64Array, mirror: bool) -> tuple[Float64Array, Float64Array]:
    """Return the observed position of a moment vector, and its derivative by the vector.

    Parameters
    ----------
    vector : ndarray, shape (P, 3)
        In the frame of the view.
    mirror : bool
        Whether the vector is a reflection's, and the normal half way between it and the view.

    Returns
    -------
    place : ndarray, shape (P, 2)
    slope : ndarray, shape (P, 2, 3)

    Raises
    ------
    SphereLightsError
        For vectors that are not finite.
    """
    Checks(SphereLightsError).within("vector", vector)
    largest = np.maximum(np.abs(vector).max(axis=1), 1e-300)
    # squares of vectors shorter than this are subnormal or zero
    short = largest * np.linalg.norm(vector / largest[:, None], axis=1)
    size = np.linalg.norm(vector, axis=1)
    size = np.where(size > 1e-150, size, short)
    size = np.maximum(size, 1e-300)[:, None]
    n = vector / size
    # d(v / |v|) / dv = (I - n n') / |v|, chained with the same for n + view in a mirror
    turn = (np.eye(3) - n[:, :, None] * n[:, None, :]) / size[:, :, None]
    if mirror:
        half = n + np.array([0.0, 0.0, 1.0])
        size = np.maximum(np.linalg.norm(half, axis=1), 1e-6)[:, None]
        n = half / size
        turn = (np.eye(3) - n[:, :, None] * n[:, None, :]) / size[:, :, None] @ turn
    up = np.maximum(1.0 + n[:, 2], 1e-9)
    # position u = n_xy sqrt(2 / (1 + n_z)), 2 sin(tilt / 2) long
    scale = np.sqrt(2.0 / up)
    slope = scale[:, None, None] * turn[:, :2]
    slope -= (scale / (2.0 * up))[:, None, None] * n[:, :2, None] * turn[:, None, 2]
    return disc_from_normal(n), slope
