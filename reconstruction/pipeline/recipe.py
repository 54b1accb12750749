"""Recipe of a rig kind: its maps, files and graph of stages."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from capture.session import Session
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.diagnosed_images import DiagnosedImages
from reconstruction.pipeline.inputs import Inputs


@dataclass(frozen=True, slots=True)
class Recipe:
    """Maps, files and stages of the sessions of one rig kind."""

    maps: tuple[str, ...]
    """Names of the maps."""
    graph: Callable[[Inputs], list[stages.PipelineStage]]
    files: tuple[str, ...] = ()
    """Names of the other products: meshes, tables."""
    required: tuple[str, ...] = ()
    """Products that the interpretation of the other maps requires."""
    products: Callable[[Session], Mapping[str, tuple[str, ...]]] | None = None
    """Products by name, where a name means several, as one map for each state."""
    maps_of_rank: Callable[[int], tuple[str, ...]] | None = None
    """Names of the maps for a number of basis BRDFs; None: this rig kind fits none."""
    diagnose: Callable[[Session], DiagnosedImages] | None = None
    """Finds faults of the images from their pixels; None: no rule covers this rig kind."""
    typical_seconds: Mapping[str, float] = field(default_factory=dict)
    """Processor seconds of the long stages at demo size, by the first word of their names."""

    def expand(self, session: Session, want: Sequence[str]) -> list[str]:
        """Expand the wanted names to the maps and files that they mean."""
        meant = {} if self.products is None else self.products(session)
        return [product for name in want for product in meant.get(name, (name,))]
