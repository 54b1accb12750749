"""Visible points of a subject in the dome, as rows that any light can illuminate."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capture.rig import View
from rigsim.arrays import Float32Array, Float64Array, Int32Array
from rigsim.as_built.dome import ActualDome
from rigsim.caching import LruCache
from rigsim.geometry.atlas import dilate_texture, sample, unwrap
from rigsim.light.lateral_scattering import LateralScattering
from rigsim.light.led_light import lobe_exponent
from rigsim.light.olat import CameraSettings, Hits, Lamp, find_hits
from rigsim.light.olat_kernels import MATT_ROWS, METAL_ROWS, SKIN_ROWS
from rigsim.light.relief_shadow import ReliefShadow
from rigsim.light.skin_material import describe_skin, describe_target
from rigsim.mitsuba.image_hits import NOTHING_ADDED, AddedLight
from rigsim.render import Caster, GBuffer
from rigsim.scenes.dome.rendering import MitsubaScene, RenderedView
from rigsim.scenes.exposing import SceneError
from rigsim.subject import SimulatedSubject
from rigsim.subject.head_motion import HeadMotion
from rigsim.targets import Target

Float16Array = NDArray[np.float16]

SUBSURFACE_CACHE_BYTES: Final = 2**29
"""Size of the cache of subsurface light: it is the same for all cameras, which request it in turn
for many lights."""

FLOAT16_SCALE: Final = 1000.0
"""Maximum of the cached light in float16: 11 bits resolve 1e-10 of full scale there."""


class DomeRows:
    """Cameras' rows of one subject or target, cached for heads that do not move.

    Parameters
    ----------
    dome
        The actual dome.
    subject
        A face or a target.
    caster
        Its mesh at rest.
    motion
        Movement of the head; None: fixed. Targets are fixed.
    how
        Settings of the cameras.
    """

    def __init__(
        self,
        dome: ActualDome,
        subject: SimulatedSubject | Target,
        caster: Caster,
        motion: HeadMotion | None,
        how: CameraSettings,
    ) -> None:
        self._dome, self._subject, self._caster = dome, subject, caster
        self._motion = motion if isinstance(subject, SimulatedSubject) else None
        self._how = how
        most = len(dome.rig.views) if self._motion is None else 2
        self._hits: LruCache[tuple[str, float], tuple[Hits, Caster]] = LruCache(lambda _: most)
        self._rendered: LruCache[tuple[str, float], RenderedView] = LruCache(lambda _: most)
        self._scenes: LruCache[tuple[str, float], MitsubaScene] = LruCache(lambda _: most)

    @property
    def is_still(self) -> bool:
        """Whether the head does not move."""
        return self._motion is None

    def pose_time_s(self, t_s: float) -> float:
        """Return the time that determines the head's pose, s; 0 for a fixed head."""
        return 0.0 if self._motion is None else round(t_s, 4)

    def lamp(self, light: int, t_s: float) -> Lamp:
        """Return a light, by index, in the frame of the mesh."""
        rotation, shift = self._pose(t_s)
        led = self._dome.rig.lights[light]
        return Lamp(
            position_mm=(np.asarray(led.position_mm) - shift) @ rotation,
            axis=self._dome.axis[light] @ rotation,
            exponent=lobe_exponent(led),
            radius_mm=led.radius_mm,
        )

    def visible_rows(
        self, view: View, t_s: float, texture: Callable[[str], Float32Array]
    ) -> tuple[Hits, Caster]:
        """Return a camera's rows and the mesh that casts shadows on them.

        Parameters
        ----------
        view
            The camera of the actual dome.
        t_s
            World time, s.
        texture
            Returns the face's reflection for a camera's colors with its normals, (N, N, C); not
            called for a target.
        """
        return self._hits.get((view.name, t_s), lambda: self._trace_rows(view, t_s, texture))

    def rendered_view(
        self, view: View, t_s: float, texture: Callable[[str], Float32Array]
    ) -> RenderedView:
        """Return a camera's hits in Mitsuba's scene; see `visible_rows`."""
        return self._rendered.get((view.name, t_s), lambda: self._observe(view, t_s, texture))

    def _observe(
        self, view: View, t_s: float, texture_of: Callable[[str], Float32Array]
    ) -> RenderedView:
        camera = view.spectral_sensitivity

        def build() -> MitsubaScene:
            subject = self._reflecting()
            if isinstance(subject, Target):
                material = describe_target(subject, camera, self._how.illuminant)
                return MitsubaScene(subject.mesh, material, self._caster.choice)
            caster, layers = self._posed(t_s, texture_of(camera))
            return MitsubaScene(caster.mesh, describe_skin(layers), caster.choice)

        scene = self._scenes.get((camera, self._twitch_amount(t_s)), build)
        lamps = tuple(self.lamp(k, t_s) for k in range(len(self._dome.rig.lights)))
        moved, distortion = self._moved(view, t_s), self._dome.distortion.get(view.name)
        return scene.observe(moved, lamps, self._how, distortion)

    def _reflecting(self) -> SimulatedSubject | Target:
        subject = self._subject
        if isinstance(subject, Target) and subject.kind == "source":
            raise SceneError(
                f"target {subject.name!r}: got one that emits light, expected one that reflects"
            )
        return subject

    def _twitch_amount(self, t_s: float) -> float:
        return 0.0 if self._motion is None else self._motion.twitch_amount(t_s)

    def _moved(self, view: View, t_s: float) -> View:
        rotation, shift = self._pose(t_s)
        return dataclasses.replace(
            view,
            position_mm=_vector((np.asarray(view.position_mm) - shift) @ rotation),
            target_mm=_vector((np.asarray(view.target_mm) - shift) @ rotation),
            up=_vector(np.asarray(view.up) @ rotation),
        )

    def _pose(self, t_s: float) -> tuple[Float64Array, Float64Array]:
        return (np.eye(3), np.zeros(3)) if self._motion is None else self._motion.pose(t_s)

    def _trace_rows(
        self, view: View, t_s: float, texture_of: Callable[[str], Float32Array]
    ) -> tuple[Hits, Caster]:
        moved, distortion = self._moved(view, t_s), self._dome.distortion.get(view.name)
        subject = self._reflecting()
        if isinstance(subject, Target):
            caster = self._caster
            return observe_target(caster, moved, subject, self._how, distortion), caster
        caster, layers = self._posed(t_s, texture_of(view.spectral_sensitivity))
        return observe_face(caster, moved, layers, self._how, distortion), caster

    def _posed(self, t_s: float, layers: Float32Array) -> tuple[Caster, Float32Array]:
        """Return the mesh and the texture of a face at a time."""
        subject, amount = self._subject, self._twitch_amount(t_s)
        if self._motion is None or isinstance(subject, Target) or amount <= 0.0:
            return self._caster, layers
        mesh, atlas = self._motion.apply_twitch(subject.mesh, amount), subject.atlas
        # The relief turns with the surface below it.
        turned = dilate_texture(unwrap(mesh, atlas.size).normal - atlas.normal, atlas.covered)
        turned_layers = np.concatenate([layers[..., :-3], layers[..., -3:] + turned], axis=-1)
        return Caster(mesh, choice=self._caster.choice), turned_layers


