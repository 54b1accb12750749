"""The measured relief of sites grown over a mesh, and moved with it."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import numpy as np
from scipy import ndimage

from model.displacement_synthesis import growth as displacement_synthesis
from model.displacement_synthesis.sources import leveled
from model.displacement_synthesis.volume_noise import VolumeNoise
from model.microstructure import KernelTable
from model.microstructure.strain_fields import KernelRegions
from model.skin import SkinAppearance, SkinMap
from rigsim.geometry.atlas import dilate_texture, unwrap
from rigsim.geometry.mesh import build_mesh
from rigsim.subject.expressions import displacement_mm, moves
from rigsim.subject.face_regions import on_mean_head, region_masks
from rigsim.subject.perfusion import STATE_NAMES
from skinrig.appearances.dynamic import MICROSTRUCTURE
from skinrig.applying.expression import Applied, ApplyError
from skinrig.applying.microstructure import apply_microstructure
from skinrig.arrays import Float32Array, Float64Array
from skinrig.blend_shapes import meshes as blend_shapes
from skinrig.blend_shapes.meshes import BlendShapeMesh

REGION_ATLAS_PX: Final = 256
"""Texels a side of the maps that say whose relief is where, and how large pixels are."""
SITE_REGIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "forehead": ("forehead", "brows", "temples"),
    "cheek": ("cheeks", "nose sides", "lids", "nose"),
    "chin": ("chin", "lips", "mouth corners", "neck"),
}
"""Regions of a face that a site's relief stands for."""
MIN_PATCH_PX: Final = 64
MIN_WAVES_PER_MM: Final = 1.0
"""The relief's longest waves: longer ones are the face's own shape (Nagano2015, section 4)."""
MAX_WAVES_PER_MM: Final = 25.0
NYQUIST_FRACTION: Final = 0.8
PIXEL_SIZE_TOL: Final = 0.01
"""Sizes of pixels that count as one: calibrations of one rig differ by less."""
POSITION_ATLAS_PX: Final = 1024
ROWS_PER_NOISE_BAND: Final = 256
RELIEF_SOURCES: Final = ("patches", "noise")
EXTRAPOLATION_MODES: Final = ("hold", "formula")
MAX_EXR_SIDE_PX: Final = 8192
"""Larger maps are written as .npy files beside the folder, tile by tile, and not as EXR."""

Choice = TypeVar("Choice", bound=str)


def one_of(option: str, value: str, choices: tuple[Choice, ...]) -> Choice:
    """Return an option's value when it is one of the choices.

    Raises
    ------
    ApplyError
        It is none.
    """
    for choice in choices:
        if value == choice:
            return choice
    raise ApplyError(f"{option}: got {value!r}, expected one of {', '.join(choices)}")


