"""Relate the exposures of the two photographs of a polarized pair, as EXIF data state them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from capture.importers.exif import compare_exposures

MAX_EQUAL_DEVIATION = 0.005
"""Relative difference of two exposures that count as equal: EXIF data round times."""


def relate_exposures(
    parallel: Mapping[str, Any], crossed: Mapping[str, Any], names: tuple[str, str]
) -> tuple[float, str]:
    """Return the exposure of the parallel photograph over that of the crossed one, and a sentence.

    Parameters
    ----------
    parallel, crossed
        Settings that files state, see `compare_exposures`; empty for none.
    names
        Of the two files, parallel first.

    Returns
    -------
    float
        1 where the files do not state both exposures in the same terms.
    str
        What is assumed; empty where both files state equal exposures.

    Examples
    --------
    >>> both = {"iso": 100, "f_number": 8.0, "flash": "off"}
    >>> relate_exposures({"exposure_s": 0.04, **both}, {"exposure_s": 0.02, **both}, ("p", "c"))[0]
    2.0
    >>> relate_exposures({}, {}, ("p.png", "c.png"))
    (1.0, 'p.png and c.png state no exposure that can be compared: both count as exposed alike')
    """
    both = " and ".join(names)
    flashes = [one.get("flash") for one in (parallel, crossed)]
    if flashes.count("fired") == 1:
        return 1.0, f"a flash fired for one of {both} only: both count as exposed alike"
    exposures, terms = compare_exposures([parallel, crossed])
    if not exposures:
        unknown = "state no exposure that can be compared: both count as exposed alike"
        return 1.0, f"{both} {unknown}"
    ratio = exposures[0] / exposures[1]
    if abs(ratio - 1.0) < MAX_EQUAL_DEVIATION:
        return 1.0, ""
    return ratio, (
        f"{names[0]} has {ratio:.3g} times the exposure of {names[1]} by its {terms}: its light is "
        "divided by that"
    )
