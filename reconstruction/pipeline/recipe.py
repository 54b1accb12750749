"""What the sessions of one kind of rig can be made into."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from capture.session import Session
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.inputs import Inputs


@dataclass(frozen=True, slots=True)
class Recipe:
    """What sessions of one kind can be made into."""

    maps: tuple[str, ...]
    """Names of the maps."""
    graph: Callable[[Inputs], list[stages.PipelineStage]]
    files: tuple[str, ...] = ()
    """Names of what is no map and goes along: meshes, tables."""
    required: tuple[str, ...] = ()
    """What the other maps mean nothing without."""
    products: Callable[[Session], Mapping[str, tuple[str, ...]]] | None = None
    """Where a name stands for more than itself, as for a map of each state: what for, by name."""
    maps_of_rank: Callable[[int], tuple[str, ...]] | None = None
    """Names of the maps where the number of lobes is chosen; None: this kind fits none."""

    def expand(self, session: Session, want: Sequence[str]) -> list[str]:
        """Return the maps and files that the wanted names stand for."""
        meant = {} if self.products is None else self.products(session)
        return [product for name in want for product in meant.get(name, (name,))]
