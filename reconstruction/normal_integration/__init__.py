"""Normal integration: height from normals, with errors."""

from reconstruction.normal_integration.integration import ConvergenceError as ConvergenceError
from reconstruction.normal_integration.integration import HeightMap as HeightMap
from reconstruction.normal_integration.integration import IntegrationSettings as IntegrationSettings
from reconstruction.normal_integration.integration import integrate as integrate
from reconstruction.normal_integration.integration import integrate_map as integrate_map
from reconstruction.normal_integration.slope_fields import Perspective as Perspective
from reconstruction.normal_integration.weighted_poisson import IntegrationError as IntegrationError
