"""Build the verdict of a report: passed checks, largest errors, uncertainties without truth."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from model.skin import SkinAppearance, SkinMap
from skinrig.reporting import page
from skinrig.reporting.map_names import map_title, split_melanin_bands, uncertainty_title
from skinrig.unit_format import format_quantity

MAX_NAME_WORDS = 9
"""Words of a check's name up to which the verdict names it: the sentence has 25 at most."""
MAX_NAMED_CLOSE = 3
"""Checks closest to their limit that are named."""
MAX_NAMED_MISSED = 8
MIN_COVERAGE, MAX_COVERAGE = 0.5, 0.9
"""Coverage of 68 % intervals outside which they are called too narrow or too wide."""
MAX_UNREMARKED_MASK = 0.2
"""Masked fraction of pixels above which a sentence names the map."""


def format_headline(checks: Sequence[page.Check]) -> str:
    """Return the verdict as one sentence, with the check that is closest to its limit.

    Examples
    --------
    >>> format_headline([])
    'No limit was checked: none applies to these results.'
    >>> format_headline([page.Check("error", 2.0, 1.0, "<=")])
    '1 of 1 checks missed its limit.'
    >>> format_headline([page.Check("error", 0.5, 1.0, "<=")])
    'The only check kept its limit.'
    >>> format_headline([page.Check("red", 0.5, 1.0, "<="), page.Check("blue", 2.0, 1.0, "<=")])
    '1 of 2 checks missed its limit; the worst is blue, at 200 % of its limit.'
    """
    missed = sum(not check.passed for check in checks)
    if not checks:
        return "No limit was checked: none applies to these results."
    if missed:
        whose = "its" if missed == 1 else "their"
        verdict = f"{missed} of {len(checks)} checks missed {whose} limit"
    elif len(checks) == 1:
        verdict = "The only check kept its limit"
    else:
        count = "Both" if len(checks) == 2 else f"All {len(checks)}"
        verdict = f"{count} checks kept their limits"
    return f"{verdict}{_largest(checks)}."


def _largest(checks: Sequence[page.Check]) -> str:
    """Return the check that uses the largest fraction of its limit, as a clause."""
    known = [check for check in checks if np.isfinite(check.used)]
    if not known or len(checks) == 1:
        return ""
    worst = max(known, key=lambda check: check.used)
    if len(worst.name.split()) > MAX_NAME_WORDS:
        return ""
    word = "closest" if worst.passed else "worst"
    return f"; the {word} is {worst.name}, at {100 * worst.used:.0f} % of its limit"


def section(
    checks: Sequence[page.Check],
    subject: str = "",
    unjudged: Sequence[str] = (),
    images: Iterable[page.Block] = (),
) -> Iterator[page.Block]:
    """Yield the verdict, the images of the first screen, the weakest results and all checks.

    Parameters
    ----------
    checks
        Checks of the report.
    about
        Contents of the report, as text.
    unjudged
        Least certain maps without a ground truth, in sentences.
    images
        Blocks between the verdict and the rest.
    """
    kind = "bad" if any(not check.passed for check in checks) else "good"
    yield page.Paragraph(format_headline(checks), f"verdict {kind if checks else ''}")
    yield from images
    if subject:
        yield page.Paragraph(subject)
    weak = list_weaknesses(checks)
    if weak:
        yield page.Heading("Where errors are largest", level=2)
        yield page.build_table(
            ("finding", "check", "measured", "limit", "largest for"),
            [[cell.replace(" %", "\N{NO-BREAK SPACE}%") for cell in row] for row in weak],
            caption="Missed limits, checks close to their limit, and unusual coverage or masks",
        )
    if unjudged:
        yield page.Heading("Largest uncertainties of maps without ground truth", level=2)
        yield page.build_note("Uncertainties are the estimates' own; their errors are unknown.")
        yield page.Bullets(unjudged)
    if checks:
        yield page.Heading("Checks", level=2)
        yield page.build_checks_table(checks)


