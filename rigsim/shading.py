"""Closed-form polarized shading of a rough dielectric surface over a depolarizing interior.

Light that is reflected by the surface keeps its polarization, turned and weighted by Fresnel's
amplitudes at the facet; light that comes back from the interior has lost it, and gets a little
anew when it leaves. Both are given as Stokes vectors (S0, S1, S2) in the frame of the camera ray,
so that one pass answers every angle of the analyser. No circular part arises, because Fresnel's
amplitudes are real below total reflection.

Notes
-----
The camera ray's frame is (h, g): h is the image's x axis made perpendicular to the ray, g is
perpendicular to both and points up in the image. S1 > 0 means polarized along h.
Film polarizers absorb along one axis that lies in the film; the light they pass is polarized
perpendicular to that axis and to the ray. ``extinction`` is the ratio of the transmittances along
and across the passing axis, 1e3 to 1e4 for real film and infinite for an ideal one; the larger
transmittance is taken as 1.

References
----------
Walter et al. 2007, doi:10.2312/EGWR/EGSR07/195-206 (GGX and its shadowing).
Born and Wolf, Principles of Optics, section 1.5 (Fresnel's amplitudes).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike

from rigsim.arrays import Float32Array, Float64Array, FloatArray

ALPHA_RANGE = (1e-3, 1.0)
"""Roughness (GGX alpha) that is evaluated without loss of digits."""


class ShadingError(ValueError):
    """An argument of the shading is outside its domain."""


def specular_stokes(
    normal: ArrayLike,
    to_light: ArrayLike,
    to_camera: ArrayLike,
    alpha: ArrayLike,
    *,
    eta: float,
    light_absorbs: ArrayLike,
    image_right: ArrayLike,
    extinction: float = math.inf,
    metal: float = 0.0,
) -> Float32Array:
    """Return the surface reflection of filtered light as Stokes vectors.

    Parameters
    ----------
    normal, to_light, to_camera
        Unit vectors, shape (N, 3), rig frame, away from the surface.
    alpha
        GGX roughness, shape (N,) or scalar, 1e-3 to 1.
    eta
        Refractive index of the interior relative to air, > 1.
    light_absorbs
        Absorbing axis of the light's film, unit vector, shape (3,).
    image_right
        The image's x axis, unit vector, shape (3,).
    extinction
        Extinction ratio of the light's film, > 1.
    metal
        When above 0, facets are an ideal metal of this reflectance at every angle, and ``eta`` does
        not matter: both amplitudes are its root, with the signs of normal incidence.

    Returns
    -------
    ndarray of float32
        Shape (N, 3): radiance in 1/sr per unit of irradiance that a surface across the beam would
        get without the film; the cosine at the surface is included. Zero where light or camera is
        below the surface.
    """
    n, light, v = _directions(normal, to_light, to_camera)
    # a copy: a view would be read-only, which is another type to the compiler
    rough = np.array(np.broadcast_to(np.asarray(alpha, np.float32), len(n)))
    _check(eta, extinction)
    if len(rough) and not (ALPHA_RANGE[0] <= rough.min() and rough.max() <= ALPHA_RANGE[1]):
        raise ShadingError(
            f"alpha: got {rough.min()} to {rough.max()}, "
            f"expected {ALPHA_RANGE[0]} to {ALPHA_RANGE[1]}"
        )
    if not 0.0 <= metal <= 1.0:
        raise ShadingError(f"metal: got {metal}, expected a reflectance from 0 to 1")
    absorbs, right = _vector(light_absorbs), _vector(image_right)
    root = math.sqrt(metal)
    return _specular(n, light, v, rough, float(eta), absorbs, right, 1.0 / extinction, root)


def entry_transmittance(
    normal: ArrayLike,
    to_light: ArrayLike,
    *,
    eta: float,
    light_absorbs: ArrayLike,
    extinction: float = math.inf,
) -> Float32Array:
    """Return which part of the light, before its film, enters the surface.

    Parameters
    ----------
    normal, to_light
        Unit vectors, shape (N, 3).
    eta, light_absorbs, extinction
        As for `specular_stokes`.

    Returns
    -------
    ndarray of float32
        Shape (N,), at most 1/2 for an ideal film; without the cosine; zero below the surface.
    """
    n, light, _ = _directions(normal, to_light, to_light)
    _check(eta, extinction)
    return _entry(n, light, float(eta), _vector(light_absorbs), 1.0 / extinction)


def exit_stokes(
    normal: ArrayLike, to_camera: ArrayLike, *, eta: float, image_right: ArrayLike
) -> Float32Array:
    """Return the Stokes vector of unpolarized interior light after it has left the surface.

    Parameters
    ----------
    normal, to_camera
        Unit vectors, shape (N, 3).
    eta, image_right
        As for `specular_stokes`.

    Returns
    -------
    ndarray of float32
        Shape (N, 3): S0 is the unpolarized transmittance in [0, 1]. Zero below the surface.
    """
    n, v, _ = _directions(normal, to_camera, to_camera)
    _check(eta, math.inf)
    return _exit(n, v, float(eta), _vector(image_right))


def analyse(
    stokes: ArrayLike,
    to_camera: ArrayLike,
    *,
    passes_deg: float,
    image_right: ArrayLike,
    image_up: ArrayLike,
    extinction: float = math.inf,
) -> Float32Array:
    """Return the radiance behind the camera's analyser (Malus's law, with leakage).

    Parameters
    ----------
    stokes
        Stokes vectors, shape (..., 3).
    to_camera
        Unit vectors against the camera rays, shape (..., 3).
    passes_deg
        Passing axis of the analyser in degrees, from the image's x axis towards its top.
    image_right, image_up
        The image's axes, unit vectors, shape (3,).
    extinction
        Extinction ratio of the analyser's film, > 1.

    Returns
    -------
    ndarray of float32
        Shape (...).
    """
    _check(2.0, extinction)
    s = np.asarray(stokes, np.float32)
    cos2, sin2 = analyser_frame(
        to_camera, passes_deg=passes_deg, image_right=image_right, image_up=image_up
    )
    leak = 1.0 / extinction
    through = (1.0 + leak) * s[..., 0] + (1.0 - leak) * (s[..., 1] * cos2 + s[..., 2] * sin2)
    return np.asarray(0.5 * through, np.float32)


def analyser_frame(
    to_camera: ArrayLike, *, passes_deg: float, image_right: ArrayLike, image_up: ArrayLike
) -> tuple[Float32Array, Float32Array]:
    """Return cosine and sine of twice the analyser's angle in each camera ray's frame.

    Parameters
    ----------
    to_camera, passes_deg, image_right, image_up
        As for `analyse`.

    Returns
    -------
    cos2, sin2 : ndarray of float32
        Shape (...). On the optical axis they belong to ``passes_deg`` itself.
    """
    v = np.asarray(to_camera, np.float32)
    right, up = _vector(image_right), _vector(image_up)
    angle = math.radians(passes_deg)
    absorbs = -math.sin(angle) * right + math.cos(angle) * up
    cos2, sin2 = _analyser(np.ascontiguousarray(v.reshape(-1, 3)), right, absorbs)
    return cos2.reshape(v.shape[:-1]), sin2.reshape(v.shape[:-1])


def fresnel_amplitudes(cos_incident: ArrayLike, eta: float) -> tuple[FloatArray, FloatArray]:
    """Return Fresnel's amplitudes of reflection, across (s) and in (p) the plane of incidence.

    Parameters
    ----------
    cos_incident
        Cosine of the angle of incidence in the outer medium, any shape, 0 to 1.
    eta
        Refractive index of the inner relative to the outer medium, > 1.

    Returns
    -------
    rs, rp : ndarray
        Amplitudes; rs < 0 < rp at normal incidence.

    Examples
    --------
    >>> rs, rp = fresnel_amplitudes(1.0, 1.5)
    >>> round(float(rs), 12), round(float(rp), 12)
    (-0.2, 0.2)
    """
    cosine = np.asarray(cos_incident, np.float64)
    inside = np.sqrt(1.0 - (1.0 - cosine * cosine) / (eta * eta))
    rs = (cosine - eta * inside) / (cosine + eta * inside)
    rp = (eta * cosine - inside) / (eta * cosine + inside)
    return rs, rp


def average_transmittance(eta: float) -> float:
    """Return the transmittance of a smooth surface for Lambertian light from outside.

    Parameters
    ----------
    eta
        Refractive index of the interior, > 1.

    Returns
    -------
    float
        1 minus the external diffuse Fresnel reflectance.

    Examples
    --------
    >>> round(1.0 - average_transmittance(1.4), 5)
    0.07681
    """
    nodes, weights = np.polynomial.legendre.leggauss(64)
    cosine = 0.5 * (nodes + 1.0)
    rs, rp = fresnel_amplitudes(cosine, eta)
    transmitted = 1.0 - 0.5 * (rs**2 + rp**2)
    return float(np.sum(weights * cosine * transmitted))


def interior_scale(eta: float) -> float:
    """Return the factor that turns a diffuse reflectance at normal incidence into an inner albedo.

    With light entering by T(incident) and leaving by T(exit), a surface whose inner albedo is this
    factor times R has the total diffuse reflectance R for light at normal incidence.

    Parameters
    ----------
    eta
        Refractive index of the interior, > 1.

    Returns
    -------
    float
        1 / (T(0) T_average).
    """
    normal_incidence = 1.0 - ((eta - 1.0) / (eta + 1.0)) ** 2
    return 1.0 / (normal_incidence * average_transmittance(eta))


def axis_in_plane(angle_deg: float, facing: ArrayLike, up: ArrayLike) -> Float64Array:
    """Return a unit vector at an angle in the plane across a beam.

    Parameters
    ----------
    angle_deg
        Angle in degrees from the horizontal, on the right for somebody who stands at the subject's
        place and is looked at, towards ``up``: +x for a beam along z.
    facing
        Direction from the film to the subject or from the film to the light, shape (3,); its sign
        does not matter for the horizontal one.
    up
        Up direction, shape (3,), not along ``facing``.

    Returns
    -------
    ndarray
        Unit vector, shape (3,).

    Examples
    --------
    >>> axis_in_plane(90.0, (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)).round(12).tolist()
    [0.0, 1.0, 0.0]
    """
    beam = np.asarray(facing, np.float64) / np.linalg.norm(facing)
    right = np.cross(np.asarray(up, np.float64), beam)
    right /= np.linalg.norm(right)
    top = np.cross(beam, right)
    angle = math.radians(angle_deg)
    return np.asarray(math.cos(angle) * right + math.sin(angle) * top)


def _vector(value: ArrayLike) -> Float64Array:
    vector = np.ascontiguousarray(value, np.float64)
    if vector.shape != (3,) or not math.isclose(float(vector @ vector), 1.0, rel_tol=1e-5):
        raise ShadingError(f"axis: got {vector.tolist()}, expected a unit vector of 3 numbers")
    return vector


def _check(eta: float, extinction: float) -> None:
    if not 1.0 < eta < 4.0:
        raise ShadingError(f"eta: got {eta}, expected 1 < eta < 4")
    if not extinction > 1.0:
        raise ShadingError(f"extinction: got {extinction}, expected > 1 (inf is an ideal film)")


def _directions(*vectors: ArrayLike) -> list[Float32Array]:
    arrays = [np.ascontiguousarray(vector, np.float32) for vector in vectors]
    shape = np.broadcast_shapes(*(array.shape for array in arrays))
    if len(shape) != 2 or shape[1] != 3:
        raise ShadingError(f"directions: got shape {shape}, expected (N, 3)")
    return [np.ascontiguousarray(np.broadcast_to(array, shape)) for array in arrays]


@njit(cache=True, inline="always")
def _transmitted(cosine, eta):  # type: ignore[no-untyped-def]
    """Return the transmittances across (s) and in (p) the plane of incidence."""
    inside = math.sqrt(max(0.0, 1.0 - (1.0 - cosine * cosine) / (eta * eta)))
    rs = (cosine - eta * inside) / (cosine + eta * inside)
    rp = (eta * cosine - inside) / (eta * cosine + inside)
    return 1.0 - rs * rs, 1.0 - rp * rp


@njit(cache=True, inline="always")
def _smith(cosine, alpha):  # type: ignore[no-untyped-def]
    tangent2 = max(0.0, 1.0 - cosine * cosine) / (cosine * cosine)
    return 2.0 / (1.0 + math.sqrt(1.0 + alpha * alpha * tangent2))


@njit(cache=True, inline="always")
def specular_one(n0, n1, n2, l0, l1, l2, v0, v1, v2, alpha, eta, absorbs, right, leak, metal):  # type: ignore[no-untyped-def]
    """Return the Stokes vector of `specular_stokes` for one element, for compiled callers.

    All numbers are float64; ``leak`` is 1 over the extinction, ``metal`` the root of its argument.
    """
    s0_sum, s1_sum, s2_sum = 0.0, 0.0, 0.0
    nl = n0 * l0 + n1 * l1 + n2 * l2
    nv = n0 * v0 + n1 * v1 + n2 * v2
    if nl > 0.0 and nv > 0.0:
        h0, h1, h2 = l0 + v0, l1 + v1, l2 + v2
        length = math.sqrt(h0 * h0 + h1 * h1 + h2 * h2)
        h0, h1, h2 = h0 / length, h1 / length, h2 / length
        hn = min(1.0, n0 * h0 + n1 * h1 + n2 * h2)
        hl = min(1.0, h0 * l0 + h1 * l1 + h2 * l2)
        a2 = alpha * alpha
        d = hn * hn * (a2 - 1.0) + 1.0
        lobe = a2 / (math.pi * d * d) * _smith(nl, alpha) * _smith(nv, alpha) / (4.0 * nv)
        inside = math.sqrt(max(0.0, 1.0 - (1.0 - hl * hl) / (eta * eta)))
        rs = (hl - eta * inside) / (hl + eta * inside)
        rp = (eta * hl - inside) / (eta * hl + inside)
        if metal > 0.0:
            rs, rp = -metal, metal
        # s = h x l across the plane of incidence; light, camera and facet in line leave it free.
        s0, s1, s2 = h1 * l2 - h2 * l1, h2 * l0 - h0 * l2, h0 * l1 - h1 * l0
        length = math.sqrt(s0 * s0 + s1 * s1 + s2 * s2)
        if length < 1e-7:
            s0, s1 = right[1] * l2 - right[2] * l1, right[2] * l0 - right[0] * l2
            s2 = right[0] * l1 - right[1] * l0
            length = math.sqrt(s0 * s0 + s1 * s1 + s2 * s2)
        s0, s1, s2 = s0 / length, s1 / length, s2 / length
        i0, i1, i2 = s1 * l2 - s2 * l1, s2 * l0 - s0 * l2, s0 * l1 - s1 * l0  # p in: -l x s
        o0, o1, o2 = v1 * s2 - v2 * s1, v2 * s0 - v0 * s2, v0 * s1 - v1 * s0  # p out: v x s
        # Field that the light's film passes: across its absorbing axis and the ray.
        e0 = absorbs[1] * l2 - absorbs[2] * l1
        e1 = absorbs[2] * l0 - absorbs[0] * l2
        e2 = absorbs[0] * l1 - absorbs[1] * l0
        length = math.sqrt(e0 * e0 + e1 * e1 + e2 * e2)
        e0, e1, e2 = e0 / length, e1 / length, e2 / length
        f0, f1, f2 = l1 * e2 - l2 * e1, l2 * e0 - l0 * e2, l0 * e1 - l1 * e0  # what leaks
        # Frame of the camera ray.
        along = right[0] * v0 + right[1] * v1 + right[2] * v2
        x0, x1, x2 = right[0] - along * v0, right[1] - along * v1, right[2] - along * v2
        length = math.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
        x0, x1, x2 = x0 / length, x1 / length, x2 / length
        y0, y1, y2 = v1 * x2 - v2 * x1, v2 * x0 - v0 * x2, v0 * x1 - v1 * x0
        sx, sy = s0 * x0 + s1 * x1 + s2 * x2, s0 * y0 + s1 * y1 + s2 * y2
        ox, oy = o0 * x0 + o1 * x1 + o2 * x2, o0 * y0 + o1 * y1 + o2 * y2
        for k in range(2):
            if k == 0:
                es = rs * (e0 * s0 + e1 * s1 + e2 * s2)
                ep = rp * (e0 * i0 + e1 * i1 + e2 * i2)
                weight = 0.5 * lobe
            else:
                es = rs * (f0 * s0 + f1 * s1 + f2 * s2)
                ep = rp * (f0 * i0 + f1 * i1 + f2 * i2)
                weight = 0.5 * lobe * leak
            fx, fy = es * sx + ep * ox, es * sy + ep * oy
            s0_sum += weight * (fx * fx + fy * fy)
            s1_sum += weight * (fx * fx - fy * fy)
            s2_sum += weight * 2.0 * fx * fy
    return s0_sum, s1_sum, s2_sum


@njit(cache=True, inline="always")
def entry_one(n0, n1, n2, l0, l1, l2, eta, absorbs, leak):  # type: ignore[no-untyped-def]
    """Return `entry_transmittance` for one element, for compiled callers; float64."""
    entered = 0.0
    nl = min(1.0, n0 * l0 + n1 * l1 + n2 * l2)
    if nl > 0.0:
        ts, tp = _transmitted(nl, eta)
        s0, s1, s2 = n1 * l2 - n2 * l1, n2 * l0 - n0 * l2, n0 * l1 - n1 * l0
        e0 = absorbs[1] * l2 - absorbs[2] * l1
        e1 = absorbs[2] * l0 - absorbs[0] * l2
        e2 = absorbs[0] * l1 - absorbs[1] * l0
        both = (s0 * s0 + s1 * s1 + s2 * s2) * (e0 * e0 + e1 * e1 + e2 * e2)
        dot = e0 * s0 + e1 * s1 + e2 * s2
        c2 = min(1.0, dot * dot / both) if both > 1e-20 else 0.5  # ts = tp at normal incidence
        passed = ts * c2 + tp * (1.0 - c2)
        leaked = ts * (1.0 - c2) + tp * c2
        entered = 0.5 * (passed + leak * leaked)
    return entered


@njit(parallel=True, cache=True)
def _specular(normal, light, camera, alpha, eta, absorbs, right, leak, metal):  # type: ignore[no-untyped-def]
    out = np.zeros((normal.shape[0], 3), np.float32)
    for i in prange(normal.shape[0]):
        n0, n1, n2 = float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2])
        l0, l1, l2 = float(light[i, 0]), float(light[i, 1]), float(light[i, 2])
        v0, v1, v2 = float(camera[i, 0]), float(camera[i, 1]), float(camera[i, 2])
        out[i, 0], out[i, 1], out[i, 2] = specular_one(
            n0, n1, n2, l0, l1, l2, v0, v1, v2, float(alpha[i]), eta, absorbs, right, leak, metal
        )
    return out


@njit(parallel=True, cache=True)
def _entry(normal, light, eta, absorbs, leak):  # type: ignore[no-untyped-def]
    out = np.zeros(normal.shape[0], np.float32)
    for i in prange(normal.shape[0]):
        n0, n1, n2 = float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2])
        l0, l1, l2 = float(light[i, 0]), float(light[i, 1]), float(light[i, 2])
        out[i] = entry_one(n0, n1, n2, l0, l1, l2, eta, absorbs, leak)
    return out


@njit(parallel=True, cache=True)
def _exit(normal, camera, eta, right):  # type: ignore[no-untyped-def]
    out = np.zeros((normal.shape[0], 3), np.float32)
    for i in prange(normal.shape[0]):
        n0, n1, n2 = float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2])
        v0, v1, v2 = float(camera[i, 0]), float(camera[i, 1]), float(camera[i, 2])
        nv = min(1.0, n0 * v0 + n1 * v1 + n2 * v2)
        if nv <= 0.0:
            continue
        ts, tp = _transmitted(nv, eta)
        out[i, 0] = 0.5 * (ts + tp)
        s0, s1, s2 = n1 * v2 - n2 * v1, n2 * v0 - n0 * v2, n0 * v1 - n1 * v0
        squared = s0 * s0 + s1 * s1 + s2 * s2
        if squared < 1e-16:
            continue
        along = right[0] * v0 + right[1] * v1 + right[2] * v2
        x0, x1, x2 = right[0] - along * v0, right[1] - along * v1, right[2] - along * v2
        length2 = x0 * x0 + x1 * x1 + x2 * x2
        y0, y1, y2 = v1 * x2 - v2 * x1, v2 * x0 - v0 * x2, v0 * x1 - v1 * x0
        sx = s0 * x0 + s1 * x1 + s2 * x2
        sy = s0 * y0 + s1 * y1 + s2 * y2
        half = 0.5 * (ts - tp) / (squared * length2)
        out[i, 1] = half * (sx * sx - sy * sy)
        out[i, 2] = half * 2.0 * sx * sy
    return out


@njit(parallel=True, cache=True)
def _analyser(camera, right, absorbs):  # type: ignore[no-untyped-def]
    cos2 = np.empty(camera.shape[0], np.float32)
    sin2 = np.empty(camera.shape[0], np.float32)
    for i in prange(camera.shape[0]):
        v0, v1, v2 = float(camera[i, 0]), float(camera[i, 1]), float(camera[i, 2])
        along = right[0] * v0 + right[1] * v1 + right[2] * v2
        x0, x1, x2 = right[0] - along * v0, right[1] - along * v1, right[2] - along * v2
        y0, y1, y2 = v1 * x2 - v2 * x1, v2 * x0 - v0 * x2, v0 * x1 - v1 * x0
        # What passes is perpendicular to the ray and to the absorbing axis.
        p0 = absorbs[1] * v2 - absorbs[2] * v1
        p1 = absorbs[2] * v0 - absorbs[0] * v2
        p2 = absorbs[0] * v1 - absorbs[1] * v0
        px, py = p0 * x0 + p1 * x1 + p2 * x2, p0 * y0 + p1 * y1 + p2 * y2
        squared = px * px + py * py
        cos2[i], sin2[i] = (px * px - py * py) / squared, 2.0 * px * py / squared
    return cos2, sin2
