"""Run a plan on a rig: set up, expose, tear down; the lights end dark in every case.

The plan decides what to capture, the session which frames are missing, and the camera rule whether
a frame is accepted. Drivers decide nothing, and this package knows nothing of bytes.
"""

from capture.acquire.outcome import (
    AcquisitionError,
    AcquisitionResult,
    CaptureInterrupted,
    Operator,
)
from capture.acquire.run import run_plan

__all__ = ["AcquisitionError", "AcquisitionResult", "CaptureInterrupted", "Operator", "run_plan"]
