"""BRDF basis: non-negative weights at surface points and their reduction."""

from reconstruction.brdf_basis.fit import BasisWeights as BasisWeights
from reconstruction.brdf_basis.fit import SampleError as SampleError
from reconstruction.brdf_basis.fit import SurfaceSamples as SurfaceSamples
from reconstruction.brdf_basis.fit import evaluate as evaluate
from reconstruction.brdf_basis.fit import fit_weights as fit_weights
from reconstruction.brdf_basis.fit import lit_sphere as lit_sphere
from reconstruction.brdf_basis.fit import plateau as plateau
from reconstruction.brdf_basis.fit import reduce as reduce
from reconstruction.brdf_basis.fit import surface_samples as surface_samples
