"""Parts of a rig other than cameras: lights, limits of LEDs, a caliper, a contact probe."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Final

from capture.documents import Document, FaultCollector, InputError

Vector = tuple[float, float, float]

ID_RULE = "1 to 64 of A-Z a-z 0-9 _ - . , not starting with a dot"
AXIS_RULE = "0 <= degrees < 180"
"""Range of a polarizer's axis."""


class RigError(InputError):
    """Raised for a rig, or a rig file, that cannot be used."""


def is_id(text: str) -> bool:
    """Return whether ``text`` is a valid name of a step, view, light or controller.

    Such a name can also be part of a file name.

    Examples
    --------
    >>> is_id("cam-0"), is_id("../cam"), is_id("")
    (True, False, False)
    """
    letters = all(c.isascii() and (c.isalnum() or c in "_-.") for c in text)
    return letters and 1 <= len(text) <= 64 and not text.startswith(".")


@dataclass(frozen=True, slots=True, kw_only=True)
class Light(Document):
    """One light of the rig: a flash, with an energy per flash, or an LED.

    Angles of axes are measured in the plane across the light's beam from the horizontal (+x of a
    camera at +z) towards +y, in degrees. Each light points at the rig's origin.
    """

    name: str
    position_mm: Vector
    """Center of the emitting disc, mm, rig frame."""
    illuminant: str = "D55"
    """Name of the spectrum, see ``model.spectra.illuminant``."""
    polarizer_axis_deg: float | None = None
    """Axis of the polarizer in front of the light, degrees, 0 <= axis < 180; None: no polarizer."""
    energy_ws: float | None = None
    """For a flash: energy of one flash at power 1, Ws (J), > 0; None: not a flash."""
    power_w: float | None = None
    """For an LED: optical power at level 1, W, > 0; None: not an LED."""
    half_intensity_deg: float | None = None
    """Angle off the light's axis at which its intensity has halved, falling as a power of the
    cosine, 0 < degrees < 90; None: the same in all directions.
    """
    radius_mm: float
    """Radius of the emitting disc, mm, > 0."""

    def __post_init__(self) -> None:
        checks = FaultCollector(f"Light {self.name!r}", RigError)
        checks.check("name", self.name, is_id(self.name), ID_RULE)
        checks.check_finite(position_mm=self.position_mm)
        checks.check(
            "position_mm", self.position_mm, math.hypot(*self.position_mm) > 0, "not the origin"
        )
        checks.check("illuminant", self.illuminant, bool(self.illuminant), "a name")
        axis, half = self.polarizer_axis_deg, self.half_intensity_deg
        checks.check("polarizer_axis_deg", axis, axis is None or 0 <= axis < 180, AXIS_RULE)
        checks.check("half_intensity_deg", half, half is None or 0 < half < 90, "0 < degrees < 90")
        strengths = {"energy_ws": self.energy_ws, "power_w": self.power_w}
        given = {name: value for name, value in strengths.items() if value is not None}
        checks.check("energy_ws, power_w", tuple(given), len(given) == 1, "one of the two")
        checks.check_positive(radius_mm=self.radius_mm, **given)
        checks.close()

    @property
    def lobe_exponent(self) -> float:
        """Exponent of the cosine off its axis in the light's intensity; 0 when uniform."""
        if self.half_intensity_deg is None:
            return 0.0
        return math.log(0.5) / math.log(math.cos(math.radians(self.half_intensity_deg)))

    def intensity(self, off_axis_rad: float) -> float:
        """Return the intensity ``off_axis_rad`` off the light's axis over that on it, 0 to 1.

        Examples
        --------
        >>> half = {"power_w": 1, "half_intensity_deg": 60}
        >>> led = Light(name="a", position_mm=(0, 0, 700), radius_mm=3, **half)
        >>> round(led.intensity(math.radians(60)), 6)
        0.5
        """
        if self.half_intensity_deg is None:
            return 1.0
        return max(math.cos(off_axis_rad), 0.0) ** self.lobe_exponent


