"""Switches of the effects that a simulated scene can omit, by rig."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

TISSUE_SWITCHES: Final = ("thickness", "melanin_depth", "oxygenation", "scattering", "absorption")
"""Switches of `rigsim.needs.tissue.TISSUE_RULES`: without a property, that of typical skin."""

SWITCHES_BY_RIG: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "flash": (
            "lateral",
            "interreflections",
            "spectral",
            "optics",
            "relief_shadows",
            *TISSUE_SWITCHES,
        ),
        "dome": (
            "subsurface",
            "interreflections",
            "spectral",
            "optics",
            "relief_shadows",
            *TISSUE_SWITCHES,
        ),
        "gradient": ("shadows", "lateral", "interreflections", "optics", *TISSUE_SWITCHES),
        "probe": ("crosstalk", "wings", "dark_current", *TISSUE_SWITCHES),
    }
)
"""Omittable effects of each rig, by the ``switch`` of the effect, see `rigsim.needs.effects`."""

LATERAL_SWITCHES: Final = frozenset({"lateral", "subsurface"})
"""Names of lateral scattering in skin: the rigs use different ones, and each accepts both."""


def omission_arguments(rig: str, names: Sequence[str]) -> dict[str, bool]:
    """Return the arguments of a rig's scene that omit effects.

    Parameters
    ----------
    rig
        Name of the rig.
    names
        Switches of effects.

    Returns
    -------
    dict
        Arguments of the scene, each False.

    Raises
    ------
    ValueError
        For a name that is not an omittable effect of the rig.

    Examples
    --------
    >>> omission_arguments("flash", ["optics", "subsurface"])
    {'optics': False, 'lateral': False}
    """
    known = SWITCHES_BY_RIG[rig]
    out: dict[str, bool] = {}
    for name in names:
        own = next((k for k in known if k == name or {k, name} <= LATERAL_SWITCHES), None)
        if own is None:
            expected = f"one of {', '.join(known)}" if known else "none; remove the option"
            raise ValueError(
                f"--omit (leave_out): got {name!r}, expected for the {rig} rig {expected}"
            )
        out[own] = False
    return out


def is_omittable(switch: str) -> bool:
    """Return whether the scenes of any rig can omit the effect of a switch.

    Examples
    --------
    >>> is_omittable("optics"), is_omittable("last_bounce")
    (True, False)
    """
    return any(switch in known for known in SWITCHES_BY_RIG.values())
