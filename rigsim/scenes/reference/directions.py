"""Reflection of a person's skin as voxels from all lights to all cameras of a dome."""

from dataclasses import dataclass
from math import cos, pi, sin
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from model import spectra
from rigsim import shading
from rigsim.arrays import Float64Array
from rigsim.mitsuba.scene_radiance import look_at
from rigsim.scenes.reference.flat_layers import describe_flat_layers, render_voxels
from rigsim.subject.person_skin import SiteSkin
from rigsim.tissue.skin_layers import ETA, skin_layer_stack
from rigsim.tissue.skin_table import interpolate_spectra

WAVELENGTH_NM: Final = np.arange(400.0, 701.0, 20.0)
"""Bands in nm; ground truth and images have the same ones."""
LIGHT_DEG: Final = (6.0, 26.0, 42.0, 56.0, 68.0, 78.0)
"""Zenith angles of the rendered lights."""
MAX_VIEW_DEG: Final = 80.0
N_VIEWS: Final = 48
"""Rendered cameras per light, even over zenith angle and azimuth."""
VIEW_DISTANCE_MM: Final = 2.0
N_QUADRATURE: Final = 32
MIN_SAMPLES: Final = 4
"""Samples per camera at the wavelength to which the rig's cameras are least sensitive."""
GOLDEN_RATIO: Final = 0.5 * (np.sqrt(5.0) - 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class DirectionalReflectance:
    """Light from below even skin: pi f_r over the boundary's transmittances, by direction."""

    coefficients: Float64Array
    """Of `_terms`, shape (terms, C): white-balanced camera RGB of one skin or of several."""
    chi2: Float64Array
    """Mean square misfit of the fit to the rendered values in units of their noise, shape (C,)."""
    noise: Float64Array
    """Relative noise of a rendered value, shape (C,)."""

    def evaluate(
        self, normal: ArrayLike, to_light: ArrayLike, to_camera: ArrayLike
    ) -> Float64Array:
        """Return f_r in 1/sr without the surface's own reflection, shape (..., C).

        Parameters
        ----------
        normal, to_light, to_camera
            Unit vectors away from the skin, shape (..., 3), broadcast together. Beyond
            `MAX_VIEW_DEG` to the normal the fit is that of this angle and the same azimuth;
            transmittances are exact.
        """
        n, light, camera = (np.asarray(way, np.float64) for way in (normal, to_light, to_camera))
        cos_l, cos_v = np.sum(n * light, axis=-1), np.sum(n * camera, axis=-1)
        between = np.sum(light * camera, axis=-1)
        passed = _transmittance(cos_l) * _transmittance(cos_v)
        scale = np.where((cos_l > 0.0) & (cos_v > 0.0), passed / pi, 0.0)
        least = cos(np.radians(MAX_VIEW_DEG))
        held_l, held_v = np.maximum(cos_l, least), np.maximum(cos_v, least)
        # squared sine at most `MAX_VIEW_DEG` over the true one, exactly 1 below
        ratio = [(1.0 - least**2) / (1.0 - np.clip(c, 0.0, least) ** 2) for c in (cos_l, cos_v)]
        across = (between - cos_l * cos_v) * np.sqrt(ratio[0] * ratio[1])
        found = _terms(held_l, held_v, across + held_l * held_v)
        return np.asarray(scale[..., None] * (found @ self.coefficients), np.float64)

    @property
    def fit_noise(self) -> float:
        """Relative noise of the fit by the renderer's noise, mean over directions and channels."""
        free = len(self.coefficients) / (len(LIGHT_DEG) * N_VIEWS)
        return float(np.sqrt(free * np.square(self.noise).mean()))

    def beam_reflectance(self) -> Float64Array:
        """Return R_d that a beam along the normal has by the light into all directions, (C,)."""
        nodes, weights = np.polynomial.legendre.leggauss(N_QUADRATURE)
        cosine = 0.5 * (nodes + 1.0)
        up = np.array([0.0, 0.0, 1.0])
        camera = np.stack([np.sqrt(1.0 - cosine**2), 0.0 * cosine, cosine], axis=-1)
        found = pi * (weights * cosine) @ self.evaluate(up, up, camera)
        return np.asarray(shading.interior_scale(ETA) * found, np.float64)


def render_directions(
    skin: SiteSkin, camera: str, illuminant: str, *, samples: int, seed: int
) -> DirectionalReflectance:
    """Render even skin under single lights in many cameras, and fit its angular dependence.

    Parameters
    ----------
    skin
        Melanin, blood and all other properties, the same everywhere.
    camera, illuminant
        Names of `model.spectra`.
    samples
        Samples per camera and light at the wavelength to which the cameras are most sensitive.
    seed
        Seed of the sampler, >= 0.

    Returns
    -------
    DirectionalReflectance
        Of skin below a smooth boundary. Reflection by even skin depends on three angles only, and
        smoothly, as light spreads by refraction and scattering: a polynomial of the cosines inside,
        symmetric by reciprocity, fits the rendered values to their noise (`chi2`).
    """
    weights = spectra.band_weights(camera, illuminant, WAVELENGTH_NM)
    importance = weights.max(axis=1) / weights.max()
    sensor, views = _cameras()
    shape = len(LIGHT_DEG), N_VIEWS, 3
    rgb = np.zeros((2, *shape))
    terms = []
    for k, degrees in enumerate(LIGHT_DEG):
        light = np.array([sin(np.radians(degrees)), 0.0, cos(np.radians(degrees))])
        passed = _transmittance(light[2]) * _transmittance(views[:, 2])
        terms.append(_terms(np.full(N_VIEWS, light[2]), views[:, 2], views @ light))
        for band, wavelength_nm in enumerate(WAVELENGTH_NM):
            stack = skin_layer_stack(float(wavelength_nm), skin.c_m, skin.c_hd, skin.tissue)
            scene = describe_flat_layers(stack, light_deg=degrees) | {"sensor": sensor}
            spp = max(round(0.5 * samples * float(importance[band])), MIN_SAMPLES)
            one = band + len(WAVELENGTH_NM) * (k + len(LIGHT_DEG) * seed)
            image = render_voxels(scene, samples=spp, seed=one)[0, :, 1].reshape(N_VIEWS, 2)
            found = pi * image / (light[2] * passed)[:, None]
            rgb[:, k] += found.T[..., None] * weights[band]
    return _fit(np.stack(terms), rgb)


def normal_reflectance(skin: SiteSkin, camera: str, illuminant: str) -> Float64Array:
    """Return the factor R_d by the photon walk for a beam along the normal, shape (3,).

    Parameters
    ----------
    skin, camera, illuminant
        As for `render_directions`.

    Notes
    -----
    It is the walk's reflectance, without the surface's own, over the boundary's transmittances at
    normal and at diffuse incidence, as docs/concepts/dome-reconstruction.md defines R_d.

    Examples
    --------
    >>> from rigsim.subject.person_skin import PersonSkin
    >>> skin = PersonSkin.of_preset("III").at("cheek")
    >>> red, green, blue = normal_reflectance(skin, "Nikon 5100 (NPL)", "LED-B3")
    >>> bool(red > green > blue > 0.0)
    True
    """
    weights = spectra.band_weights(camera, illuminant, WAVELENGTH_NM)
    c_m, c_hd = np.array([skin.c_m]), np.array([skin.c_hd])
    walked = interpolate_spectra(c_m, c_hd, skin.tissue, WAVELENGTH_NM)[0] @ weights
    return np.asarray(shading.interior_scale(ETA) * walked, np.float64)


def _cameras() -> tuple[dict[str, Any], Float64Array]:
    """Describe cameras of two equal pixels each, and return their unit vectors, shape (n, 3)."""
    order = np.arange(N_VIEWS)
    zenith = np.radians(MAX_VIEW_DEG * (order + 0.5) / N_VIEWS)
    azimuth = pi * ((order + 0.5) * GOLDEN_RATIO % 1.0)
    flat = np.sin(zenith)
    views = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.cos(zenith)])
    film = {"type": "hdrfilm", "height": 1, "rfilter": {"type": "box"}}
    wide = {"width": 2 * N_VIEWS, "pixel_format": "luminance", "component_format": "float32"}
    cameras = {
        f"camera{k}": {
            "type": "radiancemeter",
            "to_world": look_at(VIEW_DISTANCE_MM * view, (0.0, 0.0, 0.0), (0.1, 1.0, 0.3)),
            "film": film | {"width": 2},
        }
        for k, view in enumerate(views)
    }
    return {"type": "batch", "film": film | wide, **cameras}, views


