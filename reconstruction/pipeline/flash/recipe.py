"""What sessions of the flash rig can be made into."""

from reconstruction.pipeline.flash import sequence
from reconstruction.pipeline.recipe import Recipe

RECIPE = Recipe(sequence.MAP_NAMES, sequence.graph, sequence.FILE_NAMES, products=sequence.products)
