"""Crossed images of voxel skin under the gradient rig's patterns, in any orientation.

The skin lies in the plane z = 0, and the rig is turned around it, since the integrator `tissue`
has its boundary normal to z. The three bands of a color variant carry three patterns, which share
all walks. LEDs are points without polarizers, and light from below the surface is unpolarized.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from capture.rig import Rig
from model import spectra
from rigsim import shading
from rigsim.arrays import Float64Array
from rigsim.as_built.sphere import PATTERN_WEIGHTS, ActualSphere, diffuser_radiance
from rigsim.light.lobe_moments import MicrofacetSurface, led_moments
from rigsim.mitsuba.scene_radiance import look_at, radiance
from rigsim.scenes.reference.patch import SkinPatch, describe_patch
from rigsim.tissue.skin_layers import ETA

BAND_EDGES_NM: Final = (400.0, 500.0, 580.0, 700.0)
BAND_NODES_NM: Final = (460.0, 540.0, 620.0)
"""Wavelengths that represent the light between `BAND_EDGES_NM`."""
PATTERN_TRIPLES: Final = (("full", "x", "y"), ("full", "z", "-z"))
"""Patterns that are rendered together."""
NO_EXTINCTION: Final = 1.0 + 1e-9
"""Extinction ratio of LEDs without polarizers."""
SURFACE_ALPHA: Final = 0.25
"""Roughness in the fast renderer's equations, of which the crossed light is independent."""


@dataclass(frozen=True, slots=True, eq=False)
class MomentImage:
    """Light from below the surface under the four moments of the LEDs."""

    moments: Float64Array
    """Moments 1, x, y and z over a white diffuser's under all LEDs, shape (4, H, W)."""

    @property
    def mean(self) -> Float64Array:
        """Mean over the pixels, shape (4,)."""
        return np.asarray(self.moments.mean(axis=(1, 2)))

    @property
    def covariance(self) -> Float64Array:
        """Covariance of the mean by the scatter of the pixels, shape (4, 4)."""
        flat = self.moments.reshape(4, -1)
        return np.asarray(np.cov(flat) / flat.shape[1])


def turn_skin(tilt_deg: float, azimuth_deg: float) -> Float64Array:
    """Return the rotation from the rig's frame to that of tilted skin, shape (3, 3).

    Parameters
    ----------
    tilt_deg
        Angle between the skin's normal and +z, degrees.
    azimuth_deg
        Direction of the normal around +z, from +x, degrees.

    Examples
    --------
    >>> normal = turn_skin(30.0, 90.0)[2]
    >>> normal.round(3).tolist()
    [0.0, 0.5, 0.866]
    """
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    normal = np.array(
        [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)]
    )
    right = np.array(
        [np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), -np.sin(tilt)]
    )
    return np.stack([right, np.cross(normal, right), normal])


def render_moments(
    patch: SkinPatch,
    rig: Rig,
    sphere: ActualSphere,
    turn: Float64Array,
    wavelength_nm: float,
    *,
    width_px: int,
    samples: int,
    seed: int,
) -> MomentImage:
    """Render the crossed light of voxels under the four moments.

    Parameters
    ----------
    patch
        The skin; the camera's field is the patch's.
    rig, sphere
        The gradient rig, and its LEDs.
    turn
        Rotation from the rig's frame to the skin's, see `turn_skin`.
    wavelength_nm
        Wavelength, nm.
    width_px
        Pixels along each side of the field.
    samples
        Samples per pixel, for each three patterns.
    seed
        Seed of the sampler, >= 0.
    """
    white = _white(sphere)
    images: dict[str, list[Float64Array]] = {}
    for k, names in enumerate(PATTERN_TRIPLES):
        scene = describe_patterns(patch, rig, sphere, turn, wavelength_nm, names, width_px)
        found = radiance(scene, kind="rgb", samples=samples, seed=2 * seed + k)[..., 3:]
        for band, name in enumerate(names):
            images.setdefault(name, []).append(found[..., band].astype(np.float64) / white)
    full = np.mean(images["full"], axis=0)
    # the moment of each render is taken over its own full light, whose noise it shares
    first, second = images["full"]
    moments = [
        full,
        (2.0 * images["x"][0] - first) * (full.mean() / first.mean()),
        (2.0 * images["y"][0] - first) * (full.mean() / first.mean()),
        (images["z"][0] - images["-z"][0]) * (full.mean() / second.mean()),
    ]
    return MomentImage(np.stack(moments))