def _terms(
    cos_light: Float64Array, cos_camera: Float64Array, between: Float64Array
) -> Float64Array:
    """Return symmetric polynomials of the directions' cosines below the boundary, (..., terms)."""
    cos_light, cos_camera, between = np.broadcast_arrays(cos_light, cos_camera, between)
    inside = [
        np.sqrt(1.0 - (1.0 - np.clip(c, 0.0, 1.0) ** 2) / ETA**2) for c in (cos_light, cos_camera)
    ]
    flat = (between - cos_light * cos_camera) / ETA**2
    turn = 1.0 - (inside[0] * inside[1] + flat)
    steep = 1.0 - np.sqrt(1.0 - 1.0 / ETA**2)
    a, b = ((1.0 - c) / steep for c in inside)
    total, product = a + b, a * b
    return np.stack(
        [
            np.ones_like(a),
            total,
            product,
            total**2,
            total * product,
            turn,
            turn**2,
            turn**3,
            turn * total,
            turn * product,
            turn**2 * total,
        ],
        axis=-1,
    )


def _fit(terms: Float64Array, halves: Float64Array) -> DirectionalReflectance:
    """Fit values (2, lights, views, 3) by least squares, weighted by each light's noise."""
    mean = halves.mean(axis=0)
    relative = np.sqrt(np.square(0.5 * (halves[0] - halves[1]) / mean).mean(axis=1))
    coefficients, chi2 = np.empty((terms.shape[-1], 3)), np.empty(3)
    for channel in range(3):
        sigma = (relative[:, None] * mean.mean(axis=1)[:, None])[..., channel]
        design = (terms / sigma[..., None]).reshape(-1, terms.shape[-1])
        values = (mean[..., channel] / sigma).ravel()
        found, *_ = np.linalg.lstsq(design, values, rcond=None)
        coefficients[:, channel] = found
        free = len(values) - len(found)
        chi2[channel] = float(np.square(values - design @ found).sum()) / free
    noise = np.sqrt(np.square(relative).mean(axis=0))
    return DirectionalReflectance(coefficients, chi2, np.asarray(noise))


def _transmittance(cosine: ArrayLike) -> Float64Array:
    rs, rp = shading.fresnel_amplitudes(np.clip(cosine, 0.0, 1.0), ETA)
    return np.asarray(1.0 - 0.5 * (rs**2 + rp**2), np.float64)
