"""Render a shadow boundary close up for two media, to show the effect of translucency.

The paper's figures 17 and 18 are labeled least and greatest *translucency*, with the least and
greatest *sigma_tr*. Translucency is 1/sigma_tr, thus the subject of least sigma_tr is the most
translucent one. All labels here are sigma_tr.

References
----------
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 10.3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from model.skin_reflectance import SkinReflectance
from rigsim.geometry.mesh import Mesh, build_mesh
from rigsim.render import Caster
from skinrig.arrays import Float32Array, Float64Array
from skinrig.rendering import camera as rendering_camera
from skinrig.rendering.camera import Camera, RenderingError
from skinrig.rendering.geometry import FittedSurface
from skinrig.rendering.interior import Interior
from skinrig.rendering.lights import Light, Vector
from skinrig.rendering.render import Rendering, render_surface

MIN_SIGMA_TR_PER_MM: Final = (0.3558, 0.7932, 1.5173)
MAX_SIGMA_TR_PER_MM: Final = (0.9171, 1.5682, 1.6569)
"""sigma_tr of red, green and blue, 1/mm: minimum and maximum of the paper's dataset B."""
BOUNDARY_WIDTH_MM: Final = 24.0
"""Width of the image on the skin."""
CAMERA_DISTANCE_MM: Final = 250.0
CARD_HEIGHT_MM: Final = 30.0
"""Distance of the card's edge from the skin."""
LIGHT_SLANT_RAD: Final = 0.6
"""Angle of the light to the skin's normal."""
SHADOW_LIGHT_RADIUS_RAD: Final = 0.002
"""Angular radius of the light, which gives a penumbra of 0.1 mm."""
MAX_ENTRY_DISTANCE_MM: Final = 25.0
"""Radius of the discretized skin; light that enters farther away does not reach the center."""
FACE_TEXELS: Final = 2048
"""Elements along a side of the face's texture: 0.15 mm each."""
PATCH_MM: Final = 60.0
PATCH_TEXELS: Final = 256
FOREHEAD_SITE: Final = (0.12, 0.72)
"""Position on the forehead: offset from the center per width, and fraction of the mesh's height."""


