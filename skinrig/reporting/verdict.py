"""What a report says first: did it work, how good is it, and where is it bad."""

from collections.abc import Iterator, Sequence

import numpy as np

from model.skin import SkinAppearance, SkinMap
from skinrig.reporting import page
from skinrig.reporting.map_names import map_title, split_melanin_bands
from skinrig.unit_format import format_quantity

MAX_NAMED_CLOSE = 3
"""Checks named that come closest to their limit."""
MAX_NAMED_MISSED = 8
MIN_COVERAGE, MAX_COVERAGE = 0.5, 0.9
"""Share of truths inside 68 % intervals beyond which intervals are called too small or large."""
MAX_UNREMARKED_MASK = 0.2
"""Share of pixels without a value that is worth a sentence."""


def headline(checks: Sequence[page.Check]) -> str:
    """Return the verdict as one sentence.

    Examples
    --------
    >>> headline([])
    'No limit was checked: there is no truth and no benchmark here.'
    >>> headline([page.Check("error", 2.0, 1.0, "<=")])
    '1 of 1 checks missed its limit.'
    >>> headline([page.Check("error", 0.5, 1.0, "<=")])
    'The only check kept its limit.'
    """
    missed = sum(not check.passed for check in checks)
    if not checks:
        return "No limit was checked: there is no truth and no benchmark here."
    if missed:
        whose = "its" if missed == 1 else "their"
        return f"{missed} of {len(checks)} checks missed {whose} limit."
    if len(checks) == 1:
        return "The only check kept its limit."
    return f"All {len(checks)} checks kept their limits."


def section(
    checks: Sequence[page.Check], subject: str = "", unjudged: Sequence[str] = ()
) -> Iterator[page.Block]:
    """Yield the verdict, where it is worst, and all checks.

    Parameters
    ----------
    checks
        All there are.
    about
        Of what, as text.
    unjudged
        What maps without a truth know least of, in sentences.
    """
    kind = "bad" if any(not check.passed for check in checks) else "good"
    yield page.Paragraph(headline(checks), f"verdict {kind if checks else ''}")
    if subject:
        yield page.Paragraph(subject)
    weak = weaknesses(checks)
    if weak:
        yield page.Heading("Where it is worst", level=2)
        yield page.Bullets(weak)
    if unjudged:
        yield page.Heading("Without a truth: least known", level=2)
        yield page.note(
            "By their own standard errors; how far they are from the truth is not known."
        )
        yield page.Bullets(unjudged)
    if checks:
        yield page.Heading("Checks", level=2)
        yield page.checks_table(checks)


def weaknesses(checks: Sequence[page.Check]) -> list[str]:
    """Return what a reader should look at first, in sentences.

    Missed limits; skin or states whose own error lies beyond the limit that the whole keeps; what
    comes closest to its limit; intervals that hold far too few or too many truths; maps with many
    pixels that have no value.

    Examples
    --------
    >>> one = page.Check("melanin", 9.0, 10.0, "<=", "%", coverage=0.4, worst="dark: 40 %")
    >>> for text in weaknesses([one]): print(text)
    closest to its limit: melanin, 9 % of at most 10 % (90 % of it used); worst at dark: 40 %
    intervals too small: melanin, 40 % of truths lie inside the 68 % intervals
    """
    out = []
    missed = [check for check in checks if not check.passed]
    for check in missed[:MAX_NAMED_MISSED]:
        sign = "at most" if check.sense == "<=" else "at least"
        out.append(
            f"missed: {check.name}, {_measured(check)}, {sign}"
            f" {_bound(check)}{_format_worst(check)}"
        )
    if len(missed) > MAX_NAMED_MISSED:
        out.append(f"missed: {len(missed) - MAX_NAMED_MISSED} more, in the table below")
    told: set[str] = set()
    for check in checks:
        beyond = check.passed and check.sense == "<=" and check.worst_got > check.bound
        if beyond and check.worst not in told:  # channels of a map share their worst place
            told.add(check.worst)
            out.append(
                f"beyond the limit of the whole: {check.name}, {check.worst} where at most "
                f"{_bound(check)} is allowed over all, and {_measured(check)} found"
            )
    close = sorted(
        (check for check in checks if check.passed and np.isfinite(check.used)),
        key=lambda check: -check.used,
    )
    for check in close[:MAX_NAMED_CLOSE]:
        out.append(
            f"closest to its limit: {check.name}, {_measured(check)} of at most {_bound(check)} "
            f"({100 * check.used:.0f} % of it used){_format_worst(check)}"
        )
    for check in checks:
        if check.coverage < MIN_COVERAGE:
            out.append(f"intervals too small: {_format_coverage(check)}")
        elif check.coverage > MAX_COVERAGE:
            out.append(f"intervals too large: {_format_coverage(check)}")
    for check in checks:
        if check.masked > MAX_UNREMARKED_MASK:
            of_what = check.name.rsplit(",", 1)[0]  # without what is measured, such as the median
            out.append(f"masked: {of_what}: {100 * check.masked:.0f} % of pixels have no value")
    return out


