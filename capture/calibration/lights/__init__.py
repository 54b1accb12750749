"""Calibration of the dome's lights: positions, directions and intensities."""

from capture.calibration.lights.chrome_ball import directions_from_chrome_ball
from capture.calibration.lights.light_list import CameraResponse, LightTable

__all__ = ["CameraResponse", "LightTable", "directions_from_chrome_ball"]
