"""Deform the sphere of Nagano et al. 2015, fig. 5, with its relief: shrunk, grown, squashed.

The half that faces +z and a margin are one chart, by stereographic projection from -z, which is
conformal. x of the texture is x in space, and its rows go down with y. Relief is a map on that
chart, from noise in space (top row of the figure) or grown from patches (bottom row). It follows
the strain of the sphere's mesh (`model.microstructure.mesh_strain`, `model.microstructure`).

References
----------
Nagano et al. 2015, ACM Trans. Graph. 34(4), 109. doi:10.1145/2766894
Walter et al. 2007, Microfacet models for refraction through rough surfaces, EGSR.
doi:10.2312/EGWR/EGSR07/195-206
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

from model import microstructure
from model.displacement_synthesis import growth as displacement_synthesis
from model.displacement_synthesis.volume_noise import VolumeNoise
from model.microstructure import FOREHEAD, KernelTable, strain_fields
from skinrig.applying.microstructure import convolve_by_strain
from skinrig.arrays import Float32Array, Float64Array, Int64Array
from skinrig.errors import require_choice

CHART_HALF_SIDE: Final = 1.1
"""Half the chart's side, in units of the projection; 1 is the silhouette from +z."""
SPHERE_DIVISIONS: Final = 96
DEFORMATION_RATIOS: Final[Mapping[str, tuple[float, float, float]]] = {
    "neutral": (1.0, 1.0, 1.0),
    "shrunk": (0.8, 0.8, 0.8),
    "grown": (1.25, 1.25, 1.25),
    "squashed": (1.25, 0.8, 1.0),
}
"""Stretch ratios along x, y, z for the figure's shapes; the paper gives none, these are
estimates."""
ROUGHNESS_POINTS: Final[Mapping[str, tuple[float, float, float]]] = {
    "front": (0.0, 0.0, 1.0),
    "right": (math.sqrt(0.5), 0.0, math.sqrt(0.5)),
    "top": (0.0, math.sqrt(0.5), math.sqrt(0.5)),
}
"""Points of the unit sphere at which roughness is reported."""


class SphereError(ValueError):
    """Invalid sphere, deformation, map or site."""


