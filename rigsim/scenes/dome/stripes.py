"""Render the scanner's stripes on a face or a board, as its cameras see them.

A camera's rays are traced once. Each point then has, per projector, its place on the display, the
shadow, the irradiance, and the reflection in two parts: light from inside the skin, whose stripes
are blurred by lateral scattering, and light from its surface, whose stripes are not.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from capture.rig import Projector, View
from capture.scanner import STRIPE_AXES
from model import spectra
from rigsim.arrays import BoolArray, Float32Array, Float64Array, Int64Array, UInt16Array
from rigsim.as_built.dome import project_points
from rigsim.as_built.scanner import ActualScanner, build_scanner
from rigsim.boxes.scanner import ProjectorLight
from rigsim.geometry.atlas import sample
from rigsim.light.led_light import DOME_METER_RATE_PER_S, METERING_LED
from rigsim.light.surface_brdf import evaluate_brdf
from rigsim.render import Caster
from rigsim.render.rays import camera_rays, trace
from rigsim.scanner.projection import (
    BlurredStripes,
    DisplayPlaces,
    defocus_blur_px,
    emitted_light,
    stripe_levels,
)
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.dome.targets import TargetScene
from rigsim.scenes.exposing import SceneError, full_power_duration_s
from rigsim.sensor import expose_sensor, make_sensor
from rigsim.targets.printed_plate import CELL_MM, Plate, charuco_board

SKIN_SCATTERING_MM: Final = 1.37
"""Mean length 1 / sigma_tr of lateral scattering in skin at green, mm: Jensen et al. 2001,
doi:10.1145/383259.383319, table of skin1."""
PAPER_SCATTERING_MM: Final = 0.1
"""The same of printed paper, mm; chosen, of the size of measured dot gain."""
AMBIENT_RATE_PER_S: Final = 0.5
"""Full scales per second of a white under the light of a dimmed room; chosen."""
PROJECTOR_POWER_DEVIATION: Final = 0.001
"""Relative standard deviation of a projector's light between frames; chosen, as of the LEDs."""
STRIPE_SUBPIXELS: Final = 2
PRINT_SAMPLES: Final = 4
"""Samples of the print along each side of a subpixel."""
SHADOW_OFFSET_MM: Final = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class StripedPoints:
    """Points of a surface behind the subpixels of a camera."""

    pixel: Int64Array
    """Pixel of each point, index into the flat image, shape (n,)."""
    position_mm: Float64Array
    """Shape (n, 3), rig frame."""
    normal: Float64Array
    """Unit shading normals, shape (n, 3)."""
    material: Float32Array
    """Parameters of the reflection, shape (n, ...)."""


