"""Closed-form polarized shading of a rough dielectric surface over a depolarizing interior.

Light reflected by the surface keeps its polarization, rotated and weighted by Fresnel's amplitudes
at the facet. Light from the interior is depolarized, and is slightly repolarized at its exit. Both
are Stokes vectors (S0, S1, S2) in the frame of the camera ray, so that one pass serves every angle
of the analyzer. No circular part arises, because Fresnel's amplitudes are real below total
reflection.

Notes
-----
The camera ray's frame is (h, g): h is the image's x axis made perpendicular to the ray, g is
perpendicular to both and points up in the image. S1 > 0 means polarized along h.
Film polarizers absorb along one axis in their plane; they transmit light polarized perpendicular
to that axis and to the ray. ``extinction`` is the ratio of the transmittances along and across the
transmission axis, 1e3 to 1e4 for real polarizers and infinite for an ideal one; the larger
transmittance is normalized to 1.

References
----------
Walter et al. 2007, doi:10.2312/EGWR/EGSR07/195-206 (GGX and its shadowing).
Born and Wolf, Principles of Optics, section 1.5 (Fresnel's amplitudes).
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from rigsim import shading_kernels as kernels
from rigsim.arrays import Float32Array, Float64Array, FloatArray

ALPHA_RANGE = (1e-3, 1.0)
"""Roughness (GGX alpha) range without loss of precision."""


class ShadingError(ValueError):
    """An argument outside the domain of the shading."""


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
    """Return the surface reflection of polarized light as Stokes vectors.

    Parameters
    ----------
    normal, to_light, to_camera
        Unit vectors, shape (N, 3), rig frame, away from the surface.
    alpha
        GGX roughness, shape (N,) or scalar, 1e-3 to 1.
    eta
        Refractive index of the interior relative to air, > 1.
    light_absorbs
        Absorbing axis of the light's polarizer, unit vector, shape (3,).
    image_right
        The image's x axis, unit vector, shape (3,).
    extinction
        Extinction ratio of the light's polarizer, > 1.
    metal
        When above 0, facets are an ideal metal of this reflectance at every angle, and ``eta`` is
        ignored: both amplitudes are its root, with the signs of normal incidence.

    Returns
    -------
    ndarray of float32
        Shape (N, 3): radiance in 1/sr per unit of irradiance across the beam without the
        polarizer; the cosine at the surface is included. Zero where light or camera is below the
        surface.
    """
    n, light, v = _directions(normal, to_light, to_camera)
    # a copy: a broadcast view is read-only, which is a different type for the compiler
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
    return kernels.specular_stokes(
        n, light, v, rough, float(eta), absorbs, right, 1.0 / extinction, root
    )


def entry_transmittance(
    normal: ArrayLike,
    to_light: ArrayLike,
    *,
    eta: float,
    light_absorbs: ArrayLike,
    extinction: float = math.inf,
) -> Float32Array:
    """Return the fraction of the light, before its polarizer, that enters the surface.

    Parameters
    ----------
    normal, to_light
        Unit vectors, shape (N, 3).
    eta, light_absorbs, extinction
        As for `specular_stokes`.

    Returns
    -------
    ndarray of float32
        Shape (N,), at most 1/2 for an ideal polarizer; without the cosine; zero below the surface.
    """
    n, light, _ = _directions(normal, to_light, to_light)
    _check(eta, extinction)
    return kernels.entry_transmittance(
        n, light, float(eta), _vector(light_absorbs), 1.0 / extinction
    )


def exit_stokes(
    normal: ArrayLike, to_camera: ArrayLike, *, eta: float, image_right: ArrayLike
) -> Float32Array:
    """Return the Stokes vector of unpolarized interior light after its exit from the surface.

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
    return kernels.exit_stokes(n, v, float(eta), _vector(image_right))


def apply_analyzer(
    stokes: ArrayLike,
    to_camera: ArrayLike,
    *,
    passes_deg: float,
    image_right: ArrayLike,
    image_up: ArrayLike,
    extinction: float = math.inf,
) -> Float32Array:
    """Return the radiance behind the camera's analyzer (Malus's law, with leakage).

    Parameters
    ----------
    stokes
        Stokes vectors, shape (..., 3).
    to_camera
        Unit vectors opposite to the camera rays, shape (..., 3).
    passes_deg
        Transmission axis of the analyzer in degrees, from the image's x axis toward its top.
    image_right, image_up
        The image's axes, unit vectors, shape (3,).
    extinction
        Extinction ratio of the analyzer, > 1.

    Returns
    -------
    ndarray of float32
        Shape (...).
    """
    _check(2.0, extinction)
    s = np.asarray(stokes, np.float32)
    cos2, sin2 = analyzer_frame(
        to_camera, passes_deg=passes_deg, image_right=image_right, image_up=image_up
    )
    leak = 1.0 / extinction
    through = (1.0 + leak) * s[..., 0] + (1.0 - leak) * (s[..., 1] * cos2 + s[..., 2] * sin2)
    return np.asarray(0.5 * through, np.float32)


def analyzer_frame(
    to_camera: ArrayLike, *, passes_deg: float, image_right: ArrayLike, image_up: ArrayLike
) -> tuple[Float32Array, Float32Array]:
    """Return cosine and sine of twice the analyzer's angle in each camera ray's frame.

    Parameters
    ----------
    to_camera, passes_deg, image_right, image_up
        As for `apply_analyzer`.

    Returns
    -------
    cos2, sin2 : ndarray of float32
        Shape (...). On the optical axis the angle is ``passes_deg`` itself.
    """
    v = np.asarray(to_camera, np.float32)
    right, up = _vector(image_right), _vector(image_up)
    angle = math.radians(passes_deg)
    absorbs = -math.sin(angle) * right + math.cos(angle) * up
    cos2, sin2 = kernels.analyzer_frame(np.ascontiguousarray(v.reshape(-1, 3)), right, absorbs)
    return cos2.reshape(v.shape[:-1]), sin2.reshape(v.shape[:-1])


def fresnel_amplitudes(cos_incident: ArrayLike, eta: float) -> tuple[FloatArray, FloatArray]:
    """Return Fresnel's amplitudes of reflection, perpendicular (s) and parallel (p) to incidence.

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
    """Return the factor from a diffuse reflectance at normal incidence to an inner albedo.

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
    """Return a unit vector at an angle in the plane perpendicular to a beam.

    Parameters
    ----------
    angle_deg
        Angle in degrees from the horizontal axis (``up`` x ``facing``) toward ``up``; for a beam
        along +z and ``up`` +y the horizontal axis is +x.
    facing
        Direction from the polarizer to the subject or to the light, shape (3,); its sign
        does not affect the horizontal axis.
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
        raise ShadingError(
            f"extinction: got {extinction}, expected > 1 (inf is an ideal polarizer)"
        )


def _directions(*vectors: ArrayLike) -> list[Float32Array]:
    arrays = [np.ascontiguousarray(vector, np.float32) for vector in vectors]
    shape = np.broadcast_shapes(*(array.shape for array in arrays))
    if len(shape) != 2 or shape[1] != 3:
        raise ShadingError(f"directions: got shape {shape}, expected (N, 3)")
    return [np.ascontiguousarray(np.broadcast_to(array, shape)) for array in arrays]
