"""Recipe of the sessions of the gradient sphere."""

from reconstruction.pipeline.gradient import pattern_diagnosis, stages
from reconstruction.pipeline.recipe import Recipe

RECIPE = Recipe(
    stages.MAP_NAMES,
    stages.graph,
    stages.FILE_NAMES,
    products=stages.products,
    diagnose=pattern_diagnosis.diagnose_patterns,
    typical_seconds={"strain": 0.9, "facets": 4.0, "histograms": 2.4, "kernels": 12.6},
)
