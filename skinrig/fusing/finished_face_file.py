"""Names of the files of a finished face, which a report searches."""

from typing import Final

SCHEMA: Final = "skinrig.finished-face/1"
DOCUMENT_FILE: Final = "finished_face.json"
"""File that marks the folder of a finished face."""
SHEET_FILE: Final = "frames.webp"
LIVE_PAGE: Final = "person.html"
"""Page of `skinrig view` next to that folder, to which a report links."""
