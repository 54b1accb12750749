"""Recipe of the sessions of the fiber probe."""

from reconstruction.pipeline.probe import stages
from reconstruction.pipeline.recipe import Recipe

RECIPE = Recipe(
    stages.MAP_NAMES,
    stages.graph,
    stages.FILE_NAMES,
    products=stages.products,
    typical_seconds={"profiles": 2.0, "subsurface": 0.6},
)
