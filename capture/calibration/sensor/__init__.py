"""Sensor calibration: dark frames, flat field, linearity and photon transfer."""

from capture.calibration.sensor.noise_model import SensorCalibration, calibrate_sensor
from capture.calibration.sensor.transfer_curve import FlatPair, PhotonTransferError

__all__ = ["FlatPair", "PhotonTransferError", "SensorCalibration", "calibrate_sensor"]
