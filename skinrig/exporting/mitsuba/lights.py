"""Write the LEDs of a dome for Mitsuba: as tables of the plugin `ledarray`, and as spot lights."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from rigsim.as_built.dome import ActualDome
from rigsim.light.led_light import lobe_exponent, white_intensity
from rigsim.mitsuba.led_array import LED_COLUMNS, led_table
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
CUTOFF_DEG: Final = 45.0
"""Half-angle of a stock light's cone; a face of the rig subtends less than 15 degrees."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneLight:
    """An LED of the actual dome.

    Attributes
    ----------
    name
        Name in the rig.
    position_mm
        (3,), rig frame.
    axis
        (3,) unit vector in which the LED shines.
    intensity
        (3,) radiance of white in camera RGB, times mm^2: full scales per second on the axis at
        level 1, times pi, so that a material in 1/sr gives the session's signal; 0 for a dead LED.
    exponent
        n of the lobe cos^n off the axis.
    radius_mm
        Radius of the emitting disc.
    """

    name: str
    position_mm: Float64Array
    axis: Float64Array
    intensity: Float64Array
    exponent: float
    radius_mm: float


def list_lights(dome: ActualDome) -> list[SceneLight]:
    """Return the LEDs of an actual dome, in the order of the rig, for its first camera's colors."""
    view = dome.rig.views[0]
    return [
        SceneLight(
            light.name,
            np.asarray(light.position_mm, np.float64),
            np.asarray(axis, np.float64),
            math.pi * white_intensity(light, view) * float(light.name not in dome.dead),
            lobe_exponent(light),
            light.radius_mm,
        )
        for light, axis in zip(dome.rig.lights, dome.axis, strict=True)
    ]


def write_light_tables(lights: Sequence[SceneLight], folder: Path) -> None:
    """Write one table per LED, and one with all, for the emitter `ledarray`.

    Parameters
    ----------
    lights
        LEDs.
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
    )
    rows = [",".join(format(float(value), ".9g") for value in row) for row in table]
    single = {light.name: [row] for light, row in zip(lights, rows, strict=True)}
    for name, chosen in {ALL_LIGHTS: rows, **single}.items():
        lines = [",".join(LED_COLUMNS), *chosen, ""]
        (folder / TABLE_FOLDER / f"{name}.csv").write_text("\n".join(lines), encoding="ascii")


def describe_led_array() -> Element:
    """Return the LEDs of the scene's parameter ``light``: one, or all."""
    table = build_property("filename", f"{TABLE_FOLDER}/$light.csv")
    return build_plugin("emitter", "ledarray", table, id="leds")


def write_stock_lights(lights: Sequence[SceneLight], folder: Path) -> None:
    """Write one file per LED, and one with all, as Mitsuba's spot lights with the lobes' images.

    Parameters
    ----------
    lights
        LEDs.
    folder
        The scene's folder; files go to ``lights-stock``.
    """
    (folder / STOCK_FOLDER).mkdir()
    for light in lights:
        about = {"comments": f"relative intensity of {light.name}, cone of {CUTOFF_DEG:g} degrees"}
        write_channels(
            folder / STOCK_FOLDER / f"{light.name}.exr", {"Y": sample_lobe(light.exponent)}, about
        )
        write_scene(folder / STOCK_FOLDER / f"{light.name}.xml", [_describe_spot(light)])
    write_scene(folder / STOCK_FOLDER / f"{ALL_LIGHTS}.xml", map(_describe_spot, lights))


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


def _describe_spot(light: SceneLight) -> Element:
    up = (0.0, 1.0, 0.0) if abs(light.axis[1]) < 0.9 else (1.0, 0.0, 0.0)
    # texels are centered half a texel inside the image: its cone is wider than the lobe's samples
    cutoff = math.atan(math.tan(math.radians(CUTOFF_DEG)) * LOBE_TEXELS / (LOBE_TEXELS - 1))
    return build_plugin(
        "emitter",
        "spot",
        build_pose(light.position_mm, light.position_mm + light.axis, up),
        build_property("cutoff_angle", math.degrees(cutoff)),
        build_property("beam_width", math.degrees(cutoff)),
        build_property("intensity", tuple(light.intensity)),
        build_texture("texture", f"{STOCK_FOLDER}/{light.name}.exr"),
        id=light.name,
    )
