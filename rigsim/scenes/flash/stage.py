"""What scenes of one geometry before the flash rig have in common, whatever the blood does."""

from dataclasses import dataclass, field
from weakref import WeakValueDictionary

from rigsim.geometry.mesh import Mesh
from rigsim.light.interreflection import Interreflection, interreflection_for
from rigsim.light.subsurface_radiance import SurfaceLight
from rigsim.needs.effect_sizes import exchange_share
from rigsim.render import Caster
from rigsim.render.variant import VariantChoice
from rigsim.subject import SimulatedSubject
from rigsim.targets import Target


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class FlashGeometry:
    """One geometry, and what has been traced on it."""

    held: tuple[Mesh, object]
    """The mesh and the normals; while they are held their ids are theirs."""
    caster: Caster
    light: dict[object, SurfaceLight] = field(default_factory=dict)
    """Light on the face, by what it comes from."""
    hollows: dict[str, float] = field(default_factory=dict)
    """`exchange_share` of the mesh, once it was asked for."""
    bounce: dict[str, Interreflection] = field(default_factory=dict)
    """How light goes from skin to skin, once a scene needed it."""

    def share(self) -> float:
        """Return `exchange_share` of the mesh."""
        if not self.hollows:
            self.hollows["share"] = exchange_share(self.caster)
        return self.hollows["share"]

    def exchange(self) -> Interreflection:
        """Return how light goes from skin to skin."""
        if not self.bounce:
            self.bounce["skin"] = interreflection_for(self.caster)
        return self.bounce["skin"]


_stages: WeakValueDictionary[tuple[object, ...], FlashGeometry] = WeakValueDictionary()


def flash_geometry(
    subject: SimulatedSubject | Target, choice: VariantChoice | None
) -> FlashGeometry:
    """Return the stage of a geometry; the same as long as any scene holds it.

    Parameters
    ----------
    subject
        Whose mesh and, of a face, normals are the geometry.
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
