"""Recipe of the sessions of the gradient sphere."""

from reconstruction.pipeline.gradient import stages
from reconstruction.pipeline.recipe import Recipe

RECIPE = Recipe(stages.MAP_NAMES, stages.graph, stages.FILE_NAMES, products=stages.products)
