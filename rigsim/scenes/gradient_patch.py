"""A patch of skin between the caliper's jaws, as the gradient rig's camera sees it in one state.

For one state the whole picture is made once, as Stokes vectors for each of the four moments of the
light (see `rigsim.lobe_moments`); patterns and analysers are sums of these.

Frame: mm, origin at the middle of the patch. The camera's samples are points of the plane z = 0;
where the skin is higher, what is seen there stands a little nearer the axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray

from capture.rig import View
from rigsim import shading
from rigsim.lobe_moments import MomentTable, Surface, direct_moments, led_moments
from rigsim.mesh import Float32Array
from rigsim.patch_motion import Pose
from rigsim.self_shadow import hidden_part, horizon_tangent
from rigsim.skin_layers import ETA
from rigsim.sphere_build import BuiltSphere

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]

JAW_REFLECTANCE: Final = 0.03
"""Of the jaws' matt black."""

BULGE_MM: Final = 0.1
"""How far relaxed skin bulges between the jaws."""

BULGE_EXPONENT: Final = 4.0
"""The bulge falls as e^(-4 (r - 1)) with the skin's stretch r."""

BULGE_WIDTH_MM: Final = 8.0
"""Half width of the bulge across the jaws' axis."""

FOLD_MM: Final = 0.4
"""Height of the fold of buckled skin."""

FOLD_WIDTH: Final = 0.35
"""Half width of the fold over the aperture."""

SHADOW_MARGIN_PX: Final = 40
"""Pixels around the picture whose relief casts shadows into it."""

BLOCK_ROWS: Final = 128
"""Rows that are looked up at once, which bounds memory."""


class Grip(Protocol):
    """What the caliper holds, see `rigsim.taped_skin.GripState`."""

    @property
    def angle_deg(self) -> float:
        """Direction of the jaws' axis, from +x towards +y."""

    @property
    def step(self) -> int:
        """Step of the caliper."""

    @property
    def aperture_mm(self) -> float:
        """Distance of the jaws."""

    @property
    def stretch(self) -> float:
        """The skin's own stretch along the axis."""

    @property
    def attached(self) -> bool:
        """Whether the tape holds."""

    @property
    def buckled(self) -> bool:
        """Whether the skin has left its plane."""


class Sampled(Protocol):
    """A relief at points, see `rigsim.skin_stretch.SurfaceSample`."""

    @property
    def height_um(self) -> NDArray[np.floating]:
        """Height, um."""

    @property
    def slope_x(self) -> NDArray[np.floating]:
        """Slope dh/dx, dimensionless."""

    @property
    def slope_y(self) -> NDArray[np.floating]:
        """Slope dh/dy, y up."""

    @property
    def albedo(self) -> NDArray[np.floating]:
        """Diffuse reflectance."""

    @property
    def inside(self) -> BoolArray:
        """Whether there is skin."""


class Relief(Protocol):
    """Skin in one state, see `rigsim.skin_stretch.StretchedSkin`."""

    def sample(self, x_mm: ArrayLike, y_mm: ArrayLike) -> Sampled:
        """Return the relief at points of the skin's frame."""


@dataclass(frozen=True, slots=True, eq=False)
class PatchSurface:
    """What stands at the camera's samples."""

    x_mm: Float32Array
    """Place of each sample's point of the surface, mm, rig frame, shape (H, W)."""
    y_mm: Float32Array
    """The same, y up."""
    relief_um: Float32Array
    """Height of the relief, um."""
    bulge_um: Float32Array
    """Height of what bulges or folds below it, um; 0 in the patch's middle without a fold."""
    normals: Float32Array
    """Unit normals of both, rig frame, shape (H, W, 3)."""
    albedo: Float32Array
    """Diffuse reflectance."""
    alpha: Float32Array
    """GGX roughness."""
    skin: BoolArray
    """Skin, neither jaw nor beyond what is known."""

    @property
    def height_mm(self) -> Float32Array:
        """Height above the plane in focus, mm."""
        return np.asarray((self.relief_um + self.bulge_um) * np.float32(1e-3))


