"""Synthetic points for the BRDF benchmarks, from code that is independent of the estimators."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from skinrig.arrays import BoolArray, Float64Array

N_LIGHTS, N_VIEWS = 150, 16
LIGHT_SKIN_ALBEDO = (0.62, 0.42, 0.32)
DARK_SKIN_ALBEDO = (0.16, 0.085, 0.055)


@dataclass(frozen=True, slots=True, eq=False)
class TrueSamples:
    """Samples of P points under a dome's lights, and their true surface.

    Attributes
    ----------
    f, variance
        (P, M, 3) BRDF samples with noise, 1/sr, and the variance of the noise, 1/sr^2.
    light, view
        (P, M, 3) unit.
    normals
        (P, 3).
    valid
        (P, M) bool: light and view are above the horizon.
    surface
        (P, M) surface BRDF without noise, 1/sr.
    """

    f: Float64Array
    variance: Float64Array
    light: Float64Array
    view: Float64Array
    normals: Float64Array
    valid: BoolArray
    surface: Float64Array

    @property
    def samples(self) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
        """Samples, directions of light and view, and normals, in the estimators' order."""
        return self.f, self.light, self.view, self.normals


@dataclass(frozen=True, slots=True, eq=False)
class TruePoints(TrueSamples):
    """Samples with their true diffuse reflectance."""

    r_d: Float64Array
    """(P, 3)."""


def sample_dome(
    points: int,
    *,
    r_d: tuple[float, float, float],
    noise: float,
    samples: int | None,
    rng: np.random.Generator,
    eta: float = 1.3,
    tail: Literal["light", "heavy"] = "light",
) -> TruePoints:
    """Draw points with frontal normals and their samples by 16 views under 150 lights.

    Parameters
    ----------
    points
        Number of points, P.
    r_d
        Mean diffuse reflectance of the three channels; varies by 15 % over the points.
    noise
        Standard deviation of a sample, relative to its radiance plus 2 % of white's.
    samples
        Maximum number of samples per point; None: all lit and visible ones, about 900.
    rng
        Generator of all random values.
    eta
        Refractive index of the diffuse part's Fresnel factors.
    tail
        Decay of the slope density: "light" as exp(-(tan/m)^1.5), "heavy" as tan^-4.4.
    """
    # lights on a Fibonacci spiral over the sphere, cameras on an arc in front
    k = np.arange(N_LIGHTS) + 0.5
    y = 1.0 - 2.0 * k / N_LIGHTS
    azimuth = np.pi * (1.0 + np.sqrt(5.0)) * k
    ring = np.sqrt(1.0 - y**2)
    lights = np.stack([ring * np.cos(azimuth), y, ring * np.sin(azimuth)], axis=-1)
    az, el = np.meshgrid(np.linspace(-1.1, 1.1, 8), [-0.3, 0.4])
    views = np.stack([np.cos(el) * np.sin(az), np.sin(el), np.cos(el) * np.cos(az)], axis=-1)
    normals = _unit(rng.normal(size=(points, 3)) * [0.5, 0.5, 0.2] + [0.0, 0.0, 1.0])
    shape = (points, N_VIEWS, N_LIGHTS, 3)
    light = np.broadcast_to(lights, shape).reshape(points, -1, 3)
    view = np.broadcast_to(views.reshape(N_VIEWS, 1, 3), shape).reshape(points, -1, 3)
    mu_l, mu_v = np.einsum("pmc,pc->pm", light, normals), np.einsum("pmc,pc->pm", view, normals)
    valid = (mu_l > 0.12) & (mu_v > 0.25)
    # Keep the valid ones, a random choice of them, in the same number of columns for all.
    order = np.argsort(np.where(valid, rng.random(valid.shape), 2.0), axis=1)
    width = min(int(valid.sum(axis=1).max()), samples or valid.shape[1])
    chosen = order[:, :width]
    light, view = (np.take_along_axis(v, chosen[..., None], axis=1) for v in (light, view))
    mu_l, mu_v, valid = (np.take_along_axis(v, chosen, axis=1) for v in (mu_l, mu_v, valid))
    mu_l, mu_v = np.maximum(mu_l, 0.05), np.maximum(mu_v, 0.05)

    albedo = np.array(r_d) * (1.0 + 0.15 * rng.uniform(-1.0, 1.0, (points, 1)))
    half = _unit(light + view)
    cos_h = np.clip(np.einsum("pmc,pc->pm", half, normals), 1e-3, 1.0)
    cos_d = np.clip(np.sum(half * light, axis=-1), 0.0, 1.0)
    # Skin-like microfacets: the slope density falls between an exponential and a Gaussian, or as a
    # power close to GGX's 4, plus a weaker lobe of twice the width. Neither is in the built-in
    # basis. BRDF = D F G / (4 mu_l mu_v) with D(h) = p(slope) / cos^4 and a V-groove shadow term.
    m = rng.uniform(0.18, 0.34, (points, 1))
    strength = rng.uniform(0.5, 1.4, (points, 1))
    tan_h = np.sqrt(1.0 - cos_h**2) / cos_h
    density, wide = (_slopes(tan_h, width, tail) / cos_h**4 for width in (m, 2.0 * m))
    shadow = np.minimum(1.0, 2.0 * cos_h * np.minimum(mu_l, mu_v) / np.maximum(cos_d, 1e-3))
    surface = (
        strength * (0.8 * density + 0.2 * wide) * _fresnel(cos_d, 1.38) * shadow / (4 * mu_l * mu_v)
    )
    transmittance = (1.0 - _fresnel(mu_l, eta)) * (1.0 - _fresnel(mu_v, eta))
    clean = transmittance[..., None] * albedo[:, None] / np.pi + surface[..., None]
    # the noise is that of the radiance, f times the light's cosine; a white diffuser has f = 1/pi
    sigma = noise * (clean * mu_l[..., None] + 0.02 / np.pi) / mu_l[..., None]
    f = clean + sigma * rng.standard_normal(clean.shape)
    return TruePoints(f, sigma**2, light, view, normals, valid, surface, albedo)


def _slopes(tan_h: Float64Array, m: Float64Array, tail: str) -> Float64Array:
    """Return the slope density, normalized to an integral of 1 over the plane of slopes."""
    q = tan_h / m
    if tail == "light":
        return np.asarray(np.exp(-(q**1.5)) / (1.1906 * np.pi * m**2))  # 1.1906 = Gamma(7/3)
    return np.asarray(1.2 / (np.pi * m**2) * (1.0 + q**2) ** -2.2)


def _unit(v: Float64Array) -> Float64Array:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def _fresnel(c: Float64Array, eta: float) -> Float64Array:
    """Return the unpolarized Fresnel reflectance from the angles of Snell's law."""
    inside = np.arcsin(np.sqrt(1.0 - c**2) / eta)
    outside = np.arccos(c)
    small = outside < 1e-3
    total, gap = outside + inside, outside - inside
    safe = np.where(small, 1.0, total)
    s = np.sin(np.where(small, 0.0, gap)) / np.sin(safe)
    p = np.tan(np.where(small, 0.0, gap)) / np.tan(safe)
    return np.asarray(np.where(small, ((eta - 1) / (eta + 1)) ** 2, 0.5 * (s**2 + p**2)))
