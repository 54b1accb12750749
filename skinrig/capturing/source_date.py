"""Read the date of new sessions: the present, or a fixed one that makes outputs equal."""

import os
from datetime import UTC, datetime

from skinrig.errors import UnusableError

MAX_EPOCH_S = 253_402_300_799
"""Last second of the year 9999, since 1970."""


def read_clock() -> datetime:
    """Return the present time, or that of the environment variable SOURCE_DATE_EPOCH.

    With it, equal commands write equal bytes.

    Raises
    ------
    UnusableError
        When the variable is not a number of seconds since 1970.

    References
    ----------
    Reproducible Builds, "SOURCE_DATE_EPOCH specification", version 1.1, 2017.
    """
    given = os.environ.get("SOURCE_DATE_EPOCH", "")
    if not given:
        return datetime.now(UTC)
    if not (given.isascii() and given.isdigit() and int(given) <= MAX_EPOCH_S):
        raise UnusableError(
            f"SOURCE_DATE_EPOCH: got {given!r}, expected whole seconds since 1970, at most "
            f"{MAX_EPOCH_S}; correct the environment variable [SR-SIM-009]"
        )
    return datetime.fromtimestamp(int(given), UTC)
