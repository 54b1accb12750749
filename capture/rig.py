"""The nominal rig: lights, views and boxes, read from a TOML file and frozen.

What it is made of are modules of their own: `capture.view` (a camera with its geometry) and
`capture.rig_parts` (all else); their names are found here, too.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar

from pydantic import ConfigDict

from capture.documents import STRICT_CONFIG, Checks, Fault, near_miss, parse, read_toml
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
    "Rig",
    "RigError",
    "Vector",
    "View",
    "is_id",
    "load_rig",
    "rig_from_json",
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rig:
    """Lights, views and boxes with their limits; lengths in mm in the rig frame.

    The frame's origin is the subject's centre; +x right, +y up, +z towards the main camera.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT_CONFIG

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


MAX_LISTED_NAMES = 40
"""Names of lights or views that a message lists; of more it tells the first ones and the last."""


def _named(rows: tuple[Any, ...], name: str, what: str) -> Any:
    for row in rows:
        if row.name == name:
            return row
    known = [row.name for row in rows]
    listed = ", ".join(known)
    if len(known) > MAX_LISTED_NAMES:
        listed = f"{', '.join(known[:2])} … {known[-1]}, {len(known)} in all"
    fault = Fault("name", repr(name), f"one of {listed}", near_miss(name, known))
    raise RigError(what, faults=[fault])
