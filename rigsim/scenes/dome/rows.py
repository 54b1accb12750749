"""What the dome's cameras see of a subject that may move, as rows that any light can light."""

import dataclasses
from collections.abc import Callable

import numpy as np

from capture.rig import View
from rigsim.arrays import Float32Array, Float64Array
from rigsim.as_built.dome import BuiltDome
from rigsim.geometry.atlas import dilate_texture, unwrap
from rigsim.light.led_light import lobe_exponent
from rigsim.light.olat import Hits, Lamp
from rigsim.light.olat_vector import VectorLight
from rigsim.render import Caster
from rigsim.scenes.dome.views import Looking, at_skin, at_target
from rigsim.scenes.exposing import Kept, SceneError
from rigsim.subject import SimulatedSubject
from rigsim.subject.head_motion import HeadMotion
from rigsim.targets import Target


class DomeRows:
    """Cameras' rows of one subject or target; those of a head that holds still are kept.

    Parameters
    ----------
    dome
        The dome as it stands.
    subject
        A face or a target.
    caster
        Its mesh at rest.
    motion
        How the head moves; None holds it still. Targets stand still.
    how
        How cameras look.
    """

    def __init__(
        self,
        dome: BuiltDome,
        subject: SimulatedSubject | Target,
        caster: Caster,
        *,
        motion: HeadMotion | None,
        how: Looking,
    ) -> None:
        self._dome, self._subject, self._caster = dome, subject, caster
        self._motion = motion if isinstance(subject, SimulatedSubject) else None
        self._how = how
        most = len(dome.rig.views) if self._motion is None else 2
        self._hits: Kept[tuple[str, float], tuple[Hits, Caster]] = Kept(lambda _: most)
        self._vector: Kept[tuple[str, float], VectorLight] = Kept(lambda _: most)

    def instant(self, t_s: float) -> float:
        """Return the time that decides how the subject stands, s; 0 of one that holds still."""
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

    def seen(
        self, view: View, t_s: float, texture: Callable[[View], Float32Array]
    ) -> tuple[Hits, Caster]:
        """Return a camera's rows and the mesh that casts shadows on them.

        Parameters
        ----------
        view
            The camera, of the dome as it stands.
        t_s
            World time, s.
        texture
            How the face reflects for a camera, with its normals, (N, N, C); of a target not asked.
        """
        return self._hits.get((view.name, t_s), lambda: self._look(view, t_s, texture))

    def vector_light(self, view: View, t_s: float, hits: Hits, caster: Caster) -> VectorLight:
        """Return what lights rows of `seen` by compiled loops; kept as long as they are."""
        return self._vector.get((view.name, t_s), lambda: VectorLight(hits, caster))

    def _pose(self, t_s: float) -> tuple[Float64Array, Float64Array]:
        return (np.eye(3), np.zeros(3)) if self._motion is None else self._motion.pose(t_s)

    def _look(
        self, view: View, t_s: float, texture_of: Callable[[View], Float32Array]
    ) -> tuple[Hits, Caster]:
        rotation, shift = self._pose(t_s)
        moved = dataclasses.replace(
            view,
            position_mm=_vector((np.asarray(view.position_mm) - shift) @ rotation),
            target_mm=_vector((np.asarray(view.target_mm) - shift) @ rotation),
            up=_vector(np.asarray(view.up) @ rotation),
        )
        how, distortion = self._how, self._dome.distortion.get(view.name)
        subject, caster = self._subject, self._caster
        if isinstance(subject, Target):
            if subject.kind == "source":
                raise SceneError(f"target {subject.name!r}: shines itself, no dome holds it")
            return at_target(caster, moved, subject, how, distortion), caster
        amount = 0.0 if self._motion is None else self._motion.twitch(t_s)
        texture = texture_of(view)
        if amount > 0.0 and self._motion is not None:
            mesh, atlas = self._motion.twitched(subject.mesh, amount), subject.atlas
            caster = Caster(mesh, choice=caster.choice)
            # The relief turns with the surface below it.
            turned = dilate_texture(unwrap(mesh, atlas.size).normal - atlas.normal, atlas.covered)
            texture = np.concatenate([texture[..., :-3], texture[..., -3:] + turned], axis=-1)
        return at_skin(caster, moved, texture, how, distortion), caster


def _vector(values: Float64Array) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
