"""Frames under narrow-band LEDs of the flash rig's heads."""

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from capture.plan.steps import Index, Plan, PlanError, Step

LED_CENTER_NM: Final = (420, 680)
LED_WIDTH_NM: Final = (5, 50)
DEFAULT_WIDTH_NM: Final = 20
"""Full width at half maximum of common LEDs of 450 to 630 nm, 15 to 30 nm in data sheets."""
_BAND_PATTERN = re.compile(r"([0-9]{3})(?::([0-9]{1,2}))?")
_NAME_PATTERN = re.compile(r"LED-([0-9]{3})-([0-9]{1,2})")


def parse_bands(text: str) -> tuple[str, ...]:
    """Return the names of LEDs from their centers, and optional widths, in nm.

    Parameters
    ----------
    text : str
        Centers separated by commas, each with an optional full width at half maximum after a colon.

    Raises
    ------
    PlanError
        For another text, a center or a width out of range, or a band given twice.

    Examples
    --------
    >>> parse_bands("450,580:12")
    ('LED-450-20', 'LED-580-12')
    """
    names: list[str] = []
    for part in text.split(","):
        match = _BAND_PATTERN.fullmatch(part.strip())
        center, width = (int(match[1]), int(match[2] or DEFAULT_WIDTH_NM)) if match else (0, 0)
        name = f"LED-{center}-{width}"
        good = LED_CENTER_NM[0] <= center <= LED_CENTER_NM[1]
        if not (good and LED_WIDTH_NM[0] <= width <= LED_WIDTH_NM[1]) or name in names:
            raise PlanError(
                f"--bands: got {part.strip()!r}, expected centers of {LED_CENTER_NM[0]} to "
                f"{LED_CENTER_NM[1]} nm, each once, with an optional full width of "
                f"{LED_WIDTH_NM[0]} to {LED_WIDTH_NM[1]} nm; give 450,580,600 or 450:20,580:12"
            )
        names.append(name)
    return tuple(names)


def parse_led(name: str) -> tuple[float, float]:
    """Return the center and the full width at half maximum of an LED, nm.

    Raises
    ------
    PlanError
        For the name of another light.

    Examples
    --------
    >>> parse_led("LED-590-20")
    (590.0, 20.0)
    """
    match = _NAME_PATTERN.fullmatch(name)
    if match is None:
        raise PlanError(
            f"light: got {name!r}, expected LED-CENTER-WIDTH in nm; name it like LED-590-20"
        )
    return float(match[1]), float(match[2])


def led_names(plan: Plan) -> tuple[str, ...]:
    """Return the LEDs under which a plan has frames, in the order of their first frame."""
    found = [str(step.index["light"]) for step in plan.steps if "light" in step.index]
    return tuple(name for name in dict.fromkeys(found) if _NAME_PATTERN.fullmatch(name))


def add_led_frames(plan: Plan, leds: Sequence[str]) -> Plan:
    """Return a plan with one frame per LED next to each crossed frame of a subject.

    The analyzer stays crossed. The frames have their LED instead of a polarizer in their index, so
    that they are not taken for frames of the flash.

    Parameters
    ----------
    plan : Plan
        A plan of the flash rig.
    leds : sequence of str
        Names of LEDs, see `parse_bands`; none leaves the plan as it is.

    Examples
    --------
    >>> from capture.plan import flash_plan
    >>> from capture.rig import load_rig
    >>> plan = flash_plan(load_rig("flash"), darks=0, leds=("LED-590-20",))
    >>> [step.id for step in plan.steps], plan.steps[-1].index["light"]
    (['S000', 'S001', 'S001-LED-590-20'], 'LED-590-20')
    """
    steps: list[Step] = []
    for step in plan.steps:
        steps.append(step)
        if step.kind != "subject" or step.index.get("polarizer") != "crossed":
            continue
        kept = {key: value for key, value in step.index.items() if key != "polarizer"}
        for led in leds:
            index: Index = {**kept, "light": led}
            settings = {**step.settings, "light": led}
            steps.append(replace(step, id=f"{step.id}-{led}", index=index, settings=settings))
    return replace(plan, steps=tuple(steps))
