"""The nominal rig: lights, views and boxes, read from a TOML file and frozen."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import ConfigDict

from capture.documents import STRICT, Checks, Fault, InputError, near_miss, parse, read_toml

Vector = tuple[float, float, float]
Pattern = Literal["RGGB", "BGGR", "GRBG", "GBRG", "MONO"]

PATTERNS: tuple[str, ...] = ("RGGB", "BGGR", "GRBG", "GBRG", "MONO")
ID_RULE = "1 to 64 of A-Z a-z 0-9 _ - . , not starting with a dot"
MAX_SIDE_PX = 65_535
MAX_BINNING = 3.0
_AXIS = "0 <= degrees < 180"


class RigError(InputError):
    """A rig, or a rig file, that cannot be used."""


def is_id(text: str) -> bool:
    """Return whether ``text`` may name a step, view, light or box (and so be part of a file name).

    Examples
    --------
    >>> is_id("cam-0"), is_id("../cam"), is_id("")
    (True, False, False)
    """
    letters = all(c.isascii() and (c.isalnum() or c in "_-.") for c in text)
    return letters and 1 <= len(text) <= 64 and not text.startswith(".")


@dataclass(frozen=True, slots=True, kw_only=True)
class Light:
    """One light of the rig: a flash, which gives its energy in one pop, or an LED.

    Angles of axes are measured in the plane across the light's beam from the horizontal (+x of a
    camera at +z) towards +y, in degrees. A light points at the rig's origin.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    name: str
    position_mm: Vector
    """Centre of the emitting disc, mm, rig frame."""
    illuminant: str = "D55"
    """Name of the spectrum, see ``model.spectra.illuminant``."""
    polarizer_axis_deg: float | None = None
    """Axis of the polarizer in front of the light, degrees, 0 <= axis < 180; None: no polarizer."""
    energy_ws: float | None = None
    """Of a flash: energy of one pop at power 1, Ws (J), > 0; None: the light is no flash."""
    power_w: float | None = None
    """Of an LED: optical power at level 1, W, > 0; None: the light is no LED."""
    half_intensity_deg: float | None = None
    """Angle off the light's axis where its intensity has halved, falling as a power of the cosine,
    0 < degrees < 90; None: the same in all directions."""
    radius_mm: float
    """Radius of the emitting disc, mm, > 0."""

    def __post_init__(self) -> None:
        checks = Checks(f"Light {self.name!r}", RigError)
        checks.that("name", self.name, is_id(self.name), ID_RULE)
        checks.finite(position_mm=self.position_mm)
        checks.that("position_mm", self.position_mm, _norm(self.position_mm) > 0, "not the origin")
        checks.that("illuminant", self.illuminant, bool(self.illuminant), "a name")
        axis, half = self.polarizer_axis_deg, self.half_intensity_deg
        checks.that("polarizer_axis_deg", axis, axis is None or 0 <= axis < 180, _AXIS)
        checks.that("half_intensity_deg", half, half is None or 0 < half < 90, "0 < degrees < 90")
        strengths = {"energy_ws": self.energy_ws, "power_w": self.power_w}
        given = {name: value for name, value in strengths.items() if value is not None}
        checks.that("energy_ws, power_w", tuple(given), len(given) == 1, "one of the two")
        checks.positive(radius_mm=self.radius_mm, **given)
        checks.close()

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
        exponent = math.log(0.5) / math.log(math.cos(math.radians(self.half_intensity_deg)))
        return max(math.cos(off_axis_rad), 0.0) ** exponent


