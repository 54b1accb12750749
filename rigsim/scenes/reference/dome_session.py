"""A face whose skin is voxels in the light dome, as a scene of sessions.

Rays and shadows are traced on the face's mesh. `rigsim.scenes.reference.face_skin` reflects, lens
blur excepted nothing else of the session's own renderer is used.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from capture.rig import Rig, View
from rigsim.arrays import Float32Array, Float64Array
from rigsim.as_built.dome import ActualDome
from rigsim.caching import cached_method
from rigsim.geometry.atlas import sample
from rigsim.light import olat
from rigsim.light.olat import Hits, Lamp
from rigsim.light.surface_brdf import SkinSurface
from rigsim.mitsuba.variant import Renderer, VariantChoice, choose_renderer
from rigsim.needs import face as face_needs
from rigsim.needs.effects import EffectSelection, SceneEffects, omitted_effects
from rigsim.scenes.dome.rows import normalize
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.reference.face_skin import FaceDirections, FaceReflection, render_face_directions
from rigsim.sensor import apply_cfa
from rigsim.subject import SimulatedSubject

BLOCK_ROWS: Final = 2**17
"""Rows that are reflected at once: the fit's terms take 0.4 kB each."""
VOXEL_OMISSIONS: Final = frozenset(
    {
        face_needs.LATERAL_EFFECT,
        face_needs.INTERREFLECTION_EFFECT,
        face_needs.SPECTRAL_EFFECT,
        face_needs.FURTHER_BOUNCES_EFFECT,
        face_needs.RELIEF_SHADOW_EFFECT,
    }
)
"""Effects of a face that `dome_voxels` lists as unmodeled instead."""


class VoxelDomeScene(DomeScene):
    """One face of voxel skin inside the dome, at rest.

    Parameters
    ----------
    rig, subject, dome, seed, on_s, subpixels
        As for `DomeScene`; the subject is a face.
    directions
        The face's light by camera sensitivity, see `render_directions_of_views`.
    """

    renderer: Renderer = "reference"
    """Renderer of the images."""

    def __init__(
        self,
        rig: Rig,
        subject: SimulatedSubject,
        directions: Mapping[str, FaceDirections],
        *,
        dome: ActualDome | None = None,
        seed: int = 0,
        on_s: float | None = None,
        subpixels: int = 2,
    ) -> None:
        off = SceneEffects(lateral=False, interreflections=False, relief_shadows=False)
        super().__init__(
            rig,
            subject,
            dome=dome,
            seed=seed,
            effects=off,
            on_s=on_s,
            subpixels=subpixels,
            choice=choose_renderer("reference"),
        )
        self._directions = directions
        kept = (effect for effect in self.needs if effect.name not in VOXEL_OMISSIONS)
        self.needs = EffectSelection((*kept, *omitted_effects("dome_voxels")))

    @property
    def variant(self) -> VariantChoice:
        """Return the variant that renders the images, with the reason and the fit's noise."""
        noise = max(one.shape.fit_noise for one in self._directions.values())
        why = f"voxels by the integrator tissue; noise of their directions is {100 * noise:.1f} %"
        return replace(self._caster.choice, why=why)

    def brdf(
        self,
        uv: ArrayLike,
        to_light: ArrayLike,
        to_camera: ArrayLike,
        *,
        view_name: str | None = None,
    ) -> tuple[Float32Array, Float32Array]:
        """Evaluate the ground truth of the reflection at points; see `DomeScene.brdf`."""
        camera = self._camera(view_name).spectral_sensitivity
        points = np.atleast_2d(np.asarray(uv, np.float32))
        values = sample(self._texture(camera), points, np.ones(len(points), np.bool_))
        ways = normalize(values[:, -3:]), to_light, to_camera
        total, surface = self._reflection(camera).evaluate(
            points, values[:, :3], values[:, 6], ways
        )
        return total.astype(np.float32), surface.astype(np.float32)

    @cached_method
    def _reflection(self, camera: str) -> FaceReflection:
        return FaceReflection(self._face(), self._surface(camera), self._directions[camera])

    @cached_method
    def _surface(self, camera: str) -> SkinSurface:
        bare = super()._surface(camera)
        return replace(bare, fuzz=np.zeros_like(bare.fuzz))

    def _mosaics(self, view_name: str, lights: Sequence[int], t_s: float) -> list[Float32Array]:
        view = self._camera(view_name)
        return [apply_cfa(self._render(view, light, t_s), view.cfa) for light in lights]

    def _render(self, view: View, light: int, t_s: float) -> Float32Array:
        hits, caster = self._rows.visible_rows(view, t_s, self._texture)
        lamp = self._rows.lamp(light, t_s)
        lit = np.flatnonzero(olat.is_lamp_visible(hits, caster, lamp))
        rgb = np.zeros((3, len(hits.position_mm)), np.float32)
        for start in range(0, len(lit), BLOCK_ROWS):
            rows = lit[start : start + BLOCK_ROWS]
            rgb[:, rows] = self._reflected(view, hits, lamp, rows).T
        gain = np.float32(np.pi * self.dome.gain.get(view.name, 1.0))
        color = gain * self.intensity(light, view_name=view.name)
        return olat.sum_rows(hits, rgb[0], rgb[1], rgb[2], color)

    def _reflected(
        self, view: View, hits: Hits, lamp: Lamp, rows: np.ndarray[tuple[int], np.dtype[np.intp]]
    ) -> Float64Array:
        """Return the light of some rows for a light of intensity 1, over pi, shape (n, 3)."""
        points = hits.position_mm[rows].astype(np.float64)
        way = lamp.position_mm - points
        distance = np.linalg.norm(way, axis=1, keepdims=True)
        to_light = way / distance
        to_camera = hits.camera_mm - points
        to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
        normal = normalize(hits.normals()[rows]).astype(np.float64)
        # nothing is emitted backwards
        lobe = np.maximum(-to_light @ lamp.axis, 0.0) ** lamp.exponent
        cosine = np.maximum(np.sum(normal * to_light, axis=1), 0.0)
        values = olat.unpack_surface(hits.surface[rows])
        reflected, _ = self._reflection(view.spectral_sensitivity).evaluate(
            hits.texture_uv()[rows], values[:, :3], values[:, 6], (normal, to_light, to_camera)
        )
        strength = lobe * cosine / distance[:, 0] ** 2
        return np.asarray(strength[:, None] * reflected, np.float64)


def render_directions_of_views(
    rig: Rig,
    face: SimulatedSubject,
    *,
    samples: int,
    seed: int,
    progress: Callable[[str], None] | None = None,
) -> dict[str, FaceDirections]:
    """Render the face's light for each sensitivity of the dome's cameras.

    Parameters
    ----------
    rig
        The dome; its lights have one spectrum.
    face, samples, seed, progress
        As for `render_face_directions`.
    """
    illuminant = str(rig.lights[0].illuminant)
    return {
        camera: render_face_directions(
            face, camera, illuminant, samples=samples, seed=seed, progress=progress
        )
        for camera in dict.fromkeys(view.spectral_sensitivity for view in rig.views)
    }
