"""Rigs whose cameras write the light of an exposure into its pixels, instead of an image of skin.

A frame thus proves which light made it. Each rig has plans of a few frames, and the pixels that the
light of a step must give.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from capture.devices.led_box import Eyes
from capture.plan import Plan, Step, Value, flash_plan
from capture.plan.dome import dome_plan
from capture.plan.flicker import flicker_report
from capture.plan.gradient import gradient_calibration_plan, gradient_plan
from capture.plan.probe import probe_plan
from capture.plan.rows import step_lights
from capture.plan.steps import LIGHT_PATTERNS
from capture.rig import LedLimits, Rig, load_rig

MAX_ROWS = 8
"""Largest number of lights that the pixels describe."""
WIDTH_PX = 16
ANGLES_DEG: Final[Mapping[str, int]] = {"parallel": 0, "crossed": 90}
SHUTTER_TOLERANCE = 0.03
"""Largest relative deviation of the light's duration from the exposure."""

Row = tuple[int, int, int]
"""Description of a light, or of what the rig holds: three numbers of a pixel row."""


NO_WEAK_LEDS: Final[Mapping[int, float]] = {}


class WitnessRig(ABC):
    """One rig, its plans, and the pixels of its light.

    Attributes
    ----------
    name
        Name of the rig in reports.
    box
        Controller of its light.
    rig
        The rig, with small images.
    """

    name: ClassVar[str]
    box: ClassVar[str]
    rig: Rig

    @abstractmethod
    def plan(self, rng: np.random.Generator) -> Plan:
        """Draw a plan of a few frames."""

    @abstractmethod
    def describe(self, light: Any, exposure_s: float) -> Row:
        """Return the row of a light."""

    @abstractmethod
    def expect(self, step: Step) -> list[Row]:
        """Return the rows of the lights of a step."""

    def describe_hold(self, **held: Any) -> Row:
        """Return the row of what the rig holds: the caliper's grip, or the probe's head."""
        return (0, 0, 0)

    def expect_hold(self, step: Step) -> Row | None:
        """Return that row for a step; None where it does not matter."""
        return None

    def exposure(
        self, view_name: str, *, pops: Sequence[Any], exposure_s: float, seed: int, **held: Any
    ) -> NDArray[np.uint16]:
        """Return the pixels of an exposure, shape (H, W); see `rigsim.world.world.Scene`."""
        view = self.rig.view(view_name)
        image = np.zeros((view.height_px, view.width_px), np.uint16)
        image[0, 0] = len(pops)
        image[1, :3] = self.describe_hold(**held)
        rows = sorted(self.describe(light, exposure_s) for light in pops)[:MAX_ROWS]
        if rows:
            image[2 : 2 + len(rows), :3] = rows
        return image

    def weaken(self, row: Row, weak: Mapping[int, float]) -> Row:
        """Return the row of a light whose weak LEDs emit these fractions, by number."""
        return row

    def find_deviation(
        self,
        step: Step,
        cfa: NDArray[np.uint16],
        actual: Mapping[str, Value],
        weak: Mapping[int, float] = NO_WEAK_LEDS,
    ) -> str:
        """Return how the light of a frame differs from what its step requests; empty: not.

        Parameters
        ----------
        step
            Step under which the frame was filed.
        cfa
            Its pixels, shape (H, W).
        actual
            Its entry in the journal.
        weak
            Fraction that each weak LED emits, by number: no controller measures light, so that
            its frames are filed as requested.
        """
        count = min(int(cfa[0, 0]), MAX_ROWS)
        seen = [_row(row) for row in cfa[2 : 2 + count]]
        wanted = sorted(self.expect(step))[:MAX_ROWS]
        if actual["exposure_s"] != step.settings["exposure_s"]:
            return f"exposure {actual['exposure_s']} s, expected {step.settings['exposure_s']} s"
        if dead := str(actual.get("dead_lights", "")):
            wanted = self._without_dead(step, dead)
        wanted = sorted(self.weaken(row, weak) for row in wanted)
        if not self._same(seen, wanted):
            return f"light {seen}, expected {wanted}"
        held, wanted_hold = _row(cfa[1]), self.expect_hold(step)
        if wanted_hold is not None and held != wanted_hold:
            return f"grip or head {held}, expected {wanted_hold}"
        return ""

    def _without_dead(self, step: Step, dead: str) -> list[Row]:
        numbers = {light.name: 1 + number for number, light in enumerate(self.rig.lights)}
        lost = {numbers[name] for name in dead.split("+")}
        return sorted(row for row in self.expect(step) if row[0] not in lost)[:MAX_ROWS]

    def _same(self, seen: list[Row], wanted: list[Row]) -> bool:
        return seen == wanted

    @property
    def eyes(self) -> Eyes:
        """State of the subject's eyes."""
        return "closed"


