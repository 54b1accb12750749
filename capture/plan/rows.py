"""Rows of light: the LEDs that the steps of a plan switch on, one after the other."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from capture.arrays import Float64Array
from capture.plan.steps import Step, require_argument
from capture.rig import Rig, Vector

_AXIS_INDEX = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True, slots=True)
class LedRow:
    """LEDs that are on together for a time."""

    leds: tuple[int, ...]
    """Numbers of the LEDs, indices into the rig's lights; empty: dark."""
    level: float
    """Light relative to full, 0 to 1."""
    dwell_s: float
    """Duration, s."""
    fractions: tuple[float, ...] = ()
    """Weight of each LED relative to the level, 0 to 1; empty: all 1."""

    def light_levels(self, lights: int) -> Float64Array:
        """Return the levels of a number of lights, shape (lights,), 0 to 1.

        Examples
        --------
        >>> LedRow((0, 2), 0.5, 0.03, (1.0, 0.2)).light_levels(3).tolist()
        [0.5, 0.0, 0.1]
        """
        levels = np.zeros(lights)
        levels[list(self.leds)] = self.level * np.array(self.fractions or (1.0,) * len(self.leds))
        return levels


def pattern_weights(positions_mm: Sequence[Vector], pattern: str) -> Float64Array:
    """Return the weights of lights in a pattern of the gradient sphere, 0 to 1.

    Parameters
    ----------
    positions_mm : sequence of 3-vectors
        Positions of the lights, rig frame.
    pattern : str
        "full": 1; "x": (1 + x)/2 with x of the unit vector to the light, "-x": (1 - x)/2; so y and
        z; "dark": 0.

    Returns
    -------
    ndarray of float64, shape (lights,)

    Examples
    --------
    >>> pattern_weights([(600.0, 0.0, 0.0), (0.0, 0.0, 600.0)], "-x").tolist()
    [0.0, 0.5]
    """
    places = np.asarray(positions_mm, np.float64)
    if pattern in ("full", "dark"):
        return np.full(len(places), float(pattern == "full"))
    axis = _AXIS_INDEX.get(pattern.removeprefix("-"))
    require_argument(axis is not None, "pattern", pattern, "full, x, y, z, -x, -y, -z or dark")
    coordinate = places[:, axis] / np.linalg.norm(places, axis=1)
    return 0.5 * (1.0 - coordinate if pattern.startswith("-") else 1.0 + coordinate)


def step_lights(step: Step) -> tuple[str, ...]:
    """Return the names of the lights that a step of the dome switches on; none when dark.

    Examples
    --------
    >>> step_lights(Step("T1", "tracking", {}, {"leds": "L003+L010"}, ("C00",)))
    ('L003', 'L010')
    """
    leds, light = step.settings.get("leds"), step.settings.get("light", "none")
    if leds is not None:
        return tuple(str(leds).split("+"))
    return () if light == "none" else (str(light),)


def led_rows(steps: Iterable[Step], rig: Rig) -> tuple[LedRow, ...]:
    """Return the LED rows of steps of the dome or the sphere, one row per step.

    Raises
    ------
    RigError
        For a light that the rig does not have.
    """
    numbers = {light.name: number for number, light in enumerate(rig.lights)}
    rows = []
    for step in steps:
        dwell_s = float(step.settings.get("dwell_s", 0.0))
        if (pattern := step.settings.get("pattern", "dark")) != "dark":
            places = tuple(light.position_mm for light in rig.lights)
            level = float(step.settings.get("level", 1.0))
            shares = _pattern_weights(places, str(pattern))
            rows.append(LedRow(tuple(range(len(places))), level, dwell_s, shares))
            continue
        names = step_lights(step)
        for name in names:
            rig.light(name)  # names unknown lights
        level = float(step.settings.get("level", 0.0)) if names else 0.0
        rows.append(LedRow(tuple(numbers[name] for name in names), level, dwell_s))
    return tuple(rows)


@lru_cache(maxsize=64)
def _pattern_weights(positions_mm: tuple[Vector, ...], pattern: str) -> tuple[float, ...]:
    return tuple(pattern_weights(positions_mm, pattern).tolist())


def split_passes(steps: Sequence[Step]) -> list[list[Step]]:
    """Split steps where cameras must be set again or something must be put in front of them.

    Steps of one piece share exposure, sensitivity, cameras, pose and the state of the skin, so that
    they can follow one another without a pause.
    """
    pieces: list[list[Step]] = []
    before: object = None
    for step in steps:
        settings, index = step.settings, step.index
        key = (
            settings["exposure_s"],
            settings.get("iso", 100),
            step.cameras,
            index.get("pose"),
            index.get("sphere"),
            index.get("pass"),
            step.kind == "dark",
            index.get("angle"),
            index.get("caliper"),
            index.get("reading"),
        )
        if not pieces or key != before:
            pieces.append([])
        before = key
        pieces[-1].append(step)
    return pieces