def _vector(values: Float64Array) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


class DomeSubsurfaceRadiance:
    """Light from the interior of one face in addition to each point's own reflection.

    Parameters
    ----------
    scattering
        Returns the lateral scattering of the face for a camera's colors.
    """

    def __init__(self, scattering: Callable[[str], LateralScattering]) -> None:
        self._scattering = scattering
        self._kept: LruCache[tuple[str, int, float], tuple[np.float32, Float16Array]] = LruCache(
            lambda glow: SUBSURFACE_CACHE_BYTES // glow[1].nbytes
        )
        self._latest: tuple[tuple[str, int, float], Float32Array] | None = None

    def on_rows(
        self, uv: Float32Array, lamp: Lamp, view: View, light: int, t_s: float
    ) -> Float32Array:
        """Return the subsurface light at a camera's rows.

        Parameters
        ----------
        uv
            Texture coordinates of the rows, shape (n, 2).
        lamp
            The light, in the frame of the mesh.
        view
            The camera; its colors matter.
        light, t_s
            Number of the light and world time in s, the keys of the cache.

        Returns
        -------
        ndarray of float32
            pi times radiance before the boundary, (n, 3), see `rigsim.light.lateral_scattering`.
        """
        camera = view.spectral_sensitivity

        def lit() -> tuple[np.float32, Float16Array]:
            glow = self._scattering(camera).glow(lamp)
            unit = np.float32(max(float(glow.max()), 1e-30) / FLOAT16_SCALE)
            return unit, np.asarray(glow / unit, np.float16)

        key = camera, light, t_s
        if self._latest is None or self._latest[0] != key:
            unit, kept = self._kept.get(key, lit)
            # all cameras request the same light in turn
            self._latest = key, unit * kept.astype(np.float32)
        return sample(self._latest[1], uv, np.ones(len(uv), np.bool_))