@dataclass(frozen=True, slots=True, kw_only=True)
class LedLimits(Document):
    """Limits of LEDs near eyes and skin, and of their driver; a controller may allow less.

    The numbers are this project's nominal ones, not a certificate: an assembled dome is measured.
    """

    max_on_s: float = 0.5
    """Longest time an LED stays on for one command or row, s, > 0."""
    max_duty: float = 0.25
    """Largest mean level of an LED over ``duty_window_s``, 0 < duty <= 1."""
    duty_window_s: float = 1.0
    """Time over which the duty is averaged, s, > 0."""
    thermal_tau_s: float = 4.0
    """Time constant of an LED's temperature, s, > 0."""
    thermal_trip: float = 0.6
    """Trip temperature of its driver, 0 < trip < 1; 1 is the steady state when on."""
    dose_ws: float = 50.0
    """Largest energy that an LED may emit to one subject, Ws, > 0."""
    max_at_once: int = 24
    """Maximum number of LEDs that are on together, >= 2."""
    max_flashes_per_s: float = 3.0
    """Flashes seen by open eyes in any second must stay below this, > 0."""
    max_flicker_rms: float = 0.25
    """Largest light of 3 to 65 Hz at open eyes, rms over mean, > 0."""
    overlap_s: float = 1e-4
    """Time that the next LED is on before one goes off, s, >= 0."""
    settle_s: float = 1e-3
    """Time from an LED's turn to the cameras' release, s, >= ``overlap_s``."""
    max_rows: int = 1024
    """Longest table of the controller, rows, >= 1."""

    def __post_init__(self) -> None:
        checks = FaultCollector("LED limits", RigError)
        counts = ("max_at_once", "max_rows", "overlap_s", "settle_s")
        fields = [field.name for field in dataclasses.fields(self)]
        checks.check_positive(
            **{name: getattr(self, name) for name in fields if name not in counts}
        )
        checks.check("max_duty", self.max_duty, self.max_duty <= 1, "0 < duty <= 1")
        checks.check("thermal_trip", self.thermal_trip, self.thermal_trip < 1, "0 < trip < 1")
        checks.check("max_at_once", self.max_at_once, self.max_at_once >= 2, ">= 2")
        checks.check("max_rows", self.max_rows, self.max_rows >= 1, ">= 1")
        good = 0 <= self.overlap_s <= self.settle_s < math.inf
        checks.check(
            "settle_s", self.settle_s, good, f"0 <= overlap_s {self.overlap_s} <= settle_s"
        )
        checks.close()


