"""Draw the first sequence number of a host, so that numbers rise from host to host."""

import threading
import time
from typing import Final

from capture.devices import wire

MIN_NUMBERS_APART: Final = 1000
"""Distance of hosts that one process begins within a second."""
_lock = threading.Lock()
_latest: list[int] = [0]


def draw_first_number() -> int:
    """Return milliseconds since 1970 modulo 2^32, or more where the last call was just before.

    A controller refuses numbers behind the latest one. Lines of an earlier host that come again
    are thus refused for 24 days; after these, half of them are ahead.

    Examples
    --------
    >>> first = draw_first_number()
    >>> (draw_first_number() - first) % (wire.MAX_SEQ + 1) >= MIN_NUMBERS_APART
    True
    """
    with _lock:
        _latest[0] = max(time.time_ns() // 1_000_000, _latest[0] + MIN_NUMBERS_APART)
        return _latest[0] % (wire.MAX_SEQ + 1)