class AddedSkinLight:
    """What a face adds to the direct light on a camera's rows.

    Parameters
    ----------
    glow
        Its subsurface light; None: none.
    relief
        Shadows of its texture's relief; None: none.
    replaces_diffuse
        Whether the subsurface light includes the diffuse term.
    """

    def __init__(
        self,
        glow: DomeSubsurfaceRadiance | None,
        relief: ReliefShadow | None,
        replaces_diffuse: bool,
    ) -> None:
        self._glow, self._relief, self._replaces_diffuse = glow, relief, replaces_diffuse

    def of_lights(
        self, hits: Hits, view: View, lights: Sequence[int], lamps: Sequence[Lamp], t_s: float
    ) -> list[Callable[[], AddedLight]]:
        """Return a function per light that computes what is added.

        Parameters
        ----------
        hits
            A camera's rows; only skin adds light.
        view, lights, t_s
            As for `DomeSubsurfaceRadiance.on_rows`.
        lamps
            The lights, in the frame of the mesh.
        """
        glow = self._glow
        if hits.kind != SKIN_ROWS or (glow is None and self._relief is None):
            return [lambda: NOTHING_ADDED] * len(lights)
        uv = hits.texture_uv()
        reliefs: Sequence[Float32Array | None] = [None] * len(lights)
        if self._relief is not None:
            places, radii = [lamp.position_mm for lamp in lamps], [lamp.radius_mm for lamp in lamps]
            reliefs = list(self._relief.visible_fractions(uv, hits.position_mm, places, radii))

        def add(light: int, lamp: Lamp, relief: Float32Array | None) -> AddedLight:
            if glow is None:
                return AddedLight(None, relief)
            inner = glow.on_rows(uv, lamp, view, light, t_s)
            return AddedLight(inner, relief, self._replaces_diffuse)

        return [partial(add, *one) for one in zip(lights, lamps, reliefs, strict=True)]


def observe_face(
    caster: Caster,
    view: View,
    texture: Float32Array,
    settings: CameraSettings,
    distortion: ArrayLike | None,
) -> Hits:
    """Trace a camera's rows of a face.

    Parameters
    ----------
    caster
        Its mesh.
    view
        The camera, in the frame of the mesh.
    texture
        Surface and normals with relief in the last three, shape (N, N, 10) or (N, N, 14).
    settings, distortion
        Rays and lens; its distortion, see `rigsim.render.camera_rays`.
    """

    def look_up(buffers: GBuffer, rows: Int32Array) -> tuple[Float32Array, Float32Array]:
        uv = buffers.uv.reshape(-1, 2)[rows]
        values = sample(texture, uv, np.ones(len(rows), np.bool_))
        return normalize(values[:, -3:]), np.maximum(values[:, :-3], 0.0)

    return find_hits(caster, view, look_up, settings, SKIN_ROWS, distortion)


def observe_target(
    caster: Caster,
    view: View,
    target: Target,
    settings: CameraSettings,
    distortion: ArrayLike | None,
) -> Hits:
    """Trace a camera's rows of a reflecting target."""
    rgb = target.rgb(view.spectral_sensitivity, settings.illuminant)

    def look_up(buffers: GBuffer, rows: Int32Array) -> tuple[Float32Array, Float32Array]:
        uv = buffers.uv.reshape(-1, 2)[rows]
        surface = np.zeros((len(rows), 7), np.float32)
        size = rgb.shape[0]
        column = np.clip((uv[:, 0] * size).astype(np.int64), 0, size - 1)
        row = np.clip(((1.0 - uv[:, 1]) * size).astype(np.int64), 0, size - 1)
        surface[:, :3] = rgb[row, column]
        surface[:, 3] = target.alpha
        return buffers.normal.reshape(-1, 3)[rows], surface

    kind = METAL_ROWS if target.kind == "metal" else MATT_ROWS
    return find_hits(caster, view, look_up, settings, kind, distortion)


def normalize(vectors: Float32Array) -> Float32Array:
    """Normalize vectors to length 1, shape (..., 3); those of length 0 stay."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, np.float32(1e-6)), np.float32)