@dataclass(frozen=True, slots=True)
class Sphere:
    """A neutral sphere of skin and its chart."""

    radius_mm: float = 5.0
    """Radius, mm, > 0."""
    texels: int = 1024
    """Side of the chart's maps, 32 to 16,384."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.radius_mm) and self.radius_mm > 0):
            raise SphereError(f"radius_mm: got {self.radius_mm}, expected above 0")
        if not 32 <= self.texels <= 16_384:
            raise SphereError(f"texels: got {self.texels}, expected 32...16384")

    def points_mm(self) -> Float64Array:
        """Return the positions of the chart's pixels, (N, N, 3) mm; row 0 is +y."""
        return self._points(*self._chart())

    def pixel_um(self) -> Float64Array:
        """Return the side of the chart's pixels on the neutral sphere, (N, N) um."""
        x, y = self._chart()
        step = 2.0 * CHART_HALF_SIDE / self.texels
        return np.asarray(2e3 * self.radius_mm * step / (1.0 + x * x + y * y))

    def sample_noise_relief(self, noise: VolumeNoise) -> Float32Array:
        """Sample noise in space at the chart's pixels, (N, N) um."""
        return noise.at(self.points_mm()).astype(np.float32)

    def grow_relief(
        self, patches: Sequence[ArrayLike], *, patch_pixel_um: float, rng: np.random.Generator
    ) -> Float32Array:
        """Grow patches over the chart at their original scale on the skin, (N, N) um."""
        return displacement_synthesis.grow(
            patches, self.texels, rng=rng, pixel_um=self.pixel_um(), patch_pixel_um=patch_pixel_um
        )

    def _chart(self) -> tuple[Float64Array, Float64Array]:
        at = CHART_HALF_SIDE * ((np.arange(self.texels) + 0.5) * 2.0 / self.texels - 1.0)
        x, y = np.meshgrid(at, -at)
        return x, y

    def _points(self, x: Float64Array, y: Float64Array) -> Float64Array:
        square = x * x + y * y
        point = np.stack([2.0 * x, 2.0 * y, 1.0 - square], axis=-1)
        return np.asarray(self.radius_mm * point / (1.0 + square)[..., None])

    def mesh(self) -> tuple[Float64Array, Int64Array, Float64Array]:
        """Return vertices (V, 3) mm, triangles (F, 3), texture coordinates (V, 2) of the chart."""
        side = np.linspace(0.0, 1.0, SPHERE_DIVISIONS + 1)
        u, v = (part.reshape(-1) for part in np.meshgrid(side, side))
        vertices = self._points(
            CHART_HALF_SIDE * (2.0 * u - 1.0), CHART_HALF_SIDE * (2.0 * v - 1.0)
        )
        row = np.arange(SPHERE_DIVISIONS)
        first = (row[:, None] * (SPHERE_DIVISIONS + 1) + row).reshape(-1)
        a, b, c = first, first + 1, first + SPHERE_DIVISIONS + 1
        faces = np.concatenate([np.stack([a, b, c + 1], 1), np.stack([a, c + 1, c], 1)])
        return vertices, faces, np.stack([u, v], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class DeformedSphere:
    """A deformed sphere with its relief."""

    sphere: Sphere
    ratios: tuple[float, float, float]
    """Stretch ratios along x, y, z."""
    height_um: Float32Array
    """(N, N) relief on the chart, um."""
    strain: strain_fields.TextureStrain
    """Ratios and axes at the chart's pixels."""

    def slopes(self) -> Float64Array:
        """Return slopes of the relief on the deformed surface along s and t, (N, N, 2).

        The length of a pixel is that on the neutral sphere times the stretch ratio.
        """
        down, right = (np.asarray(part) for part in np.gradient(self.height_um))
        along = self.strain.axes[..., 0] * right[..., None]
        along = along + self.strain.axes[..., 1] * down[..., None]
        return np.asarray(1e-3 * along * self.strain.px_per_mm / self.strain.stretch)

    def roughness(self, site: str, *, within_rad: float = 0.2) -> tuple[float, float]:
        """Return the variances of slopes along s and t around a site.

        Parameters
        ----------
        site : str
            One of :data:`ROUGHNESS_POINTS`.
        within_rad : float
            Angular radius around the site on the neutral sphere, rad, 0.02 to 0.5.
        """
        require_choice("site", site, ROUGHNESS_POINTS, SphereError)
        if not 0.02 <= within_rad <= 0.5:
            raise SphereError(f"within_rad: got {within_rad}, expected 0.02...0.5")
        near = self.sphere.points_mm() @ np.asarray(ROUGHNESS_POINTS[site]) > (
            self.sphere.radius_mm * math.cos(within_rad)
        )
        variance_s, variance_t = np.var(self.slopes()[near], axis=0).tolist()
        return variance_s, variance_t

    def render(
        self,
        *,
        size_px: int = 256,
        alpha: float = 0.2,
        light: tuple[float, float, float] = (-0.35, 0.45, 0.82),
        samples: int = 3,
    ) -> Float64Array:
        """Render the specular reflection towards +z under a distant light.

        Parameters
        ----------
        size_px : int
            Side of the image, px; it spans 2.6 neutral radii.
        alpha : float
            GGX roughness below the relief's pixels, 0.02 to 1 (Walter et al. 2007).
        light : tuple of float
            Direction towards the light.
        samples : int
            Rays per pixel and axis.

        Returns
        -------
        ndarray, shape (size_px, size_px)
            Radiance, relative, by Cook and Torrance's model with Schlick's Fresnel term for 0.028,
            without masking; row 0 is +y; 0 outside the sphere.
        """
        count = size_px * samples
        at = 1.3 * ((np.arange(count) + 0.5) * 2.0 / count - 1.0)
        x, y = np.meshgrid(at, -at)
        a, b, c = self.ratios
        px, py = x / a, y / b
        inside = px * px + py * py < 0.999
        pz = np.sqrt(np.where(inside, 1.0 - px * px - py * py, 1.0))
        n = self.sphere.texels
        columns = (px / (1.0 + pz) / CHART_HALF_SIDE + 1.0) * 0.5 * n - 0.5
        rows = (1.0 - py / (1.0 + pz) / CHART_HALF_SIDE) * 0.5 * n - 0.5
        down, right = (np.asarray(part) for part in np.gradient(self.height_um))
        scale = 1.0 / self.sphere.pixel_um()
        slope_x, slope_y = (
            map_coordinates(part * scale, [rows, columns], order=1, mode="nearest")
            for part in (right, -down)
        )
        # tangents of the chart on the neutral sphere; the deformation diag(r) maps them to the
        # deformed sphere, where their cross product is the normal
        q = 1.0 + pz
        along_x = np.stack([q - px * px, -px * py, -px * q], axis=-1) / q[..., None]
        along_y = np.stack([-px * py, q - py * py, -py * q], axis=-1) / q[..., None]
        ratios = np.array([a, b, c])
        normal = np.stack([px / a, py / b, pz / c], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        first = along_x * ratios + slope_x[..., None] * normal
        second = along_y * ratios + slope_y[..., None] * normal
        bent = np.cross(first, second)
        bent /= np.linalg.norm(bent, axis=-1, keepdims=True)
        to_light = np.asarray(light) / np.linalg.norm(light)
        half = to_light + np.array([0.0, 0.0, 1.0])
        half /= np.linalg.norm(half)
        cosine = np.clip(bent @ half, 0.0, 1.0)
        square = alpha * alpha
        facets = square / (np.pi * (cosine**2 * (square - 1.0) + 1.0) ** 2)
        fresnel = 0.028 + 0.972 * (1.0 - half[2]) ** 5
        lit = (bent @ to_light > 0) & (bent[..., 2] > 0.02) & inside
        shade = np.where(lit, facets * fresnel / (4.0 * np.maximum(bent[..., 2], 0.02)), 0.0)
        return np.asarray(shade.reshape(size_px, samples, size_px, samples).mean(axis=(1, 3)))


def deform(
    sphere: Sphere,
    height_um: ArrayLike,
    ratios: Sequence[float],
    *,
    table: KernelTable = FOREHEAD,
    dynamic: bool = True,
) -> DeformedSphere:
    """Deform a sphere and convolve its relief by the strain.

    Parameters
    ----------
    sphere : Sphere
    height_um : array_like, shape (N, N)
        Neutral relief on its chart, um.
    ratios : sequence of 3 floats
        Stretch ratios along x, y, z, > 0; :data:`DEFORMATION_RATIOS` has those of the figure.
    table : KernelTable
        Kernels over stretch, clamped at the ends of its range; default: the paper's forehead.
    dynamic : bool
        False: keep the neutral relief, for comparison.

    Returns
    -------
    DeformedSphere

    Raises
    ------
    SphereError
    """
    height = np.asarray(height_um, np.float32)
    if height.shape != (sphere.texels, sphere.texels):
        raise SphereError(
            f"height_um: got shape {height.shape}, expected {(sphere.texels, sphere.texels)}"
        )
    scale = np.asarray(ratios, np.float64)
    if scale.shape != (3,) or not (np.isfinite(scale).all() and (scale > 0).all()):
        raise SphereError(f"ratios: got {ratios}, expected three finite numbers above 0")
    vertices, faces, uv = sphere.mesh()
    found = microstructure.strain(vertices, vertices * scale, faces, uv)
    moved, field = convolve_by_strain(height, found, faces, uv, table)
    shown = moved if dynamic else height
    return DeformedSphere(sphere, (scale[0], scale[1], scale[2]), shown, field)
