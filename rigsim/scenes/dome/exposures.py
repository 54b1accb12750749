"""Exposures of the dome's cameras: the light of pulses that fell into them, summed on a sensor."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import numpy as np

from capture.rig import View
from rigsim.arrays import Float32Array, UInt16Array
from rigsim.as_built.dome import BuiltDome
from rigsim.boxes.led_table import LedPulse
from rigsim.scenes.exposing import Kept, full_power_s
from rigsim.sensor import Sensor, expose

LED_POWER_DEVIATION: Final = 0.001
"""Relative standard deviation of an LED's energy from pulse to pulse."""

KEPT_FRAMES: Final = 16
KEPT_FRAME_BYTES: Final = 2**28
"""Latest frames that are kept, the more of the two, so that a second exposure costs nothing."""


class Exposures:
    """Exposures of one scene; frames of single lights are kept for the capture's next pass.

    Parameters
    ----------
    dome
        Whose LEDs answer as they are wired.
    render
        The light on a camera, (H, W, 3), of a light alone, by index, at a time.
    instant
        World time, s, to the time that decides how the scene stands.
    seed
        Seeds what differs from pulse to pulse.
    """

    def __init__(
        self,
        dome: BuiltDome,
        render: Callable[[View, int, float], Float32Array],
        instant: Callable[[float], float],
        *,
        seed: int,
    ) -> None:
        self._dome, self._render, self._instant, self._seed = dome, render, instant, seed
        # a capture comes back to each light in its next pass
        self._frames: Kept[tuple[str, int, float], Float32Array] = Kept(
            lambda frame: max(KEPT_FRAMES, KEPT_FRAME_BYTES // frame.nbytes)
        )

    def expose(
        self, view: View, sensor: Sensor, *, pops: Sequence[LedPulse], exposure_s: float, seed: int
    ) -> UInt16Array:
        """Expose a camera once.

        Parameters
        ----------
        view, sensor
            The camera and what it sees with.
        pops
            The pulses of the LEDs, clipped to the exposure; none gives a dark frame.
        exposure_s
            Exposure time, s.
        seed
            Seed of this exposure's noise.

        Returns
        -------
        ndarray of uint16
            Raw DN, shape (H, W).
        """
        rng = np.random.default_rng([self._seed, seed])
        light = np.zeros((view.height_px, view.width_px, 3), np.float32)
        for pulse in pops:
            on_s = full_power_s(pulse, f"LED {pulse.led}")
            energy = on_s * (1.0 + LED_POWER_DEVIATION * rng.standard_normal())
            if energy > 0.0:
                middle = self._instant(0.5 * (pulse.t_on_s + pulse.t_off_s))
                led = self._dome.answering(pulse.led)
                frame = partial(self._render, view, led, middle)
                light += np.float32(energy) * self._frames.get((view.name, led, middle), frame)
        return expose(light, sensor=sensor, rng=rng, exposure_s=exposure_s)