HOMING_SPEED_FRACTION: Final = 0.5
"""Speed of a caliper's jaws on the way to the home mark, of that of other moves."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Caliper(Document):
    """Caliper whose jaws are taped to the skin, and stretch or compress the skin between them.

    Its force limit is not a property of the rig: the operator must give it for each capture.
    """

    aperture_mm: float
    """Distance of the jaws at step 0, mm, > 0."""
    step_mm: float
    """Distance per step of the jaws, mm, > 0."""
    first_step: int
    """Narrowest position, <= 0."""
    last_step: int
    """Widest position, >= 0."""
    angles_deg: tuple[float, ...]
    """Angles to which it can be set, from +x towards +y, 0 <= degrees < 180."""
    speed_mm_per_s: float
    """Speed of the jaws, mm/s, > 0."""
    settle_s: float = 0.3
    """Time for the skin to creep between a move and the scan, s, >= 0."""

    def __post_init__(self) -> None:
        checks = FaultCollector("Caliper", RigError)
        checks.check_positive(
            aperture_mm=self.aperture_mm, step_mm=self.step_mm, speed_mm_per_s=self.speed_mm_per_s
        )
        checks.check("settle_s", self.settle_s, 0 <= self.settle_s < math.inf, "seconds >= 0")
        open_mm = self.aperture_mm + self.first_step * self.step_mm
        narrow = self.first_step <= 0 and open_mm > 0
        checks.check("first_step", self.first_step, narrow, "<= 0, and the jaws apart")
        checks.check("last_step", self.last_step, self.last_step >= 0, ">= 0")
        for angle in self.angles_deg:
            checks.check("angles_deg", angle, 0 <= angle < 180, AXIS_RULE)
        differ = len(set(self.angles_deg)) == len(self.angles_deg) > 0
        checks.check("angles_deg", self.angles_deg, differ, "at least one, none twice")
        checks.close()

    def reading_mm(self, step: int) -> float:
        """Return the distance of the jaws at a step, mm.

        Examples
        --------
        >>> from capture.rig import load_rig
        >>> load_rig("gradient").caliper.reading_mm(-2)
        6.4
        """
        return self.aperture_mm + step * self.step_mm

    @property
    def mean_homing_s(self) -> float:
        """Mean time to find the home mark at step 0, s, from anywhere in the travel.

        The travel ends half a step beyond the first and the last step.

        Examples
        --------
        >>> from capture.rig import load_rig
        >>> round(load_rig("gradient").caliper.mean_homing_s, 2)
        2.85
        """
        below, above = ((abs(n) + 0.5) * self.step_mm for n in (self.first_step, self.last_step))
        mean_mm = 0.5 * (below**2 + above**2) / (below + above)
        return mean_mm / (HOMING_SPEED_FRACTION * self.speed_mm_per_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fiber(Document):
    """One detection fiber of a contact probe, from the head's face to its end at the camera."""

    name: str
    position_mm: tuple[float, float]
    """Center on the head's face relative to the source fiber's, mm; x along the line of fibers."""
    core_mm: float
    """Diameter of the core, mm, > 0."""
    numerical_aperture: float
    """Numerical aperture: sine of the half angle of acceptance in air, 0 < NA < 1."""
    spot_px: tuple[float, float]
    """Nominal center of its end in the camera's image, pixels, x right, y down."""

    def __post_init__(self) -> None:
        checks = FaultCollector(f"Fiber {self.name!r}", RigError)
        checks.check("name", self.name, is_id(self.name), ID_RULE)
        checks.check_finite(position_mm=self.position_mm, spot_px=self.spot_px)
        checks.check_positive(core_mm=self.core_mm, numerical_aperture=self.numerical_aperture)
        na = self.numerical_aperture
        checks.check("numerical_aperture", na, na < 1, "0 < NA < 1")
        checks.close()

    @property
    def radius_mm(self) -> float:
        """Distance from the source fiber's center, mm."""
        return math.hypot(*self.position_mm)


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe(Document):
    """Contact probe: one source fiber and a line of detection fibers, held on by suction.

    The rig's only light is the end of the source fiber, at the origin of the rig's frame; +x is
    along the line of fibers and +z out of the skin.
    """

    fibers: tuple[Fiber, ...]
    """Detection fibers, by growing distance from the source."""
    source_core_mm: float
    """Diameter of the source fiber's core, mm, > 0."""
    source_numerical_aperture: float
    """Numerical aperture: sine of the half angle of the emitted light in air, 0 < NA < 1."""
    suction_mbar: float
    """Suction that holds the head on the skin, mbar below ambient pressure, > 0."""
    suction_tolerance_mbar: float
    """Tolerance of the suction during a measurement, mbar, > 0."""
    max_suction_mbar: float
    """Largest suction of the pump, mbar, > 0."""
    max_suction_s: float
    """Longest suction of skin without a rest, s, > 0."""
    rest_s: float
    """Rest between two such times, vented, s, >= 0."""
    settle_s: float
    """Time from reaching the suction to the first exposure, s, >= 0."""
    max_open_s: float = 30.0
    """Longest opening of the source's shutter per command, s, > 0."""
    camera_c: float
    """Nominal temperature of the camera, degrees Celsius."""
    camera_tolerance_c: float
    """Tolerance of the temperature during a measurement, kelvin, > 0."""

    def __post_init__(self) -> None:
        checks = FaultCollector("Probe", RigError)
        names = tuple(fiber.name for fiber in self.fibers)
        differ = len(set(names)) == len(names) > 0
        checks.check("fibers", names, differ, "at least one, names that differ")
        radii = tuple(fiber.radius_mm for fiber in self.fibers)
        grow = all(a < b for a, b in zip((0.0, *radii), radii, strict=False))
        checks.check("fibers", radii, grow, "growing distances > 0 from the source")
        fields = [field.name for field in dataclasses.fields(self)]
        free = ("fibers", "rest_s", "settle_s", "camera_c")
        checks.check_positive(**{name: getattr(self, name) for name in fields if name not in free})
        na = self.source_numerical_aperture
        checks.check("source_numerical_aperture", na, na < 1, "0 < NA < 1")
        for name in ("rest_s", "settle_s"):
            seconds = getattr(self, name)
            checks.check(name, seconds, 0 <= seconds < math.inf, "seconds >= 0")
        most = self.max_suction_mbar
        fits = self.suction_mbar + self.suction_tolerance_mbar <= most
        checks.check("suction_mbar", self.suction_mbar, fits, f"with its tolerance <= {most}")
        kept = -80.0 <= self.camera_c <= 60.0
        checks.check("camera_c", self.camera_c, kept, "-80 to 60 degrees Celsius")
        checks.close()

    @property
    def radius_mm(self) -> tuple[float, ...]:
        """Distances of the fibers from the source, mm.

        Examples
        --------
        >>> from capture.rig import load_rig
        >>> radii = load_rig("probe").probe.radius_mm
        >>> len(radii), radii[0], radii[-1]
        (28, 0.3, 7.05)
        """
        return tuple(fiber.radius_mm for fiber in self.fibers)
