"""Configure numerical libraries: cache of compiled kernels, and waiting of threads."""

import os
import sys
from collections.abc import Mapping, MutableMapping
from pathlib import Path

PACKAGES_FOLDER = Path(__file__).parent.parent
"""Folder in which the packages are installed."""
PASSIVE_WAIT_SETTINGS = {"OMP_WAIT_POLICY": "PASSIVE", "OPENBLAS_NUM_THREADS": "1"}
"""Let waiting threads sleep: spinning ones occupy cores that other processes could use. OpenMP
reads the variable when it is loaded, before the first parallel loop. With several threads of
OpenBLAS, which also spin, the last digits of two equal runs differ."""


def find_user_cache(environment: Mapping[str, str]) -> Path:
    """Return the user's cache folder, by Numba's rule.

    Parameters
    ----------
    environment
        Environment variables; ``XDG_CACHE_HOME`` takes precedence over ``HOME``.

    Examples
    --------
    >>> find_user_cache({"XDG_CACHE_HOME": "/scratch", "HOME": "/home/me"}).as_posix()
    '/scratch'
    """
    if cache := environment.get("XDG_CACHE_HOME"):
        return Path(cache)
    return Path(environment.get("HOME") or Path.home()) / ".cache"


def is_writable(folder: Path) -> bool:
    """Create a folder if it is missing; return whether files can be written into it.

    Examples
    --------
    >>> is_writable(Path("/proc/none/such"))
    False
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


def provide_kernel_cache(
    environment: MutableMapping[str, str], packages: Path = PACKAGES_FOLDER
) -> Path | None:
    """Set a private cache folder for compiled kernels if Numba has no writable one.

    Numba caches kernels next to the sources or in the user's cache. It refuses to compile if it can
    write to neither, for example in a container with a read-only home. The folder is deleted when
    the process ends. Its name is unpredictable, because whoever writes there controls the code that
    this process runs.

    Parameters
    ----------
    environment
        Variables of this process; ``NUMBA_CACHE_DIR`` is set unless it is set already.
    packages
        Folder in which the packages are installed.

    Returns
    -------
    Path or None
        The folder; None if Numba needs none.
    """
    if sys.platform == "win32" or environment.get("NUMBA_CACHE_DIR"):
        return None
    source_cache = packages / "model" / "__pycache__"
    if is_writable(source_cache) or is_writable(find_user_cache(environment) / "numba"):
        return None
    import atexit  # imported here to keep the start of other commands fast
    import shutil
    import tempfile

    folder = Path(tempfile.mkdtemp(prefix="skinrig-kernels-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    environment["NUMBA_CACHE_DIR"] = str(folder)
    return folder


def set_passive_waiting(environment: MutableMapping[str, str]) -> None:
    """Let threads sleep while waiting, unless the user has set a policy.

    Parameters
    ----------
    environment
        Variables of this process, before a numerical library is loaded; set ones are kept.

    Examples
    --------
    >>> environment = {"HOME": "/home/me"}
    >>> set_passive_waiting(environment)
    >>> environment["OMP_WAIT_POLICY"]
    'PASSIVE'
    >>> set_passive_waiting(asked := {"OMP_WAIT_POLICY": "ACTIVE"})
    >>> asked
    {'OMP_WAIT_POLICY': 'ACTIVE', 'OPENBLAS_NUM_THREADS': '1'}
    """
    for name, value in PASSIVE_WAIT_SETTINGS.items():
        environment.setdefault(name, value)
