"""The nominal rig: lights, views and controllers, read from a TOML file and frozen.

The parts of a rig are in modules of their own: `capture.rig` (a camera with its geometry) and
`capture.rig_parts` (all others); their names are also available here.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from capture.documents import (
    Document,
    Fault,
    FaultCollector,
    parse_document,
    read_toml,
    suggest_key,
)
from capture.former_names import translate_names
from capture.rig_parts import (
    AXIS_RULE,
    ID_RULE,
    Caliper,
    Fiber,
    LedLimits,
    Light,
    Probe,
    RigError,
    Vector,
    is_id,
)

__all__ = [
    "CFA_PATTERNS",
    "ID_RULE",
    "MAX_SIDE_PX",
    "Caliper",
    "Fiber",
    "LedLimits",
    "Light",
    "Probe",
    "Rig",
    "RigError",
    "Vector",
    "View",
    "is_id",
    "load_rig",
    "rig_from_json",
]

Pattern = Literal["RGGB", "BGGR", "GRBG", "GBRG", "MONO"]

CFA_PATTERNS: tuple[str, ...] = ("RGGB", "BGGR", "GRBG", "GBRG", "MONO")
MAX_SIDE_PX = 65_535
MAX_BINNING = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class View(Document):
    """One camera of the rig: pinhole, sensor and analyzer, all nominal."""

    name: str
    camera_model: str
    serial: str
    position_mm: Vector
    """Center of projection, mm, rig frame."""
    target_mm: Vector
    """Point on the optical axis, mm, rig frame."""
    up: Vector
    """Direction that is up in the image, rig frame, any length."""
    focal_mm: float
    """Distance from center of projection to sensor, mm, > 0."""
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
    """Black level, DN."""
    white_level: int
    """Saturation level, DN, at most 2**bit_depth - 1."""
    spectral_sensitivity: str = "Nikon 5100 (NPL)"
    """Name of the curves, see ``model.spectra.camera_sensitivity``."""
    analyzer_axis_deg: float | None = None
    """Axis of the analyzer at rotator reading 0 (the parallel state), degrees, 0 <= axis < 180;
    None: no analyzer.
    """
    full_well_e: float
    """Electrons at ``white_level``, > 0."""
    read_noise_e: float
    """Read noise, electrons rms, >= 0."""
    shutter_lag_s: float = 0.0
    """Time from the trigger's edge until the shutter is fully open, s, >= 0."""
    focus_mm: float | None = None
    """Distance from the center of projection to the plane in focus, mm, > 0; None: that of the
    target.
    """

    def __post_init__(self) -> None:
        checks = FaultCollector(f"View {self.name!r}", RigError)
        checks.check("name", self.name, is_id(self.name), ID_RULE)
        for field in ("camera_model", "serial", "spectral_sensitivity"):
            text = getattr(self, field)
            checks.check(field, text, bool(text) and text.isprintable(), "a printable text")
        checks.check_finite(position_mm=self.position_mm, target_mm=self.target_mm, up=self.up)
        axis = _minus(self.position_mm, self.target_mm)
        checks.check("target_mm", self.target_mm, _norm(axis) > 0, "not the camera's own position")
        checks.check("up", self.up, _norm(_cross(self.up, axis)) > 0, "not along the optical axis")
        checks.check_positive(
            focal_mm=self.focal_mm,
            pixel_um=self.pixel_um,
            f_number=self.f_number,
            full_well_e=self.full_well_e,
        )
        if self.focus_mm is not None:
            checks.check_positive(focus_mm=self.focus_mm)
        step = 1 if self.cfa == "MONO" else 2
        for field in ("width_px", "height_px"):
            size = getattr(self, field)
            even = 2 <= size <= MAX_SIDE_PX and size % step == 0
            checks.check(field, size, even, f"2 to {MAX_SIDE_PX}, even for a color filter array")
        for field in ("readout_s", "shutter_lag_s"):
            seconds = getattr(self, field)
            checks.check(field, seconds, 0 <= seconds < math.inf, "seconds >= 0")
        checks.check("bit_depth", self.bit_depth, 8 <= self.bit_depth <= 16, "8 to 16")
        checks.check("cfa", self.cfa, self.cfa in CFA_PATTERNS, f"one of {', '.join(CFA_PATTERNS)}")
        checks.check("black_level", self.black_level, self.black_level >= 0, ">= 0")
        top = 2**self.bit_depth - 1 if 8 <= self.bit_depth <= 16 else 65_535
        checks.check(
            "white_level",
            self.white_level,
            self.black_level < self.white_level <= top,
            f"black_level {self.black_level} < white_level <= {top}",
        )
        analyzer = self.analyzer_axis_deg
        checks.check(
            "analyzer_axis_deg", analyzer, analyzer is None or 0 <= analyzer < 180, AXIS_RULE
        )
        checks.check("read_noise_e", self.read_noise_e, 0 <= self.read_noise_e < math.inf, ">= 0")
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
        """Distance from the center of projection to the plane in focus, mm."""
        return self.distance_mm if self.focus_mm is None else self.focus_mm

    @property
    def field_mm(self) -> tuple[float, float]:
        """Width and height of the field at the target's distance, mm.

        Examples
        --------
        >>> from capture.rig import load_rig
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

        Pixels grow as if the sensor's own were binned: a pixel of k times the side holds k^2 times
        the electrons, and its read noise is k times as large; at most 3 x 3, beyond which the
        levels of the converter would begin to hide the noise.
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


def _minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _norm(a: Vector) -> float:
    return math.hypot(*a)


def _unit(a: Vector) -> Vector:
    length = _norm(a)
    return a[0] / length, a[1] / length, a[2] / length


@dataclass(frozen=True, slots=True, kw_only=True)
class Rig(Document):
    """Lights, views and controllers with their limits; lengths in mm in the rig frame.

    The frame's origin is the subject's center; +x right, +y up, +z towards the main camera.
    """

    name: str
    lights: tuple[Light, ...]
    views: tuple[View, ...]
    boxes: tuple[str, ...]
    """Names of the controllers that drive the lights."""
    recycle_s: float
    """Minimum time between two flashes at power 1, s, >= 0; 0 without a flash."""
    max_pops_per_min: float = 20.0
    """Maximum number of flashes in any minute, > 0."""
    polarizer_move_s: float = 0.5
    """Time to turn the analyzer, s, >= 0."""
    leds: LedLimits | None = None
    """Limits of the rig's LEDs; None: it has none."""
    caliper: Caliper | None = None
    """Caliper that stretches the skin; None: the rig has none."""
    probe: Probe | None = None
    """Contact probe with fibers; None: the rig has none."""

    def __post_init__(self) -> None:
        checks = FaultCollector(f"Rig {self.name!r}", RigError)
        checks.check("name", self.name, is_id(self.name), ID_RULE)
        for field, rows in (("lights", self.lights), ("views", self.views)):
            names = tuple(row.name for row in rows)
            checks.check(field, names, len(rows) > 0, "at least one")
            checks.check(
                field, names, len({n.casefold() for n in names}) == len(names), "names that differ"
            )
        good = all(is_id(box) for box in self.boxes) and len(set(self.boxes)) == len(self.boxes)
        checks.check("boxes", self.boxes, good, f"names that differ, of {ID_RULE}")
        checks.check("recycle_s", self.recycle_s, 0 <= self.recycle_s < math.inf, "seconds >= 0")
        checks.check_positive(max_pops_per_min=self.max_pops_per_min)
        move = self.polarizer_move_s
        checks.check("polarizer_move_s", move, 0 <= move < math.inf, "seconds >= 0")
        has_leds = any(light.power_w is not None for light in self.lights)
        known = self.leds is not None or not has_leds
        checks.check("leds", self.leds, known, "the limits of the LEDs among the lights")
        checks.close()

    def view(self, name: str) -> View:
        """Return the view called ``name``."""
        return _find_by_name(self.views, name, f"rig {self.name!r} has no view {name!r}")

    def light(self, name: str) -> Light:
        """Return the light called ``name``."""
        return _find_by_name(self.lights, name, f"rig {self.name!r} has no light {name!r}")

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
        """Return this rig with only some of its lights and views, in the rig's own order.

        Parameters
        ----------
        lights, views : sequence of str
            Names to keep; None keeps all.

        Raises
        ------
        RigError
            When a name is not of this rig.
        """
        kept_lights = [self.light(name) for name in lights] if lights is not None else self.lights
        kept_views = [self.view(name) for name in views] if views is not None else self.views
        return dataclasses.replace(
            self,
            lights=tuple(light for light in self.lights if light in kept_lights),
            views=tuple(view for view in self.views if view in kept_views),
        )


