"""Recipe of the sessions of the dome."""

from reconstruction.pipeline.dome import stages
from reconstruction.pipeline.recipe import Recipe

RECIPE = Recipe(
    stages.MAP_NAMES,
    stages.graph,
    stages.FILE_NAMES,
    ("position", stages.HOLE_MAP),
    maps_of_rank=stages.map_names,
    # between those of 320 and of 1300 pixels, whose ratios differ
    typical_seconds={
        **{"surface": 5.6, "motion": 1.0, "lumitexels": 3.9, "half-vector": 3.0, "normals": 4.8},
        **{"albedo": 7.6, "sample": 0.8, "lobes": 2.2, "refined": 14.0},
    },
)