@dataclass(frozen=True, slots=True)
class Relief:
    """Evaluates the microstructure part of a dynamic appearance on a mesh.

    Attributes
    ----------
    mesh
        With a shape for each name in ``weights``.
    weights
        Of the mesh's shapes.
    own_shapes
        Which of the names the mesh file has itself; the others are moved as the simulated head.
    size_px
        Pixels a side of the map.
    site
        Whose relief covers the whole mesh; None: each site its own region, where there are several.
    source
        "patches": the measured ones, grown; "noise": noise in space as high as they are, which has
        no seams between islands of the texture.
    extrapolate
        "hold" or "formula", beyond the table's range.
    seed
        Of the growth.
    aside
        Folder for maps that are too large for EXR.
    mesh_sha256
        Of the mesh's file.
    progress
        Called with one line now and then.
    """

    mesh: BlendShapeMesh
    weights: Mapping[str, float]
    own_shapes: tuple[str, ...]
    size_px: int
    site: str | None
    source: str
    extrapolate: Literal["hold", "formula"]
    seed: int
    aside: Path
    mesh_sha256: str
    progress: Callable[[str], None]

    @staticmethod
    def of(
        path: Path,
        weights: Mapping[str, float],
        *,
        size_px: int,
        site: str | None,
        source: str = "patches",
        extrapolate: str,
        seed: int,
        out: Path,
        progress: Callable[[str], None],
    ) -> Relief:
        """Load the mesh and give it the shapes that states need.

        Maps of more than `MAX_EXR_SIDE_PX` go to a folder beside ``out``, as .npy files.

        Raises
        ------
        ApplyError, BlendShapeError
            For a size, a weight's name or a mesh that cannot be used.
        """
        if not MIN_PATCH_PX <= size_px <= 65_536:
            raise ApplyError(f"size: got {size_px}, expected {MIN_PATCH_PX} to 65536 px")
        mesh = blend_shapes.load(path)
        used = {name: weight for name, weight in weights.items() if name != "neutral"}
        shaped, own = _with_states(mesh, list(used))
        held = one_of("extrapolate", extrapolate, EXTRAPOLATION_MODES)
        kept: Literal["hold", "formula"] = "hold" if held == "hold" else "formula"
        moved = {n: w for n, w in used.items() if n in shaped.shapes}
        aside = out.with_name(f"{out.name}-large")
        made_of = one_of("synthesize", source, RELIEF_SOURCES)
        return Relief(
            shaped, moved, own, size_px, site, made_of, kept, seed, aside, _sha256(path), progress
        )

    def __call__(self, appearance: SkinAppearance, part: dict[str, Any], done: Applied) -> None:
        """Grow the neutral relief, move it, and put the maps into ``done``."""
        sites = dict(part["sites"])
        if self.site is not None and self.site not in sites:
            raise ApplyError(f"site: got {self.site!r}, expected one of {', '.join(sites)}")
        names = [self.site] if self.site is not None else list(sites)
        scale = _scale(self.mesh)
        rng = np.random.default_rng(self.seed)
        patches = {name: [_patch(name, appearance, sites[name])] for name in names}
        pixels_um = [float(sites[name]["pixel_um"]) for name in names]
        if max(pixels_um) > (1.0 + PIXEL_SIZE_TOL) * min(pixels_um):
            raise ApplyError(
                f"sites: reliefs with pixels of {sorted(pixels_um)} um, expected one size; "
                "choose one with --site"
            )
        regions = _regions(self.mesh, names)
        large = self.size_px > MAX_EXR_SIDE_PX
        neutral: Any = None
        if large:
            self.aside.mkdir(parents=True, exist_ok=True)
            growing = self.aside / "displacement_neutral.npy.part"
            neutral = np.lib.format.open_memmap(growing, "w+", np.float32, (self.size_px,) * 2)
        if self.source == "noise":
            self.progress(f"draw noise on {self.size_px} x {self.size_px} pixels")
            rms_um = float(np.sqrt(np.mean([np.nanvar(one) for (one,) in patches.values()])))
            neutral = _noise(self.mesh, self.size_px, rms_um, scale, rng=rng, out=neutral)
        else:
            self.progress(
                f"grow the relief of {', '.join(names)} to {self.size_px} x {self.size_px}"
            )
            neutral = displacement_synthesis.grow(
                patches,
                self.size_px,
                rng=rng,
                regions=regions,
                out=neutral,
                pixel_um=scale / self.size_px,
                patch_pixel_um=float(np.mean(pixels_um)),
                threads=2,
            )
        if large:
            neutral.flush()
            os.replace(growing, self.aside / "displacement_neutral.npy")
        tables = tuple(
            KernelTable.from_json(appearance.files[sites[name]["table"]].decode()) for name in names
        )
        kernels = tables[0] if regions is None else KernelRegions(tables, regions)
        self.progress("strain and convolution")
        moved = apply_microstructure(
            self.mesh,
            self.weights,
            neutral,
            kernels,
            extrapolate=self.extrapolate,
            out=self.aside / "displacement.npy" if large else None,
            progress=lambda at, of: self.progress(f"tile {at} of {of}"),
        )
        made = "noise as high as" if self.source == "noise" else "grown from"
        note = f"um, {made} measured patches; texture of the mesh"
        if large:
            done.left_out.append(
                (MICROSTRUCTURE, f"EXR of {self.size_px} px: written to {self.aside.name} as .npy")
            )
            step = -(-self.size_px // MAX_EXR_SIDE_PX)
            note += f"; every {step}. pixel"
            shown = [np.array(each[::step, ::step]) for each in (neutral, moved.height)]
        else:
            shown = [neutral, np.asarray(moved.height)]
        done.maps["displacement_neutral"] = SkinMap(shown[0], "um", None, None, note)
        done.maps["displacement"] = SkinMap(shown[1], "um", None, None, f"{note}, under strain")
        figures = moved.report.to_dict()
        seconds = ("strain_s", "convolution_s")
        done.figures[MICROSTRUCTURE] = {
            "sites": names,
            "source": self.source,
            "tables": [table.source for table in tables],
            "own_shapes": list(self.own_shapes),
            **{key: value for key, value in figures.items() if key not in seconds},
            **{f"{key[:-2]}_seconds": figures[key] for key in seconds},
            "seed": self.seed,
        }
        done.inputs["mesh"] = self.mesh_sha256
        if large:
            done.figures[MICROSTRUCTURE]["files"] = {
                path.name: _sha256(path) for path in sorted(self.aside.glob("displacement*.npy"))
            }


def _sha256(path: Path) -> str:
    if path.is_dir():  # OBJ files of a folder
        digest = hashlib.sha256()
        for each in sorted(path.iterdir()):
            digest.update(each.name.encode() + bytes.fromhex(_sha256(each)))
        return digest.hexdigest()
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _with_states(
    mesh: BlendShapeMesh, names: Sequence[str]
) -> tuple[BlendShapeMesh, tuple[str, ...]]:
    """Return the mesh with shapes for states that it lacks, and the names that it has itself."""
    own = tuple(name for name in names if name in mesh.shapes)
    unknown = [name for name in names if name not in mesh.shapes and name not in STATE_NAMES]
    if unknown:
        raise ApplyError(
            f"weights: got {unknown[0]!r}, expected a state ({', '.join(STATE_NAMES)}) or a shape "
            f"of the mesh ({', '.join(mesh.shapes) or 'it has none'})"
        )
    missing = [name for name in names if name not in own and moves(name)]
    if not missing:
        return mesh, own
    face = build_mesh(mesh.vertices_mm, mesh.faces, mesh.uv, shapes=dict(mesh.shapes))
    made = {name: displacement_mm(face, name) for name in missing}
    return (BlendShapeMesh(mesh.vertices_mm, mesh.uv, mesh.faces, {**mesh.shapes, **made}), own)


def _patch(site: str, appearance: SkinAppearance, entry: Mapping[str, Any]) -> Float32Array:
    relief = appearance.maps[str(entry["map"])]
    if min(relief.values.shape) < MIN_PATCH_PX:
        raise ApplyError(
            f"{site}: a patch of {relief.values.shape} px, expected {MIN_PATCH_PX} px or more "
            "a side"
        )
    return leveled(relief.values, pixel_um=float(entry["pixel_um"]), valid=relief.valid)


def _noise(
    mesh: BlendShapeMesh,
    size_px: int,
    rms_um: float,
    scale_um: Float64Array,
    *,
    rng: np.random.Generator,
    out: Float32Array | None,
) -> Float32Array:
    """Return noise in space on the mesh's texture, up to half a wave in a pixel."""
    finest = NYQUIST_FRACTION * 0.5e3 * size_px / float(np.median(scale_um))
    if finest <= MIN_WAVES_PER_MM:
        raise ApplyError(
            f"size: {size_px} px show no wave shorter than a millimetre, expected larger maps"
        )
    band = (MIN_WAVES_PER_MM, min(finest, MAX_WAVES_PER_MM))
    noise = VolumeNoise.draw(rms_um=rms_um, band_per_mm=band, rng=rng)
    # places lie smoothly between the texels of a smaller atlas: microns off at most
    atlas = unwrap(_face(mesh), POSITION_ATLAS_PX)
    places = dilate_texture(atlas.position_mm, atlas.covered, steps=8).astype(np.float64)
    target = np.empty((size_px, size_px), np.float32) if out is None else out
    columns = (np.arange(size_px) + 0.5) * POSITION_ATLAS_PX / size_px - 0.5
    for top in range(0, size_px, ROWS_PER_NOISE_BAND):
        rows = (
            np.arange(top, min(top + ROWS_PER_NOISE_BAND, size_px)) + 0.5
        ) * POSITION_ATLAS_PX / size_px - 0.5
        at = np.meshgrid(rows, columns, indexing="ij")
        points = np.stack(
            [
                ndimage.map_coordinates(places[..., k], at, order=1, mode="nearest")
                for k in range(3)
            ],
            axis=-1,
        )
        target[top : top + len(rows)] = noise.at(points)
    return target


def _scale(mesh: BlendShapeMesh) -> Float64Array:
    """Return how long the texture's side is on the skin, um, by place, (h, w)."""
    atlas = _atlas(mesh)
    area = np.linalg.norm(np.cross(atlas.dp_du_mm, atlas.dp_dv_mm), axis=-1)
    seen = atlas.covered & (area > 0)
    if not seen.any():
        raise ApplyError("mesh: its texture covers nothing")
    side = np.sqrt(np.where(seen, area, np.median(area[seen])))
    return np.asarray(1e3 * np.clip(side, *np.percentile(side[seen], [2, 98])), np.float64)


def _regions(mesh: BlendShapeMesh, names: Sequence[str]) -> Float64Array | None:
    """Return weights of the sites over the texture, (R, h, w); None for a single site."""
    if len(names) == 1:
        return None

    unknown = [name for name in names if name not in SITE_REGIONS]
    if unknown:
        raise ApplyError(
            f"sites: no region is known for {unknown[0]!r}, expected {', '.join(SITE_REGIONS)}; "
            "choose one with --site"
        )
    atlas = _atlas(mesh)
    masks = region_masks(on_mean_head(atlas.position_mm, _face(mesh)))
    weights = np.stack([sum(masks[r] for r in SITE_REGIONS[name]) for name in names])
    weights = weights.astype(np.float64) * atlas.covered
    # where no region speaks all sites mix evenly
    return np.asarray(weights + 1e-3)


def _atlas(mesh: BlendShapeMesh) -> Any:

    return unwrap(_face(mesh), REGION_ATLAS_PX)


def _face(mesh: BlendShapeMesh) -> Any:

    return build_mesh(mesh.vertices_mm, mesh.faces, mesh.uv)
