"""Polarized reflection by facets and transmission by a smooth boundary, in Dr.Jit.

Stokes vectors (S0, S1, S2) refer to an axis across the ray; the second axis is the direction of
propagation times the first. No circular part arises from linear polarization, because Fresnel's
amplitudes are real below total reflection.

References
----------
Born and Wolf, Principles of Optics, section 1.5 (Fresnel's amplitudes).
"""

from typing import Any

Stokes = tuple[Any, Any, Any]
Facets = list[tuple[Any, Any]]
"""Lobes of facets: D G / (4 n.l n.v) times the fraction of the surface, and refractive index."""


def fresnel_amplitudes(dr: Any, cosine: Any, eta: Any) -> tuple[Any, Any]:
    """Return Fresnel's amplitudes across (s) and along (p) the plane of incidence."""
    c = dr.clip(cosine, 0.0, 1.0)
    inside = dr.sqrt(1.0 - (1.0 - c * c) / (eta * eta))
    return (c - eta * inside) / (c + eta * inside), (eta * c - inside) / (eta * c + inside)


def double_angle(dr: Any, vector: Any, axis: Any, forward: Any) -> tuple[Any, Any]:
    """Return cosine and sine of twice the angle of a vector from an axis, across a ray.

    The axis is perpendicular to the ray, none but the ray's direction must be of unit length. Both
    are zero where the vector or the axis vanishes.
    """
    x, y = dr.dot(vector, axis), dr.dot(vector, dr.cross(forward, axis))
    scale = dr.rcp(dr.maximum(x * x + y * y, 1e-20))
    return (x * x - y * y) * scale, 2.0 * x * y * scale


def turn_axis(stokes: Stokes, cos2: Any, sin2: Any) -> Stokes:
    """Return Stokes vectors relative to an axis at an angle from the present one."""
    s0, s1, s2 = stokes
    return s0, cos2 * s1 + sin2 * s2, cos2 * s2 - sin2 * s1


class FilmedLight:
    """Light of irradiance 1 across the beam behind a polarizer, at surface points.

    Parameters
    ----------
    dr
        The module ``drjit``.
    to_light
        Unit vectors.
    absorbs
        Absorbing axis of the polarizer.
    leak
        Ratio of the transmittances across and along its transmission axis: 0 is ideal, 1 none.
    """

    def __init__(self, dr: Any, to_light: Any, absorbs: Any, leak: Any) -> None:
        self._dr, self.to_light = dr, to_light
        self._passes = dr.cross(absorbs, to_light)
        self._degree = (1.0 - leak) / (1.0 + leak)

    def relative_to(self, axis: Any) -> Stokes:
        """Return the Stokes vector relative to an axis across the ray."""
        cos2, sin2 = double_angle(self._dr, axis, self._passes, -self.to_light)
        return 1.0, cos2 * self._degree, -sin2 * self._degree


def reflect_light(
    dr: Any, facets: Facets, light: FilmedLight, to_camera: Any, right: Any
) -> Stokes:
    """Return the Stokes vector of light reflected by facets, without the surface's cosine.

    Parameters
    ----------
    dr
        The module ``drjit``.
    facets
        Lobes.
    light
        The light.
    to_camera
        Unit vectors.
    right
        Direction whose part across the camera's ray is the axis of the result.
    """
    across = incidence_normal(dr, light.to_light, to_camera, right)
    lh = 0.5 * dr.norm(light.to_light + to_camera)
    mean, difference, mixed = 0.0, 0.0, 0.0
    for strength, index in facets:
        rs, rp = fresnel_amplitudes(dr, lh, index)
        mean += strength * (0.5 * (rs * rs + rp * rp))
        difference += strength * (0.5 * (rs * rs - rp * rp))
        mixed += strength * (rs * rp)
    s0, s1, s2 = light.relative_to(across)
    out = mean * s0 + difference * s1, difference * s0 + mean * s1, mixed * s2
    return turn_axis(out, *double_angle(dr, right, across, to_camera))


def incidence_normal(dr: Any, to_light: Any, to_camera: Any, otherwise: Any) -> Any:
    """Return a vector across light and camera; across the light alone where both are one."""
    across = dr.cross(to_camera, to_light)
    small = dr.squared_norm(across) < 1e-12
    return dr.select(small, dr.cross(otherwise, to_light), across)


