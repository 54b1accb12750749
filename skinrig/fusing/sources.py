"""Find the maps of one person by several rigs, from sessions or appearances."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from capture.rig import load_rig
from capture.session import Session
from model import store
from model.skin import SkinAppearance
from reconstruction.pipeline.probe.stages import SUBSURFACE_FILE
from skinrig.appearances.contents import FUSION_KEY, hash_document
from skinrig.appearances.dynamic import DYNAMIC_KIND, WRINKLES, describe_parts
from skinrig.errors import UsageError
from skinrig.fusing.unmeasured import drop_unmeasured

RIG_NAMES: Final = ("flash", "dome", "gradient", "probe", WRINKLES)
"""Rigs whose maps can be fused, in the order of the table of inputs; the dome's wrinkles last."""
SESSION_FILE: Final = "session.json"


class FusionInputError(ValueError):
    """Folders whose maps cannot be fused."""


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """Maps of one rig."""

    rig: str
    path: Path
    appearance: SkinAppearance

    @property
    def digest(self) -> str:
        """SHA-256 of the folder's document."""
        return hash_document(self.path)

    def spectra(self) -> tuple[str, str, bool]:
        """Return names of camera and illuminant, and whether the session states them."""
        table: Any = self.appearance.parameters.get("color_table")
        if isinstance(table, dict):
            return str(table["camera"]), str(table["illuminant"]), True
        session = self._sibling("session", SESSION_FILE)
        rig = load_rig(self.rig) if session is None else Session.open(session).rig
        return rig.views[0].spectral_sensitivity, rig.lights[0].illuminant, session is not None

    def site(self) -> str:
        """Return the site of a patch: the last word of the folder's name."""
        return re.sub(r"[^a-z0-9_]", "_", self.path.resolve().name.rpartition("-")[2].lower())

    def truth(self) -> SkinAppearance | None:
        """Return the ground truth next to the maps; None of measured people."""
        folder = self._sibling("truth", store.DOCUMENT_FILE)
        return None if folder is None else store.read(folder)

    def _sibling(self, key: str, document: str) -> Path | None:
        """Return a folder next to the maps that they name, if it has its document."""
        name = self.appearance.parameters.get(key)
        if not isinstance(name, str) or not name or Path(name).name != name:
            return None
        folder = self.path.resolve().parent / name
        return folder if (folder / document).is_file() else None


@dataclass(frozen=True, slots=True, eq=False)
class Sources:
    """Maps of one person, one folder per rig."""

    by_rig: Mapping[str, Source]

    def get(self, rig: str) -> Source | None:
        """Return the maps of a rig; None if it was not given."""
        return self.by_rig.get(rig)

    def without(self, rigs: Sequence[str]) -> "Sources":
        """Return the maps of the other rigs.

        Parameters
        ----------
        rigs
            Names to leave out.

        Raises
        ------
        FusionInputError
            If none is left, or a name is not that of a given rig.
        """
        for name in rigs:
            if name not in self.by_rig:
                raise FusionInputError(
                    f"--without: got {name!r}, expected one of {', '.join(self.by_rig)}, their "
                    "maps r_d, diffuse, sigma_tr, normals, covariance, or unmeasured; name a given "
                    "one"
                )
        return Sources({name: one for name, one in self.by_rig.items() if name not in rigs})


def read_sources(paths: Sequence[Path]) -> Sources:
    """Read the maps of one person.

    Parameters
    ----------
    paths
        APPEARANCE/ folders, or SESSION/ folders with their maps next to them.

    Raises
    ------
    FusionInputError
        If maps are of no known rig, or two folders are of one rig.
    """
    found: dict[str, Source] = {}
    for path in paths:
        folder = _find_maps(path)
        appearance = store.read(folder)
        rig = _recognize(folder, appearance)
        if rig in found:
            raise FusionInputError(
                f"{folder}: got a second {rig} folder after {found[rig].path}; give one per rig"
            )
        # the result gets its own parts for display, or none
        found[rig] = Source(rig, folder, drop_unmeasured(appearance))
    if not {"flash", "dome"} & found.keys():
        raise FusionInputError(
            f"{', '.join(map(str, paths)) or 'none'}: got no colors of a face, expected maps of "
            "the dome (r_d) or of the flash rig (diffuse); add one"
        )
    return Sources({name: found[name] for name in RIG_NAMES if name in found})


def _find_maps(path: Path) -> Path:
    """Return the folder of maps of a session, or the folder itself."""
    if not (path / SESSION_FILE).is_file():
        return path
    near = [
        entry
        for entry in sorted(path.resolve().parent.iterdir())
        if (entry / store.DOCUMENT_FILE).is_file()
    ]
    for entry in near:
        document = store.read_document(entry)
        own = document.parameters.get("session") == path.resolve().name
        is_own = own and document.parameters.get("kind") == "appearance"
        if is_own and FUSION_KEY not in document.parameters:
            return entry
    raise UsageError(
        f"{path}: got a session without maps next to it, expected an appearance; run "
        f"`skinrig reconstruct {path}` first, or give the folder of its maps"
    )


def _recognize(path: Path, appearance: SkinAppearance) -> str:
    """Return the rig of an appearance by its maps and files."""
    maps, files = appearance.maps, appearance.files
    if appearance.parameters.get("kind") == DYNAMIC_KIND and WRINKLES in describe_parts(appearance):
        return WRINKLES
    if "r_d" in maps and "position" in maps:
        return "dome"
    if "diffuse" in maps:
        return "flash"
    if SUBSURFACE_FILE in files:
        return "probe"
    if any(name.startswith("normals_") and name.endswith("_n0") for name in maps):
        return "gradient"
    raise FusionInputError(
        f"{path}: got maps {', '.join(sorted(maps)) or 'none'}, expected r_d with position "
        f"(dome), diffuse (flash), {SUBSURFACE_FILE} (probe), normals of the neutral step "
        "(gradient) or fitted wrinkles; reconstruct or fit them first"
    )