@dataclass(frozen=True, slots=True, kw_only=True)
class LedLimits:
    """What LEDs may do near eyes and skin, and what their driver can; a box may allow less.

    The numbers are this project's nominal ones, not a certificate: an assembled dome is measured.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    max_on_s: float = 0.5
    """Longest time an LED stays on for one command or row, s, > 0."""
    max_duty: float = 0.25
    """Most mean level of an LED over ``duty_window_s``, 0 < duty <= 1."""
    duty_window_s: float = 1.0
    """Time over which duty is taken, s, > 0."""
    thermal_tau_s: float = 4.0
    """Time constant of an LED's temperature, s, > 0."""
    thermal_trip: float = 0.6
    """Temperature at which its driver trips, 0 < trip < 1; 1 is where it would settle when on."""
    dose_ws: float = 50.0
    """Most light an LED may send out to one subject, Ws, > 0."""
    max_at_once: int = 24
    """Most LEDs that may be on together, >= 2."""
    max_flashes_per_s: float = 3.0
    """Flashes seen by open eyes in any second must stay below this, > 0."""
    max_flicker_rms: float = 0.25
    """Most light of 3 to 65 Hz at open eyes, rms over mean, > 0."""
    overlap_s: float = 1e-4
    """How long before one LED goes off the next one is on, s, >= 0."""
    settle_s: float = 1e-3
    """Time from an LED's turn to the cameras' release, s, >= ``overlap_s``."""
    max_rows: int = 1024
    """Longest table the box holds, >= 1."""

    def __post_init__(self) -> None:
        checks = Checks("LED limits", RigError)
        counts = ("max_at_once", "max_rows", "overlap_s", "settle_s")
        fields = [field.name for field in dataclasses.fields(self)]
        checks.positive(**{name: getattr(self, name) for name in fields if name not in counts})
        checks.that("max_duty", self.max_duty, self.max_duty <= 1, "0 < duty <= 1")
        checks.that("thermal_trip", self.thermal_trip, self.thermal_trip < 1, "0 < trip < 1")
        checks.that("max_at_once", self.max_at_once, self.max_at_once >= 2, ">= 2")
        checks.that("max_rows", self.max_rows, self.max_rows >= 1, ">= 1")
        good = 0 <= self.overlap_s <= self.settle_s < math.inf
        checks.that("settle_s", self.settle_s, good, f"0 <= overlap_s {self.overlap_s} <= settle_s")
        checks.close()