def describe_patterns(
    patch: SkinPatch,
    rig: Rig,
    sphere: ActualSphere,
    turn: Float64Array,
    wavelength_nm: float,
    patterns: tuple[str, ...],
    width_px: int,
) -> dict[str, Any]:
    """Describe the skin under three patterns, one in each band, for `tissue`.

    Parameters
    ----------
    patch, rig, sphere, turn, wavelength_nm, width_px
        As for `render_moments`.
    patterns
        Three names of `rigsim.as_built.sphere.PATTERN_WEIGHTS`.
    """
    scene = describe_patch(patch, rig, wavelength_nm, width_px=width_px)
    scene = {name: part for name, part in scene.items() if name[:5] != "light"}
    view = rig.views[0]
    scene["sensor"] = scene["sensor"] | {
        "to_world": look_at(
            *(tuple(turn @ np.array(v)) for v in (view.position_mm, view.target_mm, view.up))
        ),
        "film": scene["sensor"]["film"] | {"pixel_format": "rgb"},
    }
    weights = np.array([PATTERN_WEIGHTS[name] for name in patterns])
    places = sphere.position_mm @ turn.T
    # the power that gives an irradiance of its intensity at the origin
    power = sphere.intensity * np.sum(places**2, axis=1)
    for k in np.flatnonzero((places[:, 2] > 0.0) & (sphere.intensity > 0.0)):
        scene[f"light{k}"] = {
            "type": "point",
            "position": places[k].tolist(),
            "intensity": {
                "type": "rgb",
                "value": (power[k] * (weights @ sphere.weights[k])).tolist(),
            },
        }
    return scene


def predict_moments(
    albedo: float, rig: Rig, sphere: ActualSphere, turn: Float64Array
) -> Float64Array:
    """Return the four moments of the same light by the fast renderer's equations, shape (4,).

    Parameters
    ----------
    albedo
        Diffuse reflectance of the skin, 0 to 1.
    rig, sphere, turn
        As for `render_moments`.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> from rigsim.as_built.sphere import nominal_sphere
    >>> rig = load_rig("gradient")
    >>> light = predict_moments(0.4, rig, nominal_sphere(rig), turn_skin(0.0, 0.0))
    >>> bool(0.3 < light[0] < 0.5)
    True
    """
    view = rig.views[0]
    surface = MicrofacetSurface(SURFACE_ALPHA, ETA, view.position_mm, view.axes[0], NO_EXTINCTION)
    normal, origin = turn[2:3], np.zeros((1, 3))
    to_camera = np.array([view.position_mm]) / np.linalg.norm(view.position_mm)
    leaves = shading.exit_stokes(normal, to_camera, eta=ETA, image_right=surface.image_right)
    total = np.zeros(4)
    for led, place in enumerate(sphere.position_mm):
        if float(place @ normal[0]) > 0.0:
            entering = float(led_moments(normal, origin, sphere, led, surface)[1][0])
            total += entering * sphere.weights[led]
    inner = albedo * shading.interior_scale(ETA) / np.pi
    white = diffuser_radiance(sphere, np.zeros(1), np.zeros(1), extinction=NO_EXTINCTION)[0, 0]
    return np.asarray(float(leaves[0, 0]) * inner * total / white)


def weigh_bands(rig: Rig) -> Float64Array:
    """Return the parts of the gradient camera's band between `BAND_EDGES_NM`, of sum 1.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> weigh_bands(load_rig("gradient")).shape
    (3,)
    """
    wavelengths = np.arange(BAND_EDGES_NM[0] + 5.0, BAND_EDGES_NM[-1], 10.0)
    each = spectra.band_weights(
        rig.views[0].spectral_sensitivity, rig.lights[0].illuminant, wavelengths
    ).mean(axis=1)
    parts = np.histogram(wavelengths, BAND_EDGES_NM, weights=each)[0]
    return np.asarray(parts / parts.sum(), np.float64)


def _white(sphere: ActualSphere) -> float:
    """Return the radiance of a white diffuser that faces the camera under all LEDs."""
    way = sphere.position_mm / np.linalg.norm(sphere.position_mm, axis=1, keepdims=True)
    return float(np.sum(sphere.intensity * np.maximum(way[:, 2], 0.0)) / np.pi)
