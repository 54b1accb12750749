"""Render the light on a patch of skin by a Mitsuba scene: relief, skin, LEDs and camera."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.ndimage import maximum_filter

from capture.rig import View
from rigsim import shading
from rigsim.arrays import BoolArray, Float32Array, Int32Array
from rigsim.as_built.sphere import REFERENCE_DISTANCE_MM, ActualSphere
from rigsim.geometry.mesh import grid_faces
from rigsim.light.led_light import lobe_exponent
from rigsim.light.lobe_moments import MicrofacetSurface
from rigsim.light.relief_shadow import horizon_tangent
from rigsim.light.skin_material import describe_texture
from rigsim.mitsuba.led_array import led_table
from rigsim.mitsuba.rig_camera import describe_camera
from rigsim.mitsuba.scene_radiance import load_description
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import VariantChoice
from rigsim.scenes.gradient.patch import PatchSurface
from rigsim.tissue.skin_layers import ETA

RAY_OFFSET_MM: Final = 1e-4
"""Start of shadow rays above the relief: 1 % of a sample's pitch, 800 float32 steps at 1 mm."""

HORIZON_SLACK_RAD: Final = 0.03
"""Elevation below which a horizon near an LED counts as able to hide it."""

HORIZON_SECTORS: Final = 16
"""Number of directions with horizons that choose the shadow rays."""

HORIZON_WINDOW: Final = 5
"""Samples around one whose highest horizon counts."""

CORNER_OFFSET: Final = 0.001
"""Shift of the camera to the right and down, in samples: about 1 % of rays that aim at a corner of
six triangles miss all of them."""


@dataclass(frozen=True, slots=True, eq=False)
class ReliefGrid:
    """Triangles between the samples of a patch, as `rigsim.geometry.mesh.Mesh` of any size."""

    vertices_mm: Float32Array
    """Positions, mm, rig frame, shape (V, 3)."""
    faces: Int32Array
    """Vertex indices, shape (F, 3)."""
    uv: Float32Array
    """Centers of the texels of a texture with the samples' shape, (V, 2); v runs up."""
    normals: Float32Array
    """Unit normals of the relief, shape (V, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class TracedLight:
    """Light of the LEDs on a patch, by hits and shadow rays in a Mitsuba scene."""

    sphere: ActualSphere
    surface: MicrofacetSurface
    leds: tuple[int, ...]
    """Lit LEDs; with shadows only those above the patch's plane."""
    shadows: bool
    """Whether the relief casts shadows."""
    view: View
    """The camera."""
    choice: VariantChoice
    """A vectorized variant."""

    def packed(self, wide: PatchSurface, *, margin: int, pitch_um: float) -> Float32Array:
        """Return Stokes vectors and entering light of the four moments, shape (16, H, W).

        Parameters
        ----------
        wide
            The surface, with ``margin`` more samples on all sides, which cast shadows.
        margin
            Number of those samples.
        pitch_um
            Sample pitch, um.
        """
        rows, columns = (n - 2 * margin for n in wide.skin.shape)
        lit = [k for k in self.leds if self.sphere.intensity[k] > 0.0]
        if not lit:
            return np.zeros((16, rows, columns), np.float32)
        mi = load_mitsuba(self.choice)
        scene = load_description(mi, describe_relief(wide, self.led_rows(lit)))
        camera = load_description(mi, self.camera((rows, columns), pitch_um))
        integrator = load_description(
            mi,
            {
                "type": "ledmoments",
                "table": self.sphere.weights[lit],
                "shadows": self.shadows,
                "offset_mm": RAY_OFFSET_MM,
                "subpixels": 1,
            },
        )
        hidable = self._hidable(wide, lit, margin, pitch_um) if self.shadows else None
        image = integrator.image(scene, camera, hidable)
        return np.ascontiguousarray(np.moveaxis(image, -1, 0))

    def _hidable(
        self, wide: PatchSurface, lit: Sequence[int], margin: int, pitch_um: float
    ) -> Callable[[int], BoolArray]:
        """Return a function of an index into ``lit``: samples at which the relief may hide its LED.

        There the horizon is as high as the LED. The slack of its elevation is that of the LED's
        disc, of positions in the field and of the triangles between samples.
        """
        height_um = wide.relief_um + wide.bulge_um
        inner = slice(margin, -margin or None)
        tangents = []
        for k in range(HORIZON_SECTORS):
            azimuth = 2.0 * math.pi * k / HORIZON_SECTORS
            tangent = horizon_tangent(height_um, pixel_um=pitch_um, azimuth_rad=azimuth)
            tangents.append(maximum_filter(tangent, size=HORIZON_WINDOW)[inner, inner])
        field_mm = float(np.hypot(wide.x_mm, wide.y_mm).max())

        def is_hidable(k: int) -> BoolArray:
            led = lit[k]
            place = self.sphere.position_mm[led]
            distance_mm = float(np.linalg.norm(place))
            reach_mm = field_mm + float(self.sphere.radius_mm[led])
            lowest = math.asin(place[2] / distance_mm) - reach_mm / distance_mm - HORIZON_SLACK_RAD
            turn = math.atan2(place[1], place[0]) / (2.0 * math.pi) * HORIZON_SECTORS
            sector = math.floor(turn) % HORIZON_SECTORS
            near = np.maximum(tangents[sector], tangents[(sector + 1) % HORIZON_SECTORS])
            return np.asarray(near > math.tan(lowest))

        return is_hidable

    def led_rows(self, lit: Sequence[int]) -> Float32Array:
        """Return the rows of some LEDs for `rigsim.mitsuba.led_array`, shape (N, 16)."""
        place = self.sphere.position_mm[lit]
        power = self.sphere.intensity[lit, None] * REFERENCE_DISTANCE_MM**2
        return led_table(
            place,
            -place / np.linalg.norm(place, axis=1, keepdims=True),
            intensity=np.repeat(power, 3, axis=1),
            exponent=[lobe_exponent(self.sphere.nominal.lights[k]) for k in lit],
            radius_mm=self.sphere.radius_mm[lit],
            absorbs=self.sphere.absorbs[lit],
            leak=1.0 / self.surface.extinction,
        )

    def camera(self, shape: tuple[int, int], pitch_um: float) -> dict[str, Any]:
        """Return the description of the camera with a pixel for each sample of a patch.

        Parameters
        ----------
        shape
            Rows and columns of samples.
        pitch_um
            Sample pitch, um.
        """
        described = describe_camera(self.view)
        right, up, _ = (np.array(axis, np.float64) for axis in self.view.axes)
        pose = np.array(described["to_world"])
        pose[:3, 3] += CORNER_OFFSET * 1e-3 * pitch_um * (right - up)
        film = described["film"] | {"height": shape[0], "width": shape[1]}
        focal_px = 1e3 * self.view.distance_mm / pitch_um
        return described | {"to_world": pose, "focal_px": focal_px, "film": film}


