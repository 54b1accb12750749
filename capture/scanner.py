"""Face scanner of a rig: projectors of stripes between cameras, nominal."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal, get_args

from capture.documents import Document, FaultCollector
from capture.rig_parts import ID_RULE, RigError, Vector, is_id
from capture.view import View

StripeAxis = Literal["columns", "rows"]
STRIPE_AXES: tuple[str, ...] = get_args(StripeAxis)
MIN_PHASE_STEPS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Projector(Document):
    """Projector of a scanner: lens and display, nominal."""

    name: str
    model: str
    serial: str
    position_mm: Vector
    """Center of projection, mm, rig frame."""
    target_mm: Vector
    """Point on the optical axis, in focus, mm, rig frame."""
    up: Vector
    """Direction that is up in the image, rig frame, any length."""
    focal_mm: float
    """Distance from center of projection to display, mm, > 0."""
    pixel_um: float
    """Pixel pitch of the display, um, > 0."""
    width_px: int
    height_px: int
    f_number: float
    illuminant: str = "LED-B3"
    """Name of the light's spectrum in `model.spectra`."""
    power_w: float
    """Optical power of the full white image, W, > 0."""
    cameras: tuple[str, ...]
    """Views of the scanner that take its stripes."""

    def __post_init__(self) -> None:
        checks = FaultCollector(f"Projector {self.name!r}", RigError)
        checks.check("name", self.name, is_id(self.name), ID_RULE)
        for field in ("model", "serial", "illuminant"):
            text = getattr(self, field)
            checks.check(field, text, bool(text) and text.isprintable(), "a printable text")
        checks.check_positive(power_w=self.power_w)
        count = len(set(self.cameras))
        checks.check("cameras", self.cameras, count == len(self.cameras) > 0, "some, none twice")
        checks.close()
        _ = self.pinhole  # checks position, lens and display

    @property
    def pinhole(self) -> View:
        """The projector as an inverse camera, whose pixels are those of its display."""
        return View(
            name=self.name,
            camera_model=self.model,
            serial=self.serial,
            position_mm=self.position_mm,
            target_mm=self.target_mm,
            up=self.up,
            focal_mm=self.focal_mm,
            pixel_um=self.pixel_um,
            width_px=self.width_px,
            height_px=self.height_px,
            f_number=self.f_number,
            readout_s=0.0,
            bit_depth=8,
            cfa="MONO",
            black_level=0,
            white_level=255,
            full_well_e=1.0,
            read_noise_e=0.0,
        )

    def length_px(self, axis: str) -> int:
        """Return the number of columns or rows of the display."""
        return self.width_px if axis == "columns" else self.height_px


@dataclass(frozen=True, slots=True, kw_only=True)
class Scanner(Document):
    """Scanner of the face: its projectors, cameras and patterns.

    The patterns of an axis are first the bits of the reflected Gray code of cells of half a
    period, the most significant first, then the steps n = 0 to N - 1 of the sinusoid
    ``(1 + cos(2 pi (x / period - n / N))) / 2``, with x the number of the column or row.
    """

    projectors: tuple[Projector, ...]
    views: tuple[View, ...]
    period_px: int
    """Period of the sinusoid, projector pixels, even."""
    phase_steps: int
    """Number of steps of the sinusoid, >= 3."""
    exposure_s: float
    """Exposure of the cameras, s, > 0."""
    settle_s: float = 0.02
    """Time from the command to the cameras' release, s, >= 0."""
    max_show_s: float = 0.5
    """Longest time that a pattern is shown per command, s, > 0."""
    range_mm: tuple[float, float]
    """Shortest and longest distance of skin from a camera, mm."""

    def __post_init__(self) -> None:
        checks = FaultCollector("Scanner", RigError)
        names = [row.name for row in self.projectors] + [row.name for row in self.views]
        differ = len({name.casefold() for name in names}) == len(names)
        checks.check("projectors", names, bool(self.projectors) and differ, "names that differ")
        known = {view.name for view in self.views}
        for projector in self.projectors:
            wrong = set(projector.cameras) - known
            checks.check(
                f"cameras of {projector.name}", projector.cameras, not wrong, f"of {sorted(known)}"
            )
            fits = self.period_px <= min(projector.width_px, projector.height_px)
            checks.check("period_px", self.period_px, fits, "at most the display's sides")
        even = self.period_px >= 2 and self.period_px % 2 == 0
        checks.check("period_px", self.period_px, even, "even, >= 2")
        enough = self.phase_steps >= MIN_PHASE_STEPS
        checks.check("phase_steps", self.phase_steps, enough, f">= {MIN_PHASE_STEPS}")
        checks.check_positive(exposure_s=self.exposure_s, max_show_s=self.max_show_s)
        checks.check("settle_s", self.settle_s, 0 <= self.settle_s < math.inf, "seconds >= 0")
        fits = self.settle_s + self.exposure_s <= self.max_show_s
        checks.check("max_show_s", self.max_show_s, fits, ">= settle_s + exposure_s")
        near, far = self.range_mm
        checks.check("range_mm", self.range_mm, 0 < near < far < math.inf, "0 < shortest < longest")
        checks.close()

    def projector(self, name: str) -> Projector:
        """Return the projector called ``name``."""
        for projector in self.projectors:
            if projector.name == name:
                return projector
        names = ", ".join(projector.name for projector in self.projectors)
        raise RigError(f"projector: got {name!r}, expected one of {names}")

    def gray_bits(self, length_px: int) -> int:
        """Return the number of bits of the Gray code along an axis of that length.

        Examples
        --------
        >>> from capture.rig import load_rig
        >>> load_rig("dome").scanner.gray_bits(800)
        6
        """
        return math.ceil(math.log2(2 * length_px / self.period_px))

    def pattern_count(self, projector: Projector, axis: str) -> int:
        """Return the number of patterns along an axis of a projector."""
        return self.gray_bits(projector.length_px(axis)) + self.phase_steps

    def resized(self, width_px: int) -> Scanner:
        """Return this scanner with cameras ``width_px`` wide; see `View.resized`."""
        return dataclasses.replace(self, views=tuple(v.resized(width_px) for v in self.views))
