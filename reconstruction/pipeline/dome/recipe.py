"""Recipe of the sessions of the dome."""

from reconstruction.pipeline.dome import stages
from reconstruction.pipeline.recipe import Recipe

RECIPE = Recipe(
    stages.MAP_NAMES, stages.graph, stages.FILE_NAMES, ("position",), maps_of_rank=stages.map_names
)
