"""Find the ground truth of an expression or strain step of a simulated session."""

from pathlib import Path
from typing import Final

from model import store
from skinrig.simulating.orders import truth_folder

DEFAULT_STATE: Final = "neutral"
"""Expression used if none is given."""


def find_state_truth(session: Path, state: str) -> Path | None:
    """Return the ground truth folder of a simulated session's expression, if it exists.

    The first expression of `session-face` is in ``truth-face``, a later one such as smile in
    ``truth-face-smile``.
    """
    first = truth_folder(session)
    for named in (first, first.with_name(f"{first.name}-{state}")):
        if (named / store.DOCUMENT_FILE).is_file():
            if store.read_document(named).parameters.get("state") == state:
                return named
    return None


def find_comparison_truth(session: Path, state: str = DEFAULT_STATE) -> Path | None:
    """Return the ground truth folder with which maps of a session are compared, or None.

    For the default expression, as of rigs with one expression only, it is the session's own.
    """
    found = find_state_truth(session, state)
    if found is not None or state != DEFAULT_STATE:
        return found
    folder = truth_folder(session)
    return folder if (folder / store.DOCUMENT_FILE).is_file() else None
