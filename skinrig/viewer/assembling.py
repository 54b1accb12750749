"""From what is known of a face to a scene: every asset builder adds its part."""

import tomllib
from collections.abc import Callable, Iterable, Mapping
from importlib import resources
from types import MappingProxyType
from typing import Any, Final

from skinrig.viewer.assets import facial_color as facial_color_assets
from skinrig.viewer.assets import fitted as fitted_assets
from skinrig.viewer.assets import reflectance as reflectance_assets
from skinrig.viewer.assets import surface as surface_assets
from skinrig.viewer.assets import wrinkles as wrinkle_assets
from skinrig.viewer.microstructure import assets as microstructure_assets
from skinrig.viewer.scene import Assets, SceneSource, ViewerScene

Weights = Mapping[str, float]

EMOTION_STATES: Final = ("happiness", "sadness", "surprise", "fear", "anger", "disgust")
"""Ekman's six."""

COMBINED_STATES: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "sad smile": ("sadness", "smile"),
        "anger and surprise": ("anger", "surprise"),
        "after exercise": ("anger", "surprise", "exercise"),
    }
)
"""Of Jimenez et al.: figure 1's sad smile, and the row of figure 11, each at full weight."""

GLOBAL_STATES: Final = ("exercise", "alcohol")
"""States of the whole face that no muscle makes."""

ACTION_UNITS: Final[Mapping[str, Mapping[str, float]]] = tomllib.loads(
    resources.files("skinrig").joinpath("data/action_units.toml").read_text(encoding="utf-8")
)
"""Shapes of ARKit, without left and right, and their weights."""


def preset_assets(scene: ViewerScene) -> Assets:
    """Return the presets that a scene's blend shapes, and its states of blood, can show."""
    names = (*scene.mesh.shapes, *scene.params.get("weights", {}))
    return {"presets": {name: {"weights": w} for name, w in presets(names).items()}}


def presets(names: Iterable[str]) -> dict[str, dict[str, float]]:
    """Return weights by preset, in the order in which people look for them.

    Parameters
    ----------
    names
        Of blend shapes and states.

    Examples
    --------
    >>> presets(["anger", "surprise"])["anger and surprise"]
    {'anger': 1.0, 'surprise': 1.0}
    >>> presets(["mouthSmile_L", "mouthSmile_R"])["smile"]
    {'mouthSmile_L': 1.0, 'mouthSmile_R': 1.0}
    """
    known = tuple(dict.fromkeys(names))
    basic = {name: _weights(name, known) for name in (*EMOTION_STATES, "smile", *GLOBAL_STATES)}
    # a combination of which a part is missing would be another one's
    combined = {
        name: _joined(basic[part] for part in parts)
        for name, parts in COMBINED_STATES.items()
        if all(basic[part] for part in parts)
    }
    first = {name: basic[name] for name in (*EMOTION_STATES, "smile") if basic[name]}
    last = {name: basic[name] for name in GLOBAL_STATES if basic[name]}
    return {"neutral": {}, **first, **combined, **last}


def _weights(name: str, known: tuple[str, ...]) -> dict[str, float]:
    """Return the state of that name and, where there is no such shape, its action units."""
    found = {name: 1.0} if name in known else {}
    units = {
        shape: weight
        for unit, weight in ACTION_UNITS.get(name, {}).items()
        for shape in known
        if shape in (unit, f"{unit}_L", f"{unit}_R", f"{unit}Left", f"{unit}Right")
    }
    return {**found, **units}


def _joined(parts: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Return weights added, no muscle beyond its full movement."""
    total: dict[str, float] = {}
    for part in parts:
        for name, weight in part.items():
            total[name] = min(total.get(name, 0.0) + weight, 1.0)
    return total


ASSET_BUILDERS: Final[tuple[Callable[[SceneSource], Assets], ...]] = (
    facial_color_assets.assets,
    reflectance_assets.default_scattering,
    surface_assets.assets,
    fitted_assets.assets,
    wrinkle_assets.assets,
    microstructure_assets.assets,
)
"""In the order in which their parts are listed; they do not see each other's."""


def assemble(source: SceneSource, provenance: Mapping[str, Any]) -> ViewerScene:
    """Return the scene of a source."""
    scene = ViewerScene(mesh=source.mesh, provenance=provenance)
    for build in ASSET_BUILDERS:
        scene = scene.with_assets(build(source))
    return scene.with_assets(preset_assets(scene))