def _row(pixels: NDArray[np.uint16]) -> Row:
    first, second, third = (int(value) for value in pixels[:3])
    return first, second, third


class FlashWitness(WitnessRig):
    """Two expressions under polarized flashes of drawn power."""

    name, box = "flash", "flash"
    rig = load_rig("flash").resized(WIDTH_PX)

    def plan(self, rng: np.random.Generator) -> Plan:
        """Draw a plan of a few frames."""
        plan = flash_plan(self.rig, states=("neutral", "smile"), repeats=2, darks=1)
        steps = [
            step
            if step.kind == "dark"
            else replace(step, settings={**step.settings, "power": float(rng.integers(1, 11)) / 10})
            for step in plan.steps
        ]
        return replace(plan, steps=tuple(steps))

    def describe(self, light: Any, exposure_s: float) -> Row:
        """Return power, analyzer and 1."""
        return round(1e3 * light.power), ANGLES_DEG[light.polarizer], 1

    def expect(self, step: Step) -> list[Row]:
        """Return the rows of the lights of a step."""
        if step.kind == "dark":
            return []
        power = round(1e3 * float(step.settings["power"]))
        return [(power, ANGLES_DEG[str(step.settings["polarizer"])], 1)]


class DomeWitness(WitnessRig):
    """One light at a time, in a dome of a few lights with one camera."""

    name, box = "dome", "dome"
    rig = load_rig("dome")
    rig = rig.subset(
        lights=[light.name for light in rig.lights[::12]][:13], views=[rig.views[0].name]
    ).resized(WIDTH_PX)
    _eyes: Eyes = "closed"

    def plan(self, rng: np.random.Generator) -> Plan:
        """Draw a plan of a few frames."""
        plan = dome_plan(self.rig, tracking_interval=int(rng.choice([6, 100])))
        within = flicker_report(plan, self.rig).within(self.rig.leds or LedLimits())
        self._eyes = "open" if within else "closed"
        return plan

    @property
    def eyes(self) -> Eyes:
        """Open where the last plan is within the limits for open eyes."""
        return self._eyes

    def describe(self, light: Any, exposure_s: float) -> Row:
        """Return number of the LED from 1, level and 1."""
        return 1 + light.led, round(1e3 * light.level), 1

    def expect(self, step: Step) -> list[Row]:
        """Return the rows of the lights of a step."""
        numbers = {light.name: 1 + number for number, light in enumerate(self.rig.lights)}
        level = round(1e3 * float(step.settings.get("level", 1.0)))
        return [(numbers[name], level, 1) for name in step_lights(step)]

    def weaken(self, row: Row, weak: Mapping[int, float]) -> Row:
        """Return the row of a light whose weak LEDs emit these fractions, by number."""
        return row[0], round(row[1] * weak.get(row[0] - 1, 1.0)), row[2]


