"""Import Mitsuba: startup and threads."""

import contextlib
import os
from collections.abc import MutableMapping
from functools import cache
from typing import Any, Final

from rigsim.mitsuba.render_error import RenderError
from rigsim.mitsuba.variant import VariantChoice, user_cache_dir

MIN_THREADS: Final = 2
"""Mitsuba 3.9 never finishes reading an EXR image with a single thread."""
MAX_THREADS: Final = 16


def load_mitsuba(choice: VariantChoice) -> Any:
    """Import Mitsuba with a variant set.

    Parameters
    ----------
    choice
        Result of `rigsim.mitsuba.variant.choose_variant`; its library is set before the first
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
    share_kernels(os.environ)
    try:
        import drjit as dr
        import mitsuba as mi
    except ImportError as error:
        raise RenderError(f"Mitsuba cannot be imported: {error}; reinstall mitsuba") from error
    dr.set_thread_count(thread_count())
    mi.set_log_level(mi.LogLevel.Error)
    return mi


def share_kernels(environment: MutableMapping[str, str]) -> None:
    """Let processes share compiled kernels in the user's cache folder, where Dr.Jit bounds them.

    Without a folder that it can write, Dr.Jit compiles in each process.

    Parameters
    ----------
    environment
        Variables of this process, before Dr.Jit is imported; a set ``DRJIT_CACHE_DIR`` is kept.
    """
    folder = user_cache_dir() / "drjit"
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    if os.access(folder, os.W_OK | os.X_OK):
        environment.setdefault("DRJIT_CACHE_DIR", str(folder))


def thread_count() -> int:
    """Return the number of threads for rendering: this process's cores, 2 to 16.

    ``NUMBA_NUM_THREADS``, which bounds the compiled loops, bounds it as well.
    """
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        cores = os.cpu_count() or 1
    bound = os.environ.get("NUMBA_NUM_THREADS", "")
    if bound.isdecimal():
        cores = min(cores, int(bound))
    return max(MIN_THREADS, min(cores, MAX_THREADS))
