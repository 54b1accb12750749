"""Turn one photograph of a face into maps and a report."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from capture.session.manifest import SubjectRecord
from skinrig.errors import UnusableError

PORTRAIT_MAPS: Final = ("image", "melanin", "hemoglobin")


@dataclass(frozen=True, slots=True)
class Portrait:
    """Folders that `analyze_portrait` wrote."""

    session: Path
    appearance: Path
    report: Path
    assumed: tuple[str, ...]
    """Assumptions in place of calibrations, one sentence each."""


def analyze_portrait(
    photograph: Path,
    out: Path,
    *,
    width_px: int,
    subject: SubjectRecord,
    progress: Callable[..., None],
) -> Portrait:
    """Find the face of a photograph, estimate its chromophores, and write a report.

    Parameters
    ----------
    photograph
        RAW, TIFF, EXR, PNG or JPEG file.
    out
        Folder for session, maps and report.
    width_px
        Largest width of the face's image; a wider one is averaged by a whole factor.
    subject
        Person in the photograph, with the consent.
    progress
        Called with one line before each step.

    Raises
    ------
    skinrig.errors.UnusableError
        If `photograph` is not a file, or gray, or `out` has content.
    capture.importers.image_checks.PhotoError
        If it cannot be read, or shows no face.
    """
    from capture.importers import import_photos
    from capture.importers.framing import FACE_CROP, Framing
    from reconstruction.pipeline import recipes as pipeline
    from skinrig.atomic_file import replace_folder_atomically, write_atomically
    from skinrig.reporting.report import build_any

    if not photograph.is_file():
        raise UnusableError(
            f"{photograph}: got no file, expected one photograph; a folder of them is imported by"
            " `skinrig import photos`"
        )
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UnusableError(f"--out: {out} exists, expected a new or empty folder; name another")
    with replace_folder_atomically(out) as made:
        session, appearance, report = _list_places(made)
        progress("find the face")
        framing = Framing.parse(FACE_CROP, width_px)
        done = import_photos(photograph, out=session, framing=framing, subject=subject)
        if not done.color_states:
            raise UnusableError(
                f"{photograph}: got a gray photograph, expected a color photograph, from which "
                "melanin and hemoglobin follow; give another file"
            )
        found = pipeline.reconstruct(session, want=PORTRAIT_MAPS, out=appearance, progress=progress)
        progress("write the report")
        write_atomically(report, build_any([appearance]).html)
    assumed = tuple(dict.fromkeys((*done.assumed, *found.assumed)))
    return Portrait(*_list_places(out), assumed)


def _list_places(folder: Path) -> tuple[Path, Path, Path]:
    """Return the session, the maps and the report in a folder."""
    return folder / "session", folder / "appearance", folder / "report.html"
