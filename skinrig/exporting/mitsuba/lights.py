"""Write the lights of a rig for Mitsuba: as tables of the plugin `ledarray`, and as spot lights."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from rigsim.mitsuba.led_array import FILM_COLUMNS, LED_COLUMNS, led_table
from skinrig.arrays import Float32Array, Float64Array
from skinrig.exporting.images import write_channels
from skinrig.exporting.mitsuba.elements import (
    Element,
    build_plugin,
    build_pose,
    build_property,
    build_texture,
    write_scene,
)

ALL_LIGHTS: Final = "all"
STOCK_FOLDER: Final = "lights-stock"
TABLE_FOLDER: Final = "lights"
LOBE_TEXELS: Final = 65
"""Texels along a lobe's image; bilinear interpolation of a lobe is then exact within 0.03 %."""
POLARIZER_PAIR: Final = 0.25
"""Fraction of depolarized light that two ideal polarizers transmit."""
CUTOFF_DEG: Final = 45.0
"""Half-angle of a stock light's cone; a face of the rig subtends less than 15 degrees."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneLight:
    """An LED or a flash of an actual rig.

    Attributes
    ----------
    name
        Name in the rig.
    position_mm
        (3,), rig frame.
    axis
        (3,) unit vector in which the light shines.
    intensity
        (3,) radiant intensity on the axis at level 1 in camera RGB, so that a material in 1/sr
        gives the session's signal; before a polarizer; 0 for a dead LED.
    exponent
        n of the lobe cos^n off the axis.
    radius_mm
        Radius of the emitting disc.
    absorbs
        (3,) absorbing axis of its polarizer; None without one.
    leak
        Transmittance of the polarizer along that axis over that across it.
    """

    name: str
    position_mm: Float64Array
    axis: Float64Array
    intensity: Float64Array
    exponent: float
    radius_mm: float
    absorbs: Float64Array | None = None
    leak: float = 0.0


Levels = Mapping[str, Float64Array]
"""Level of each light, by the name of a pattern of lights."""


def single_lights(lights: Sequence[SceneLight]) -> Levels:
    """Return each light as a pattern of its name, after one of all."""
    single = {light.name: row for light, row in zip(lights, np.eye(len(lights)), strict=True)}
    return {ALL_LIGHTS: np.ones(len(lights)), **single}


def write_light_tables(lights: Sequence[SceneLight], levels: Levels, folder: Path) -> None:
    """Write one table per pattern of lights for the emitter `ledarray`.

    Parameters
    ----------
    lights
        Lights; either all have polarizers or none.
    levels
        Patterns.
    folder
        The scene's folder; files go to ``lights``.
    """
    (folder / TABLE_FOLDER).mkdir()
    table = led_table(
        [light.position_mm for light in lights],
        [light.axis for light in lights],
        intensity=[light.intensity for light in lights],
        exponent=[light.exponent for light in lights],
        radius_mm=[light.radius_mm for light in lights],
        absorbs=[light.absorbs for light in lights if light.absorbs is not None] or None,
        leak=[light.leak for light in lights],
    )
    header = ",".join((LED_COLUMNS + FILM_COLUMNS)[: table.shape[1]])
    for name, level in levels.items():
        table[:, LED_COLUMNS.index("level")] = level
        rows = [",".join(format(float(value), ".9g") for value in row) for row in table]
        lines = [header, *(row for row, lit in zip(rows, level, strict=True) if lit > 0.0), ""]
        (folder / TABLE_FOLDER / f"{name}.csv").write_text("\n".join(lines), encoding="ascii")


def describe_led_array() -> Element:
    """Return the lights of the pattern that the scene's parameter ``light`` names."""
    table = build_property("filename", f"{TABLE_FOLDER}/$light.csv")
    return build_plugin("emitter", "ledarray", table, id="leds")


def write_stock_lights(lights: Sequence[SceneLight], levels: Levels, folder: Path) -> None:
    """Write one file per pattern, with Mitsuba's spot lights and their lobes' images.

    A light with a polarizer has a quarter of its intensity, for its polarizer and the analyzer.

    Parameters
    ----------
    lights, levels
        Lights and patterns.
    folder
        The scene's folder; files go to ``lights-stock``.
    """
    (folder / STOCK_FOLDER).mkdir()
    for light in lights:
        about = {"comments": f"relative intensity of {light.name}, cone of {CUTOFF_DEG:g} degrees"}
        write_channels(
            folder / STOCK_FOLDER / f"{light.name}.exr", {"Y": sample_lobe(light.exponent)}, about
        )
    for name, level in levels.items():
        lit = [_describe_spot(a, k) for a, k in zip(lights, level, strict=True) if k > 0.0]
        write_scene(folder / STOCK_FOLDER / f"{name}.xml", lit)


def sample_lobe(exponent: float) -> Float32Array:
    """Return the relative intensity on a plane across the axis, shape (T, T); 1 in the middle.

    Examples
    --------
    >>> lobe = sample_lobe(2.0)
    >>> float(lobe[32, 32]), round(float(lobe[32, 64]), 6)
    (1.0, 0.5)
    """
    slope = np.linspace(-1.0, 1.0, LOBE_TEXELS) * math.tan(math.radians(CUTOFF_DEG))
    cosine = 1.0 / np.sqrt(1.0 + slope[:, None] ** 2 + slope**2)
    return np.asarray(cosine**exponent, np.float32)


def record_light(light: SceneLight) -> dict[str, Any]:
    """Return a light as JSON values."""
    record = {
        "name": light.name,
        "position_mm": light.position_mm.tolist(),
        "axis": light.axis.tolist(),
        "intensity": light.intensity.tolist(),
        "exponent": light.exponent,
        "radius_mm": light.radius_mm,
    }
    if light.absorbs is None:
        return record
    return record | {"absorbs": light.absorbs.tolist(), "leak": light.leak}


def _describe_spot(light: SceneLight, level: float) -> Element:
    passed = level if light.absorbs is None else POLARIZER_PAIR * level
    up = (0.0, 1.0, 0.0) if abs(light.axis[1]) < 0.9 else (1.0, 0.0, 0.0)
    # texels are centered half a texel inside the image: its cone is wider than the lobe's samples
    cutoff = math.atan(math.tan(math.radians(CUTOFF_DEG)) * LOBE_TEXELS / (LOBE_TEXELS - 1))
    return build_plugin(
        "emitter",
        "spot",
        build_pose(light.position_mm, light.position_mm + light.axis, up),
        build_property("cutoff_angle", math.degrees(cutoff)),
        build_property("beam_width", math.degrees(cutoff)),
        build_property("intensity", tuple(passed * light.intensity)),
        build_texture("texture", f"{STOCK_FOLDER}/{light.name}.exr"),
        id=light.name,
    )