def rig_from_json(data: Mapping[str, Any], *, where: str = "rig") -> Rig:
    """Build a rig from decoded JSON or TOML, listing all faults at once.

    Raises
    ------
    RigError
        With every fault's path, the value found and the value expected.
    """
    advice = "Correct these entries of the rig file."
    code = "SR-PLN-005"
    data = translate_names(data)
    return parse_document(Rig, data, where=where, error=RigError, advice=advice, code=code)


def load_rig(name_or_path: str | Path) -> Rig:
    """Return a rig that ships with the package, or one described in a TOML file.

    Parameters
    ----------
    name_or_path : str or Path
        ``"flash"``, or a path (anything that ends in ``.toml`` or contains a separator).

    Raises
    ------
    RigError
        When the file is missing or has faults; all of them are listed.

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
            expected = f"one of {', '.join(known)}, or the path of a .toml file"
            raise RigError(
                "rig not found",
                faults=[Fault("rig", repr(text), expected, suggest_key(text, known))],
                advice="Name a rig, or the path of a rig file.",
                code="SR-PLN-006",
            )
        path = shipped / f"{text}.toml"
    return rig_from_json(read_toml(path, error=RigError), where=str(path))


MAX_LISTED_NAMES = 40
"""Maximum number of lights or views in a message; of more it lists the first ones and the last."""


def _find_by_name(rows: tuple[Any, ...], name: str, label: str) -> Any:
    for row in rows:
        if row.name == name:
            return row
    known = [row.name for row in rows]
    listed = ", ".join(known)
    if len(known) > MAX_LISTED_NAMES:
        listed = f"{', '.join(known[:2])} … {known[-1]}, {len(known)} in all"
    fault = Fault("name", repr(name), f"one of {listed}", suggest_key(name, known))
    raise RigError(label, faults=[fault])