def sample_grid(view: View, *, subpixels: int, border_px: int) -> tuple[FloatArray, FloatArray]:
    """Return x (W s,) and y (H s,) of the camera's samples in the plane z = 0, mm."""
    pitch = view.distance_mm / view.focal_px
    places = []
    for count in (view.width_px, view.height_px):
        n = (count + 2 * border_px) * subpixels
        places.append((np.arange(n) - 0.5 * (n - 1)) / subpixels * pitch)
    return places[0], -places[1]


def stand(
    relief: Relief, grip: Grip, pose: Pose, x_mm: FloatArray, y_mm: FloatArray, *,
    eye_mm: float, alpha: float,
) -> PatchSurface:  # fmt: skip
    """Return what the camera's samples meet.

    Parameters
    ----------
    relief
        The skin in this state, in its own frame.
    grip
        The caliper, which moves with the skin.
    pose
        Where the skin lies.
    x_mm, y_mm
        The samples, as `sample_grid` gives them.
    eye_mm
        Distance of the camera, mm.
    alpha
        Roughness where the relief states none.
    """
    ideal_x, ideal_y = np.meshgrid(x_mm, y_mm)
    cosine, sine = math.cos(pose.turn_rad), math.sin(pose.turn_rad)
    x, y = ideal_x, ideal_y
    # tilts and view angles shrink the step to the surface's point 30-fold: once is enough
    for last in (False, True):
        own_x = cosine * (x - pose.x_mm) + sine * (y - pose.y_mm)
        own_y = cosine * (y - pose.y_mm) - sine * (x - pose.x_mm)
        found = relief.sample(own_x, own_y)
        bulge_mm, bulge_x, bulge_y = bulge(grip, own_x, own_y)
        if not last:
            nearer = 1.0 - (1e-3 * found.height_um + bulge_mm) / eye_mm
            x, y = ideal_x * nearer, ideal_y * nearer
    slope_u, slope_v = found.slope_x + bulge_x, found.slope_y + bulge_y
    slope_x, slope_y = cosine * slope_u - sine * slope_v, sine * slope_u + cosine * slope_v
    normals = np.empty((*x.shape, 3), np.float32)
    length = np.sqrt(1.0 + slope_x**2 + slope_y**2)
    normals[..., 0], normals[..., 1], normals[..., 2] = (
        -slope_x / length,
        -slope_y / length,
        (1.0 / length),
    )
    angle = math.radians(grip.angle_deg)
    along = math.cos(angle) * own_x + math.sin(angle) * own_y
    skin = np.asarray(found.inside, bool) & (np.abs(along) < 0.5 * grip.aperture_mm)
    normals[~skin] = (0.0, 0.0, 1.0)
    rough = getattr(found, "alpha", None)
    return PatchSurface(
        x.astype(np.float32),
        y.astype(np.float32),
        np.where(skin, found.height_um, 0.0).astype(np.float32),
        np.where(skin, 1e3 * bulge_mm, 0.0).astype(np.float32),
        normals,
        np.where(skin, found.albedo, JAW_REFLECTANCE).astype(np.float32),
        np.full(x.shape, alpha, np.float32)
        if rough is None
        else np.where(skin, rough, alpha).astype(np.float32),
        skin,
    )


