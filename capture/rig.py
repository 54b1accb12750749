"""The nominal rig: lights, views and controllers, read from a TOML file and frozen.

The parts of a rig are in modules of their own: `capture.view` (a camera with its geometry),
`capture.scanner` (projectors and their cameras) and `capture.rig_parts` (all others); their names
are also available here.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

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
from capture.scanner import Projector, Scanner
from capture.view import CFA_PATTERNS, MAX_SIDE_PX, View

__all__ = [
    "CFA_PATTERNS",
    "ID_RULE",
    "MAX_SIDE_PX",
    "Caliper",
    "Fiber",
    "LedLimits",
    "Light",
    "Probe",
    "Projector",
    "Rig",
    "RigError",
    "Scanner",
    "Vector",
    "View",
    "is_id",
    "load_rig",
    "rig_from_json",
]

SCANNER_BOX = "scanner"
"""Name of the controller of a scanner."""


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
    scanner: Scanner | None = None
    """Scanner of the face; it is used where ``boxes`` names its controller. None: none."""

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
        scanned = self.scanner is not None or SCANNER_BOX not in self.boxes
        checks.check("scanner", self.scanner, scanned, "the scanner that its controller drives")
        checks.close()

    @property
    def all_views(self) -> tuple[View, ...]:
        """The views, and those of the scanner where its controller is used."""
        if self.scanner is None or SCANNER_BOX not in self.boxes:
            return self.views
        return self.views + self.scanner.views

    def with_scanner(self) -> Rig:
        """Return this rig with its scanner in use.

        Raises
        ------
        RigError
            When the rig has none.

        Examples
        --------
        >>> load_rig("dome").with_scanner().boxes
        ('dome', 'scanner')
        """
        if self.scanner is None:
            raise RigError(f"scanner: rig {self.name!r} has none, expected a [scanner] section")
        if SCANNER_BOX in self.boxes:
            return self
        return dataclasses.replace(self, boxes=(*self.boxes, SCANNER_BOX))

    def view(self, name: str) -> View:
        """Return the view called ``name``, also of the scanner."""
        return _find_by_name(self.all_views, name, f"rig {self.name!r} has no view {name!r}")

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
        return dataclasses.replace(
            self,
            views=tuple(v.resized(width_px) for v in self.views),
            scanner=None if self.scanner is None else self.scanner.resized(width_px),
        )

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

    def at_iso(self, factor: float) -> Rig:
        """Return this rig with fewer electrons at full scale of its cameras, as at a higher ISO.

        Exposure times stay, and so do levels: each corresponds to fewer electrons, as if less
        light arrived. Shot noise grows by ``sqrt(factor)`` and read noise, relative to the level,
        by ``factor``. Cameras of the scanner stay nominal.

        Parameters
        ----------
        factor
            ISO over the nominal one, > 0.

        Raises
        ------
        RigError
            For another factor.

        Examples
        --------
        >>> cam = load_rig("flash").view("cam")
        >>> cam.full_well_e / load_rig("flash").at_iso(4.0).view("cam").full_well_e
        4.0
        """
        if not 0.0 < factor < math.inf:
            fault = Fault("factor", str(factor), "a number above 0")
            raise RigError("ISO cannot be changed", faults=[fault])
        views = tuple(
            dataclasses.replace(v, full_well_e=v.full_well_e / factor) for v in self.views
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
        return _read_packaged_rig(shipped / f"{text}.toml")
    return _read_rig(path)


def _read_rig(path: Path) -> Rig:
    return rig_from_json(read_toml(path, error=RigError), where=str(path))


@cache
def _read_packaged_rig(path: Path) -> Rig:
    """Read a rig file of the package once per process: a rig is immutable."""
    return _read_rig(path)


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
