"""What every export's document says of where it is from and how its images lie."""

from typing import Any, Final

from model.skin import SkinAppearance
from skinrig import consent

IMAGE_ORIENTATION: Final = (
    "row 0 of every image is its top; of a texture that is v = 1, with (0, 0) bottom left"
)


def provenance(appearance: SkinAppearance) -> dict[str, Any]:
    """Return where an appearance is from, as JSON values.

    Parameters
    ----------
    appearance
        Any; of one that moves, what is told by its parts.

    Examples
    --------
    >>> found = provenance(SkinAppearance({}, "simulated", {"assumed": ["a"]}, seed=7))
    >>> found["source"], found["seed"], found["assumed"], found["consent"]
    ('simulated', 7, ['a'], [])
    """
    told: list[Any] = [appearance.parameters.get("assumed")]
    parts = appearance.parameters.get("parts")
    if isinstance(parts, dict):
        told += [part.get("assumed") for part in parts.values() if isinstance(part, dict)]
    assumed = [str(text) for one in told if isinstance(one, list | tuple) for text in one]
    return {
        "source": appearance.source,
        "inputs": dict(appearance.inputs),
        "versions": dict(appearance.versions),
        "seed": appearance.seed,
        "assumed": list(dict.fromkeys(assumed)),
        "consent": consent.recorded(appearance),
    }
