"""Dynamic microstructure: mesh strain, kernel table and convolution."""

from model.microstructure.convolution import ConvolutionError, convolve, convolve_tiled
from model.microstructure.convolution_kernels import TRUNCATE_SIGMAS
from model.microstructure.kernel_table import (
    ALPHA_LIMITS,
    FOREHEAD,
    TABLE_SCHEMA,
    KernelPoints,
    KernelTable,
    KernelTableError,
    forehead_points,
    gaussian_weights,
    kernel_parameters,
)
from model.microstructure.mesh_strain import MeshStrain, StrainError, strain

__all__ = [
    "ALPHA_LIMITS",
    "FOREHEAD",
    "TABLE_SCHEMA",
    "TRUNCATE_SIGMAS",
    "ConvolutionError",
    "KernelPoints",
    "KernelTable",
    "KernelTableError",
    "MeshStrain",
    "StrainError",
    "convolve",
    "convolve_tiled",
    "forehead_points",
    "gaussian_weights",
    "kernel_parameters",
    "strain",
]
