"""Wrinkles as signed blends of partial-derivative normal maps."""

from model.wrinkles.expressions import JIMENEZ2011_TABLE as JIMENEZ2011_TABLE
from model.wrinkles.expressions import ZONE_SUM_LIMITS as ZONE_SUM_LIMITS
from model.wrinkles.expressions import WrinkleError as WrinkleError
from model.wrinkles.masks import Masks as Masks
from model.wrinkles.masks import mask_stack as mask_stack
from model.wrinkles.masks import mask_textures as mask_textures
from model.wrinkles.masks import zone_strength as zone_strength
from model.wrinkles.partial_derivatives import MAX_DERIVATIVE as MAX_DERIVATIVE
from model.wrinkles.partial_derivatives import ZONE_NAMES as ZONE_NAMES
from model.wrinkles.partial_derivatives import EncodedDerivatives as EncodedDerivatives
from model.wrinkles.partial_derivatives import WrinkleLayer as WrinkleLayer
from model.wrinkles.partial_derivatives import combine as combine
from model.wrinkles.partial_derivatives import combine_layers as combine_layers
from model.wrinkles.partial_derivatives import decode as decode
from model.wrinkles.partial_derivatives import encode as encode
from model.wrinkles.partial_derivatives import encode_with_report as encode_with_report
from model.wrinkles.partial_derivatives import from_unit as from_unit
from model.wrinkles.partial_derivatives import to_kernel_planes as to_kernel_planes
from model.wrinkles.partial_derivatives import to_unit as to_unit
