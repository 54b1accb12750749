"""Peak resident memory of the process during a call, as counted by the kernel.

`tracemalloc` counts allocations of Python and NumPy and slows code that allocates often. The kernel
counts the pages of all libraries at no cost, except pages that were free in the heap before.
"""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

PROCESS_STATUS_PATH = Path("/proc/self/status")
CLEAR_REFS_PATH = Path("/proc/self/clear_refs")
PEAK_RESET_CODE = "5"
"""Text for `clear_refs` that resets the peak to the current resident memory (proc(5))."""


@dataclass(slots=True)
class Peak:
    """Result of :func:`track_peak`."""

    mb: float | None = None
    """Peak resident memory above that at the start, MB; None: the system does not report it."""


@contextmanager
def track_peak() -> Iterator[Peak]:
    """Measure the growth of resident memory within the block, after free heap is released.

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
    # malloc_trim exists in glibc only; elsewhere the reuse of freed heap is not counted
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
