"""Kernel fit: (alpha, sigma) of microstructure per strain."""

from reconstruction.kernel_fit.fit import convolved_histogram, fit_kernel, fit_relief

__all__ = ["convolved_histogram", "fit_kernel", "fit_relief"]
