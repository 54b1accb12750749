"""Tissue optics: absorption of chromophores and reflectance of layered skin."""

from model.tissue_optics.constants import PAPER_CONSTANTS as PAPER_CONSTANTS
from model.tissue_optics.constants import SKIN_CONSTANTS as SKIN_CONSTANTS
from model.tissue_optics.constants import TissueConstants as TissueConstants
from model.tissue_optics.constants import TissueError as TissueError
from model.tissue_optics.layers import blood_absorption as blood_absorption
from model.tissue_optics.layers import layer_stack_reflectance as layer_stack_reflectance
from model.tissue_optics.layers import skin_layers as skin_layers
from model.tissue_optics.layers import two_layer_reflectance as two_layer_reflectance