class GradientWitness(WitnessRig):
    """A ball of black glass under patterns, without a caliper."""

    name, box = "gradient", "gradient_sphere"
    rig = load_rig("gradient").resized(WIDTH_PX)

    def plan(self, rng: np.random.Generator) -> Plan:
        """Draw a plan of a few frames."""
        return gradient_calibration_plan(self.rig, "ball")

    def describe(self, light: Any, exposure_s: float) -> Row:
        """Return number of the pattern from 1, analyzer and level."""
        pattern = 1 + LIGHT_PATTERNS.index(light.pattern)
        return pattern, round(light.analyzer_deg), round(1e3 * light.level)

    def expect(self, step: Step) -> list[Row]:
        """Return the rows of the lights of a step."""
        pattern = str(step.settings["pattern"])
        if pattern == "dark":
            return []
        reading = step.settings.get("analyzer_deg", ANGLES_DEG[str(step.settings["polarizer"])])
        level = round(1e3 * float(step.settings["level"]))
        return [(1 + LIGHT_PATTERNS.index(pattern), round(float(reading)), level)]

    def _without_dead(self, step: Step, dead: str) -> list[Row]:
        return sorted(self.expect(step))  # a pattern has many LEDs


class CaliperWitness(GradientWitness):
    """Skin in a caliper: neutral, compressed and stretched under a few patterns."""

    name = "caliper"

    def plan(self, rng: np.random.Generator) -> Plan:
        """Draw a plan of a few frames."""
        angle = float(rng.choice([0.0, 45.0, 90.0]))
        patterns = ("full", *(str(name) for name in rng.permutation(LIGHT_PATTERNS[1:])[:2]))
        return gradient_plan(
            self.rig,
            angles=[angle],
            steps=(-1, 1),
            patterns=tuple(dict.fromkeys(patterns)),
            darks=1,
        )

    def describe_hold(self, **held: Any) -> Row:
        """Return angle, position from 100, and whether the tape holds."""
        grip = held["grip"]
        return round(grip.angle_deg), 100 + grip.step, int(grip.attached)

    def expect_hold(self, step: Step) -> Row | None:
        """Return that row for a step on skin."""
        if "caliper" not in step.index:
            return None
        return round(float(step.index["angle"])), 100 + int(step.index["caliper"]), 1


class ProbeWitness(WitnessRig):
    """A short series of exposures at one site."""

    name, box = "probe", "probe"
    rig = load_rig("probe")

    def plan(self, rng: np.random.Generator) -> Plan:
        """Draw a plan of a few frames."""
        longest_s = float(rng.choice([0.5, 2.0, 8.0]))
        site = str(rng.choice(["forehead", "cheek", "chin"]))
        return probe_plan(self.rig, sites=[site], brackets=4, max_exposure_s=longest_s, darks=1)

    def describe(self, light: Any, exposure_s: float) -> Row:
        """Return level, number of the uncovered fiber from 1 (0: all), and the light's duration."""
        fiber = 0 if light.fiber is None else 1 + light.fiber
        open_share = (light.t_off_s - light.t_on_s) / exposure_s
        return round(1e3 * light.level), fiber, round(1e3 * open_share)

    def expect(self, step: Step) -> list[Row]:
        """Return the rows of the lights of a step."""
        if step.kind == "dark":
            return []
        fiber = step.settings.get("fiber")
        level = round(1e3 * float(step.settings.get("level", 1.0)))
        return [(level, 0 if fiber is None else 1 + int(fiber), round(1e3))]

    def weaken(self, row: Row, weak: Mapping[int, float]) -> Row:
        """Return the row of the only LED, which may emit a fraction."""
        return round(row[0] * weak.get(0, 1.0)), row[1], row[2]

    def _same(self, seen: list[Row], wanted: list[Row]) -> bool:
        tolerance = 1e3 * SHUTTER_TOLERANCE
        return [row[:2] for row in seen] == [row[:2] for row in wanted] and all(
            abs(one[2] - other[2]) <= tolerance for one, other in zip(seen, wanted, strict=True)
        )

    def describe_hold(self, **held: Any) -> Row:
        """Return the site's length of name, angle, and whether the head is placed."""
        head = held["head"]
        return len(head.site), round(head.angle_deg), int(head.placed)

    def expect_hold(self, step: Step) -> Row | None:
        """Return that row for a step on skin."""
        if "site" not in step.index:
            return None
        return len(str(step.index["site"])), round(float(step.index["angle"])), 1


WITNESS_RIGS: Final[Mapping[str, WitnessRig]] = {
    rig.name: rig
    for rig in (FlashWitness(), DomeWitness(), GradientWitness(), CaliperWitness(), ProbeWitness())
}
