"""What a simulated scene is asked not to build, by the names that its list of effects shows."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

SWITCHES_BY_RIG: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "flash": ("lateral", "interreflections", "spectral", "optics", "relief_shadows"),
        "dome": ("subsurface", "interreflections", "spectral", "optics", "relief_shadows"),
        "gradient": ("shadows", "lateral", "interreflections", "optics"),
        "probe": (),
    }
)
"""By rig: what can be left out, by the ``switch`` of its effect, see `rigsim.needs.effects`."""

LATERAL_SWITCHES: Final = frozenset({"lateral", "subsurface"})
"""Names of light spreading sideways in skin: each rig's own, and the other's."""


def omission_arguments(rig: str, names: Sequence[str]) -> dict[str, bool]:
    """Return arguments for a rig's scene that leave effects out.

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
        Where a name is none that the rig's scenes can leave out.

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
            expected = f"one of {', '.join(known)}" if known else "none: its scenes build all"
            raise ValueError(f"leave_out: got {name!r}, expected of the {rig} rig {expected}")
        out[own] = False
    return out


def is_omittable(switch: str) -> bool:
    """Return whether some rig's scenes can leave the effect of a switch out.

    Examples
    --------
    >>> is_omittable("optics"), is_omittable("last_bounce")
    (True, False)
    """
    return any(switch in known for known in SWITCHES_BY_RIG.values())
