"""Age a rig as built: brightness of LEDs and size of the frame on an earlier day.

Only effects with a published size are modeled: decay of LEDs with their operating hours, and the
temperature of the room. Gains of cameras, flash lamps, fibers and white references stay constant.

References
----------
Bretschneider, An intuitive metric for lumen maintenance, IES: flux decays exponentially (TM-21), to
70 % after 36,000 h or more.
Photometric Testing, LED specifications: the flux of a white LED falls by 30 % from 25 to 85 degrees
Celsius.
IES LM-79: laboratories keep 25 degrees Celsius within 2 K.
CRC Handbook of Chemistry and Physics: linear thermal expansion of aluminum, 23.1e-6 / K.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from rigsim.arrays import Float64Array
from rigsim.as_built.dome import ActualDome
from rigsim.as_built.sphere import ActualSphere

LED_DECAY_PER_H: Final = -math.log(0.7) / 36_000.0
"""Decay of an LED's flux per operating hour: the fastest that TM-21 reports as 36,000 h."""
OPERATING_H_PER_DAY: Final = 4.0
"""Operating hours per day, this project's choice: a busy laboratory."""
DECAY_DEVIATION: Final = 0.5
"""Relative standard deviation of an LED's decay, this project's choice: parts age differently."""
LED_FLUX_PER_K: Final = -0.30 / 60.0
"""Relative change of an LED's flux with temperature."""
ROOM_DEVIATION_K: Final = 1.0
"""Standard deviation of the room's temperature between days: 2 K are two of them."""
EXPANSION_PER_K: Final = 23.1e-6
"""Linear thermal expansion of the frame, aluminum."""


class AgeError(ValueError):
    """A day that is not in the past."""


@dataclass(frozen=True, slots=True)
class RigAge:
    """State of a rig some days ago, relative to today."""

    days_ago: int
    """Days before today, >= 0."""
    warmer_k: float
    """Temperature of the room less that of today, K; 0 today."""

    def __post_init__(self) -> None:
        """Check the range."""
        if self.days_ago < 0:
            raise AgeError(f"days_ago: got {self.days_ago}, expected 0 or more")

    def led_factors(self, names: list[str], *, seed: int) -> Float64Array:
        """Return the flux of LEDs relative to today, shape (L,), > 0.

        Parameters
        ----------
        names
            Names of the LEDs; each ages at its own rate.
        seed
            Seed of the rig as built.
        """
        normal = [
            np.random.default_rng([seed, 0x61676521, *name.encode()]).standard_normal()
            for name in names
        ]
        rate = LED_DECAY_PER_H * np.maximum(1.0 + DECAY_DEVIATION * np.array(normal), 0.0)
        aged = np.exp(rate * OPERATING_H_PER_DAY * self.days_ago)
        return np.asarray(aged * math.exp(LED_FLUX_PER_K * self.warmer_k))

    @property
    def frame_factor(self) -> float:
        """Size of the frame relative to today."""
        return 1.0 + EXPANSION_PER_K * self.warmer_k


def draw_rig_age(days_ago: int, *, seed: int) -> RigAge:
    """Draw the state of a rig on an earlier day; the same day has the same temperature.

    Parameters
    ----------
    days_ago
        Days before today, >= 0; 0 is the rig as built.
    seed
        Seed of the rig as built, >= 0.

    Raises
    ------
    AgeError
        The day is in the future.

    Examples
    --------
    >>> draw_rig_age(0, seed=1)
    RigAge(days_ago=0, warmer_k=0.0)
    >>> old = draw_rig_age(90, seed=1).led_factors(["a", "b"], seed=1)
    >>> bool((abs(old - 1.0) < 0.03).all()), bool(old[0] != old[1])
    (True, True)
    """
    if days_ago <= 0:
        return RigAge(days_ago, 0.0)
    rng = np.random.default_rng([seed, 0x726F6F6D, days_ago])
    return RigAge(days_ago, ROOM_DEVIATION_K * float(rng.standard_normal()))


def age_dome(built: ActualDome, age: RigAge, *, seed: int) -> ActualDome:
    """Return a dome as it was on an earlier day; for today the same object.

    Parameters
    ----------
    built
        The dome today.
    age
        State of the rig on that day.
    seed
        Seed of the dome as built.
    """
    if age.days_ago == 0:
        return built
    grown = age.frame_factor
    lights = built.rig.lights
    factors = age.led_factors([light.name for light in lights], seed=seed)
    aged = tuple(
        dataclasses.replace(
            light,
            power_w=None if light.power_w is None else light.power_w * float(factor),
            position_mm=_scale(light.position_mm, grown),
        )
        for light, factor in zip(lights, factors, strict=True)
    )
    views = tuple(
        dataclasses.replace(
            view,
            position_mm=_scale(view.position_mm, grown),
            target_mm=_scale(view.target_mm, grown),
        )
        for view in built.rig.views
    )
    return dataclasses.replace(built, rig=dataclasses.replace(built.rig, lights=aged, views=views))


def _scale(point: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    x, y, z = point
    return factor * x, factor * y, factor * z


def age_sphere(built: ActualSphere, age: RigAge, *, seed: int) -> ActualSphere:
    """Return a sphere of LEDs as it was on an earlier day; for today the same object.

    Parameters
    ----------
    built
        The sphere today.
    age
        State of the rig on that day.
    seed
        Seed of the sphere as built.
    """
    if age.days_ago == 0:
        return built
    names = [light.name for light in built.nominal.lights]
    return dataclasses.replace(
        built,
        intensity=built.intensity * age.led_factors(names, seed=seed),
        position_mm=built.position_mm * age.frame_factor,
    )
