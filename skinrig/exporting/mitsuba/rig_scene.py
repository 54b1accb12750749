"""Define the parts of an exported scene that depend on the rig."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from capture.rig import View
from rigsim.as_built.polarizers import POLARIZER_READING_DEG, Polarizers
from skinrig.exporting.mitsuba.elements import Element, build_plugin, build_property
from skinrig.exporting.mitsuba.lights import Levels, SceneLight

SCENE_FILE: Final = "scene.xml"
STOCK_SCENE_FILE: Final = "scene-stock.xml"
POLARIZED_SCENE_FILE: Final = "scene-{}.xml"
POLARIZED_STOCK_FILE: Final = "scene-stock-{}.xml"
"""Scenes of one reading of the analyzer: parallel or crossed."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneFile:
    """One scene file."""

    elements: Sequence[Element]
    """Integrator, cameras and surface, without lights."""
    defaults: Mapping[str, str | int]
    """Parameters with their defaults, without ``light``."""
    is_stock: bool
    """Whether a plain Mitsuba loads it."""


@dataclass(frozen=True, slots=True, eq=False)
class RigScene:
    """Scenes of one session."""

    files: Mapping[str, SceneFile]
    """Scenes by file name."""
    lights: Sequence[SceneLight]
    """Lights."""
    levels: Levels
    """Patterns of lights; the first is the default."""
    textures: Sequence[str]
    """Names of the maps."""
    views: Sequence[Mapping[str, Any]]
    """Cameras, as JSON values."""
    readme: str
    """Text of the README, with the fields of `readme.format_readme`."""
    unit: str
    """Unit of an image."""
    built_effects: frozenset[str]
    """Effects of a session that the scene has, too."""
    record: Mapping[str, Any] = field(default_factory=dict)
    """Further JSON values."""


def describe_analyzed(polarizers: Polarizers, view: View, name: str, **settings: Any) -> Element:
    """Return the integrator `olat` with the rig's analyzer.

    Parameters
    ----------
    polarizers, view
        Polarizers and camera.
    name
        "parallel" or "crossed".
    settings
        Further properties.
    """
    numbers = {
        "analyzer_deg": analyzer_angles_deg(polarizers, view)[name],
        "analyzer_leak": 1.0 / polarizers.analyzer_extinction,
        **settings,
    }
    olat = build_plugin("integrator", "olat", *(build_property(k, v) for k, v in numbers.items()))
    olat.append(Element("integer", {"name": "subpixels", "value": "$subpixels"}))
    return olat


def analyzer_angles_deg(polarizers: Polarizers, view: View) -> dict[str, float]:
    """Return the analyzer's transmission axis from the image's x axis toward its top, by name."""
    return {name: polarizers.analyzer_axis_deg(view, name, None) for name in POLARIZER_READING_DEG}


def describe_path() -> Element:
    """Return Mitsuba's path tracer with the scene's parameter ``depth``."""
    path = build_plugin("integrator", "path")
    path.append(Element("integer", {"name": "max_depth", "value": "$depth"}))
    return path
