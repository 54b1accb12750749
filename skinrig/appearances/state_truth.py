"""Find the ground truth of a simulated session's state."""

from pathlib import Path
from typing import Final

from model import store
from skinrig.simulating.orders import truth_folder

DEFAULT_STATE: Final = "neutral"
"""State used if none is given."""


def find_state_truth(session: Path, state: str) -> Path | None:
    """Return the folder with a simulated session's truth of a state, where there is one.

    A session's first state has no name in its folder's: ``truth-face`` of `session-face`, and
    ``truth-face-smile`` of a state that comes later.
    """
    first = truth_folder(session)
    for named in (first, first.with_name(f"{first.name}-{state}")):
        if (named / store.DOCUMENT_FILE).is_file():
            if store.read_document(named).parameters.get("state") == state:
                return named
    return None


def find_comparison_truth(session: Path, state: str = DEFAULT_STATE) -> Path | None:
    """Return the folder with what maps of a session's state are to be compared with, or None.

    Where no state is asked for, as of rigs before which faces hold still, it is the session's own.
    """
    found = find_state_truth(session, state)
    if found is not None or state != DEFAULT_STATE:
        return found
    folder = truth_folder(session)
    return folder if (folder / store.DOCUMENT_FILE).is_file() else None
