"""Light that forecasts lack, since the simulator does not model it."""

from typing import Final

from rigsim.needs.effects import omitted_effects
from skinrig.errors import require_choice

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