def bulge(
    grip: Grip, x_mm: FloatArray, y_mm: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how far skin stands out of its plane in mm, and its slopes in x and y.

    Skin between jaws bulges, the more the less it is stretched; buckled skin has a fold besides,
    beside the middle. The camera is focused on the middle of the patch.
    """
    angle = math.radians(grip.angle_deg)
    cosine, sine = math.cos(angle), math.sin(angle)
    along, across = cosine * x_mm + sine * y_mm, cosine * y_mm - sine * x_mm
    height = np.zeros(np.shape(along))
    d_along, d_across = np.zeros_like(height), np.zeros_like(height)
    if grip.attached:
        half = 0.5 * grip.aperture_mm
        size = BULGE_MM * math.exp(-BULGE_EXPONENT * (grip.stretch - 1.0))
        a, da = _hump(along, half)
        b, db = _hump(across, BULGE_WIDTH_MM)
        height += size * (a * b - 1.0)
        d_along += size * da * b
        d_across += size * a * db
        if grip.buckled:
            a, da = _hump(along - 0.2 * half, FOLD_WIDTH * grip.aperture_mm)
            height += FOLD_MM * a * b
            d_along += FOLD_MM * da * b
            d_across += FOLD_MM * a * db
    return height, cosine * d_along - sine * d_across, sine * d_along + cosine * d_across


def _hump(x: FloatArray, half: float) -> tuple[FloatArray, FloatArray]:
    """Return cos^2 that ends at plus and minus ``half``, and its derivative."""
    phase = np.clip(0.5 * np.pi * x / half, -0.5 * np.pi, 0.5 * np.pi)
    return np.cos(phase) ** 2, -0.5 * np.pi / half * np.sin(2.0 * phase)


@dataclass(frozen=True, slots=True, eq=False)
class Lighting:
    """Everything about the light that does not change with the state."""

    sphere: BuiltSphere
    surface: Surface
    table: MomentTable
    leds: tuple[int, ...]
    """LEDs in the table; with shadows only those above the patch's plane."""
    sectors: int
    """Directions whose horizons are found; between them they are interpolated. 0: no shadows."""
    sigmas_mm: FloatArray
    """Widths of the lateral kernel of light in skin; none: light leaves where it entered."""
    weights: FloatArray
    """Their shares, sum 1."""

    def stokes(
        self, patch: PatchSurface, height_um: Float32Array, *, margin: int, pitch_um: float
    ) -> Float32Array:
        """Return the picture of a patch, before the lens.

        Parameters
        ----------
        patch
            The surface.
        height_um
            Heights with ``margin`` more samples on all sides, which cast shadows.
        margin
            See there.
        pitch_um
            Distance of samples, um.

        Returns
        -------
        ndarray of float32
            Shape (12, H, W): Stokes vector of each moment, radiance.
        """
        rows, columns = patch.skin.shape
        packed = np.empty((16, rows, columns), np.float32)
        for first in range(0, rows, BLOCK_ROWS):
            part = slice(first, first + BLOCK_ROWS)
            found = self._unshadowed(patch, part)
            packed[:, part] = found.T.reshape(16, -1, columns)
        if self.sectors:
            self._remove_hidden(patch, height_um, margin, pitch_um, packed)
        packed[:12, ~patch.skin] = 0.0
        entering = self._spread(packed[12:], patch.skin, 1e-3 * pitch_um)
        right = self.surface.image_right
        eye = np.asarray(self.surface.eye_mm, np.float32)
        scale = np.float32(shading.interior_scale(ETA) / math.pi)
        out = packed[:12]
        for first in range(0, rows, BLOCK_ROWS):
            part = slice(first, first + BLOCK_ROWS)
            n = patch.normals[part].reshape(-1, 3)
            to_camera = eye - np.stack(
                [patch.x_mm[part], patch.y_mm[part], np.zeros_like(patch.x_mm[part])], axis=-1
            ).reshape(-1, 3)
            to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
            leaves = shading.exit_stokes(n, to_camera, eta=ETA, image_right=right)
            leaves = leaves.T.reshape(3, -1, columns) * (scale * patch.albedo[part])
            for m in range(4):
                out[3 * m : 3 * m + 3, part] += leaves * entering[m, part]
        return out

    def _unshadowed(self, patch: PatchSurface, part: slice) -> Float32Array:
        n = patch.normals[part].reshape(-1, 3)
        x, y = patch.x_mm[part].ravel(), patch.y_mm[part].ravel()
        alpha = patch.alpha[part].ravel()
        found = self.table.lookup(n, x, y, alpha)
        steep = np.flatnonzero(~self.table.covers(n))
        if steep.size:
            places = np.column_stack([x[steep], y[steep], np.zeros(steep.size)])
            found[steep] = direct_moments(
                n[steep], places, self.sphere, self.surface, leds=self.leds, alpha=alpha[steep]
            ).packed()
        return found

    def _remove_hidden(
        self,
        patch: PatchSurface,
        height_um: Float32Array,
        margin: int,
        pitch_um: float,
        packed: Float32Array,
    ) -> None:
        """Take away, LED by LED, what stands behind the relief."""
        direction = self.sphere.position_mm / np.linalg.norm(
            self.sphere.position_mm, axis=1, keepdims=True
        )
        azimuth = np.arctan2(direction[:, 1], direction[:, 0]) % (2.0 * np.pi)
        place = azimuth / (2.0 * np.pi) * self.sectors
        inner = slice(margin, -margin or None)
        tangents: dict[int, Float32Array] = {}
        weights = self.sphere.weights.astype(np.float32)
        flat = packed.reshape(16, -1)
        normals = patch.normals.reshape(-1, 3)
        x, y, alpha = patch.x_mm.ravel(), patch.y_mm.ravel(), patch.alpha.ravel()
        for led in sorted(self.leds, key=lambda k: float(place[k])):
            sector = int(place[led])
            wanted = (sector, (sector + 1) % self.sectors)
            tangents = {k: t for k, t in tangents.items() if k in wanted}
            for k in wanted:
                if k not in tangents:
                    angle = 2.0 * math.pi * k / self.sectors
                    full = horizon_tangent(height_um, pixel_um=pitch_um, azimuth_rad=angle)
                    tangents[k] = np.ascontiguousarray(full[inner, inner])
            elevation = math.asin(float(direction[led, 2]))
            radius = float(self.sphere.radius_mm[led] / np.linalg.norm(
                self.sphere.position_mm[led]))  # fmt: skip
            t = np.float32(place[led] - sector)
            tangent = (1 - t) * tangents[wanted[0]] + t * tangents[wanted[1]]
            facing = normals @ direction[led].astype(np.float32) > 0.0
            low = math.tan(max(elevation - radius, 0.0))
            at = np.flatnonzero(facing & (tangent.ravel() > low) & patch.skin.ravel())
            if not at.size:
                continue
            share = hidden_part(tangent.ravel()[at], elevation_rad=elevation, radius_rad=radius)
            places = np.column_stack([x[at], y[at], np.zeros(at.size)])
            stokes, entry = led_moments(
                normals[at], places, self.sphere, led, self.surface, alpha=alpha[at]
            )
            for m in range(4):
                weight = weights[led, m] * share
                for c in range(3):
                    flat[3 * m + c, at] -= weight * stokes[:, c]
                flat[12 + m, at] -= weight * entry

    def _spread(self, entering: Float32Array, skin: BoolArray, pitch_mm: float) -> Float32Array:
        """Spread light inside the skin; beyond the picture it goes on mirrored."""
        if not self.sigmas_mm.size:
            return entering
        rows, columns = skin.shape
        fy = np.arange(rows) / (2.0 * rows * pitch_mm)
        fx = np.arange(columns) / (2.0 * columns * pitch_mm)
        square = (2.0 * np.pi**2 * (fy[:, None] ** 2 + fx[None, :] ** 2)).astype(np.float32)
        kernel = np.zeros_like(square)
        for sigma, weight in zip(self.sigmas_mm, self.weights, strict=True):
            kernel += np.float32(weight) * np.exp(-np.float32(sigma**2) * square)
        out = np.empty_like(entering)
        for m in range(4):
            # under the jaws no light enters, but what spreads there is lost
            field = np.where(skin, entering[m], 0.0)
            spectrum = scipy.fft.dctn(field, type=2, workers=2)
            spectrum *= kernel
            out[m] = scipy.fft.idctn(spectrum, type=2, workers=2)
            out[m][~skin] = entering[m][~skin]
        return out
