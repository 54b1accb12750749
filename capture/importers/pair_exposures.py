"""Relate the exposures of the two photographs of a polarized pair, as EXIF data state them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from capture.importers.exif import compute_exposure

MAX_EQUAL_DEVIATION = 0.005
"""Relative difference of two exposures that count as equal: EXIF data round times."""
EXPOSURE_NAMES = ("exposure_s", "iso", "f_number", "flash")


def relate_exposures(
    parallel: Mapping[str, Any], crossed: Mapping[str, Any], names: tuple[str, str]
) -> tuple[float, str]:
    """Return the exposure of the parallel photograph over that of the crossed one, and a sentence.

    Parameters
    ----------
    parallel, crossed
        Settings that files state, see `compute_exposure`; empty for none.
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
    given = [{name for name in EXPOSURE_NAMES if name in one} for one in (parallel, crossed)]
    exposures = compute_exposure(parallel), compute_exposure(crossed)
    if parallel.get("flash") != crossed.get("flash") and all(given):
        return 1.0, f"a flash fired for one of {both} only: both count as exposed alike"
    if given[0] != given[1] or exposures[0] is None or exposures[1] is None:
        unknown = "state no exposure that can be compared: both count as exposed alike"
        return 1.0, f"{both} {unknown}"
    ratio = exposures[0] / exposures[1]
    if abs(ratio - 1.0) < MAX_EQUAL_DEVIATION:
        return 1.0, ""
    terms = "ISO and f-number" if parallel.get("flash") == "fired" else "time, ISO and f-number"
    return ratio, (
        f"{names[0]} has {ratio:.3g} times the exposure of {names[1]} by its {terms}: its light is "
        "divided by that"
    )