@dataclass(frozen=True, slots=True, kw_only=True)
class Caliper:
    """A caliper whose jaws are taped to the skin, and stretch or compress what lies between.

    How much force it may use is no property of the rig: who captures must say it.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    aperture_mm: float
    """Distance of the jaws at step 0, mm, > 0."""
    step_mm: float
    """How far a step moves them, mm, > 0."""
    first_step: int
    """Narrowest position, <= 0."""
    last_step: int
    """Widest position, >= 0."""
    angles_deg: tuple[float, ...]
    """Angles that it can be set to, from +x towards +y, 0 <= degrees < 180."""
    speed_mm_per_s: float
    """How fast the jaws move, mm/s, > 0."""
    settle_s: float = 0.3
    """How long the skin is left to creep after a move before it is scanned, s, >= 0."""

    def __post_init__(self) -> None:
        checks = Checks("Caliper", RigError)
        checks.positive(
            aperture_mm=self.aperture_mm,
            step_mm=self.step_mm,
            speed_mm_per_s=self.speed_mm_per_s,
        )
        checks.that("settle_s", self.settle_s, 0 <= self.settle_s < math.inf, "seconds >= 0")
        open_mm = self.aperture_mm + self.first_step * self.step_mm
        narrow = self.first_step <= 0 and open_mm > 0
        checks.that("first_step", self.first_step, narrow, "<= 0, and the jaws apart")
        checks.that("last_step", self.last_step, self.last_step >= 0, ">= 0")
        for angle in self.angles_deg:
            checks.that("angles_deg", angle, 0 <= angle < 180, _AXIS)
        differ = len(set(self.angles_deg)) == len(self.angles_deg) > 0
        checks.that("angles_deg", self.angles_deg, differ, "at least one, none twice")
        checks.close()

    def reading_mm(self, step: int) -> float:
        """Return the distance of the jaws at a step, mm.

        Examples
        --------
        >>> load_rig("gradient").caliper.reading_mm(-2)
        6.4
        """
        return self.aperture_mm + step * self.step_mm


@dataclass(frozen=True, slots=True, kw_only=True)
class Fibre:
    """One detection fibre of a contact probe, from the head's face to its end before the camera."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    name: str
    position_mm: tuple[float, float]
    """Centre on the head's face from the source fibre's centre, mm; x along the line of fibres."""
    core_mm: float
    """Diameter of the core, mm, > 0."""
    numerical_aperture: float
    """Sine of the half angle in air that the fibre takes light from, 0 < NA < 1."""
    spot_px: tuple[float, float]
    """Nominal centre of its end in the camera's image, pixels, x right, y down."""

    def __post_init__(self) -> None:
        checks = Checks(f"Fibre {self.name!r}", RigError)
        checks.that("name", self.name, is_id(self.name), ID_RULE)
        checks.finite(position_mm=self.position_mm, spot_px=self.spot_px)
        checks.positive(core_mm=self.core_mm, numerical_aperture=self.numerical_aperture)
        na = self.numerical_aperture
        checks.that("numerical_aperture", na, na < 1, "0 < NA < 1")
        checks.close()

    @property
    def radius_mm(self) -> float:
        """Distance from the source fibre's centre, mm."""
        return math.hypot(*self.position_mm)


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """A contact probe: one source fibre and a line of detection fibres, held on by suction.

    The rig's one light is what comes out of the source fibre, at the origin of the rig's frame;
    +x is along the line of fibres and +z out of the skin.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    fibres: tuple[Fibre, ...]
    """By growing distance from the source."""
    source_core_mm: float
    """Diameter of the source fibre's core, mm, > 0."""
    source_numerical_aperture: float
    """Sine of the half angle in air of the light that it sends out, 0 < NA < 1."""
    suction_mbar: float
    """Suction at which the head is held on the skin, mbar below the air's pressure, > 0."""
    suction_tolerance_mbar: float
    """How far from it a measurement may go on, mbar, > 0."""
    max_suction_mbar: float
    """The most that the pump may draw, mbar, > 0."""
    max_suction_s: float
    """Longest time that skin is sucked at without a rest, s, > 0."""
    rest_s: float
    """Rest between two such times, vented, s, >= 0."""
    settle_s: float
    """Time from the suction's being reached to the first exposure, s, >= 0."""
    max_open_s: float = 30.0
    """Longest time that the source's shutter stays open for one command, s, > 0."""
    camera_c: float
    """Temperature at which the camera is kept, degrees Celsius."""
    camera_tolerance_c: float
    """How far from it a measurement may go on, kelvin, > 0."""

    def __post_init__(self) -> None:
        checks = Checks("Probe", RigError)
        names = tuple(fibre.name for fibre in self.fibres)
        differ = len(set(names)) == len(names) > 0
        checks.that("fibres", names, differ, "at least one, names that differ")
        radii = tuple(fibre.radius_mm for fibre in self.fibres)
        grow = all(a < b for a, b in zip((0.0, *radii), radii, strict=False))
        checks.that("fibres", radii, grow, "growing distances > 0 from the source")
        fields = [field.name for field in dataclasses.fields(self)]
        free = ("fibres", "rest_s", "settle_s", "camera_c")
        checks.positive(**{name: getattr(self, name) for name in fields if name not in free})
        na = self.source_numerical_aperture
        checks.that("source_numerical_aperture", na, na < 1, "0 < NA < 1")
        for name in ("rest_s", "settle_s"):
            seconds = getattr(self, name)
            checks.that(name, seconds, 0 <= seconds < math.inf, "seconds >= 0")
        most = self.max_suction_mbar
        fits = self.suction_mbar + self.suction_tolerance_mbar <= most
        checks.that("suction_mbar", self.suction_mbar, fits, f"with its tolerance <= {most}")
        kept = -80.0 <= self.camera_c <= 60.0
        checks.that("camera_c", self.camera_c, kept, "-80 to 60 degrees Celsius")
        checks.close()

    @property
    def radius_mm(self) -> tuple[float, ...]:
        """Distances of the fibres from the source, mm.

        Examples
        --------
        >>> radii = load_rig("probe").probe.radius_mm
        >>> len(radii), radii[0], radii[-1]
        (28, 0.3, 7.05)
        """
        return tuple(fibre.radius_mm for fibre in self.fibres)


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """One camera of the rig: pinhole, sensor and analyser, all nominal."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    name: str
    camera_model: str
    serial: str
    position_mm: Vector
    """Centre of projection, mm, rig frame."""
    target_mm: Vector
    """Point on the optical axis, mm, rig frame."""
    up: Vector
    """Direction that is up in the image, rig frame, any length."""
    focal_mm: float
    """Distance from centre of projection to sensor, mm, > 0."""
    pixel_um: float
    """Pixel pitch, um, > 0."""
    width_px: int
    height_px: int
    f_number: float
    readout_s: float
    """Time from the end of one exposure to readiness for the next, s, >= 0."""
    bit_depth: int
    """Bits of the converter, 8 to 16."""
    cfa: Pattern
    """Colors of the 2 x 2 cell read row by row, or MONO."""
    black_level: int
    """DN of no light."""
    white_level: int
    """DN of saturation, at most 2**bit_depth - 1."""
    spectral_sensitivity: str = "Nikon 5100 (NPL)"
    """Name of the curves, see ``model.spectra.camera_sensitivity``."""
    analyser_axis_deg: float | None = None
    """Axis of the analyser at rotator reading 0 (the parallel state), degrees, 0 <= axis < 180;
    None: no analyser."""
    full_well_e: float
    """Electrons at ``white_level``, > 0."""
    read_noise_e: float
    """Read noise, electrons rms, >= 0."""
    shutter_lag_s: float = 0.0
    """Time from the trigger's edge until the shutter is fully open, s, >= 0."""
    focus_mm: float | None = None
    """Distance from the centre of projection to the plane in focus, mm, > 0; None: that of the
    target."""

    def __post_init__(self) -> None:
        checks = Checks(f"View {self.name!r}", RigError)
        checks.that("name", self.name, is_id(self.name), ID_RULE)
        for field in ("camera_model", "serial", "spectral_sensitivity"):
            text = getattr(self, field)
            checks.that(field, text, bool(text) and text.isprintable(), "a printable text")
        checks.finite(position_mm=self.position_mm, target_mm=self.target_mm, up=self.up)
        axis = _minus(self.position_mm, self.target_mm)
        checks.that("target_mm", self.target_mm, _norm(axis) > 0, "not the camera's own position")
        checks.that("up", self.up, _norm(_cross(self.up, axis)) > 0, "not along the optical axis")
        checks.positive(
            focal_mm=self.focal_mm,
            pixel_um=self.pixel_um,
            f_number=self.f_number,
            full_well_e=self.full_well_e,
        )
        if self.focus_mm is not None:
            checks.positive(focus_mm=self.focus_mm)
        step = 1 if self.cfa == "MONO" else 2
        for field in ("width_px", "height_px"):
            size = getattr(self, field)
            even = 2 <= size <= MAX_SIDE_PX and size % step == 0
            checks.that(field, size, even, f"2 to {MAX_SIDE_PX}, even for a color filter array")
        for field in ("readout_s", "shutter_lag_s"):
            seconds = getattr(self, field)
            checks.that(field, seconds, 0 <= seconds < math.inf, "seconds >= 0")
        checks.that("bit_depth", self.bit_depth, 8 <= self.bit_depth <= 16, "8 to 16")
        checks.that("cfa", self.cfa, self.cfa in PATTERNS, f"one of {', '.join(PATTERNS)}")
        checks.that("black_level", self.black_level, self.black_level >= 0, ">= 0")
        top = 2**self.bit_depth - 1 if 8 <= self.bit_depth <= 16 else 65_535
        checks.that(
            "white_level",
            self.white_level,
            self.black_level < self.white_level <= top,
            f"black_level {self.black_level} < white_level <= {top}",
        )
        analyser = self.analyser_axis_deg
        checks.that("analyser_axis_deg", analyser, analyser is None or 0 <= analyser < 180, _AXIS)
        checks.that("read_noise_e", self.read_noise_e, 0 <= self.read_noise_e < math.inf, ">= 0")
        checks.close()

    @property
    def focal_px(self) -> float:
        """Focal length in pixels (square pixels)."""
        return self.focal_mm * 1e3 / self.pixel_um

    @property
    def distance_mm(self) -> float:
        """Distance from camera to target, mm."""
        return _norm(_minus(self.position_mm, self.target_mm))

    @property
    def focus_distance_mm(self) -> float:
        """Distance from the centre of projection to the plane in focus, mm."""
        return self.distance_mm if self.focus_mm is None else self.focus_mm

    @property
    def field_mm(self) -> tuple[float, float]:
        """Width and height seen at the target's distance, mm.

        Examples
        --------
        >>> [round(side, 1) for side in load_rig("flash").view("cam").field_mm]
        [260.7, 173.8]
        """
        scale = self.distance_mm / self.focal_px
        return self.width_px * scale, self.height_px * scale

    @property
    def axes(self) -> tuple[Vector, Vector, Vector]:
        """Unit vectors right, up and back (from target to camera) of the image, rig frame."""
        back = _unit(_minus(self.position_mm, self.target_mm))
        right = _unit(_cross(self.up, back))
        return right, _cross(back, right), back

    @property
    def gain_e_per_dn(self) -> float:
        """Nominal conversion gain, electrons per DN."""
        return self.full_well_e / (self.white_level - self.black_level)

    def resized(self, width_px: int) -> View:
        """Return this view with ``width_px`` columns and the same field of view; rows stay even.

        Pixels grow as if the sensor's own were binned: a pixel of k times the side holds k^2
        times the electrons, and its read noise is k times as large; no further than 3 x 3, where
        the levels of the converter would begin to hide the noise.
        """
        step = 1 if self.cfa == "MONO" else 2
        if not 2 <= width_px <= MAX_SIDE_PX or width_px % step:
            raise RigError(
                f"View {self.name!r} cannot be resized",
                faults=[
                    Fault("width_px", str(width_px), f"2 to {MAX_SIDE_PX}, a multiple of {step}")
                ],
            )
        factor = self.width_px / width_px
        height_px = max(step * round(self.height_px / factor / step), 2)
        binned = min(max(factor, 1.0), MAX_BINNING)
        return dataclasses.replace(
            self,
            width_px=width_px,
            height_px=height_px,
            pixel_um=self.pixel_um * factor,
            full_well_e=self.full_well_e * binned**2,
            read_noise_e=self.read_noise_e * binned,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Rig:
    """Lights, views and boxes with their limits; lengths in mm in the rig frame.

    The frame's origin is the subject's centre; +x right, +y up, +z towards the main camera.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    name: str
    lights: tuple[Light, ...]
    views: tuple[View, ...]
    boxes: tuple[str, ...]
    """Names of the controllers that drive the lights."""
    recycle_s: float
    """Least time between two pops of a flash at power 1, s, >= 0; 0 where no light is a flash."""
    max_pops_per_min: float = 20.0
    """Most pops in any minute, > 0."""
    polarizer_move_s: float = 0.5
    """Time to turn the analyser, s, >= 0."""
    leds: LedLimits | None = None
    """Limits of the rig's LEDs; None: it has none."""
    caliper: Caliper | None = None
    """What stretches the skin; None: nothing does."""
    probe: Probe | None = None
    """What touches the skin with fibres; None: nothing does."""

    def __post_init__(self) -> None:
        checks = Checks(f"Rig {self.name!r}", RigError)
        checks.that("name", self.name, is_id(self.name), ID_RULE)
        for field, rows in (("lights", self.lights), ("views", self.views)):
            names = tuple(row.name for row in rows)
            checks.that(field, names, len(rows) > 0, "at least one")
            checks.that(
                field, names, len({n.casefold() for n in names}) == len(names), "names that differ"
            )
        good = all(is_id(box) for box in self.boxes) and len(set(self.boxes)) == len(self.boxes)
        checks.that("boxes", self.boxes, good, f"names that differ, of {ID_RULE}")
        checks.that("recycle_s", self.recycle_s, 0 <= self.recycle_s < math.inf, "seconds >= 0")
        checks.positive(max_pops_per_min=self.max_pops_per_min)
        move = self.polarizer_move_s
        checks.that("polarizer_move_s", move, 0 <= move < math.inf, "seconds >= 0")
        has_leds = any(light.power_w is not None for light in self.lights)
        known = self.leds is not None or not has_leds
        checks.that("leds", self.leds, known, "the limits of the LEDs among the lights")
        checks.close()

    def view(self, name: str) -> View:
        """Return the view called ``name``."""
        return _named(self.views, name, f"rig {self.name!r} has no view {name!r}")

    def light(self, name: str) -> Light:
        """Return the light called ``name``."""
        return _named(self.lights, name, f"rig {self.name!r} has no light {name!r}")

    def resized(self, width_px: int) -> Rig:
        """Return this rig with every view ``width_px`` wide: same field of view, larger pixels.

        Examples
        --------
        >>> small = load_rig("flash").resized(504).view("cam")
        >>> small.width_px, small.height_px, small.pixel_um
        (504, 336, 45.0)
        """
        return dataclasses.replace(self, views=tuple(v.resized(width_px) for v in self.views))

    def cropped(self, width_px: int) -> Rig:
        """Return this rig with the middle ``width_px`` columns and as many rows of every view.

        Examples
        --------
        >>> small = load_rig("gradient").cropped(512).view("cam")
        >>> small.height_px, round(small.field_mm[0], 3), small.pixel_um
        (512, 3.072, 5.5)
        """
        views = tuple(
            dataclasses.replace(v, width_px=width_px, height_px=width_px) for v in self.views
        )
        return dataclasses.replace(self, views=views)

    def subset(
        self, *, lights: Sequence[str] | None = None, views: Sequence[str] | None = None
    ) -> Rig:
        """Return this rig with some of its lights and views only, in the rig's own order.

        Parameters
        ----------
        lights, views : sequence of str
            Names to keep; None keeps all.

        Raises
        ------
        RigError
            Where a name is not of this rig.
        """
        kept_lights = [self.light(name) for name in lights] if lights is not None else self.lights
        kept_views = [self.view(name) for name in views] if views is not None else self.views
        return dataclasses.replace(
            self,
            lights=tuple(light for light in self.lights if light in kept_lights),
            views=tuple(view for view in self.views if view in kept_views),
        )

    def to_json(self) -> dict[str, Any]:
        """Return the rig as JSON values; ``rig_from_json`` is the inverse."""
        return dataclasses.asdict(self)


def rig_from_json(data: Mapping[str, Any], *, where: str = "rig") -> Rig:
    """Build a rig from decoded JSON or TOML, listing all faults at once.

    Raises
    ------
    RigError
        With every fault's path, what was found and what was expected.
    """
    return parse(Rig, data, where=where, error=RigError)


def load_rig(name_or_path: str | Path) -> Rig:
    """Return a rig that ships with the package, or one described in a TOML file.

    Parameters
    ----------
    name_or_path : str or Path
        ``"flash"``, or a path (anything that ends in ``.toml`` or holds a separator).

    Raises
    ------
    RigError
        Where the file is missing or has faults; all of them are listed.

    Examples
    --------
    >>> rig = load_rig("flash")
    >>> [light.name for light in rig.lights], rig.view("cam").width_px
    (['left', 'right'], 3024)
    """
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or text.endswith(".toml") or "/" in text:
        path = Path(name_or_path)
    else:
        shipped = Path(str(files("capture"))) / "rigs"
        known = sorted(file.stem for file in shipped.glob("*.toml"))
        if text not in known:
            hint = (
                near_miss(text, known) or f"one of {', '.join(known)}, or the path of a .toml file"
            )
            raise RigError("there is no such rig", faults=[Fault("rig", repr(text), hint)])
        path = shipped / f"{text}.toml"
    return rig_from_json(read_toml(path, error=RigError), where=str(path))


MOST_LISTED = 40
"""Names of lights or views that a message lists; of more it tells the first ones and the last."""


def _named(rows: tuple[Any, ...], name: str, what: str) -> Any:
    for row in rows:
        if row.name == name:
            return row
    known = [row.name for row in rows]
    listed = ", ".join(known)
    if len(known) > MOST_LISTED:
        listed = f"{', '.join(known[:2])} … {known[-1]}, {len(known)} in all"
    fault = Fault("name", repr(name), f"one of {listed}", near_miss(name, known))
    raise RigError(what, faults=[fault])


def _minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _norm(a: Vector) -> float:
    return math.hypot(*a)


def _unit(a: Vector) -> Vector:
    length = _norm(a)
    return a[0] / length, a[1] / length, a[2] / length
