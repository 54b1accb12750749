"""Sensor noise of a camera, for the stages of every rig."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture import raw
from reconstruction.pipeline.inputs import InputsError


@dataclass(frozen=True, slots=True)
class ElectronNoise:
    """Conversion gain, electrons per DN, and read noise, electrons rms, of one camera."""

    gain: float
    read_noise: float

    @staticmethod
    def of(frame: raw.RawFrame) -> ElectronNoise:
        """Read gain and read noise from the frame's own noise profile.

        Raises
        ------
        InputsError
            Where the frame has none.
        """
        if frame.noise_profile is None:
            hint = "calibrate the sensor"
            raise InputsError(f"{frame.path}: got no noise profile, expected one; {hint}")
        scale, offset = frame.noise_profile
        span = frame.white - float(np.mean(frame.black))
        gain = 1.0 / max(scale * span, 1e-12)
        return ElectronNoise(gain, float(np.sqrt(offset)) * span * gain)