def list_weaknesses(checks: Sequence[page.Check]) -> list[tuple[str, str, str, str, str]]:
    """Return the weakest results: finding, check, measured value, limit, group of largest error.

    Missed limits; checks with one skin band or strain step above the limit of the whole; the
    checks closest to their limits; intervals with too small or too large coverage; maps with many
    masked pixels.

    Examples
    --------
    >>> one = page.Check("melanin", 9.0, 10.0, "<=", "%", coverage=0.4, worst="dark: 40 %")
    >>> for row in list_weaknesses([one]): print(row)
    ('close to its limit', 'melanin', '9 %', '≤ 10 %', 'dark: 40 %')
    ('68 % intervals too narrow', 'melanin', 'coverage 40 %', '', '')
    """
    out = []
    missed = [check for check in checks if not check.passed]
    for check in missed[:MAX_NAMED_MISSED]:
        out.append(("limit missed", *_compared(check)))
    if len(missed) > MAX_NAMED_MISSED:
        out.append(
            ("limit missed", f"{len(missed) - MAX_NAMED_MISSED} more, see below", "", "", "")
        )
    named: set[str] = set()
    listed: list[str] = []
    for check in checks:
        beyond = check.passed and check.sense == "<=" and check.worst_got > check.bound
        if beyond and check.worst not in named:  # channels of a map share their group
            named.add(check.worst)
            listed.append(check.name)
            out.append(("kept; one group above the limit", *_compared(check)))
    close = sorted(
        (check for check in checks if check.passed and np.isfinite(check.used)),
        key=lambda check: -check.used,
    )
    for check in close[:MAX_NAMED_CLOSE]:
        if check.name not in listed:
            out.append(("close to its limit", *_compared(check)))
    for check in checks:
        share = f"coverage {100 * check.coverage:.0f} %"
        if check.coverage < MIN_COVERAGE:
            out.append(("68 % intervals too narrow", check.name, share, "", ""))
        elif check.coverage > MAX_COVERAGE:
            out.append(("68 % intervals too wide", check.name, share, "", ""))
    for check in checks:
        if check.masked > MAX_UNREMARKED_MASK:
            of_what = check.name.rsplit(",", 1)[0]  # without the statistic, such as the median
            out.append(("many masked pixels", of_what, f"{100 * check.masked:.0f} %", "", ""))
    return out


def _compared(check: page.Check) -> tuple[str, str, str, str]:
    """Return name, measured value, limit, and the group with the largest error."""
    sign = "≤" if check.sense == "<=" else "≥"
    measured, bound = (
        format_quantity(page.format_number(one), check.unit) for one in (check.got, check.bound)
    )
    return check.name, measured, f"{sign} {bound}", check.worst


RESIDUAL_WORDS = ("residual", "misfit", "gamut_distance")
"""Words in the names of maps of model misfit."""
BANDED_MAPS = ("melanin", "hemoglobin")


MAX_NAMED_MAPS = 3
"""Maps of an appearance that are named first: the least certain."""


def list_least_certain(name: str, appearance: SkinAppearance) -> list[str]:
    """Return the maps with the largest uncertainties, in sentences.

    Parameters
    ----------
    name
        Name of the appearance.
    appearance
        Its maps; those without uncertainties are omitted.

    Examples
    --------
    >>> thickness = SkinMap(np.full((2, 2), 2.0), "mm", np.full((2, 2), 0.1))
    >>> list_least_certain("cheek", SkinAppearance({"thickness": thickness}, "measured"))
    ['cheek: thickness, median standard uncertainty 5 % of its value']
    """
    relative: list[tuple[float, str]] = []
    angles: list[tuple[float, str]] = []
    for key, one in sorted(appearance.maps.items()):
        row = _relative_stderr(key, one) if one.stderr is not None else None
        if row is None:
            continue
        share = float(str(row[2]))
        of = f"{name}: {map_title(key)}, median {uncertainty_title(key)}"
        missing = f", {100 - share:.0f} % of pixels masked" if share < 99.5 else ""
        if row[1] == "°":
            angle = float(str(row[4]))
            text = f"{of} {page.format_number(angle)}°"
            angles.append((angle, text + missing))
        elif np.isfinite(percent := float(str(row[5]))):
            text = f"{of} {page.format_number(percent)} % of its value"
            relative.append((percent, text + missing))
    first = sorted(relative, reverse=True)[:MAX_NAMED_MAPS] + sorted(angles, reverse=True)[:1]
    return [text for _, text in first]


def build_uncertainty_blocks(appearance: SkinAppearance) -> Iterator[page.Block]:
    """Yield uncertainties and residuals of maps, by melanin band where melanin is estimated.

    Parameters
    ----------
    appearance
        Without a ground truth: errors and coverage are unknown.
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
    yield page.build_view("unjudged", spreads=spreads, residuals=residuals, bands=bands)


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
    return (
        map_title(name),
        page.format_short_unit(skin_map.unit),
        share,
        median,
        middle,
        percent,
        high,
    )


def _median_residual(name: str, skin_map: SkinMap) -> tuple[object, ...] | None:
    if not skin_map.mask.any():
        return None
    values = np.abs(skin_map.values[skin_map.mask].astype(np.float64))
    low, middle, high = np.percentile(values, [50, 68.27, 95])
    return (
        map_title(name),
        page.format_short_unit(skin_map.unit),
        float(low),
        float(middle),
        float(high),
    )


def _by_band(appearance: SkinAppearance) -> Iterator[tuple[object, ...]]:
    """Yield relative uncertainties, %, by melanin band where melanin is estimated."""
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
