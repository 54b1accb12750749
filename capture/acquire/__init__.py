"""Run a plan on a rig: set up, expose, tear down; whatever happens, the lights end dark.

The driver decides nothing and this package nothing about bytes: what to shoot is the plan's, what
is missing is the session's, whether a frame is the right one is the camera rule's.
"""

from capture.acquire.outcome import AcquisitionError, AcquisitionResult, Interrupted, Operator
from capture.acquire.run import run_plan

__all__ = ["AcquisitionError", "AcquisitionResult", "Interrupted", "Operator", "run_plan"]
