"""Recipe of the sessions of the dome."""

from reconstruction.pipeline.dome import stages
from reconstruction.pipeline.recipe import Recipe

RECIPE = Recipe(
    stages.MAP_NAMES,
    stages.graph,
    stages.FILE_NAMES,
    ("position",),
    maps_of_rank=stages.map_names,
    typical_seconds={
        **{"surface": 6.1, "lumitexels": 1.6, "normals": 2.0, "albedo": 3.1},
        **{"sample": 0.8, "lobes": 7.8, "refined": 8.5},
    },
)
