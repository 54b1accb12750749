"""Define the viewer's scene: deformable mesh, textures, tables, parameters and omissions.

A scene is plain data. `skinrig.viewer.faces` collects the known data of a face. Asset builders
derive textures, tables and parameters from it, and `skinrig.viewer.packing` compresses them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal, TypedDict, get_args

import numpy as np
from numpy.typing import NDArray

from model.skin import SkinAppearance
from rigsim.geometry.mesh import Mesh
from rigsim.subject import SimulatedSubject
from skinrig.arrays import Float32Array
from skinrig.unmeasured.person import FaceParts
from skinrig.viewer.fine_skin import FineSkin

Storage = Literal["u8", "u16", "f16", "f32"]
Page = Literal["head", "picture"]
"""A head with blend shapes, or an image with normals."""
Filter = Literal["linear", "mipmap", "nearest"]
Kind = Literal["procedural", "mesh", "probe", "flash", "dynamic", "dome", "model"]

MAX_TEXTURE_PX: Final = 4096
"""Maximum side of a texture on any WebGL2 device of the last ten years."""


class SceneError(ValueError):
    """An inconsistent scene, or data that cannot be displayed."""


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """One texture of the page.

    Attributes
    ----------
    values : ndarray of float32
        Shape (H, W, C), C from 1 to 4, row 0 at the top (v = 1); or (L, H, W, C) for layers.
    storage
        Storage in the page: "u8" and "u16" are scaled linearly to the range of each layer and
        channel; "f16" and "f32" are unscaled.
    filter
        Interpolation between texels.
    fine
        Quantization step of the finest octave (difference of a texel from its neighborhood) in
        words, only for "u8"; 1: lossless. Noise there costs most bytes and is least visible.
    """

    values: Float32Array
    storage: Storage = "u8"
    filter: Filter = "linear"
    fine: int = 1

    def __post_init__(self) -> None:
        """Raise for invalid shapes, values and names."""
        shape = self.values.shape
        if self.values.ndim not in (3, 4) or not 1 <= shape[-1] <= 4 or 0 in shape:
            raise SceneError(
                f"texture: got shape {shape}, expected (H, W, C) or (L, H, W, C) with C from 1 to 4"
            )
        if max(shape[-3:-1]) > MAX_TEXTURE_PX:
            raise SceneError(
                f"texture: got {shape}, expected at most {MAX_TEXTURE_PX} texels per side; "
                "choose a smaller --size-px"
            )
        if self.values.dtype != np.float32 or not np.isfinite(self.values).all():
            raise SceneError(f"texture: got {self.values.dtype} or NaN, expected finite float32")
        if self.storage not in get_args(Storage) or self.filter not in get_args(Filter):
            raise SceneError(
                f"texture: got {self.storage!r}, {self.filter!r}, expected a storage and a filter"
            )
        if self.fine != 1 and (
            self.storage != "u8" or not 1 < self.fine < 128 or any(n % 2 for n in shape[-3:-1])
        ):
            raise SceneError(
                f"texture: got fine = {self.fine} of {self.storage} {shape}, expected 1, or up to "
                "127 of u8 with an even number of texels per side"
            )


class Assets(TypedDict, total=False):
    """Additions of an asset builder to a scene; every key is optional."""

    textures: Mapping[str, Texture]
    tables: Mapping[str, NDArray[Any]]
    params: Mapping[str, Any]
    presets: Mapping[str, Mapping[str, Any]]
    facts: Mapping[str, Any]
    left_out: tuple[tuple[str, str], ...]
    added: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True, eq=False)
class SceneSource:
    """Data of a face from which assets are built.

    Attributes
    ----------
    kind
        Kind of source.
    mesh
        Geometry.
    size
        Side of the large textures, texels.
    seed
        Random seed of simulated parts.
    subject
        Simulated person that replaces what was not measured.
    skin
        Finest maps of that person, of side `size`.
    appearances
        Folders by kind: "probe" (translucency), "flash" (chromophores in an image), "dynamic"
        (facial color, wrinkles, microstructure), "dome", "model".
    paths
        Paths of these folders.
    landmarks
        Table of landmarks of the flash rig's neutral image.
    calibration
        Folder with the color calibration of the dome's cameras.
    own_mesh
        Whether the mesh is a scan or a file, not the simulated head.
    parts
        Eyes and hair on this mesh, which were not measured; None: without.
    """

    kind: Kind
    mesh: Mesh
    size: int
    seed: int
    subject: SimulatedSubject
    skin: FineSkin
    appearances: Mapping[str, SkinAppearance] = field(default_factory=dict)
    paths: Mapping[str, Path] = field(default_factory=dict)
    landmarks: Path | None = None
    calibration: Path | None = None
    own_mesh: bool = False
    parts: FaceParts | None = None

    @property
    def captured(self) -> bool:
        """Whether something of the face was captured."""
        return bool(self.appearances)

    @property
    def fitted(self) -> tuple[SkinAppearance, ...]:
        """Appearances of a dome, the fitted model before plain maps."""
        return tuple(self.appearances[k] for k in ("model", "dome") if k in self.appearances)


@dataclass(frozen=True, slots=True, eq=False)
class ViewerScene:
    """Contents of a page.

    Attributes
    ----------
    mesh
        Geometry and blend shapes.
    textures, tables
        Textures and tables by name. A table is an array of any shape, or float32 of (rows, columns,
        channels) if the page samples it; row 0 first, not flipped.
    params
        Initial parameters of the page, JSON values.
    presets
        Parameters by preset.
    facts
        Errors and figures that the page displays, JSON values.
    provenance
        Provenance of the scene.
    left_out
        Omitted features with reasons.
    added
        Displayed parts that were not measured, with their source and error.
    page
        Page that shows the scene.
    """

    mesh: Mesh
    textures: Mapping[str, Texture] = field(default_factory=dict)
    tables: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    params: Mapping[str, Any] = field(default_factory=dict)
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    left_out: tuple[tuple[str, str], ...] = ()
    added: tuple[tuple[str, str], ...] = ()
    page: Page = "head"

    def with_assets(self, assets: Assets) -> ViewerScene:
        """Return the scene with added assets.

        Raises
        ------
        SceneError
            If two builders use the same name.
        """
        merged: dict[str, Any] = {}
        for key in ("textures", "tables", "params", "presets", "facts"):
            old: Mapping[str, Any] = getattr(self, key)
            new: Mapping[str, Any] = assets.get(key, {})  # type: ignore[assignment]
            double = sorted(set(old) & set(new))
            if double:
                raise SceneError(f"{key}: {double[0]!r} comes from two builders")
            merged[key] = MappingProxyType({**old, **new})
        left_out = (*self.left_out, *assets.get("left_out", ()))
        added = (*self.added, *assets.get("added", ()))
        return replace(self, **merged, left_out=left_out, added=added)