@dataclass(frozen=True, slots=True, eq=False)
class ShadowBoundary:
    """A region of skin half in the shadow of a card; the lit side is on the left."""

    name: str
    surface: FittedSurface
    camera: Camera
    light: Light
    card: Mesh
    """Mesh that casts the shadow; invisible to the camera."""
    caster: Caster
    interior: Interior

    @staticmethod
    def on_face(surface: FittedSurface, *, size_px: int) -> ShadowBoundary:
        """Create the shadow on the forehead of a face.

        Raises
        ------
        RenderingError
            If the mesh has no surface there.
        """
        caster = Caster(surface.mesh)
        low, high = surface.mesh.vertices_mm.min(axis=0), surface.mesh.vertices_mm.max(axis=0)
        span = high - low
        x = 0.5 * (low[0] + high[0]) + FOREHEAD_SITE[0] * span[0]
        y = low[1] + FOREHEAD_SITE[1] * span[1]
        origin = np.array([[x, y, high[2] + 10.0]])
        prim, share = caster.first_hit(origin, [[0.0, 0.0, -1.0]])
        if prim[0] < 0:
            raise RenderingError(
                f"mesh: got no surface at x {x:.0f}, y {y:.0f} mm, expected the forehead; check "
                "its frame"
            )
        corners = surface.mesh.vertices_mm[surface.mesh.faces[prim[0]]].astype(np.float64)
        one, two = (float(w) for w in share[0])
        target = np.array([1.0 - one - two, one, two]) @ corners
        normal = caster.face_normals[prim[0]].astype(np.float64)
        finer = max(1, FACE_TEXELS // surface.atlas.size)
        return _boundary("face", surface, caster, target, normal, size_px, subdivisions=finer)

    @staticmethod
    def on_plane(model: SkinReflectance, *, size_px: int) -> ShadowBoundary:
        """Create the shadow on a flat patch with a model's median maps."""
        corners = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
        mesh = build_mesh(PATCH_MM * corners, [[0, 1, 2], [0, 2, 3]], corners[:, :2] + 0.5)
        shape = (PATCH_TEXELS, PATCH_TEXELS)
        at = ((np.arange(PATCH_TEXELS) + 0.5) / PATCH_TEXELS - 0.5) * PATCH_MM
        x, y = np.meshgrid(at, -at)

        def even(name: str) -> Float32Array:
            median = np.median(getattr(model, name)[model.valid], axis=0).astype(np.float32)
            return np.broadcast_to(median, (*shape, len(median))).copy()

        normals = np.broadcast_to(np.array([0, 0, 1], np.float32), (*shape, 3)).copy()
        places = np.stack([x, y, np.zeros(shape)], axis=-1).astype(np.float32)
        light = even("r_d"), even("weights"), model.lobes, even("translucency_mm")
        skin = SkinReflectance(*light, normals, places, np.ones(shape, np.bool_), model.eta)
        laid = FittedSurface.of(skin, mesh)
        up = np.array([0.0, 0.0, 1.0])
        return _boundary("flat patch", laid, Caster(mesh), np.zeros(3), up, size_px)

    def render(self, sigma_tr_per_mm: Vector | None, *, subpixels: int = 2) -> Rendering:
        """Render with a uniform sigma_tr; None: without lateral scattering."""
        laid = (
            self.surface if sigma_tr_per_mm is None else self.surface.with_sigma_tr(sigma_tr_per_mm)
        )
        return render_surface(
            laid,
            self.camera,
            self.light,
            subsurface="local" if sigma_tr_per_mm is None else "dipole",
            subpixels=subpixels,
            blockers=self.card,
            caster=self.caster,
            interior=self.interior.with_surface(laid),
        )


def _boundary(
    name: str,
    surface: FittedSurface,
    caster: Caster,
    target: Float64Array,
    normal: Float64Array,
    size_px: int,
    *,
    subdivisions: int = 1,
) -> ShadowBoundary:
    """Place camera, light and card around a point of the skin."""
    up = np.array([0.0, 1.0, 0.0]) - normal[1] * normal
    up /= np.linalg.norm(up)
    right = np.cross(up, normal)
    span = 2.0 * math.atan(0.5 * BOUNDARY_WIDTH_MM / CAMERA_DISTANCE_MM)
    size, fov = (size_px, size_px // 2), math.degrees(span)
    eye = target + CAMERA_DISTANCE_MM * normal
    camera = rendering_camera.look_at(
        eye, target_mm=target, up=up, fov_deg=fov, size_px=size, name=name
    )
    towards = math.cos(LIGHT_SLANT_RAD) * normal - math.sin(LIGHT_SLANT_RAD) * right
    edge = target + CARD_HEIGHT_MM * towards
    away = np.cross(up, towards)  # across the light, to the right
    corners = [edge + h * up + w * away for h, w in ((-80, 0), (-80, 90), (80, 90), (80, 0))]
    card = build_mesh(corners, [[0, 1, 2], [0, 2, 3]], np.zeros((4, 2)))
    x, y, z = towards.tolist()
    light = Light(name="card", direction=(x, y, z), radius=SHADOW_LIGHT_RADIUS_RAD)
    below = Interior.of(surface, subdivisions=subdivisions, region=(target, MAX_ENTRY_DISTANCE_MM))
    return ShadowBoundary(name, surface, camera, light, card, caster, below)


def measure_profile(rendering: Rendering) -> tuple[Float64Array, Float64Array]:
    """Return positions across the boundary, mm, (W,), and their subsurface radiance, (W, 3).

    The radiance is the mean over the middle half of the rows; the lit side is at negative
    positions.
    """
    height, width = rendering.coverage.shape
    rows = rendering.diffuse[height // 4 : height - height // 4].astype(np.float64)
    place = (np.arange(width) - 0.5 * (width - 1)) * BOUNDARY_WIDTH_MM / width
    return place, rows.mean(axis=0)


def measure_rise_mm(position_mm: Float64Array, level: Float64Array) -> Float64Array:
    """Return the distance between the 90 % and 10 % levels of a shadow boundary, mm, (3,).

    Parameters
    ----------
    position_mm
        Increasing positions, shape (W,).
    level
        Decreasing radiance from light to shadow, shape (W, 3); its ends are the levels 1 and 0.

    Examples
    --------
    >>> place = np.linspace(-10.0, 10.0, 201)
    >>> ramp = np.clip(0.5 - place / 4.0, 0.0, 1.0)[:, None] * [1.0, 2.0, 3.0]
    >>> measure_rise_mm(place, ramp).round(6).tolist()
    [3.2, 3.2, 3.2]
    """
    top, bottom = level[:3].mean(axis=0), level[-3:].mean(axis=0)
    share = (level - bottom) / np.where(top > bottom, top - bottom, 1.0)
    found = []
    for channel in range(level.shape[1]):
        falling = np.minimum.accumulate(share[:, channel])
        at = [np.interp(-part, -falling, position_mm) for part in (0.9, 0.1)]
        found.append(at[1] - at[0])
    return np.array(found)
