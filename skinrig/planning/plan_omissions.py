"""Parts of a capture that a plan omits, and light that its forecast lacks."""

import tomllib
from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import Any, Final

from rigsim.needs.effects import omitted_effects
from skinrig.errors import require_choice

OMISSIONS_TABLE = resources.files("skinrig").joinpath("data/left_out.toml")
UNMODELED_IMAGES: Final = {
    "dome": ("dome_face", "dome_bounces", "dome_lateral"),
    "flash": ("flash_face",),
    "gradient": ("gradient", "gradient_skin"),
    "probe": ("probe", "probe_layered"),
}
"""Tables of `rigsim/data/left_out.toml` by rig."""


def list_unmodeled_effects(rig: str) -> tuple[tuple[str, str], ...]:
    """List effects of light that a rig's forecast lacks, each with its size or reason.

    Parameters
    ----------
    rig
        Name of the rig.

    Examples
    --------
    >>> dict(list_unmodeled_effects("dome"))["highlights of skin on skin"]
    'only subsurface light reaches other skin; 0.8 % of the light, 4 to 9 times the noise'
    """
    images = UNMODELED_IMAGES[require_choice("rig", rig, UNMODELED_IMAGES)]
    effects = omitted_effects(*images)
    return tuple((one.name, one.reason) for one in effects if one.verdict == "unmodeled")


def list_omissions(rig: str, *rows: tuple[Any, ...]) -> tuple[tuple[str, str], ...]:
    """List the parts that a plan omits, with reasons.

    Parameters
    ----------
    rig
        Name of the rig.
    rows
        Per part: whether it is omitted, its key in `data/left_out.toml`, and the values of that
        text's placeholders.
    """
    table = _read_table()[rig]
    named = [(table[name], words) for left, name, *words in rows if left]
    return tuple((row["what"].format(*words), row["why"].format(*words)) for row, words in named)


@cache
def _read_table() -> dict[str, Any]:
    return tomllib.loads(OMISSIONS_TABLE.read_text(encoding="utf-8"))


def explain_less_light(reasons: Sequence[str]) -> str:
    """Return why less light suffices; `reasons` are not empty if the goals are out of reach."""
    if reasons:
        return "the error increases by at most 5 %"
    return "the goals are reached without it"
