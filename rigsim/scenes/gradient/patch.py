"""Sample a patch of skin between the caliper's jaws at the gradient camera's pixels.

Frame: mm, origin at the center of the patch. The camera's samples are points of the plane z = 0;
where the skin is higher, the visible point is slightly nearer to the axis.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import ArrayLike

from capture.rig import View
from rigsim.arrays import BoolArray, Float32Array, Float64Array
from rigsim.skin_patch.motion import PatchPose
from rigsim.skin_patch.stretch import SurfaceSample
from rigsim.world.taped_skin import GripState

JAW_REFLECTANCE: Final = 0.03
"""Reflectance of the jaws' matt black."""

BULGE_MM: Final = 0.1
"""Height of the bulge of relaxed skin between the jaws."""

BULGE_EXPONENT: Final = 4.0
"""The bulge falls as e^(-4 (r - 1)) with the skin's stretch r."""

BULGE_WIDTH_MM: Final = 8.0
"""Half width of the bulge across the jaws' axis."""

FOLD_MM: Final = 0.4
"""Height of the fold of buckled skin."""

FOLD_WIDTH: Final = 0.35
"""Half width of the fold over the aperture."""

SHADOW_MARGIN_PX: Final = 40
"""Pixels around the image whose relief casts shadows into it."""


class Relief(Protocol):
    """Interface of skin in one state, see `rigsim.skin_patch.stretch.StretchedSkin`."""

    def sample(self, x_mm: ArrayLike, y_mm: ArrayLike) -> SurfaceSample:
        """Return the relief at points of the skin's frame."""


@dataclass(frozen=True, slots=True, eq=False)
class PatchSurface:
    """Surface at the camera's samples."""

    x_mm: Float32Array
    """Position of each sample's surface point, mm, rig frame, shape (H, W)."""
    y_mm: Float32Array
    """The same, y up."""
    relief_um: Float32Array
    """Height of the relief, um."""
    bulge_um: Float32Array
    """Height of bulge and fold below it, um; 0 in the patch's center without a fold."""
    normals: Float32Array
    """Unit normals of both, rig frame, shape (H, W, 3)."""
    albedo: Float32Array
    """Diffuse reflectance."""
    alpha: Float32Array
    """GGX roughness."""
    skin: BoolArray
    """Skin, excluding jaws and points beyond the known patch."""

    @property
    def height_mm(self) -> Float32Array:
        """Height above the plane in focus, mm."""
        return np.asarray((self.relief_um + self.bulge_um) * np.float32(1e-3))

    def crop(self, margin: int) -> PatchSurface:
        """Return the patch without ``margin`` samples on all sides."""
        part = slice(margin, -margin or None)
        cut = (
            np.ascontiguousarray(getattr(self, field.name)[part, part])
            for field in dataclasses.fields(self)
        )
        return PatchSurface(*cut)


Grid = tuple[Float64Array, Float64Array]


def sample_grid(view: View, *, subpixels: int, border_px: int) -> Grid:
    """Return x (W s,) and y (H s,) of the camera's samples in the plane z = 0, mm."""
    pitch = view.distance_mm / view.focal_px
    places = []
    for count in (view.width_px, view.height_px):
        n = (count + 2 * border_px) * subpixels
        places.append((np.arange(n) - 0.5 * (n - 1)) / subpixels * pitch)
    return places[0], -places[1]