def _transmitted(dr: Any, cosine: Any, eta: Any) -> tuple[Any, Any]:
    """Return mean and half difference (s less p) of the boundary's transmittances."""
    rs, rp = fresnel_amplitudes(dr, cosine, eta)
    return 1.0 - 0.5 * (rs * rs + rp * rp), 0.5 * (rp * rp - rs * rs)


def entering_light(dr: Any, normal: Any, light: FilmedLight, eta: Any) -> Any:
    """Return the irradiance across the beam that enters through a smooth boundary."""
    mean, difference = _transmitted(dr, dr.dot(normal, light.to_light), eta)
    s0, s1, _ = light.relative_to(dr.cross(normal, light.to_light))
    return mean * s0 + difference * s1


def leaving_light(dr: Any, normal: Any, to_camera: Any, eta: Any, right: Any) -> Stokes:
    """Return the Stokes vector of unpolarized light of radiance 1 behind a smooth boundary."""
    mean, difference = _transmitted(dr, dr.dot(normal, to_camera), eta)
    cos2, sin2 = double_angle(dr, right, dr.cross(normal, to_camera), to_camera)
    return mean, cos2 * difference, -sin2 * difference


def filmed_spectrum(mi: Any, weight: Any, light: FilmedLight) -> Any:
    """Return an emitter's weight behind a polarizer: in polarized variants as a Mueller matrix.

    Parameters
    ----------
    mi
        The module ``mitsuba`` with a variant.
    weight
        The weight, `mi.UnpolarizedSpectrum`.
    light
        Its polarization; the matrix refers to Mitsuba's basis of the ray from the light.
    """
    import drjit as dr

    if not mi.is_polarized:
        return weight
    matrix = dr.zeros(mi.Spectrum)
    for row, value in enumerate(light.relative_to(mi.mueller.stokes_basis(-light.to_light))):
        matrix[row, 0] = weight * value
    return matrix


def surface_mueller(
    mi: Any,
    facets: Facets,
    volume: Any,
    interior: Any,
    normal: Any,
    to_light: Any,
    to_camera: Any,
    eta: float,
) -> Any:
    """Return the Mueller matrix of a surface, without its cosine, in Mitsuba's bases.

    Parameters
    ----------
    mi
        The module ``mitsuba`` with a polarized variant.
    facets
        Lobes of facets, which keep polarization.
    volume
        Reflection in 1/sr of what lies on the surface, which depolarizes.
    interior
        Reflection in 1/sr between the boundary's two transmissions, which depolarizes; has colors.
    normal, to_light, to_camera
        Unit vectors.
    eta
        Index of the interior.
    """
    import drjit as dr

    optics = mi.mueller
    bases = optics.stokes_basis(-to_light), optics.stokes_basis(to_camera)

    def rotated(matrix: Any, entry: Any, leaves: Any) -> Any:
        return optics.rotate_mueller_basis(
            matrix, -to_light, entry, bases[0], to_camera, leaves, bases[1]
        )

    def axis(vector: Any, basis: Any) -> Any:
        return dr.select(dr.squared_norm(vector) < 1e-12, basis, dr.normalize(vector))

    lh = dr.minimum(0.5 * dr.norm(to_light + to_camera), 1.0)
    reflected = dr.zeros(mi.Matrix4f)
    for strength, index in facets:
        reflected += strength * optics.specular_reflection(lh, mi.Complex2f(index, 0.0))
    across = dr.normalize(incidence_normal(dr, to_light, to_camera, bases[0]))
    reflected = rotated(reflected, across, across) + optics.depolarizer(mi.Float(volume))
    entry = optics.specular_transmission(dr.dot(normal, to_light), mi.Float(eta))
    leaves = optics.specular_transmission(dr.dot(normal, to_camera), mi.Float(eta))
    passed = rotated(
        leaves @ optics.depolarizer(mi.Float(1.0)) @ entry,
        axis(dr.cross(normal, to_light), bases[0]),
        axis(dr.cross(normal, to_camera), bases[1]),
    )
    total = dr.zeros(mi.Spectrum)
    for i in range(4):
        for j in range(4):
            color = mi.UnpolarizedSpectrum(passed[i, j]) * interior
            total[i, j] = color + mi.UnpolarizedSpectrum(reflected[i, j])
    return total
