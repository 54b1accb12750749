"""Check the place of an output before the work for it begins."""

import os
import shutil
import tempfile
from pathlib import Path

from skinrig.errors import UnusableError

MIN_FREE_BYTES = 2**20
"""Free space without which no output is begun; the smallest folder that a command writes needs
about as much."""


def require_writable(path: str | Path, *, option: str = "--out") -> None:
    """Raise an error unless an output can be made at a path that need not exist.

    A folder is made for a moment beside the nearest folder that exists, because permissions do not
    tell everything about a medium.

    Parameters
    ----------
    path
        File or folder to be written.
    option
        Option that names it, for the message.

    Raises
    ------
    UnusableError
        When its folder is a file, cannot be written to, or has no space left.

    Examples
    --------
    >>> require_writable(Path(tempfile.gettempdir()) / "a" / "b")
    """
    target = Path(path).absolute()
    parent = next(folder for folder in target.parents if os.path.lexists(folder))
    try:
        with tempfile.TemporaryDirectory(prefix=".skinrig-", dir=parent):
            free = shutil.disk_usage(parent).free
    except OSError as error:
        raise UnusableError(
            f"{option}: {target}: {parent} cannot be written to ({error.strerror}); nothing was "
            "computed: name another folder [SR-CLI-002]"
        ) from error
    if free < MIN_FREE_BYTES:
        raise UnusableError(
            f"{option}: {target}: got {free} bytes free, expected at least {MIN_FREE_BYTES}; "
            "nothing was computed: free space, or name another disk [SR-CLI-003]"
        )
