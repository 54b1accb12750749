"""Run plans on the flash rig."""

from capture.acquire.flash.run import acquire

__all__ = ["acquire"]
