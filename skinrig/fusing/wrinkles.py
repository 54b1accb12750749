"""Carry wrinkles of a person's expressions, measured by the dome, to the fused person."""

from dataclasses import dataclass
from typing import Any

from model.skin import SkinMap
from skinrig.appearances.dynamic import WRINKLES, describe_parts
from skinrig.fusing.sources import FusionInputError, Source


@dataclass(frozen=True, slots=True, eq=False)
class CarriedWrinkles:
    """Wrinkle maps on the texture of the dome's mesh, with their files and document."""

    maps: dict[str, SkinMap]
    files: dict[str, bytes]
    document: dict[str, Any]


def carry_wrinkles(moving: Source, dome: Source | None) -> CarriedWrinkles:
    """Return the wrinkles of a moving face for the fused person.

    Parameters
    ----------
    moving
        Folder of `skinrig fit wrinkles`; its other parts stay there.
    dome
        Maps of the neutral face that the wrinkles were fitted to; None: not given.

    Raises
    ------
    FusionInputError
        If the wrinkles are those of another neutral face, whose texture differs.
    """
    neutral = moving.appearance.inputs.get(f"{WRINKLES}: neutral")
    if dome is None or neutral != dome.digest:
        got = "no dome's maps" if dome is None else f"the dome's maps {dome.path}"
        raise FusionInputError(
            f"{moving.path}: got {got}, expected those of the neutral face that the wrinkles were "
            "fitted to; give that folder, or run `skinrig fit wrinkles` with this one"
        )
    document = describe_parts(moving.appearance)[WRINKLES]
    return CarriedWrinkles(
        {name: moving.appearance.maps[name] for name in document["maps"]},
        {name: moving.appearance.files[name] for name in document["files"]},
        document,
    )
