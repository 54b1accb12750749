"""What a report says first: did it work, how good is it, and where is it bad."""

from collections.abc import Iterator, Sequence

import numpy as np

from skinrig.reporting import page
from skinrig.written_units import written

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
    checks: Sequence[page.Check], about: str = "", unjudged: Sequence[str] = ()
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
    if about:
        yield page.Paragraph(about)
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
        out.append(f"missed: {check.name}, {_measured(check)}, {sign} {_bound(check)}{_at(check)}")
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
            f"({100 * check.used:.0f} % of it used){_at(check)}"
        )
    for check in checks:
        if check.coverage < MIN_COVERAGE:
            out.append(f"intervals too small: {_covered(check)}")
        elif check.coverage > MAX_COVERAGE:
            out.append(f"intervals too large: {_covered(check)}")
    for check in checks:
        if check.masked > MAX_UNREMARKED_MASK:
            of_what = check.name.rsplit(",", 1)[0]  # without what is measured, such as the median
            out.append(f"masked: {of_what}: {100 * check.masked:.0f} % of pixels have no value")
    return out


def _measured(check: page.Check) -> str:
    return written(page.number(check.got), check.unit)


def _bound(check: page.Check) -> str:
    return written(page.number(check.bound), check.unit)


def _at(check: page.Check) -> str:
    return f"; worst at {check.worst}" if check.worst else ""


def _covered(check: page.Check) -> str:
    return f"{check.name}, {100 * check.coverage:.0f} % of truths lie inside the 68 % intervals"
