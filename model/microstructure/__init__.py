"""Dynamic microstructure: mesh strain, kernel table and convolution."""

from model.microstructure.convolution import ConvolutionError as ConvolutionError
from model.microstructure.convolution import convolve as convolve
from model.microstructure.convolution import convolve_tiled as convolve_tiled
from model.microstructure.convolution_kernels import TRUNCATE_SIGMAS as TRUNCATE_SIGMAS
from model.microstructure.kernel_table import ALPHA_LIMITS as ALPHA_LIMITS
from model.microstructure.kernel_table import FOREHEAD as FOREHEAD
from model.microstructure.kernel_table import TABLE_SCHEMA as TABLE_SCHEMA
from model.microstructure.kernel_table import KernelPoints as KernelPoints
from model.microstructure.kernel_table import KernelTable as KernelTable
from model.microstructure.kernel_table import KernelTableError as KernelTableError
from model.microstructure.kernel_table import forehead_points as forehead_points
from model.microstructure.kernel_table import gaussian_weights as gaussian_weights
from model.microstructure.kernel_table import kernel_parameters as kernel_parameters
from model.microstructure.mesh_strain import MeshStrain as MeshStrain
from model.microstructure.mesh_strain import StrainError as StrainError
from model.microstructure.mesh_strain import strain as strain
