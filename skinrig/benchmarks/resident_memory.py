"""Most memory that the process held during a call, as the kernel counts it.

`tracemalloc` sees what Python and NumPy allocate and slows what allocates often; the kernel counts
the pages of all libraries for nothing, but not those that were free in the heap already.
"""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

PROCESS_STATUS_PATH = Path("/proc/self/status")
CLEAR_REFS_PATH = Path("/proc/self/clear_refs")
PEAK_RESET_CODE = "5"
"""What written to `clear_refs` sets the peak to what is held now (proc(5))."""


@dataclass(slots=True)
class Peak:
    """What :func:`track_peak` found."""

    mb: float | None = None
    """Most resident memory above that at the start, MB; None: this system does not tell."""


@contextmanager
def track_peak() -> Iterator[Peak]:
    """Measure how far resident memory rises within the block; free heap is given back before.

    Examples
    --------
    >>> import numpy as np
    >>> with track_peak() as peak:
    ...     held = np.ones(8_000_000)
    >>> peak.mb is None or 50 < peak.mb < 100
    True
    """
    peak = Peak()
    begin = _reset()
    yield peak
    if begin is not None:
        most = _read("VmHWM")
        peak.mb = None if most is None else max(most - begin, 0.0)


def _reset() -> float | None:
    # glibc alone has it; elsewhere heap that was freed before is not seen when used again
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
    try:
        CLEAR_REFS_PATH.write_text(PEAK_RESET_CODE, encoding="ascii")
    except OSError:
        return None
    return _read("VmRSS")


def _read(name: str) -> float | None:
    try:
        lines = PROCESS_STATUS_PATH.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return None
    for line in lines:
        if line.startswith(f"{name}:"):
            return float(line.split()[1]) * 1024 / 1e6
    return None
