"""Report section on a fused person's face, lit and moving."""

import json
import os
from collections.abc import Iterator
from pathlib import Path

from skinrig.drawing import frame_sheet
from skinrig.drawing.png import to_data_url
from skinrig.fusing.finished_face_file import DOCUMENT_FILE, LIVE_PAGE, SHEET_FILE
from skinrig.reporting import page

SECTION_TITLE = "The finished face"


def section(folder: Path, number: int, report_folder: Path | None) -> Iterator[page.Block]:
    """Yield the frames of a finished face with buttons for light and movement.

    Parameters
    ----------
    folder
        With frames and their record.
    number
        Number of the face on the page; it distinguishes the names of buttons.
    report_folder
        Folder of the report, for the link to the live page; None: unknown, without a link.
    """
    document = json.loads((folder / DOCUMENT_FILE).read_text(encoding="utf-8"))
    live = folder.parent / LIVE_PAGE
    link = ""
    if report_folder is not None and live.is_file():
        link = Path(os.path.relpath(live.resolve(), report_folder.resolve())).as_posix()
    width, height = frame_sheet.FRAME_PX
    lights = list(document["lights"])
    yield page.Heading(SECTION_TITLE, level=2)
    yield page.build_view(
        "finished_face",
        index=number,
        address=to_data_url((folder / SHEET_FILE).read_bytes(), "webp"),
        size=(width * frame_sheet.N_STEPS, height * frame_sheet.N_LIGHTS),
        lights=lights,
        first=frame_sheet.FIRST_LIGHT,
        document=document,
        link=link,
        command=f"skinrig view {folder.parent / document['person']} -o {live}",
        left_out=[[what, why] for what, why in document["left_out"]],
    )
