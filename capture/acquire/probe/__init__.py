"""Run plans on the fiber probe."""

from capture.acquire.probe.run import acquire

__all__ = ["acquire"]
