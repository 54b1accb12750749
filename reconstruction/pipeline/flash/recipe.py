"""Recipe of the sessions of the flash rig."""

from reconstruction.pipeline.flash import pair_diagnosis, sequence
from reconstruction.pipeline.recipe import Recipe

RECIPE = Recipe(
    sequence.MAP_NAMES,
    sequence.graph,
    sequence.FILE_NAMES,
    products=sequence.products,
    diagnose=pair_diagnosis.diagnose_pairs,
    typical_seconds={"chromophores": 10.7, "tsumura": 0.4},
)
