"""Write an export folder atomically, sealed by an ASC MHL manifest of all files."""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from capture.session.mhl import write_first_generation
from model.skin import SkinAppearance
from skinrig import consent
from skinrig.atomic_file import replace_folder_atomically


@dataclass(frozen=True, slots=True)
class ExportResult:
    """Files of an export with its omissions.

    Attributes
    ----------
    path
        The folder.
    manifest
        The ASC MHL manifest that lists every file.
    files
        Number of files, without the manifest.
    left_out
        Parts of the format that the source lacks, with reasons.
    """

    path: Path
    manifest: Path
    files: int
    left_out: tuple[tuple[str, str], ...] = ()


def export_sealed(
    target: Path,
    write: Callable[[Path], Sequence[tuple[str, str]] | None],
    now: datetime | None = None,
    *,
    progress: Callable[[str], None] | None = None,
) -> ExportResult:
    """Fill a hidden folder by ``write``, seal it, and rename it when it is complete.

    Parameters
    ----------
    target
        A folder that does not exist.
    write
        Called with an empty folder.
    now
        Date of the manifest; None: the present.
    progress
        Called with the name of the last step, before it begins.

    Returns
    -------
    ExportResult
        Omissions are those that ``write`` returned.
    """
    moment = now or datetime.now(UTC)
    with replace_folder_atomically(target) as part:  # has the final name, which is in the manifest
        left_out = tuple(write(part) or ())
        if progress is not None:
            progress("hash the written files")
        written = [path for path in part.rglob("*") if path.is_file()]
        for path in written:  # the manifest has dates: equal times give equal manifests
            os.utime(path, (moment.timestamp(), moment.timestamp()))
        manifest = write_first_generation(part, now=moment, version=version("skinrig"))
    return ExportResult(target, target / manifest.relative_to(part), len(written), left_out)


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a document as indented JSON; equal content gives equal bytes."""
    text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")


PROVENANCE_KEY: Final = "provenance"
"""Name of the JSON text of `format_provenance` in the metadata of EXR, PNG, MaterialX and USD."""
IMAGE_ORIENTATION: Final = (
    "row 0 of every image is its top; of a texture that is v = 1, with (0, 0) bottom left"
)


def describe_provenance(appearance: SkinAppearance) -> dict[str, Any]:
    """Return the provenance of an appearance as JSON values.

    Parameters
    ----------
    appearance
        Any appearance; of a dynamic one, the parts are listed.

    Examples
    --------
    >>> found = describe_provenance(SkinAppearance({}, "simulated", {"assumed": ["a"]}, seed=7))
    >>> found["source"], found["seed"], found["assumed"], found["consent"]
    ('simulated', 7, ['a'], [])
    """
    assumptions: list[Any] = [appearance.parameters.get("assumed")]
    parts = appearance.parameters.get("parts")
    if isinstance(parts, dict):
        assumptions += [part.get("assumed") for part in parts.values() if isinstance(part, dict)]
    assumed = [str(text) for one in assumptions if isinstance(one, list | tuple) for text in one]
    return {
        "source": appearance.source,
        "inputs": dict(appearance.inputs),
        "versions": dict(appearance.versions),
        "seed": appearance.seed,
        "assumed": list(dict.fromkeys(assumed)),
        "consent": consent.read_consent(appearance),
    }


def format_provenance(appearance: SkinAppearance) -> str:
    """Format the provenance of an appearance as one line of ASCII, JSON.

    Examples
    --------
    >>> json.loads(format_provenance(SkinAppearance({}, "simulated", seed=7)))["seed"]
    7
    """
    return json.dumps(describe_provenance(appearance), allow_nan=False, separators=(",", ":"))
