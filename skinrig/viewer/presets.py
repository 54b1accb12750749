"""Expressions and states by name, as weights of a face's blend shapes and of its blood.

A face whose shapes are called like the emotions takes them as they are; one with shapes of single
muscles, named as in ARKit, takes the action units of each emotion.

References
----------
Jimenez et al. 2010, doi:10.1145/1866158.1866167, figures 1 and 11 (combinations).
Ekman and Friesen 1978, Facial Action Coding System; Friesen and Ekman 1983, EMFACS-7.
"""

import tomllib
from collections.abc import Iterable, Mapping
from importlib import resources
from types import MappingProxyType
from typing import Final

from skinrig.viewer.scene import Assets, ViewerScene

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


def assets(scene: ViewerScene) -> Assets:
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
