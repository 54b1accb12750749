"""Run plans on the gradient sphere and its caliper."""

from capture.acquire.gradient.run import acquire

__all__ = ["acquire"]
