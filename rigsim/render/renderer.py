"""Import Mitsuba, in this module only: startup, threads, and memory that it may read."""

import os
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rigsim.render.variant import VariantChoice


class RenderError(RuntimeError):
    """Mitsuba returned an unusable image, or cannot be started."""


def load_mitsuba(choice: VariantChoice) -> Any:
    """Import Mitsuba with a variant set.

    Parameters
    ----------
    choice
        Result of `rigsim.render.variant.choose_variant`; its library is set before the first
        import.

    Returns
    -------
    module
        ``mitsuba`` with the variant active.
    """
    mi = _import_mitsuba(choice.library)
    if mi.variant() != choice.name:
        try:
            mi.set_variant(choice.name)
        except ImportError as error:
            raise RenderError(
                f"Mitsuba's variant {choice.name} is missing: {error}; reinstall mitsuba"
            ) from error
    return mi


@cache
def _import_mitsuba(library: str) -> Any:
    if library:
        os.environ["DRJIT_LIBLLVM_PATH"] = library
    try:
        import drjit as dr
        import mitsuba as mi
    except ImportError as error:
        raise RenderError(f"Mitsuba cannot be imported: {error}; reinstall mitsuba") from error
    dr.set_thread_count(thread_count())
    mi.set_log_level(mi.LogLevel.Error)
    return mi


def thread_count() -> int:
    """Return the number of threads for rendering: this process's cores, at most 16."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        cores = os.cpu_count() or 1
    return max(1, min(cores, 16))


PADDING_VALUES: Final = 64


def pad_memory(values: NDArray[np.generic]) -> NDArray[Any]:
    """Return a copy of a row of numbers with padding behind its end.

    The renderer reads NumPy's memory directly, in whole vectors of up to 16 numbers, and Embree
    reads 16 bytes at a mesh's last corner. At the end of a memory page either would read beyond the
    process's memory and crash it.

    Examples
    --------
    >>> row = pad_memory(np.arange(5, dtype=np.float32))
    >>> row.tolist(), row.base.size - row.size
    ([0.0, 1.0, 2.0, 3.0, 4.0], 64)
    """
    held = np.zeros(values.size + PADDING_VALUES, values.dtype)
    held[: values.size] = values.reshape(-1)
    return held[: values.size]