def _measured(check: page.Check) -> str:
    return format_quantity(page.number(check.got), check.unit)


def _bound(check: page.Check) -> str:
    return format_quantity(page.number(check.bound), check.unit)


def _format_worst(check: page.Check) -> str:
    return f"; worst at {check.worst}" if check.worst else ""


def _format_coverage(check: page.Check) -> str:
    return f"{check.name}, {100 * check.coverage:.0f} % of truths lie inside the 68 % intervals"


RESIDUAL_WORDS = ("residual", "misfit", "gamut_distance")
"""Words in the names of maps that tell how badly a model fits."""
BANDED_MAPS = ("melanin", "hemoglobin")


MAX_NAMED_MAPS = 3
"""Maps of an appearance that are named first: those that know least."""


def list_least_certain(name: str, appearance: SkinAppearance) -> list[str]:
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
    >>> list_least_certain("cheek", SkinAppearance({"thickness": thickness}, "measured"))
    ['cheek: thickness, median standard error 5 % of its value']
    """
    told: list[tuple[float, str]] = []
    angles: list[tuple[float, str]] = []
    for key, one in sorted(appearance.maps.items()):
        row = _relative_stderr(key, one) if one.stderr is not None else None
        if row is None:
            continue
        share = float(str(row[2]))
        of = f"{name}: {map_title(key)}, median standard error"
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


def uncertainty_blocks(appearance: SkinAppearance) -> Iterator[page.Block]:
    """Yield standard errors and residuals of maps, by melanin band where melanin is among them.

    Parameters
    ----------
    appearance
        Without a truth: errors and coverage of intervals cannot be told, and are not.
    """
    spreads = [
        row
        for name, one in sorted(appearance.maps.items())
        if one.stderr is not None and (row := _relative_stderr(name, one)) is not None
    ]
    residuals = [
        row
        for name, one in sorted(appearance.maps.items())
        if any(word in name for word in RESIDUAL_WORDS)
        and (row := _median_residual(name, one)) is not None
    ]
    bands = list(_by_band(appearance))
    yield page.view("unjudged", spreads=spreads, residuals=residuals, bands=bands)


def _relative_stderr(name: str, skin_map: SkinMap) -> tuple[object, ...] | None:
    good = skin_map.mask
    if skin_map.stderr is None or not good.any():
        return None
    stderr = skin_map.stderr[good].astype(np.float64)
    share = 100.0 * float(good.mean())
    if "normals" in name:
        stderr = np.degrees(stderr)
        high = float(np.percentile(stderr, 95))
        return map_title(name), "°", share, "", float(np.median(stderr)), "", high
    values = skin_map.values[good].astype(np.float64)
    size = np.abs(values)
    relative = stderr[size > 0] / size[size > 0]
    percent = 100.0 * float(np.median(relative)) if relative.size else float("nan")
    middle, high = np.percentile(stderr, [50, 95]).tolist()
    median = float(np.median(values))
    return map_title(name), page.short_unit(skin_map.unit), share, median, middle, percent, high


def _median_residual(name: str, skin_map: SkinMap) -> tuple[object, ...] | None:
    if not skin_map.mask.any():
        return None
    values = np.abs(skin_map.values[skin_map.mask].astype(np.float64))
    low, middle, high = np.percentile(values, [50, 68.27, 95])
    return (map_title(name), page.short_unit(skin_map.unit), float(low), float(middle), float(high))


def _by_band(appearance: SkinAppearance) -> Iterator[tuple[object, ...]]:
    """Yield relative standard errors, %, by band of the melanin where that is among the maps."""
    melanin = appearance.maps.get("melanin")
    if melanin is None:
        return
    levels = melanin.values.astype(np.float64)
    for name in BANDED_MAPS:
        one = appearance.maps.get(name)
        if one is None or one.stderr is None or one.values.shape != levels.shape:
            continue
        size = np.abs(one.values.astype(np.float64))
        for band, chosen in split_melanin_bands(levels, melanin.mask & one.mask & (size > 0)):
            relative = 100.0 * one.stderr[chosen] / size[chosen]
            middle, most = np.percentile(relative, [50, 95]).tolist()
            yield map_title(name), band, int(chosen.sum()), middle, most
