"""Share the traced geometry between flash scenes that differ in the blood only."""

from weakref import WeakValueDictionary

import numpy as np

from capture.rig import View
from rigsim.geometry.mesh import Mesh
from rigsim.light.subsurface_radiance import SurfaceIllumination
from rigsim.mitsuba.variant import VariantChoice
from rigsim.needs.sampled_light import SampledLamp, SampledLight, sample_light
from rigsim.render import Caster
from rigsim.scenes.exposing import FaceGeometry
from rigsim.scenes.flash.surfaces import FlashLights
from rigsim.subject import SimulatedSubject
from rigsim.targets import Target


class FlashGeometry(FaceGeometry):
    """One geometry with its traced rays.

    Parameters
    ----------
    held
        The mesh and the normals; holding them keeps their ids unique.
    caster
        Caster of the mesh.
    """

    def __init__(self, held: tuple[Mesh, object], caster: Caster) -> None:
        super().__init__(caster)
        self.held = held
        self.light: dict[object, SurfaceIllumination] = {}  # on the face, by its source
        self.sampled: dict[object, SampledLight] = {}  # the same for rules, by source and camera

    def sample_light(
        self, subject: SimulatedSubject | Target, flashes: FlashLights, view: View
    ) -> SampledLight | None:
        """Return the light of all flashes on a face, for rules; None for a target."""
        if not isinstance(subject, SimulatedSubject):
            return None
        key = (*flashes.key, view.position_mm)
        if key not in self.sampled:
            lamps = [
                SampledLamp(light.position_mm, light.radius_mm, float(weight))
                for light, weight in zip(flashes.lights, flashes.weights, strict=True)
            ]
            cameras = np.array([view.position_mm])
            self.sampled[key] = sample_light(subject, self.caster, [lamps], cameras)
        return self.sampled[key]


_stages: WeakValueDictionary[tuple[object, ...], FlashGeometry] = WeakValueDictionary()


def shared_flash_geometry(
    subject: SimulatedSubject | Target, choice: VariantChoice | None
) -> FlashGeometry:
    """Return the shared geometry; the same as long as any scene holds it.

    Parameters
    ----------
    subject
        Its mesh and, for a face, its normals are the geometry.
    choice
        Mitsuba variant to trace with; None chooses.
    """
    normal = subject.normal if isinstance(subject, SimulatedSubject) else None
    key = (id(subject.mesh), id(normal), choice)
    stage = _stages.get(key)
    if stage is None:
        stage = FlashGeometry((subject.mesh, normal), Caster(subject.mesh, choice=choice))
        _stages[key] = stage
    return stage
