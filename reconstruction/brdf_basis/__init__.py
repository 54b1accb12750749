"""BRDF basis: non-negative weights at surface points and their reduction."""

from reconstruction.brdf_basis.fit import BasisWeights as BasisWeights
from reconstruction.brdf_basis.fit import SampleError as SampleError
from reconstruction.brdf_basis.fit import SurfaceSamples as SurfaceSamples
from reconstruction.brdf_basis.fit import evaluate as evaluate
from reconstruction.brdf_basis.fit import find_plateau_rank as find_plateau_rank
from reconstruction.brdf_basis.fit import fit_weights as fit_weights
from reconstruction.brdf_basis.fit import reduce as reduce
from reconstruction.brdf_basis.fit import render_lit_sphere as render_lit_sphere
from reconstruction.brdf_basis.fit import surface_samples as surface_samples