class StripedSurface(Protocol):
    """A surface in front of the scanner."""

    scattering_mm: float

    def see(self, view: View, distortion: Float64Array) -> StripedPoints:
        """Return the points behind a camera's subpixels."""

    def is_blocked(self, start: Float64Array, way: Float64Array, length: Float64Array) -> BoolArray:
        """Return which points are in the shadow of the surface."""

    def reflect(
        self, points: StripedPoints, to_light: Float64Array, to_camera: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Return pi f_r of light from inside and from the surface, shape (n,) each."""


class StripedFace:
    """A face in front of the scanner.

    Parameters
    ----------
    caster
        Its mesh.
    texture
        Returns packed reflection and normals for a camera, shape (N, N, 10) or (N, N, 14).
    """

    scattering_mm = SKIN_SCATTERING_MM

    def __init__(self, caster: Caster, texture: Callable[[View], Float32Array]) -> None:
        self._caster, self._texture = caster, texture

    def see(self, view: View, distortion: Float64Array) -> StripedPoints:
        """Return the points behind a camera's subpixels."""
        origins, ways = camera_rays(view, subpixels=STRIPE_SUBPIXELS, distortion=distortion)
        at, uv, position, _, _ = trace(self._caster, origins, ways).hit_samples()
        layers = sample(self._texture(view), uv, np.ones(len(at), np.bool_))
        normal = layers[:, -3:].astype(np.float64)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
        pixel = _pixel_of(at, view)
        return StripedPoints(pixel, position.astype(np.float64), normal, layers[:, :-3])

    def is_blocked(self, start: Float64Array, way: Float64Array, length: Float64Array) -> BoolArray:
        """Return which points are in the shadow of the face."""
        return self._caster.is_blocked(start, way, 0.999 * length)

    def reflect(
        self, points: StripedPoints, to_light: Float64Array, to_camera: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Return pi f_r of light from inside and from the surface, mean of camera RGB."""
        total, outer = evaluate_brdf(points.material, points.normal, to_light, to_camera)
        inner = total.mean(axis=1, dtype=np.float64) - outer
        return math.pi * inner, math.pi * outer.astype(np.float64)


class StripedBoard:
    """A printed board in front of the scanner.

    Parameters
    ----------
    plate
        The board.
    pose
        Returns its present rotation to the rig frame, and the place of its top left corner, mm.
    """

    scattering_mm = PAPER_SCATTERING_MM

    def __init__(self, plate: Plate, pose: Callable[[], tuple[Float64Array, Float64Array]]) -> None:
        self._plate, self._pose = plate, pose

    def see(self, view: View, distortion: Float64Array) -> StripedPoints:
        """Return the points behind a camera's subpixels."""
        rotation, corner = self._pose()
        _, ways = camera_rays(view, subpixels=STRIPE_SUBPIXELS, distortion=distortion)
        eye = np.asarray(view.position_mm, np.float64)
        away = ways.reshape(-1, 3).astype(np.float64)
        depth = away @ rotation[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            length = (corner - eye) @ rotation[:, 2] / depth
        position = eye + length[:, None] * away
        cell = ((position - corner) @ rotation[:, :2]) / CELL_MM
        with np.errstate(invalid="ignore"):
            ahead = (depth > 1e-9) & (length > 0)
        paper = self._mean_reflectance(np.where(ahead[:, None], cell, -1e9), ways.shape[:2])
        at = np.flatnonzero(paper > 0.0)
        normal = np.broadcast_to(-rotation[:, 2], (len(at), 3)).astype(np.float64)
        return StripedPoints(_pixel_of(at, view), position[at], normal, paper[at])

    def _mean_reflectance(self, cell: Float64Array, size: tuple[int, int]) -> Float32Array:
        """Return the mean reflectance over each ray's part of a pixel, by its neighbors' places."""
        grid = cell.reshape(*size, 2)
        down, across = np.gradient(grid, axis=0), np.gradient(grid, axis=1)
        steps = (np.arange(PRINT_SAMPLES) + 0.5) / PRINT_SAMPLES - 0.5
        rows, columns = self._plate.reflectance.shape
        framed = np.pad(self._plate.reflectance, 1)  # nothing around the board
        total = np.zeros(size)
        for a in steps:
            for b in steps:
                place = np.floor(grid + a * down + b * across) + 1
                x = np.clip(place[..., 0], 0, columns + 1).astype(np.int64)
                y = np.clip(place[..., 1], 0, rows + 1).astype(np.int64)
                total += framed[y, x]
        return np.asarray(total.reshape(-1) / PRINT_SAMPLES**2, np.float32)

    def is_blocked(self, start: Float64Array, way: Float64Array, length: Float64Array) -> BoolArray:
        """Return that a plane shadows nothing."""
        return np.zeros(len(start), np.bool_)

    def reflect(
        self, points: StripedPoints, to_light: Float64Array, to_camera: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Return the reflectance of matt paper, without a surface term."""
        paper = points.material.astype(np.float64)
        return paper, np.zeros_like(paper)


@dataclass(frozen=True, slots=True, eq=False)
class _LitPoints:
    """Lit points of one camera under one projector."""

    pixel: Int64Array
    inner: Float64Array
    outer: Float64Array
    places: dict[str, DisplayPlaces]  # by axis


class StripeScene:
    """Exposures of the scanner's cameras.

    Parameters
    ----------
    scanner
        The actual scanner.
    surface
        What is in front of it; it may move between exposures, see `forget`.
    seed
        Seeds the variation between exposures.
    """

    def __init__(self, scanner: ActualScanner, surface: StripedSurface, *, seed: int) -> None:
        self.scanner, self.surface, self.seed = scanner, surface, seed
        self._seen: dict[str, StripedPoints] = {}
        self._lit: dict[tuple[str, str], _LitPoints] = {}
        self._rooms: dict[str, Float64Array] = {}
        self._tables: dict[tuple[str, str, int], BlurredStripes] = {}

    @property
    def view_names(self) -> frozenset[str]:
        """Names of the scanner's cameras."""
        return frozenset(self.scanner.views)

    def trace(self) -> None:
        """Trace all cameras' points now, so that no client of a served scanner waits for them."""
        for projector in self.scanner.nominal.projectors:
            for view_name in projector.cameras:
                self._ambient(view_name)
                self._lit_points(view_name, projector.name)

    def forget(self) -> None:
        """Trace the surface again, which has moved."""
        self._seen.clear()
        self._lit.clear()
        self._rooms.clear()

    def exposure(
        self, view_name: str, *, pops: Sequence[ProjectorLight], exposure_s: float, seed: int
    ) -> UInt16Array:
        """Return the raw DN, (H, W), of a camera under the projectors' light.

        Parameters
        ----------
        view_name
            Name of a camera of the scanner.
        pops
            Light of the projectors, clipped to the exposure; none yields ambient light alone.
        exposure_s, seed
            Exposure time in s, and seed of its noise.
        """
        if view_name not in self.scanner.views:
            raise SceneError(f"view: got {view_name!r}, expected a camera of the scanner")
        view = self.scanner.views[view_name]
        rng = np.random.default_rng([self.seed, seed])
        image = exposure_s * self._ambient(view_name)
        for light in pops:
            on_s = full_power_duration_s(light, f"projector {light.projector}")
            energy = on_s * (1.0 + PROJECTOR_POWER_DEVIATION * rng.standard_normal())
            image = image + energy * self.radiance(view_name, light)
        sensor = make_sensor(view)
        return expose_sensor(
            image.astype(np.float32), sensor=sensor, rng=rng, exposure_s=exposure_s
        )

    def radiance(self, view_name: str, light: ProjectorLight) -> Float64Array:
        """Return the light of one pattern on a camera, full scales per second, shape (H, W)."""
        view = self.scanner.views[view_name]
        lit = self._lit_points(view_name, light.projector)
        if light.axis:
            stripes, places = self._stripes(light), lit.places[light.axis]
            signal = lit.inner * stripes.at(places, scattered=True)
            signal = signal + lit.outer * stripes.at(places, scattered=False)
        else:
            signal = lit.inner + lit.outer
        return _image(view, lit.pixel, signal)

    def _stripes(self, light: ProjectorLight) -> BlurredStripes:
        key = (light.projector, light.axis, light.pattern)
        if key not in self._tables:
            nominal = self.scanner.nominal
            length = nominal.projector(light.projector).length_px(light.axis)
            levels = stripe_levels(length, nominal.period_px, nominal.phase_steps, light.pattern)
            emitted = emitted_light(levels, self.scanner.gamma[light.projector])
            self._tables[key] = BlurredStripes.of(emitted)
        return self._tables[key]

    def _points(self, view_name: str) -> StripedPoints:
        if view_name not in self._seen:
            distortion = self.scanner.distortion[view_name]
            self._seen[view_name] = self.surface.see(self.scanner.views[view_name], distortion)
        return self._seen[view_name]

    def _ambient(self, view_name: str) -> Float64Array:
        """Return the ambient light of a camera, full scales per second, shape (H, W)."""
        if view_name not in self._rooms:
            view, points = self.scanner.views[view_name], self._points(view_name)
            to_camera = _unit(np.asarray(view.position_mm) - points.position_mm)
            inner, _ = self.surface.reflect(points, points.normal, to_camera)
            self._rooms[view_name] = AMBIENT_RATE_PER_S * _image(view, points.pixel, inner)
        return self._rooms[view_name]

    def _lit_points(self, view_name: str, projector: str) -> _LitPoints:
        key = (view_name, projector)
        if key not in self._lit:
            self._lit[key] = self._illuminate(view_name, projector)
        return self._lit[key]

    def _illuminate(self, view_name: str, name: str) -> _LitPoints:
        view, points = self.scanner.views[view_name], self._points(view_name)
        lens, distortion = self.scanner.projectors[name], self.scanner.distortion[name]
        away = np.asarray(lens.position_mm, np.float64) - points.position_mm
        distance = np.linalg.norm(away, axis=1)
        to_light = away / distance[:, None]
        cosine = np.einsum("nk,nk->n", to_light, points.normal)
        display = project_points(lens, distortion, points.position_mm)
        inside = (display > -0.5) & (display < [lens.width_px - 0.5, lens.height_px - 0.5])
        row = np.flatnonzero((cosine > 0.0) & inside.all(axis=1))
        start = points.position_mm[row] + SHADOW_OFFSET_MM * points.normal[row]
        row = row[~self.surface.is_blocked(start, to_light[row], distance[row])]
        kept = StripedPoints(
            points.pixel[row], points.position_mm[row], points.normal[row], points.material[row]
        )
        to_camera = _unit(np.asarray(view.position_mm) - kept.position_mm)
        inner, outer = self.surface.reflect(kept, to_light[row], to_camera)
        irradiance = projector_intensity(self.scanner.nominal.projector(name), view)
        irradiance = irradiance * cosine[row] / distance[row] ** 2
        back = np.array(lens.axes[2])
        depth = (np.asarray(lens.position_mm) - kept.position_mm) @ back
        defocus = defocus_blur_px(lens, depth)
        per_mm = _display_gradient(lens, distortion, kept.position_mm, kept.normal)
        return _LitPoints(
            kept.pixel,
            irradiance * inner,
            irradiance * outer,
            {
                axis: DisplayPlaces.of(
                    display[row, k],
                    (lens.width_px, lens.height_px)[k],
                    defocus,
                    self.surface.scattering_mm * per_mm[:, k],
                )
                for k, axis in enumerate(STRIPE_AXES)
            },
        )


def scan_face(scene: DomeScene, *, seed: int, noise_seed: int) -> None:
    """Put the scanner of a scene's rig, as built, in front of its face, at rest at time 0."""
    if scene.rig.scanner is not None:
        surface = StripedFace(Caster(scene.subject.mesh), scene.texture)
        built = build_scanner(scene.rig.scanner, seed=seed)
        scene.stripes = StripeScene(built, surface, seed=noise_seed)


def scan_board(scene: TargetScene, *, seed: int, noise_seed: int) -> None:
    """Put the scanner of a scene's rig, as built, in front of its board."""
    if scene.rig.scanner is not None:
        surface = StripedBoard(charuco_board(), scene.plate_pose)
        built = build_scanner(scene.rig.scanner, seed=seed)
        scene.stripes = StripeScene(built, surface, seed=noise_seed)


def projector_intensity(projector: Projector, view: View) -> float:
    """Return the signal of a perfect white in a projector's full light, full scales mm^2 per s.

    The unit of light is that of the dome, see `rigsim.light.led_light.white_intensity`; the light
    of the projector is even over its field.
    """
    power, half_deg, distance_mm = METERING_LED
    exponent = math.log(0.5) / math.log(math.cos(math.radians(half_deg)))
    lens = projector.pinhole
    # solid angle of the display, small against a hemisphere
    side_sr = lens.width_px * lens.height_px / lens.focal_px**2
    unit = power * (exponent + 1.0) / (2.0 * math.pi) / distance_mm**2
    white = spectra.camera_white(view.spectral_sensitivity, projector.illuminant)
    share = float(np.mean(white / white.max()))
    return DOME_METER_RATE_PER_S * share * (projector.power_w / side_sr) / unit


def _display_gradient(
    lens: View, distortion: Float64Array, position_mm: Float64Array, normal: Float64Array
) -> Float64Array:
    """Return columns and rows of the display per mm along the surface, shape (n, 2)."""
    helper = np.where(np.abs(normal[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    first = _unit(np.cross(helper, normal))
    second = np.cross(normal, first)
    here = project_points(lens, distortion, position_mm)
    along = [
        project_points(lens, distortion, position_mm + 0.1 * way) - here for way in (first, second)
    ]
    return np.asarray(np.hypot(*along) / 0.1, np.float64)


def _image(view: View, pixel: Int64Array, signal: Float64Array) -> Float64Array:
    """Return the mean of subpixels' signals in each pixel, shape (H, W)."""
    total = np.bincount(pixel, signal, minlength=view.height_px * view.width_px)
    return np.asarray(
        total.reshape(view.height_px, view.width_px) / STRIPE_SUBPIXELS**2, np.float64
    )


def _unit(vectors: Float64Array) -> Float64Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True), np.float64)


def _pixel_of(subpixel: Int64Array, view: View) -> Int64Array:
    """Return the pixel of subpixels, both as indices into flat images."""
    row, column = np.divmod(subpixel, view.width_px * STRIPE_SUBPIXELS)
    return (row // STRIPE_SUBPIXELS) * view.width_px + column // STRIPE_SUBPIXELS
