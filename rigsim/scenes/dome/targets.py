"""Render calibration targets in the dome: a ChArUco board, mirror balls, a white plate.

An operator moves the target through several poses, which `TargetScene.set_pose` selects. Poses are
drawn near those of `TARGET_POSES`, since a board cannot be held to a tenth of a millimeter. Only
the first pose is exact: a jig holds the board at the rig's origin, facing +z, and so defines the
rig frame.
"""

import math
from collections.abc import Sequence
from typing import Any, Final, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from capture.rig import Rig, View
from rigsim.arrays import Float32Array, Float64Array, Int64Array, UInt16Array
from rigsim.as_built.dome import ActualDome, build_dome, pixel_corner_rays, project_points
from rigsim.boxes.led_table import LedPulse
from rigsim.caching import LruCache, cached_method
from rigsim.light.led_light import lobe_exponent, white_intensity
from rigsim.needs.effects import Effect, EffectSelection, PixelNoise, decide_effect, omitted_effects
from rigsim.package_data import package_table
from rigsim.scenes.dome.scene import LED_POWER_DEVIATION
from rigsim.scenes.exposing import RigScene, SceneError, full_power_duration_s
from rigsim.sensor import color_filters, expose_sensor, make_sensor
from rigsim.targets import mirror_ball, printed_plate

Kind: TypeAlias = Literal["charuco", "mirror", "white"]

BALL_RADIUS_MM: Final = 50.0
WHITE_SLOPE_DEG: Final = 0.05
"""RMS slope of the white plate's surface in each direction, degrees."""
MAX_LED_DISC_VARIATION: Final = 2e-4
"""Largest relative difference between the light of an LED's disc and that of its center."""

_TargetPose: TypeAlias = tuple[float, float, float, float, float, float]
BOARD_POSES: Final[tuple[_TargetPose, ...]] = package_table("dome_targets")["board_places"]
"""Azimuth and elevation of the front's normal, rotation in its plane (degrees), center (mm)."""

PLATE_POSES: Final[tuple[_TargetPose, ...]] = package_table("dome_targets")["plate_places"]
"""Poses of the white plate, likewise; the first three face most lights."""

BALL_POSITIONS: Final[tuple[tuple[float, float, float], ...]] = package_table("dome_targets")[
    "ball_places"
]
"""Center of the ball, mm."""

TARGET_POSES: Final[dict[str, int]] = {
    "charuco": len(BOARD_POSES),
    "mirror": len(BALL_POSITIONS),
    "white": len(PLATE_POSES),
}
"""Number of poses of each target."""

PLACEMENT_DEVIATION_MM: Final = 3.0
PLACEMENT_DEVIATION_DEG: Final = 2.0
"""Standard deviations of the operator's placement of a target."""


