"""Kernel fit: (alpha, sigma) of microstructure per strain."""

from reconstruction.kernel_fit.fit import KernelSearch, fit_kernel

__all__ = ["KernelSearch", "fit_kernel"]
