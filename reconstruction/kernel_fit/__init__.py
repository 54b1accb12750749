"""Kernel fit: (alpha, sigma) of microstructure per strain."""

from reconstruction.kernel_fit.fit import fit_kernel

__all__ = ["fit_kernel"]
