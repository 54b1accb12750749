"""Compute the flicker of the dome's LEDs at the subject's eyes, as the controller limits it.

The controller evaluates flicker independently of the host, so that a wrong plan on the host cannot
pass: one eye midway between the subject's two, exact integrals of switched light, and Fourier sums
instead of a transform.
"""

import math
from collections.abc import Iterable, Sequence

import numpy as np

from capture.rig import Light
from rigsim.arrays import Float64Array
from rigsim.boxes.led_table import LedPulse

EYE_POSITION_MM = (0.0, 25.0, 80.0)
"""Position midway between the eyes of a nominal head, rig frame; the gaze is +z."""
FLICKER_BAND_HZ = (3.0, 65.0)
FLICKER_FUSION_S = 1.0 / 65.0
"""Shortest period of visible flicker, s."""
FLICKER_SAMPLE_S = 2e-3
MIN_FLASH_FRACTION = 0.1
"""Smallest change that counts as a flash, relative to the brightest light."""
MIN_RMS_SPAN_S = 2.0
"""Shorter light is limited by its flashes alone."""


class EyeFlickerMonitor:
    """Flicker at the eyes.

    Parameters
    ----------
    lights
        The LEDs with their positions.
    """

    def __init__(self, lights: Sequence[Light]) -> None:
        self.weights = np.array([_irradiance_at_eye(light) for light in lights])

    def flashes_per_s(self, light: Iterable[LedPulse]) -> float:
        """Return the flashes in the worst second: half the reversals by >= 0.1 of the peak."""
        times, integral = self._integral(light)
        if times.size == 0:
            return 0.0
        # The eye averages over the fusion time: a difference of the integral at both ends of the
        # window.
        grid = np.arange(times[0] - 0.1, times[-1] + 0.1, FLICKER_SAMPLE_S)
        upper = np.interp(grid + 0.5 * FLICKER_FUSION_S, times, integral)
        seen = (
            upper - np.interp(grid - 0.5 * FLICKER_FUSION_S, times, integral)
        ) / FLICKER_FUSION_S
        if seen.max() <= 0.0:
            return 0.0
        turns = grid[_turning_points(seen, MIN_FLASH_FRACTION * float(seen.max()))]
        if turns.size == 0:
            return 0.0
        within = np.searchsorted(turns, turns + 1.0 - 0.5 * FLICKER_SAMPLE_S) - np.arange(
            turns.size
        )
        return float(within.max()) / 2.0

    def rms(self, light: Iterable[LedPulse]) -> float:
        """Return the rms of the 3 to 65 Hz part over the mean, from first light to last; or 0."""
        # LEDs that are lit together add up to one light at the eye
        lit: dict[tuple[float, float], float] = {}
        for pulse in light:
            if pulse.t_off_s > pulse.t_on_s:
                when = (pulse.t_on_s, pulse.t_off_s)
                lit[when] = lit.get(when, 0.0) + float(self.weights[pulse.led]) * pulse.level
        if not lit:
            return 0.0
        on, off = np.array(list(lit)).T
        weight = np.array(list(lit.values()))
        start, span = float(on.min()), float(off.max() - on.min())
        mean = float((weight * (off - on)).sum()) / span
        if span < MIN_RMS_SPAN_S or mean <= 0.0:
            return 0.0
        orders = np.arange(
            math.ceil(FLICKER_BAND_HZ[0] * span), math.floor(FLICKER_BAND_HZ[1] * span) + 1
        )
        # A pulse's Fourier coefficient over the span is (exp(-i w off) - exp(-i w on)) / (-i w
        # span). By Parseval the band's mean square is twice the sum of |c_n|^2 over positive
        # orders.
        omega = 2.0 * np.pi * orders / span
        power = 0.0
        for part in np.array_split(omega, max(1, omega.size * on.size // 200_000)):
            turn = np.exp(-1j * np.outer(part, off - start)) - np.exp(
                -1j * np.outer(part, on - start)
            )
            power += float((np.abs((turn @ weight) / (part * span)) ** 2).sum())
        return math.sqrt(2.0 * power) / mean

    def _integral(self, light: Iterable[LedPulse]) -> tuple[Float64Array, Float64Array]:
        """Return the switching times and the cumulative light until then, W s/m^2."""
        changes: dict[float, float] = {}
        for pulse in light:
            step = float(self.weights[pulse.led]) * pulse.level
            changes[pulse.t_on_s] = changes.get(pulse.t_on_s, 0.0) + step
            changes[pulse.t_off_s] = changes.get(pulse.t_off_s, 0.0) - step
        times = np.array(sorted(changes))
        rate = np.cumsum([changes[t] for t in times])
        total = np.concatenate([[0.0], np.cumsum(rate[:-1] * np.diff(times))])
        return times, total[: times.size]


def _irradiance_at_eye(light: Light) -> float:
    """Return the irradiance of an LED at level 1 on the eye, W/m^2."""
    x, y, z = (e - p for e, p in zip(EYE_POSITION_MM, light.position_mm, strict=True))
    distance_mm = math.hypot(x, y, z)
    cosine = max(-z / distance_mm, 0.0)
    px, py, pz = light.position_mm
    along = -(x * px + y * py + z * pz) / (distance_mm * math.hypot(px, py, pz))
    # The lobe cos^n halves at the half-intensity angle: n = -ln 2 / ln cos(half). Its integral over
    # the hemisphere is 2 pi / (n + 1), which normalizes it to the LED's power.
    half_rad = math.radians(light.half_intensity_deg or 60.0)
    order = -math.log(2.0) / math.log(math.cos(half_rad))
    spread = (order + 1.0) / (2.0 * math.pi) * max(along, 0.0) ** order
    return (light.power_w or 0.0) * spread * cosine / (1e-3 * distance_mm) ** 2


def _turning_points(values: Float64Array, min_change: float) -> list[int]:
    """Return where a curve has risen, or fallen, by ``min_change`` since its last reversal."""
    found: list[int] = []
    low = high = float(values[0])
    direction = 0
    for place, value in enumerate(values.tolist()):
        low, high = min(low, value), max(high, value)
        if direction <= 0 and value >= low + min_change:
            direction, high = 1, value
            found.append(place)
        elif direction >= 0 and value <= high - min_change:
            direction, low = -1, value
            found.append(place)
        if direction > 0:
            low = high
        elif direction < 0:
            high = low
    return found
