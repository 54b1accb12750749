"""Render the diffuse reflectance of flat layers of skin as voxels below a smooth boundary."""

from dataclasses import dataclass
from math import isfinite, pi, sqrt
from typing import Any, Final, Literal

import numpy as np
from scipy.special import roots_legendre

from rigsim.arrays import Float64Array
from rigsim.mitsuba.scene_radiance import look_at, radiance
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import choose_variant
from rigsim.tissue.tissue_mc import LayerStack, TransportError

VoxelIntegrator = Literal["tissue", "volpath"]

N_LIGHTS: Final = 24
"""Gauss-Legendre directions of the hemisphere. From 12 on, R_d changes by less than 1e-4."""
ATTENUATION_LENGTHS: Final = 20.0
"""Depth and half-width of a semi-infinite stack in diffusion lengths of its last layer: light
beyond is below exp(-20) of the incident."""
MAX_ROWS_PER_LAYER: Final = 64
WIDTH_PX: Final = 8


@dataclass(frozen=True, slots=True)
class RenderedReflectance:
    """Diffuse reflectance by a renderer."""

    pixels: Float64Array
    """Independent estimates, shape (n,)."""

    @property
    def reflectance(self) -> float:
        """Their mean."""
        return float(self.pixels.mean())

    @property
    def stderr(self) -> float:
        """Standard error of the mean."""
        return float(self.pixels.std(ddof=1) / sqrt(self.pixels.size))


