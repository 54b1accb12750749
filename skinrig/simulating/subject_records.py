"""What manifests and truths of simulated captures hold of whom they show."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rigsim.population import files as subject_file

SUBJECT_FILE_SUFFIX = ".toml"
"""Of a subject's file, see `rigsim.population.files`."""


def pseudonym(subject: str, seed: int) -> str:
    """Return the pseudonym of a simulated subject.

    Examples
    --------
    >>> pseudonym("III", 0), pseudonym("homogeneous:0.04,1.5", 2), pseudonym("people/ann.toml", 0)
    ('simulated-III-0', 'simulated-homogeneous-0.04-1.5-2', 'simulated-ann-0')
    """
    said = Path(subject).stem if subject.endswith(SUBJECT_FILE_SUFFIX) else subject
    name = "".join(c if c.isascii() and (c.isalnum() or c in "_.-") else "-" for c in said)
    return f"simulated-{name}-{seed}"


def manifest_record(subject: str) -> str | dict[str, Any]:
    """Return a subject as a session's manifest holds it: a preset, or all that its file says."""
    return subject_file.record_subject(subject)


def find_unused_subject_keys(
    subject: str, rig: str, progress: Callable[[str], None] | None = None
) -> tuple[str, ...]:
    """Return the keys of a subject's file of which a rig sees nothing; none of a preset.

    Parameters
    ----------
    subject
        As the command line has it.
    rig
        Name of the rig.
    tell
        Told of them, in one line, where there are any.
    """
    if not subject_file.is_subject_file(subject):
        return ()
    keys = subject_file.read_subject_file(subject).unused_keys(rig)
    if keys and progress is not None:
        progress(f"{subject}: the {rig} rig sees nothing of {', '.join(keys)}")
    return keys


def truth_parameters(
    subject: str, rig: str, progress: Callable[[str], None] | None
) -> dict[str, Any]:
    """Return parameters of a truth that tell of a subject's file; none of a preset.

    Parameters
    ----------
    subject
        As the command line has it.
    rig
        Name of the rig.
    progress
        Told what the file says and the rig does not see.
    """
    if not subject_file.is_subject_file(subject):
        return {}
    return {
        "subject": Path(subject).stem,
        "subject_file": subject_file.record_subject(subject),
        "subject_unused": list(find_unused_subject_keys(subject, rig, progress)),
    }