class TargetScene(RigScene):
    """A calibration target in the center of an actual dome.

    Parameters
    ----------
    kind
        "charuco", "mirror" or "white".
    dome
        The actual dome.
    seed
        Seeds the operator's placement, the plate's waves and the noise.
    slope_deg
        RMS slope of the white plate's surface, degrees.
    """

    def __init__(
        self, kind: Kind, dome: ActualDome, *, seed: int, slope_deg: float = WHITE_SLOPE_DEG
    ) -> None:
        if kind not in get_args(Kind):
            raise SceneError(f"target: got {kind!r}, expected one of {', '.join(get_args(Kind))}")
        self.kind = kind
        self.dome = dome
        self.rig = dome.rig
        self.seed = seed
        self.pose = 0
        self._seen: LruCache[tuple[str, int], printed_plate.PlateImage] = LruCache(
            lambda _: len(self.rig.views)
        )
        rng = np.random.default_rng([seed, len(kind)])
        self._plate = (
            printed_plate.white_plate(slope_deg=slope_deg, rng=rng)
            if kind == "white"
            else printed_plate.charuco_board()
        )
        self._hand = rng.standard_normal((max(TARGET_POSES.values()), 6))
        self.needs = self._needs()
        lights = self.rig.lights
        self._lamp_mm = np.array([light.position_mm for light in lights])
        self._exponent = np.array([lobe_exponent(light) for light in lights])

    def _needs(self) -> EffectSelection:
        noise = PixelNoise.of(make_sensor(self.rig.views[0]))
        sizes = noise.change_over_noise(MAX_LED_DISC_VARIATION)
        mirror = self.kind == "mirror"
        effects = [
            Effect(
                "images of the LEDs in the target",
                "built" if mirror else "absent",
                "the ball reflects them" if mirror else "paper is matt",
            ),
            decide_effect(
                "extent of the LEDs in the light on plates",
                sizes,
                None,
                switch="",
                reason=f"{100 * MAX_LED_DISC_VARIATION:g} % of the light",
            ),
            *omitted_effects("dome_target"),
        ]
        return EffectSelection(tuple(effects))

    def set_pose(self, pose: int) -> None:
        """Move the target to its pose number ``pose``."""
        if not 0 <= pose < TARGET_POSES[self.kind]:
            raise SceneError(f"pose: got {pose}, expected 0 to {TARGET_POSES[self.kind] - 1}")
        self.pose = pose
        if self.stripes is not None:
            self.stripes.forget()

    def exposure(
        self, view_name: str, *, pops: Sequence[LedPulse], exposure_s: float, seed: int
    ) -> UInt16Array:
        """Simulate one exposure of a camera.

        Parameters
        ----------
        view_name
            Name of the camera.
        pops
            The pulses of the LEDs, clipped to the exposure; none yields a dark frame.
        exposure_s
            Exposure time, s.
        seed
            Seed of this exposure's noise.

        Returns
        -------
        ndarray of uint16
            Raw DN, shape (H, W).
        """
        if self.stripes is not None and view_name in self.stripes.view_names:
            return self.stripes.exposure(view_name, pops=pops, exposure_s=exposure_s, seed=seed)
        view = self._camera(view_name)
        rng = np.random.default_rng([self.seed, seed])
        on_s = np.zeros(len(self.rig.lights))
        for pulse in pops:
            energy = full_power_duration_s(pulse, f"LED {pulse.led}")
            light = self.dome.light_of_channel(pulse.led)
            if self.rig.lights[light].name not in self.dome.dead:
                on_s[light] += energy * (1.0 + LED_POWER_DEVIATION * rng.standard_normal())
        gray, color = self._lit(view, on_s)
        signal = color_filters(gray, color, view.cfa)
        return expose_sensor(signal, sensor=make_sensor(view), rng=rng, exposure_s=exposure_s)

    def light(self, view_name: str, on_s: Sequence[float] | Float64Array) -> Float32Array:
        """Return the light on a sensor without noise and vignetting, camera RGB, (H, W, 3).

        Parameters
        ----------
        view_name
            Name of the camera.
        on_s
            On-time of each light in s, times its level, shape (L,).
        """
        gray, color = self._lit(self._camera(view_name), np.asarray(on_s, np.float64))
        return np.asarray(gray[..., None] * color)

    def _lit(self, view: View, seconds: Float64Array) -> tuple[Float32Array, Float32Array]:
        """Return the light on a sensor by pixel, (H, W), and the factors of its channels, (3,)."""
        lit = np.nonzero(seconds > 0)[0]
        if not lit.size:
            return np.zeros((view.height_px, view.width_px), np.float32), np.ones(3, np.float32)
        rgb = np.array([white_intensity(self.rig.lights[i], view) for i in lit])
        color = rgb[0] / rgb[0].max()
        strength = seconds[lit] * rgb.max(axis=1) * self.dome.gain.get(view.name, 1.0)
        lamps = (self._lamp_mm[lit], self.dome.axis[lit], self._exponent[lit], strength)
        if self.kind == "mirror":
            gray = self._ball(view, lit, lamps)
        else:
            gray = self._seen_plate(view).render(*self.plate_pose(), lamps)
        return np.asarray(gray), color.astype(np.float32)

    def plate_pose(self, pose: int | None = None) -> tuple[Float64Array, Float64Array]:
        """Return a plate's pose: rotation to the rig frame, position of its top left corner, mm.

        The plate's axes are x right and y down as seen from its front, z into it.
        """
        number = self.pose if pose is None else pose
        places = BOARD_POSES if self.kind == "charuco" else PLATE_POSES
        values = np.array(places[number], np.float64)
        if number > 0 or self.kind == "white":
            hand = self._hand[number]
            values = values + hand * ([PLACEMENT_DEVIATION_DEG] * 3 + [PLACEMENT_DEVIATION_MM] * 3)
        azimuth, elevation, turn = np.radians(values[:3])
        front = _front_normal(azimuth, elevation)
        right = np.array([math.cos(azimuth), 0.0, -math.sin(azimuth)])
        down = -np.cross(front, right)
        x = math.cos(turn) * right + math.sin(turn) * down
        rotation = np.stack([x, np.cross(-front, x), -front], axis=1)
        width, height = self._plate.size_mm
        return rotation, values[3:] - rotation @ np.array([width / 2, height / 2, 0.0])

    def ball_center_mm(self, pose: int | None = None) -> Float64Array:
        """Return the center of the mirror ball."""
        number = self.pose if pose is None else pose
        return np.array(BALL_POSITIONS[number]) + PLACEMENT_DEVIATION_MM * self._hand[number, :3]

    def truth(self) -> dict[str, Any]:
        """Return the ground truth of calibration; lengths in mm, rig frame.

        Returns
        -------
        dict
            ``position_mm`` (L, 3), ``axis`` (L, 3), ``exponent`` (L,) of the lights in the order of
            the rig; ``intensity`` (L, 3) in the unit of `rigsim.light.led_light.white_intensity`, 0
            where dead; ``gain`` by view; ``draw_ball_center_mm`` (poses, 3) or ``plate_pose`` (a
            list of rotation and position).
        """
        view = self.rig.views[0]
        alive = np.array([light.name not in self.dome.dead for light in self.rig.lights])
        intensity = np.array([white_intensity(light, view) for light in self.rig.lights])
        out: dict[str, Any] = {
            "position_mm": self._lamp_mm.copy(),
            "axis": self.dome.axis.copy(),
            "exponent": self._exponent.copy(),
            "intensity": intensity * alive[:, None],
            "gain": dict(self.dome.gain),
        }
        places = range(TARGET_POSES[self.kind])
        if self.kind == "mirror":
            out["ball_mm"] = np.array([self.ball_center_mm(k) for k in places])
        else:
            out["plate_pose"] = [self.plate_pose(k) for k in places]
        return out

    def _seen_plate(self, view: View) -> printed_plate.PlateImage:
        """Return the plate's points in a camera's pixels, in its present pose."""
        rays, eye = self._corner_rays(view), np.array(view.position_mm)
        how = (rays, eye, *self.plate_pose(), self._plate, EDGE_SUBPIXELS)
        return self._seen.get((view.name, self.pose), lambda: printed_plate.trace_plate(*how))

    @cached_method
    def _corner_rays(self, view: View) -> Float64Array:
        return pixel_corner_rays(view, self.dome.distortion.get(view.name, np.zeros(5)))

    def _ball(
        self, view: View, lit: NDArray[np.intp], lamps: mirror_ball.LampArrays
    ) -> Float32Array:
        rays, eye = self._corner_rays(view), np.array(view.position_mm)
        place = self.ball_center_mm()
        ball = (place, BALL_RADIUS_MM, mirror_ball.CHROMIUM_REFLECTANCE)
        cloth = mirror_ball.cloth_radiance(lamps)
        image = mirror_ball.render_cloth(rays, eye, ball, cloth, EDGE_SUBPIXELS)
        for index, lamp, axis, exponent, strength in zip(lit, *lamps, strict=True):
            radius = self.rig.lights[index].radius_mm
            led = (lamp, axis, float(exponent), radius, float(strength))
            for reflected in (True, False):
                box = self._box(view, place, led, reflected)
                if box is not None:
                    how = (reflected, SPOT_SUBPIXELS)
                    mirror_ball.add_lamp(image, rays, box, eye, ball, led, *how)
        return np.asarray(image)

    def _box(
        self, view: View, ball: Float64Array, led: mirror_ball.LedArrays, reflected: bool
    ) -> Int64Array | None:
        """Return rows and columns that an LED can cover, or None outside the image."""
        lamp, axis, _, radius, _ = led
        eye = np.array(view.position_mm)
        if not reflected and (eye - lamp) @ axis <= 0.0:
            return None
        side = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        across = np.cross(axis, side)
        rim = [lamp + 1.3 * radius * v for v in (side, -side, across, -across)]
        if reflected:
            rim = [mirror_ball.reflection_point(eye, place, ball, BALL_RADIUS_MM) for place in rim]
        distortion = self.dome.distortion.get(view.name, np.zeros(5))
        px = project_points(view, distortion, np.array(rim))
        if not np.isfinite(px).all():
            return None
        low = np.floor(px.min(axis=0)) - 1
        high = np.ceil(px.max(axis=0)) + 2
        size = np.array([view.width_px, view.height_px])
        if (high <= 0).any() or (low >= size).any():
            return None
        low, high = np.clip(low, 0, size), np.clip(high, 0, size)
        return np.array([low[1], high[1], low[0], high[0]], np.int64)


