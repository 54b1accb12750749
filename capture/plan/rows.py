"""Rows of light: what the steps of a plan ask of the dome's LEDs, one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from capture.plan.steps import Step
from capture.rig import Rig


@dataclass(frozen=True, slots=True)
class LedRow:
    """LEDs that are on together for a time."""

    leds: tuple[int, ...]
    """Numbers of the LEDs, indices into the rig's lights; empty: dark."""
    level: float
    """Light relative to full, 0 to 1."""
    dwell_s: float
    """How long, s."""


def lights_of(step: Step) -> tuple[str, ...]:
    """Return the names of the lights that a step of the dome switches on; none when dark.

    Examples
    --------
    >>> lights_of(Step("T1", "tracking", {}, {"leds": "L003+L010"}, ("C00",)))
    ('L003', 'L010')
    """
    leds, light = step.settings.get("leds"), step.settings.get("light", "none")
    if leds is not None:
        return tuple(str(leds).split("+"))
    return () if light == "none" else (str(light),)


def led_rows(steps: Iterable[Step], rig: Rig) -> tuple[LedRow, ...]:
    """Return what steps of the dome ask of the LEDs of ``rig``, one row a step.

    Raises
    ------
    RigError
        For a light that the rig does not have.
    """
    numbers = {light.name: number for number, light in enumerate(rig.lights)}
    rows = []
    for step in steps:
        names = lights_of(step)
        for name in names:
            rig.light(name)  # names what is unknown
        level = float(step.settings.get("level", 0.0)) if names else 0.0
        dwell_s = float(step.settings.get("dwell_s", 0.0))
        rows.append(LedRow(tuple(numbers[name] for name in names), level, dwell_s))
    return tuple(rows)


def passes(steps: Sequence[Step]) -> list[list[Step]]:
    """Cut steps where cameras must be set anew or something must be put before them.

    Steps of one piece share exposure, sensitivity, cameras and pose, and so can follow one another
    without a pause.
    """
    pieces: list[list[Step]] = []
    before: object = None
    for step in steps:
        settings, index = step.settings, step.index
        key = (
            settings["exposure_s"], settings.get("iso", 100), step.cameras,
            index.get("pose"), index.get("sphere"), index.get("pass"), step.kind == "dark",
        )  # fmt: skip
        if not pieces or key != before:
            pieces.append([])
        before = key
        pieces[-1].append(step)
    return pieces
