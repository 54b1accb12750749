"""Make a second copy of a session, after a check of consent and disk space."""

from collections.abc import Callable
from pathlib import Path

from capture.session import Session
from capture.session.copying import CopyReport, copy_session, part_folder
from skinrig.errors import UsageError
from skinrig.resources.forecast import (
    ResourceForecast,
    forecast_resources,
    measure_folder_mb,
    require_resources,
)


def copy_with_consent(
    session: Path,
    copy: Path,
    *,
    use: str | None,
    read_back: bool,
    progress: Callable[[str], None] | None = None,
) -> CopyReport:
    """Copy a session for a use that its subject agreed to; see `copy_session`.

    Parameters
    ----------
    session, copy
        SESSION/ folder, and the new folder.
    use
        Purpose of the copy; None is refused.
    read_back
        Whether the copy is read back from its disk.
    progress
        Called with a line per file.

    Raises
    ------
    skinrig.errors.UsageError
        Without a use.
    capture.session.ConsentError
        If the subject has not agreed to the use, or the consent has expired.
    skinrig.errors.UnusableError
        If the disk has less space than the files need.
    capture.session.SessionError
        See `capture.session.copying.copy_session`.
    """
    if use is None:
        raise UsageError("--use: got none; name the purpose of the copy [SR-EXP-001]")
    opened = Session.open(session)
    opened.require_consent(use)
    need = forecast_resources("export session", {"source_mb": measure_folder_mb(session)})
    left_mb = max(need.disk_mb - measure_folder_mb(part_folder(copy)), 0.0)
    need = ResourceForecast(need.memory_mb, need.space_mb, left_mb)
    require_resources("session copy", need, copy)
    return copy_session(session, copy, read_back=read_back, progress=progress)