def describe_flat_layers(
    stack: LayerStack,
    *,
    integrator: VoxelIntegrator = "tissue",
    alpha: float = 0.0,
    floor_reflectance: float = 0.0,
    light_deg: float | None = None,
) -> dict[str, Any]:
    """Describe layers of one refractive index, and a camera that observes them along the normal.

    Parameters
    ----------
    stack
        The layers. A last layer of finite thickness is on an opaque floor.
    integrator
        ``tissue``, or Mitsuba's ``volpath``.
    alpha
        Beckmann roughness of the boundary; 0: smooth.
    floor_reflectance
        Diffuse reflectance of the floor, 0 to 1.
    light_deg
        Zenith angle of one distant light of unit irradiance across its beam, degrees. None: a
        uniform hemisphere of unit radiance, so that the radiance is that of a beam along the
        normal, reflected into all directions, by reciprocity; for ``tissue`` it is `N_LIGHTS`
        directions, for ``volpath`` a constant environment.

    Raises
    ------
    TransportError
        Layers differ in refractive index, or their thicknesses have no common voxel.
    """
    layers = stack.layers
    eta = layers[0].eta / stack.eta_above
    if any(layer.eta != layers[0].eta for layer in layers):
        raise TransportError(
            f"layers: eta: got {[layer.eta for layer in layers]}, expected one value; "
            "use trace_photons"
        )
    if any(layer.g != layers[0].g for layer in layers):
        raise TransportError(
            f"layers: g: got {[layer.g for layer in layers]}, expected one value; use trace_photons"
        )
    grid, depth = _voxels(stack)
    half = depth if isfinite(layers[-1].thickness_mm) else 1.0
    half = max(ATTENUATION_LENGTHS * half, depth)
    box = np.diag([2.0 * half, 2.0 * half, depth, 1.0])
    box[:3, 3] = -half, -half, -depth
    sigma_t = grid.sum(axis=-1, keepdims=True)
    albedo = grid[..., 1:] / np.where(sigma_t > 0.0, sigma_t, 1.0)

    def volume(values: Float64Array) -> dict[str, Any]:
        return {"type": "gridvolume", "grid": values, "filter_type": "nearest", "to_world": box}

    medium = {
        "type": "heterogeneous",
        "sigma_t": volume(sigma_t),
        "albedo": volume(albedo),
        "phase": {"type": "hg", "g": layers[0].g},
    }
    floor = np.diag([half, half, 1.0, 1.0])
    floor[2, 3] = -depth
    return {
        "type": "scene",
        "integrator": {"type": integrator, "max_depth": -1},
        "skin": {
            "type": "rectangle",
            "to_world": np.diag([half, half, 1.0, 1.0]),
            "bsdf": describe_boundary(eta, alpha),
            "interior": medium,
        },
        "floor": {
            "type": "rectangle",
            "to_world": floor,
            "bsdf": {"type": "diffuse", "reflectance": floor_reflectance},
        },
        "sensor": {
            "type": "orthographic",
            "to_world": look_at((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
            @ np.diag([0.1, 0.1, 1.0, 1.0]),
            "film": {
                "type": "hdrfilm",
                "width": WIDTH_PX,
                "height": WIDTH_PX,
                "pixel_format": "luminance",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
        },
        **_lights(integrator, light_deg),
    }


def describe_boundary(eta: float, alpha: float) -> dict[str, Any]:
    """Describe a boundary; ``null`` where the index does not change."""
    if eta == 1.0:
        return {"type": "null"}
    index = {"int_ior": float(eta), "ext_ior": 1.0}
    if alpha == 0.0:
        return {"type": "dielectric", **index}
    return {"type": "roughdielectric", "distribution": "beckmann", "alpha": alpha, **index}


def render_reflectance(
    stack: LayerStack,
    *,
    samples: int,
    seed: int,
    integrator: VoxelIntegrator = "tissue",
    floor_reflectance: float = 0.0,
) -> RenderedReflectance:
    """Render the diffuse reflectance of layers for light along the normal.

    Parameters
    ----------
    stack, integrator, floor_reflectance
        As for `describe_flat_layers`; the boundary is smooth.
    samples
        Samples per pixel, of 64 pixels.
    seed
        Seed of the sampler, >= 0.

    Returns
    -------
    RenderedReflectance
        Without the surface's own reflection, as `rigsim.tissue.tissue_mc.trace_photons` states it.

    Examples
    --------
    >>> from math import inf
    >>> from rigsim.tissue.tissue_mc import Layer
    >>> stack = LayerStack((Layer(inf, 1.0, 9.0, 0.0, 1.5),))
    >>> found = render_reflectance(stack, samples=64, seed=0)
    >>> abs(found.reflectance - 0.22) < 0.02
    True
    """
    description = describe_flat_layers(
        stack, integrator=integrator, floor_reflectance=floor_reflectance
    )
    image = render_voxels(description, samples=samples, seed=seed)
    own = stack.specular_reflectance if integrator == "volpath" else 0.0
    return RenderedReflectance(image[..., -1].ravel().astype(np.float64) - own)


def render_voxels(description: dict[str, Any], *, samples: int, seed: int) -> Float64Array:
    """Render one band of a described scene, shape (H, W, channels).

    The first channel is the whole radiance. ``tissue`` appends the part with a collision inside.
    """
    load_mitsuba(choose_variant("mono"))
    return radiance(description, kind="mono", samples=samples, seed=seed).astype(np.float64)


def _voxels(stack: LayerStack) -> tuple[Float64Array, float]:
    """Return sigma_a and sigma_s from the floor up, shape (rows, 1, 1, 2), and the depth."""
    layers = stack.layers
    last = layers[-1]
    finite = [layer.thickness_mm for layer in layers if isfinite(layer.thickness_mm)]
    row = _common_row(finite) if finite else 1.0
    counts = [round(mm / row) for mm in finite]
    if not isfinite(last.thickness_mm):
        scattered = last.sigma_s_per_mm * (1.0 - last.g)
        mu_eff = sqrt(3.0 * last.sigma_a_per_mm * (last.sigma_a_per_mm + scattered))
        if not finite:
            row = ATTENUATION_LENGTHS / mu_eff
        counts.append(max(round(ATTENUATION_LENGTHS / mu_eff / row), 1))
    rates = [(layer.sigma_a_per_mm, layer.sigma_s_per_mm) for layer in layers]
    rows = np.repeat(np.array(rates), counts, axis=0)[::-1]
    return rows[:, None, None, :], row * len(rows)


def _common_row(thicknesses_mm: list[float]) -> float:
    """Return the largest height of which all thicknesses are multiples."""
    for parts in range(1, MAX_ROWS_PER_LAYER + 1):
        row = min(thicknesses_mm) / parts
        counts = np.array(thicknesses_mm) / row
        if np.allclose(counts, np.round(counts), rtol=0.0, atol=1e-6):
            return row
    raise TransportError(
        f"layers: thickness_mm: got {thicknesses_mm}, expected multiples of one voxel; round them"
    )


def _lights(integrator: VoxelIntegrator, light_deg: float | None) -> dict[str, Any]:
    if light_deg is not None:
        return {"light": _distant_light(np.cos(np.radians(light_deg)), 1.0, 1.0)}
    if integrator == "volpath":
        return {"light": {"type": "constant", "radiance": 1.0}}
    # In the squared cosine, equal weights of directions are equal parts of the radiance.
    nodes, weights = roots_legendre(N_LIGHTS)
    cosines, weights = np.sqrt(0.5 * (nodes + 1.0)), 0.5 * weights
    return {
        f"light{k}": _distant_light(cosine, pi * weight / cosine, weight)
        for k, (cosine, weight) in enumerate(zip(cosines, weights, strict=True))
    }


def _distant_light(cosine: float, irradiance: float, weight: float) -> dict[str, Any]:
    return {
        "type": "directional",
        "direction": [-sqrt(1.0 - cosine**2), 0.0, -float(cosine)],
        "irradiance": float(irradiance),
        "sampling_weight": float(weight),
    }
