"""Open trait libraries: their spaces by facial region, and the parameters of their samples."""

import hashlib
import io
import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np

from model.checks.files import read_arrays
from model.texture_statistics.space import TextureError, TextureSpace
from model.traits import TraitSpace
from model.traits import storage as trait_storage
from model.traits.storage import TraitLibrary
from reconstruction.correspondence import common_regions
from reconstruction.correspondence.common_parameterization import CommonFrame
from skinrig.appearances.contents import hash_file
from skinrig.errors import UnusableError, require_choice
from skinrig.traits.albedo_vectors import AlbedoTraits, VectorKind

SURFACE_SPACE: Final = "surface"
ALBEDO_SPACE: Final = "albedo"
TEXTURE_SPACE_FILE: Final = "texture_space.npz"
DEFAULT_SIDE_MM, DEFAULT_SIZE_PX = 240.0, 256
"""Side and size of the common map, for a library that does not record them."""


def space_name(region: str) -> str:
    """Return the name of the space of a region's albedo.

    Examples
    --------
    >>> space_name("face"), space_name("no-beard")
    ('albedo', 'albedo_no_beard')
    """
    return ALBEDO_SPACE if region == "face" else f"{ALBEDO_SPACE}_{region.replace('-', '_')}"


def library_parameters(frame: CommonFrame, kind: VectorKind, **more: Any) -> dict[str, Any]:
    """Return the parameters of a library's samples."""
    return {"vectors": kind, "frame": frame.to_document(), **more}


def texture_bytes(space: TextureSpace) -> bytes:
    """Encode a texture space as the bytes of a file."""
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        mean=space.mean,
        axes=space.axes,
        edges=space.edges,
        counts=np.array([space.levels, space.orientations, space.images]),
    )
    return stream.getvalue()


@dataclass(frozen=True, slots=True, eq=False)
class LibraryParts:
    """Decoded parts of a trait library.

    Attributes
    ----------
    surface
        Traits of mean mixtures of materials, or None.
    albedo
        Albedo traits by region.
    frame
        The common map.
    """

    surface: TraitSpace | None
    albedo: dict[str, AlbedoTraits]
    frame: CommonFrame

    @property
    def traits(self) -> tuple[str, ...]:
        """All traits, in alphabetical order."""
        spaces = [one.traits for one in self.albedo.values()]
        spaces += [] if self.surface is None else [self.surface]
        return tuple(sorted({name for space in spaces for name in space.traits}))


def open_library(library: TraitLibrary) -> LibraryParts:
    """Decode the parts of a trait library.

    Raises
    ------
    UnusableError
        If its albedo traits lack their texture space.
    """
    parameters = library.parameters
    stated = parameters.get("vectors", "histograms")
    kind = require_choice("vectors", stated, get_args(VectorKind))
    frame = (
        CommonFrame.from_document(parameters["frame"])
        if isinstance(parameters.get("frame"), dict)
        else common_regions.standard_frame(
            side_mm=DEFAULT_SIDE_MM, center_mm=(0.0, 0.0), size=DEFAULT_SIZE_PX
        )
    )
    albedo = {}
    for region in common_regions.REGION_NAMES:
        if space_name(region) in library.spaces:
            albedo[region] = AlbedoTraits(
                kind, _texture(library), library.spaces[space_name(region)]
            )
    return LibraryParts(library.spaces.get(SURFACE_SPACE), albedo, frame)


def _texture(library: TraitLibrary) -> TextureSpace:
    content = library.files.get(TEXTURE_SPACE_FILE)
    if content is None:
        raise UnusableError(
            f"files: got {json.dumps(sorted(library.files))}, expected {TEXTURE_SPACE_FILE}: "
            "albedo traits need their texture space; learn the library again"
        )
    try:
        stored = read_arrays(content)
        mean, axes, edges = (stored[name] for name in ("mean", "axes", "edges"))
        levels, orientations, images = (int(n) for n in stored["counts"])
        return TextureSpace(mean, axes, edges, levels, orientations, images)
    except (KeyError, ValueError, TypeError, TextureError) as error:
        raise UnusableError(
            f"{TEXTURE_SPACE_FILE}: cannot be read: {error}; learn the library again"
        ) from error


def load(path: Path | None) -> tuple[TraitLibrary, str]:
    """Read a library and the hash of its file; None: the library of this package.

    Raises
    ------
    UnusableError
        For None, if this package has no library.
    """
    if path is not None:
        return trait_storage.load(path), hash_file(path)
    packaged = resources.files("model").joinpath("data", trait_storage.PACKAGED_FILE)
    if not packaged.is_file():
        raise UnusableError(
            "traits: this package has no library; name one with --space FILE (`skinrig fit "
            "traits` learns one)"
        )
    return trait_storage.load_packaged_traits(), hashlib.sha256(packaged.read_bytes()).hexdigest()
