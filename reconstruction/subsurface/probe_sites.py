"""Texture coordinates of a probe's sites on a face, fixed or read from a table."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from reconstruction.correspondence import landmark_table
from reconstruction.subsurface.translucency import TranslucencyError

SITE_UV: Final[Mapping[str, tuple[float, float]]] = {
    "forehead": (0.500, 0.820),
    "cheek": (0.263, 0.528),
    "cheek left": (0.263, 0.528),
    "cheek right": (0.737, 0.528),
    "chin": (0.500, 0.205),
}
"""Texture coordinates of the sites of a probe on the simulated heads: of the points nearest to the
landmarks of `rigsim.subject.head`, means of 8 heads (they differ by 0.002); chin is below it, where
the skin faces down. Left and right as in the image; "cheek" is the left one."""


def read_landmarks(
    path: str | Path, *, texture_px: tuple[int, int]
) -> dict[str, tuple[float, float]]:
    """Read texture coordinates of sites from a table ``name,x,y``.

    Parameters
    ----------
    path
        CSV with a header; x to the right and y down from the center of the texture's upper left
        pixel, px.
    texture_px : (int, int)
        Height and width of the texture they were read from.

    Returns
    -------
    dict
        Name to (u, v).

    Raises
    ------
    TranslucencyError
        For another header, a value that is not a number, a name twice, or a site beyond the
        texture.
    """
    height, width = texture_px
    try:
        places_px = landmark_table.read_landmark_table(path)
    except landmark_table.LandmarkError as error:
        raise TranslucencyError(str(error)) from error
    found: dict[str, tuple[float, float]] = {}
    for name, (x, y) in places_px.items():
        u, v = (x + 0.5) / width, 1.0 - (y + 0.5) / height
        if not (0 <= u <= 1 and 0 <= v <= 1):
            raise TranslucencyError(
                f"{path}: {name!r}: got ({x}, {y}), expected within {width} x {height} px; "
                "correct the row or give the size of the texture it was read from"
            )
        found[name] = (u, v)
    return found