def relief_grid(patch: PatchSurface) -> ReliefGrid:
    """Return the triangles between a patch's samples.

    Their corners are the samples themselves, so that each camera ray meets the exact normal.
    """
    rows, columns = patch.skin.shape
    vertices = np.stack([patch.x_mm, patch.y_mm, patch.height_mm], axis=-1)
    v, u = np.mgrid[0:rows, 0:columns]
    uv = np.stack([(u + 0.5) / columns, 1.0 - (v + 0.5) / rows], axis=-1)
    return ReliefGrid(
        vertices.reshape(-1, 3).astype(np.float32),
        grid_faces(rows, columns).astype(np.int32),
        uv.reshape(-1, 2).astype(np.float32),
        np.ascontiguousarray(patch.normals.reshape(-1, 3), np.float32),
    )


def describe_relief(patch: PatchSurface, leds: Float32Array) -> dict[str, Any]:
    """Return the description of a patch between the caliper's jaws, under LEDs.

    The jaws are matt.

    Parameters
    ----------
    patch
        The surface, with the relief that casts shadows.
    leds
        Rows of `rigsim.mitsuba.led_array.led_table`.
    """
    albedo = np.float32(shading.interior_scale(ETA)) * patch.albedo
    return {
        "type": "scene",
        "embree_use_robust_intersections": True,
        "patch": {
            "type": "mesh",
            "mesh": relief_grid(patch),
            "bsdf": {
                "type": "skincoat",
                "distribution": "ggx",
                "int_ior": ETA,
                "r_d": describe_texture(np.repeat(albedo[..., None], 3, axis=-1)),
                "alpha": describe_texture(patch.alpha),
                "bare": describe_texture(patch.skin.astype(np.float32)),
            },
        },
        "leds": {"type": "ledarray", "table": leds},
    }
