"""Show progress as a bar by tqdm, in notebooks and terminals."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from skinrig.errors import MissingExtra

FRACTION_PATTERN: Final = re.compile(r"\b(\d+)/(\d+)\b")
PERCENT_PATTERN: Final = re.compile(r"\b(\d+) %")
"""Progress in a line: 3/40 frames, or 25 % of a stage."""
Report = Callable[..., None]
"""Called with a line, and the seconds that are left or None."""


def parse_progress(line: str) -> tuple[int, int] | None:
    """Return the done and total number of steps in a line of progress; None without.

    Examples
    --------
    >>> parse_progress("3/40 S002 subject"), parse_progress("lumitexels: 25 %")
    ((3, 40), (25, 100))
    >>> parse_progress("align smile to the neutral image")
    """
    if found := FRACTION_PATTERN.search(line):
        done, total = int(found[1]), int(found[2])
        return (done, total) if done <= total else None
    if found := PERCENT_PATTERN.search(line):
        return min(int(found[1]), 100), 100
    return None


@contextmanager
def show_progress(title: str, wanted: bool) -> Iterator[Report | None]:
    """Yield a function that moves a progress bar by lines of progress.

    Parameters
    ----------
    title
        Text before the bar.
    wanted
        False: no bar, and None is yielded.

    Raises
    ------
    MissingExtra
        If tqdm is not installed.
    """
    if not wanted:
        yield None
        return
    try:
        from tqdm.auto import tqdm
    except ImportError as error:
        raise MissingExtra("a progress bar (or give progress=False)", "notebook") from error
    with tqdm(desc=title, leave=False, mininterval=0) as bar:

        def report(line: str, left_s: float | None = None) -> None:
            found = parse_progress(line)
            if found is None:
                bar.set_postfix_str(line)
                return
            done, total = found
            if total != bar.total:
                bar.reset(total)
            bar.update(done - bar.n)

        yield report