EDGE_SUBPIXELS: Final = 8
"""Rays along each side of pixels at an edge."""
SPOT_SUBPIXELS: Final = 12
"""Rays along each side of pixels near an LED's image."""


def make_target_scene(
    kind: Kind, rig: Rig, *, seed: int, dome: ActualDome | None = None
) -> TargetScene:
    """Build a target in an actual dome from its nominal description.

    Parameters
    ----------
    kind
        "charuco", "mirror" or "white".
    rig
        The nominal dome.
    seed
        Seeds the actual dome (unless given) and the scene.
    dome
        The actual dome; None builds one with the usual tolerances.

    Returns
    -------
    TargetScene
    """
    return TargetScene(kind, dome or build_dome(rig, seed=seed), seed=seed)


def plate_normals() -> list[tuple[float, float, float]]:
    """Return the normals of the white plate's front in each pose, before the operator's error."""
    turns = np.radians([place[:2] for place in PLATE_POSES])
    return [tuple(_front_normal(azimuth, elevation).tolist()) for azimuth, elevation in turns]


def _front_normal(azimuth: float, elevation: float) -> Float64Array:
    """Return the front normal of a plate rotated by angles in rad."""
    x, z = math.sin(azimuth), math.cos(azimuth)
    return np.array([math.cos(elevation) * x, math.sin(elevation), math.cos(elevation) * z])
