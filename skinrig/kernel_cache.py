"""The environment of numerical libraries: where compiled kernels are kept, how threads wait."""

import os
import sys
from collections.abc import Mapping, MutableMapping
from pathlib import Path

PACKAGES_FOLDER = Path(__file__).parent.parent
"""The folder that the packages are installed in."""
PASSIVE_WAIT_SETTINGS = {"OMP_WAIT_POLICY": "PASSIVE"}
"""Threads that spin as they wait hold a core that other work of the machine could have. OpenMP
reads it when it is loaded, which is before the first parallel loop."""


def user_cache(environment: Mapping[str, str]) -> Path:
    """Return the folder of a user's caches, as Numba finds it.

    Parameters
    ----------
    environment
        Variables; ``XDG_CACHE_HOME`` comes first, then ``HOME``.

    Examples
    --------
    >>> user_cache({"XDG_CACHE_HOME": "/scratch", "HOME": "/home/me"}).as_posix()
    '/scratch'
    """
    if told := environment.get("XDG_CACHE_HOME"):
        return Path(told)
    return Path(environment.get("HOME") or Path.home()) / ".cache"


def is_writable(folder: Path) -> bool:
    """Make a folder if it is missing and return whether files can be written into it.

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
    """Name a private folder for compiled kernels where Numba would find none.

    Numba keeps them beside the sources or in the user's cache, and refuses to compile where it can
    write neither: an installation of root's in a container whose home is read-only, say. The
    folder goes when the process ends. It has a name that nobody can foresee, because whoever writes
    there writes what this process runs.

    Parameters
    ----------
    environment
        Variables of this process; ``NUMBA_CACHE_DIR`` is set, and nothing is done if it is already.
    packages
        Folder that the packages are installed in.

    Returns
    -------
    Path or None
        The folder; None where there is no need of one.
    """
    if sys.platform == "win32" or environment.get("NUMBA_CACHE_DIR"):
        return None
    beside = packages / "model" / "__pycache__"
    if is_writable(beside) or is_writable(user_cache(environment) / "numba"):
        return None
    import atexit  # here: no other start of a command has to load them
    import shutil
    import tempfile

    folder = Path(tempfile.mkdtemp(prefix="skinrig-kernels-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    environment["NUMBA_CACHE_DIR"] = str(folder)
    return folder


def set_passive_waiting(environment: MutableMapping[str, str]) -> None:
    """Let threads sleep as they wait, unless the user has said how they shall.

    Parameters
    ----------
    environment
        Variables of this process, before a numerical library is loaded; what is set stays.

    Examples
    --------
    >>> environment = {"HOME": "/home/me"}
    >>> set_passive_waiting(environment)
    >>> environment["OMP_WAIT_POLICY"]
    'PASSIVE'
    >>> set_passive_waiting(asked := {"OMP_WAIT_POLICY": "ACTIVE"})
    >>> asked
    {'OMP_WAIT_POLICY': 'ACTIVE'}
    """
    for name, value in PASSIVE_WAIT_SETTINGS.items():
        environment.setdefault(name, value)
