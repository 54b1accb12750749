"""Compare the exposure times of a bracket with the light of its frames."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capture.documents import Fault
from capture.hdr import BracketError

MAX_TIME_ERROR: Final = 0.1
"""Relative error of a ratio of exposure times from which it is refused."""
SPREAD_PERCENTILES: Final = 10.0, 50.0, 90.0
"""Percentiles of the pixels' ratios, of which all must be off in one direction."""
MIN_SIGNAL_SIGMAS: Final = 10.0
MIN_COMPARED, MAX_COMPARED = 50, 20_000
"""Pixels that compare two exposures."""


def check_times(
    frames: Sequence[NDArray[np.integer]],
    exposures_s: ArrayLike,
    *,
    gain: float,
    read_noise: float,
    black: float,
    white: float,
) -> None:
    """Refuse a bracket whose light contradicts its exposure times.

    Each frame is compared with that of the next longer time, by the ratios of pixels that are
    bright in both and saturated in neither. A false time changes all of them alike. Either time of
    a pair may be the wrong one: the error states their ratio. The parameters are those of
    `capture.hdr.merge`.

    Raises
    ------
    BracketError
        If eight of ten pixels or more contradict a ratio of times by more than 10 %.

    Examples
    --------
    >>> short, long = np.full((9, 9), 612), np.full((9, 9), 1812)
    >>> check_times([short, long], [0.1, 1.0], gain=2.0, read_noise=4.0, black=512, white=16383)
    Traceback (most recent call last):
        ...
    capture.hdr.BracketError: Bracket: the light contradicts the exposure times
      exposures_s[0] over exposures_s[1]: got 0.1 (0.1 s over 1 s), expected 0.0769 as their light
    """
    times = np.asarray(exposures_s, np.float64)
    step = max(1, frames[0].size // MAX_COMPARED) if frames else 1
    samples = [frame.reshape(-1)[::step].astype(np.float64) for frame in frames]
    faults = []
    order = np.argsort(times, kind="stable")
    for k, longer in pairwise(order.tolist()):
        expected = (samples[longer] - black) * (times[k] / times[longer])
        sigma = np.sqrt(np.maximum(expected, 0.0) / gain + (read_noise / gain) ** 2 + 1.0 / 12.0)
        bright = expected > MIN_SIGNAL_SIGMAS * sigma
        bright &= (samples[k] < white) & (samples[longer] < white)
        if np.count_nonzero(bright) < MIN_COMPARED:
            continue
        ratios = (samples[k] - black)[bright] / expected[bright]
        low, ratio, high = np.percentile(ratios, SPREAD_PERCENTILES)
        # a head that moved between the exposures changes pixels by different ratios
        if low > 1.0 + MAX_TIME_ERROR or high < 1.0 - MAX_TIME_ERROR:
            nominal = times[k] / times[longer]
            got = f"{nominal:.3g} ({times[k]:.3g} s over {times[longer]:.3g} s)"
            where = f"exposures_s[{k}] over exposures_s[{longer}]"
            faults.append(Fault(where, got, f"{nominal * ratio:.3g} as their light"))
    if faults:
        what = "the light contradicts the exposure times"
        raise BracketError(what, where="Bracket", faults=faults)
