"""Records of simulated subjects in manifests and ground truths."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rigsim.population import files as subject_file

SUBJECT_FILE_SUFFIX = ".toml"
"""Suffix of a subject file, see `rigsim.population.files`."""

FACE_TEXELS = 512
"""Texels per side of the face's simulated maps: about 0.5 mm each."""
COARSE_FACE_TEXELS = 256
MAX_COARSE_WIDTH_PX = 256
"""Up to this width a pixel of the flash rig and the dome is 1 mm or more on the face: as much as a
texel of `COARSE_FACE_TEXELS`."""


def choose_face_texels(width_px: int) -> int:
    """Return the texels per side of a simulated face's maps for images of a width."""
    return COARSE_FACE_TEXELS if width_px <= MAX_COARSE_WIDTH_PX else FACE_TEXELS


def pseudonym(subject: str, seed: int) -> str:
    """Return the pseudonym of a simulated subject.

    Examples
    --------
    >>> pseudonym("III", 0), pseudonym("homogeneous:0.04,1.5", 2), pseudonym("people/ann.toml", 0)
    ('simulated-III-0', 'simulated-homogeneous-0.04-1.5-2', 'simulated-ann-0')
    """
    label = Path(subject).stem if subject.endswith(SUBJECT_FILE_SUFFIX) else subject
    name = "".join(c if c.isascii() and (c.isalnum() or c in "_.-") else "-" for c in label)
    return f"simulated-{name}-{seed}"


def manifest_record(subject: str) -> str | dict[str, Any]:
    """Return a subject for a session's manifest: a preset's name, or the content of its file."""
    return subject_file.record_subject(subject)


def find_unused_subject_keys(
    subject: str, rig: str, progress: Callable[[str], None] | None = None
) -> tuple[str, ...]:
    """Return the keys of a subject file that do not affect a rig; empty for a preset.

    Parameters
    ----------
    subject
        Preset or file of the command line.
    rig
        Name of the rig.
    progress
        Called with one line that lists them, if there are any.
    """
    if not subject_file.is_subject_file(subject):
        return ()
    keys = subject_file.read_subject_file(subject).unused_keys(rig)
    if keys and progress is not None:
        progress(f"{subject}: without effect on the {rig} rig: {', '.join(keys)}")
    return keys


def truth_parameters(
    subject: str, rig: str, progress: Callable[[str], None] | None
) -> dict[str, Any]:
    """Return the ground truth's parameters from a subject file; empty for a preset.

    Parameters
    ----------
    subject
        Preset or file of the command line.
    rig
        Name of the rig.
    progress
        Called with one line that lists the keys without effect on the rig.
    """
    if not subject_file.is_subject_file(subject):
        return {}
    return {
        "subject": Path(subject).stem,
        "subject_file": subject_file.record_subject(subject),
        "subject_unused": list(find_unused_subject_keys(subject, rig, progress)),
    }
