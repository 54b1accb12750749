"""Versions of all libraries that can change a result."""

import re
from functools import cache
from importlib import metadata


@cache
def list_library_versions(root: str = "skinrig") -> dict[str, str]:
    """Return the versions of a distribution and of all that it requires, directly or not, by name.

    Optional requirements (extras) and those of other platforms count only where a required
    distribution installs them. The result is shared; leave it unmodified.

    Parameters
    ----------
    root
        Name of an installed distribution.

    Raises
    ------
    importlib.metadata.PackageNotFoundError
        When ``root`` is not installed.

    Examples
    --------
    >>> found = list_library_versions()
    >>> found["numpy"] == metadata.version("numpy"), "llvmlite" in found, "pytest" in found
    (True, True, False)
    """
    found = {root: metadata.version(root)}
    waiting = [root]
    while waiting:
        for line in metadata.requires(waiting.pop()) or ():
            requirement, _, marker = line.partition(";")
            start = re.match(r"[\w.-]+", requirement)
            name = re.sub(r"[-_.]+", "-", start[0]).lower() if start else ""
            if not name or "extra" in marker or name in found:
                continue
            try:
                found[name] = metadata.version(name)
            except metadata.PackageNotFoundError:  # of another platform or Python
                continue
            waiting.append(name)
    return dict(sorted(found.items()))
