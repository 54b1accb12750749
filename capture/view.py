"""A camera of the rig: pinhole, sensor and analyzer, all nominal."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

from capture.documents import Document, Fault, FaultCollector
from capture.rig_parts import AXIS_RULE, ID_RULE, RigError, Vector, is_id

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