def sample_patch(
    relief: Relief, grip: GripState, pose: PatchPose, grid: Grid, *, eye_mm: float, alpha: float
) -> PatchSurface:
    """Return the surface at the camera's samples.

    Parameters
    ----------
    relief
        The skin in this state, in its own frame.
    grip
        The caliper, which moves with the skin.
    pose
        Pose of the skin.
    grid
        x and y of the samples, from `sample_grid`.
    eye_mm
        Distance of the camera, mm.
    alpha
        Roughness where the relief defines none.
    """
    ideal_x, ideal_y = np.meshgrid(*grid)
    cosine, sine = math.cos(pose.rotation_rad), math.sin(pose.rotation_rad)
    x, y = ideal_x, ideal_y
    # A camera ray meets height h at lateral offset h tan(view angle). Slope times tan(view angle)
    # contracts the fixed-point iteration for the surface point 30-fold, so that one step suffices.
    for last in (False, True):
        own_x = cosine * (x - pose.x_mm) + sine * (y - pose.y_mm)
        own_y = cosine * (y - pose.y_mm) - sine * (x - pose.x_mm)
        found = relief.sample(own_x, own_y)
        bulge_mm, bulge_x, bulge_y = bulge_height_and_slopes(grip, own_x, own_y)
        if not last:
            nearer = 1.0 - (1e-3 * found.height_um + bulge_mm) / eye_mm
            x, y = ideal_x * nearer, ideal_y * nearer
    slope_u, slope_v = found.slope_x + bulge_x, found.slope_y + bulge_y
    slope_x, slope_y = cosine * slope_u - sine * slope_v, sine * slope_u + cosine * slope_v
    normals = np.empty((*x.shape, 3), np.float32)
    length = np.sqrt(1.0 + slope_x**2 + slope_y**2)
    normals[..., 0], normals[..., 1] = -slope_x / length, -slope_y / length
    normals[..., 2] = 1.0 / length
    angle = math.radians(grip.angle_deg)
    along = math.cos(angle) * own_x + math.sin(angle) * own_y
    skin = np.asarray(found.inside, bool) & (np.abs(along) < 0.5 * grip.aperture_mm)
    normals[~skin] = (0.0, 0.0, 1.0)
    return PatchSurface(
        x.astype(np.float32),
        y.astype(np.float32),
        np.where(skin, found.height_um, 0.0).astype(np.float32),
        np.where(skin, 1e3 * bulge_mm, 0.0).astype(np.float32),
        normals,
        np.where(skin, found.albedo, JAW_REFLECTANCE).astype(np.float32),
        np.where(skin, found.alpha, alpha).astype(np.float32),
        skin,
    )


def bulge_height_and_slopes(
    grip: GripState, x_mm: Float64Array, y_mm: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the skin's height above its plane in mm, and its slopes in x and y.

    Skin between jaws bulges, the more the less it is stretched; buckled skin also has a fold off
    the center. The camera is focused on the center of the patch.
    """
    angle = math.radians(grip.angle_deg)
    cosine, sine = math.cos(angle), math.sin(angle)
    along, across = cosine * x_mm + sine * y_mm, cosine * y_mm - sine * x_mm
    height = np.zeros(np.shape(along))
    d_along, d_across = np.zeros_like(height), np.zeros_like(height)
    if grip.attached:
        half = 0.5 * grip.aperture_mm
        size = BULGE_MM * math.exp(-BULGE_EXPONENT * (grip.stretch - 1.0))
        a, da = _cosine_bump(along, half)
        b, db = _cosine_bump(across, BULGE_WIDTH_MM)
        height += size * (a * b - 1.0)
        d_along += size * da * b
        d_across += size * a * db
        if grip.buckled:
            a, da = _cosine_bump(along - 0.2 * half, FOLD_WIDTH * grip.aperture_mm)
            height += FOLD_MM * a * b
            d_along += FOLD_MM * da * b
            d_across += FOLD_MM * a * db
    return height, cosine * d_along - sine * d_across, sine * d_along + cosine * d_across


def _cosine_bump(x: Float64Array, half: float) -> tuple[Float64Array, Float64Array]:
    """Return cos^2 that ends at plus and minus ``half``, and its derivative."""
    phase = np.clip(0.5 * np.pi * x / half, -0.5 * np.pi, 0.5 * np.pi)
    return np.cos(phase) ** 2, -0.5 * np.pi / half * np.sin(2.0 * phase)
