"""Reflection of polarized lights by smooth facets into a camera behind an analyzer."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from capture.arrays import Float64Array
from capture.calibration.geometry import CameraPose
from capture.calibration.polarization.malus import PolarizationError
from capture.rig import Light


def fresnel_amplitudes(cosine: ArrayLike, eta: float) -> tuple[Float64Array, Float64Array]:
    """Return Fresnel's amplitudes of reflection, across (s) and in (p) the plane of incidence.

    Parameters
    ----------
    cosine : array_like
        Cosine of the angle of incidence, outside, 0 to 1.
    eta : float
        Refractive index of the inside over that of the outside, > 1.

    Returns
    -------
    rs, rp : ndarray of float64
        rs < 0 everywhere; rp > 0 at normal incidence, 0 at Brewster's angle.

    References
    ----------
    Born and Wolf, Principles of Optics, 7th ed., section 1.5.2, doi 10.1017/CBO9781139644181.

    Examples
    --------
    >>> rs, rp = fresnel_amplitudes([1.0, 1 / np.hypot(1.0, 1.5)], 1.5)
    >>> rs.round(6).tolist(), np.abs(rp).round(6).tolist()
    ([-0.2, -0.384615], [0.2, 0.0])
    """
    # Snell's law gives the cosine inside: cos_t^2 = 1 - (1 - cos_i^2) / eta^2.
    outside = np.asarray(cosine, np.float64)
    inside = np.sqrt(1.0 - (1.0 - outside**2) / eta**2)
    rs = (outside - eta * inside) / (outside + eta * inside)
    rp = (eta * outside - inside) / (eta * outside + inside)
    return rs, rp


@dataclass(frozen=True, slots=True, eq=False)
class FacetReflection:
    """Polarized lights, mirrored by facets into a camera behind an analyzer.

    Attributes
    ----------
    to_light, to_camera, normal : ndarray of float64, shape (L, 3)
        Unit vectors at each facet.
    light_right, light_up : ndarray of float64, shape (L, 3)
        Axes of each light's polarizer: its angle is measured from the first towards the second.
    axis_rad : ndarray of float64, shape (L,)
        Nominal transmission axis of each light's polarizer.
    image_right, image_up : ndarray of float64, shape (3,)
        Axes of the analyzer.
    analyzer_rad : float
        Nominal transmission axis of the analyzer at reading 0.
    eta : float
        Refractive index of the facets.
    """

    to_light: Float64Array
    to_camera: Float64Array
    normal: Float64Array
    light_right: Float64Array
    light_up: Float64Array
    axis_rad: Float64Array
    image_right: Float64Array
    image_up: Float64Array
    analyzer_rad: float
    eta: float

    @classmethod
    def of(
        cls,
        lights: tuple[Light, ...],
        camera: CameraPose,
        analyzer_deg: float,
        eta: float,
        *,
        to_light: Float64Array,
        to_camera: Float64Array,
        facing: Float64Array | None = None,
    ) -> Self:
        """Return the reflection by facets that mirror each light into the camera.

        Parameters
        ----------
        lights : tuple of Light
            With polarizers.
        camera : CameraPose
        analyzer_deg : float
            Nominal axis of the analyzer at reading 0, degrees from the image's x axis to its top.
        eta : float
            Refractive index, > 1.
        to_light, to_camera : ndarray of float64, shape (L, 3)
            Unit vectors from the facets.
        facing : ndarray of float64, shape (L, 3), optional
            Directions from the rig's origin to the lights, which the polarizers face; None:
            nominal.

        Raises
        ------
        PolarizationError
            If a light has no polarizer.
        """
        bare = [light.name for light in lights if light.polarizer_axis_deg is None]
        if bare:
            raise PolarizationError(
                f"lights: {', '.join(bare)} have no polarizer; use a rig with polarizers"
            )
        place = [light.position_mm for light in lights] if facing is None else facing
        beam = np.array(place, np.float64)
        beam /= np.linalg.norm(beam, axis=1, keepdims=True)
        right = np.cross([0.0, 1.0, 0.0], beam)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        half = to_light + to_camera
        normal = half / np.linalg.norm(half, axis=1, keepdims=True)
        axis_rad = np.radians([light.polarizer_axis_deg or 0.0 for light in lights])
        film, image = (right, np.cross(beam, right)), (camera.rotation[0], -camera.rotation[1])
        analyzer_rad = float(np.radians(analyzer_deg))
        return cls(to_light, to_camera, normal, *film, axis_rad, *image, analyzer_rad, eta)

    def with_directions(self, to_light: Float64Array, eta: float) -> Self:
        """Return the reflection with lights in other directions, and of another index.

        Parameters
        ----------
        to_light : ndarray of float64, shape (L, 3)
            Directions from the facets, any length; polarizers face the facets as before.
        eta : float
        """
        light = _unit(to_light)
        normal = _unit(light + self.to_camera)
        return replace(self, to_light=light, normal=normal, eta=eta)

    def reflected_fields(self, axis_error_rad: ArrayLike = 0.0) -> Float64Array:
        """Return the reflected fields, shape (L, 2, 2).

        Parameters
        ----------
        axis_error_rad : array_like, shape (L,) or ()
            Deviation of each light's axis from its nominal angle.

        Returns
        -------
        ndarray of float64
            First the transmitted, then the absorbed component of unit amplitude at the polarizer;
            components along the image's right and up, made perpendicular to the ray.
        """
        light, camera, normal = self.to_light, self.to_camera, self.normal
        angle = (self.axis_rad + np.asarray(axis_error_rad, np.float64))[:, None]
        # Jones calculus: the field is split along s and p of the plane of incidence, scaled by
        # Fresnel's amplitudes, and put together in the axes of the reflected ray.
        absorbs = -np.sin(angle) * self.light_right + np.cos(angle) * self.light_up
        passed = _unit(_cross(absorbs, light))
        s = _cross(normal, light)
        # at normal incidence the plane of incidence is undefined, and any choice is valid
        straight = np.linalg.norm(s, axis=-1, keepdims=True) < 1e-9
        s = _unit(np.where(straight, _cross(self.image_up, light), s))
        p_in, p_out = _cross(s, light), _cross(camera, s)
        rs, rp = fresnel_amplitudes(np.sum(normal * light, axis=-1), self.eta)
        out = []
        for field in (passed, _cross(light, passed)):
            across = (rs * np.sum(field * s, axis=-1))[:, None] * s
            out.append(across + (rp * np.sum(field * p_in, axis=-1))[:, None] * p_out)
        return self._in_image(np.stack(out, axis=1), self._image_axes())

    def transmit_through_analyzer(
        self,
        readings_rad: ArrayLike,
        axis_error_rad: ArrayLike = 0.0,
        zero_rad: ArrayLike = 0.0,
        light_leak: ArrayLike = 0.0,
        analyzer_leak: ArrayLike = 0.0,
    ) -> Float64Array:
        """Return the fraction of each light that reaches the sensor, shape (E, L).

        Parameters
        ----------
        readings_rad : array_like, shape (E,)
            Readings of the analyzer.
        axis_error_rad : array_like, shape (L,) or ()
            As in `reflected_fields`.
        zero_rad : array_like, shape (L,) or ()
            True angle of the analyzer minus its reading.
        light_leak, analyzer_leak : array_like, shape (L,) or ()
            Transmittance along the absorbing axis over that along the transmission axis.

        Returns
        -------
        ndarray of float64
            Relative to the light transmitted by the light's polarizer: reflectance times the
            analyzer.
        """
        field = self.reflected_fields(axis_error_rad)
        axes = self._image_axes()
        whole = np.sum(field**2, axis=-1)
        light = np.asarray(light_leak, np.float64)
        analyzer = np.asarray(analyzer_leak, np.float64)[..., None]
        rows = []
        for reading in np.atleast_1d(np.asarray(readings_rad, np.float64)):
            angle = self.analyzer_rad + reading + np.asarray(zero_rad, np.float64)
            angle = np.broadcast_to(angle, self.axis_rad.shape)[:, None]
            absorbs = -np.sin(angle) * self.image_right + np.cos(angle) * self.image_up
            # the transmitted field is perpendicular to the ray and to the absorbing axis
            passes = _unit(self._in_image(_cross(absorbs, self.to_camera)[:, None], axes))
            along = np.sum(field * passes, axis=-1) ** 2
            # Malus's law with leakage: the transmitted component, and a fraction of the absorbed
            # one.
            behind = along + analyzer * (whole - along)
            rows.append(behind[:, 0] + light * behind[:, 1])
        return np.array(rows)

    def _image_axes(self) -> tuple[Float64Array, Float64Array]:
        """Return the image's right and up made perpendicular to each ray, shapes (L, 3)."""
        camera = self.to_camera
        x = _unit(self.image_right - (camera @ self.image_right)[:, None] * camera)
        return x, _cross(camera, x)

    @staticmethod
    def _in_image(vectors: Float64Array, axes: tuple[Float64Array, Float64Array]) -> Float64Array:
        """Return components of vectors (L, n, 3) across each ray, shape (L, n, 2)."""
        return np.stack([np.sum(vectors * axis[:, None], axis=-1) for axis in axes], axis=-1)


def _cross(first: Float64Array, second: Float64Array) -> Float64Array:
    """Return cross products of rows of three, as `numpy.cross` in a fifth of its time."""
    out = np.empty(np.broadcast_shapes(first.shape, second.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(first[..., j], second[..., k], out=out[..., i])
        out[..., i] -= first[..., k] * second[..., j]
    return out


def _unit(vectors: Float64Array) -> Float64Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
