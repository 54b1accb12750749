"""Maps without a truth: what their own standard errors and residuals say, and no more."""

from collections.abc import Iterator

import numpy as np

from model.skin import SkinAppearance, SkinMap
from skinrig.arrays import BoolArray, Float64Array
from skinrig.evaluating import flash
from skinrig.reporting import page
from skinrig.reporting.map_names import melanin_band, words

RESIDUAL_WORDS = ("residual", "misfit", "gamut_distance")
"""Words in the names of maps that tell how badly a model fits."""
BANDED_MAPS = ("melanin", "hemoglobin")
MIN_BAND_PIXELS = 20
"""Of a melanin band that is told."""


MAX_NAMED_MAPS = 3
"""Maps of an appearance that are named first: those that know least."""


def weaknesses(name: str, appearance: SkinAppearance) -> list[str]:
    """Return what an appearance without a truth knows least of, by its own standard errors.

    Parameters
    ----------
    name
        Of the appearance.
    appearance
        Its maps; those without standard errors say nothing.

    Examples
    --------
    >>> thickness = SkinMap(np.full((2, 2), 2.0), "mm", np.full((2, 2), 0.1))
    >>> weaknesses("cheek", SkinAppearance({"thickness": thickness}, "measured"))
    ['cheek: thickness, median standard error 5 % of its value']
    """
    told: list[tuple[float, str]] = []
    angles: list[tuple[float, str]] = []
    for key, one in sorted(appearance.maps.items()):
        row = _spread(key, one) if one.stderr is not None else None
        if row is None:
            continue
        share = float(str(row[2]))
        of = f"{name}: {words(key)}, median standard error"
        missing = f", {100 - share:.0f} % of pixels without a value" if share < 99.5 else ""
        if row[1] == "°":
            angle = float(str(row[4]))
            text = f"{of} {page.number(angle)}°"
            angles.append((angle, text + missing))
        elif np.isfinite(percent := float(str(row[5]))):
            text = f"{of} {page.number(percent)} % of its value"
            told.append((percent, text + missing))
    first = sorted(told, reverse=True)[:MAX_NAMED_MAPS] + sorted(angles, reverse=True)[:1]
    return [text for _, text in first]


def section(appearance: SkinAppearance) -> Iterator[page.Block]:
    """Yield standard errors and residuals of maps, by melanin band where melanin is among them.

    Parameters
    ----------
    appearance
        Without a truth: errors and coverage of intervals cannot be told, and are not.
    """
    spreads = [
        row
        for name, one in sorted(appearance.maps.items())
        if one.stderr is not None and (row := _spread(name, one)) is not None
    ]
    residuals = [
        row
        for name, one in sorted(appearance.maps.items())
        if any(word in name for word in RESIDUAL_WORDS)
        and (row := _residual(name, one)) is not None
    ]
    bands = list(_by_band(appearance))
    yield page.view("unjudged", spreads=spreads, residuals=residuals, bands=bands)


def _values(one: SkinMap) -> tuple[Float64Array, BoolArray]:
    values = one.values.astype(np.float64)
    good = np.isfinite(values if values.ndim == 2 else values.sum(axis=-1))
    return values, good & one.mask


def _spread(name: str, one: SkinMap) -> tuple[object, ...] | None:
    values, good = _values(one)
    if one.stderr is None or not good.any():
        return None
    stderr = one.stderr[good].astype(np.float64)
    share = 100.0 * float(good.mean())
    if "normals" in name:
        stderr = np.degrees(stderr)
        high = float(np.percentile(stderr, 95))
        return words(name), "°", share, "", float(np.median(stderr)), "", high
    size = np.abs(values[good])
    relative = stderr[size > 0] / size[size > 0]
    percent = 100.0 * float(np.median(relative)) if relative.size else float("nan")
    middle, high = np.percentile(stderr, [50, 95]).tolist()
    median = float(np.median(values[good]))
    return words(name), page.short_unit(one.unit), share, median, middle, percent, high


def _residual(name: str, one: SkinMap) -> tuple[object, ...] | None:
    values, good = _values(one)
    if not good.any():
        return None
    low, middle, high = np.percentile(np.abs(values[good]), [50, 68.27, 95])
    return (words(name), page.short_unit(one.unit), float(low), float(middle), float(high))


def _by_band(appearance: SkinAppearance) -> Iterator[tuple[object, ...]]:
    """Yield relative standard errors, %, by band of the melanin where that is among the maps."""
    melanin = appearance.maps.get("melanin")
    if melanin is None:
        return
    levels, known = _values(melanin)
    for name in BANDED_MAPS:
        one = appearance.maps.get(name)
        if one is None or one.stderr is None or one.values.shape != levels.shape:
            continue
        values, good = _values(one)
        for low, high in flash.MELANIN_RANGES:
            inside = known & (levels >= low) & (levels < high)
            chosen = inside & good & (np.abs(values) > 0)
            if (count := int(np.count_nonzero(chosen))) >= MIN_BAND_PIXELS:
                relative = 100.0 * one.stderr[chosen] / np.abs(values[chosen])
                middle, most = np.percentile(relative, [50, 95]).tolist()
                yield words(name), melanin_band(low, high), count, middle, most
