"""Normal integration: height from normals, with errors."""

from reconstruction.normal_integration.integration import (
    HeightMap,
    NotConverged,
    Settings,
    integrate,
    integrate_map,
)
from reconstruction.normal_integration.slope_fields import Perspective
from reconstruction.normal_integration.weighted_poisson import IntegrationError

__all__ = [
    "HeightMap",
    "IntegrationError",
    "NotConverged",
    "Perspective",
    "Settings",
    "integrate",
    "integrate_map",
]
