"""What the viewer shows: a mesh that moves, textures, tables, parameters and what is left out.

A scene is plain data. Its sources (`skinrig.viewer.faces`, `skinrig.viewer.faces`)
say what is known of a face; asset builders turn that into textures, tables and parameters; the
packer (`skinrig.viewer.packing`) makes it small.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal, TypedDict, get_args

import numpy as np

from model.skin import SkinAppearance
from rigsim.geometry.mesh import Mesh
from rigsim.subject import SimulatedSubject
from skinrig.arrays import Float32Array
from skinrig.viewer.fine_skin import FineSkin

Storage = Literal["u8", "u16", "f16", "f32"]
Filter = Literal["linear", "mipmap", "nearest"]
Kind = Literal["procedural", "mesh", "dynamic", "dome", "model"]

MAX_TEXTURE_PX: Final = 4096
"""Texels a side that any WebGL2 device of the last ten years takes."""


class SceneError(ValueError):
    """A scene that contradicts itself, or nothing that could be shown."""


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """One texture of the page.

    Attributes
    ----------
    values : ndarray of float32
        Shape (H, W, C), C from 1 to 4, row 0 at the top (v = 1); or (L, H, W, C) for layers.
    storage
        How the page holds it: "u8" and "u16" are spread linearly over the range of each layer and
        channel; "f16" and "f32" as they are.
    filter
        Between texels.
    fine
        Of "u8" alone: the finest octave (what a texel differs by from its neighborhood) is rounded
        to so many words; 1 keeps all. Noise costs the most bytes and shows the least there.
    """

    values: Float32Array
    storage: Storage = "u8"
    filter: Filter = "linear"
    fine: int = 1

    def __post_init__(self) -> None:
        """Check shape, numbers and names."""
        shape = self.values.shape
        if self.values.ndim not in (3, 4) or not 1 <= shape[-1] <= 4 or 0 in shape:
            raise SceneError(
                f"texture: got shape {shape}, expected (H, W, C) or (L, H, W, C) with C from 1 to 4"
            )
        if max(shape[-3:-1]) > MAX_TEXTURE_PX:
            raise SceneError(
                f"texture: got {shape}, expected at most {MAX_TEXTURE_PX} texels a side; "
                "choose a smaller --size-px"
            )
        if self.values.dtype != np.float32 or not np.isfinite(self.values).all():
            raise SceneError(f"texture: got {self.values.dtype} or NaN, expected finite float32")
        if self.storage not in get_args(Storage) or self.filter not in get_args(Filter):
            raise SceneError(f"texture: got {self.storage!r}, {self.filter!r}: unknown")
        if self.fine != 1 and (
            self.storage != "u8" or not 1 < self.fine < 128 or any(n % 2 for n in shape[-3:-1])
        ):
            raise SceneError(
                f"texture: got fine = {self.fine} of {self.storage} {shape}, expected 1, or up to "
                "127 of u8 with an even number of texels a side"
            )


class Assets(TypedDict, total=False):
    """What an asset builder adds to a scene; every key may be missing."""

    textures: Mapping[str, Texture]
    tables: Mapping[str, Float32Array]
    params: Mapping[str, Any]
    presets: Mapping[str, Mapping[str, Any]]
    facts: Mapping[str, Any]
    left_out: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True, eq=False)
class SceneSource:
    """What is known of a face before assets are built from it.

    Attributes
    ----------
    kind
        Where it comes from.
    mesh
        Its geometry.
    size
        Texels a side of the large textures.
    seed
        Of everything that is drawn, where something is.
    subject
        The simulated person who stands for what was not measured.
    skin
        Its finest maps at `size`.
    appearances
        Fitted folders by kind: "dynamic" (facial color, wrinkles, microstructure), "dome", "model".
    paths
        Those folders.
    landmarks
        Table of named points of the picture that the flash rig's maps are drawn on.
    calibration
        Folder with the color calibration of the dome's cameras.
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

    @property
    def fitted(self) -> tuple[SkinAppearance, ...]:
        """Folders of a dome's maps, the better one first: a model with lobes, or the maps alone."""
        return tuple(self.appearances[k] for k in ("model", "dome") if k in self.appearances)


@dataclass(frozen=True, slots=True, eq=False)
class ViewerScene:
    """All that goes into a page.

    Attributes
    ----------
    mesh
        Geometry and blend shapes.
    textures, tables
        By name; a table is a float32 array of any shape, (rows, columns, channels) where the page
        samples it: row 0 first, not flipped.
    params
        Parameters the page starts with; JSON values.
    presets
        Parameters that a preset sets, by name.
    facts
        Stated errors and figures that the page shows; JSON values.
    provenance
        Where the scene comes from.
    left_out
        (what, why) of each feature that the page lacks.
    """

    mesh: Mesh
    textures: Mapping[str, Texture] = field(default_factory=dict)
    tables: Mapping[str, Float32Array] = field(default_factory=dict)
    params: Mapping[str, Any] = field(default_factory=dict)
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    left_out: tuple[tuple[str, str], ...] = ()

    def with_assets(self, assets: Assets) -> ViewerScene:
        """Return the scene with more in it.

        Raises
        ------
        SceneError
            Two builders name a texture, table, parameter, preset or fact alike.
        """
        merged: dict[str, Any] = {}
        for key in ("textures", "tables", "params", "presets", "facts"):
            old: Mapping[str, Any] = getattr(self, key)
            new: Mapping[str, Any] = assets.get(key, {})  # type: ignore[assignment]
            double = sorted(set(old) & set(new))
            if double:
                raise SceneError(f"{key}: {double[0]!r} comes from two builders")
            merged[key] = MappingProxyType({**old, **new})
        return replace(self, **merged, left_out=(*self.left_out, *assets.get("left_out", ())))
