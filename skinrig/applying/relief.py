"""Grow the measured relief of sites over a mesh and deform it by the mesh's strain."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
from scipy import ndimage

from model.displacement_synthesis import growth as displacement_synthesis
from model.displacement_synthesis.sources import level_patch
from model.displacement_synthesis.split import SpectrumMatch, add_mesoscale, match_spectrum
from model.displacement_synthesis.volume_noise import VolumeNoise
from model.microstructure import KernelTable
from model.microstructure.strain_fields import KernelRegions, rasterize
from model.skin import SkinAppearance, SkinMap
from rigsim.geometry.atlas import dilate_texture, unwrap
from rigsim.geometry.mesh import build_mesh
from rigsim.subject.expressions import displacement_mm, is_moving_state
from rigsim.subject.face_regions import region_masks, to_mean_head
from rigsim.subject.perfusion import STATE_NAMES
from skinrig.appearances.contents import hash_file
from skinrig.appearances.dynamic import MICROSTRUCTURE
from skinrig.applying.chart_seams import join_charts
from skinrig.applying.expression import AppliedExpression, ApplyError
from skinrig.applying.mesoscale import read_mesoscale
from skinrig.applying.microstructure import apply_microstructure, strain_image
from skinrig.arrays import Float32Array, Float64Array
from skinrig.blend_shapes import meshes as blend_shapes
from skinrig.blend_shapes.meshes import BlendShapeMesh
from skinrig.console import select_attributes
from skinrig.errors import require_choice

REGION_ATLAS_PX: Final = 256
"""Side of the maps of site weights and of pixel size, texels."""
SITE_REGIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "forehead": ("forehead", "brows", "temples"),
    "cheek": ("cheeks", "nose sides", "lids", "nose"),
    "chin": ("chin", "lips", "mouth corners", "neck"),
}
"""Regions of a face that each site's relief covers."""
MIN_PATCH_PX: Final = 64
MIN_WAVES_PER_MM: Final = 1.0
"""Minimum spatial frequency of relief; lower ones belong to the mesh (Nagano2015, section 4)."""
MAX_WAVES_PER_MM: Final = 25.0
NYQUIST_FRACTION: Final = 0.8
PIXEL_SIZE_TOL: Final = 0.01
"""Relative tolerance of equal pixel sizes; calibrations of one rig differ by less."""
POSITION_ATLAS_PX: Final = 1024
ROWS_PER_NOISE_BAND: Final = 256
SECONDS_KEYS: Final = ("strain_s", "convolution_s")
RELIEF_SOURCES: Final = ("patches", "noise")
Extrapolation = Literal["hold", "formula"]
STRAIN_SIDE_PX: Final = 1024
STRAIN_NOTE: Final = "stretch ratios r_s and r_t, angle of axis s from +x towards +y, rad"
EXTRAPOLATION_MODES: Final[tuple[Extrapolation, ...]] = get_args(Extrapolation)
MAX_EXR_SIDE_PX: Final = 8192
"""Maximum side of EXR maps; larger maps are written as .npy files next to the folder."""


@dataclass(frozen=True, slots=True)
class ReliefRequest:
    """Settings of the relief of a mesh."""

    size_px: int
    """Width and height of the map."""
    site: str | None = None
    """Site whose relief covers the whole mesh; None: each site covers its own region."""
    source: str = "patches"
    """"patches": grown from measured patches; "noise": noise in space of the same RMS height, which
    is seamless across islands of the texture."""
    extrapolate: Extrapolation = "hold"
    """Extrapolation beyond the table's range: "hold" or "formula"."""
    seed: int = 0
    """Random seed of the growth."""
    mesoscale: Path | None = None
    """Displacement map of a scan over the mesh's texture, um, whose waves above the split stay."""

    def __post_init__(self) -> None:
        require_choice("synthesize", self.source, RELIEF_SOURCES, ApplyError)
        require_choice("extrapolate", self.extrapolate, EXTRAPOLATION_MODES, ApplyError)
        if self.mesoscale is not None and self.source != "patches":
            raise ApplyError(
                f"--mesoscale: got --synthesize {self.source}, expected patches; remove one"
            )

    @property
    def exceeds_exr(self) -> bool:
        """Whether the maps exceed `MAX_EXR_SIDE_PX`."""
        return self.size_px > MAX_EXR_SIDE_PX


@dataclass(frozen=True, slots=True)
class ReliefEvaluator:
    """Evaluates the microstructure part of a dynamic appearance on a mesh.

    Attributes
    ----------
    request
        Settings of the relief.
    mesh
        Mesh with a blend shape for each name in ``weights``.
    weights
        Weight by blend shape.
    own_shapes
        Shapes of the mesh file itself; the others are transferred from the simulated head.
    temporary_folder
        Folder for maps that are too large for EXR.
    mesh_sha256
        Digest of the mesh's file.
    progress
        Called with one line per step.
    """

    request: ReliefRequest
    mesh: BlendShapeMesh
    weights: Mapping[str, float]
    own_shapes: tuple[str, ...]
    temporary_folder: Path
    mesh_sha256: str
    progress: Callable[[str], None]

    @staticmethod
    def of(
        path: Path,
        weights: Mapping[str, float],
        request: ReliefRequest,
        *,
        out: Path,
        progress: Callable[[str], None],
    ) -> ReliefEvaluator:
        """Load the mesh and add the blend shapes that the weights need.

        Maps of more than `MAX_EXR_SIDE_PX` go to a folder next to ``out``, as .npy files.

        Raises
        ------
        ApplyError, MeshError
                If a size, the name of a weight or the mesh is invalid.
        """
        if not MIN_PATCH_PX <= request.size_px <= 65_536:
            raise ApplyError(
                f"--size-px: got {request.size_px}, expected {MIN_PATCH_PX} to 65536; enter another"
            )
        used = {name: weight for name, weight in weights.items() if name != "neutral"}
        mesh, own = _with_states(blend_shapes.load(path), list(used))
        kept = {name: weight for name, weight in used.items() if name in mesh.shapes}
        aside = out.with_name(f"{out.name}-large")
        return ReliefEvaluator(request, mesh, kept, own, aside, _sha256(path), progress)

    def __call__(
        self, appearance: SkinAppearance, part: dict[str, Any], done: AppliedExpression
    ) -> None:
        """Grow the neutral relief, deform it, and add the maps to ``done``."""
        sites, asked = dict(part["sites"]), self.request
        if asked.site is not None:
            require_choice("site", asked.site, sites, ApplyError)
        names = [asked.site] if asked.site is not None else list(sites)
        regions = _regions(self.mesh, names)
        own = {name: sites[name] for name in names}
        neutral, spectrum = self._neutral(appearance, own, regions)
        tables = tuple(
            KernelTable.from_json(appearance.files[sites[name]["table"]].decode()) for name in names
        )
        self.progress("strain and convolution")
        moved = apply_microstructure(
            self.mesh,
            self.weights,
            neutral,
            tables[0] if regions is None else KernelRegions(tables, regions),
            extrapolate=asked.extrapolate,
            out=self.temporary_folder / "displacement.npy" if asked.exceeds_exr else None,
            progress=lambda at, of: self.progress(f"tile {at} of {of}"),
        )
        made = "noise with the RMS of" if asked.source == "noise" else "grown from"
        note = f"um, {made} measured patches; texture of the mesh"
        step = -(-asked.size_px // MAX_EXR_SIDE_PX) if asked.exceeds_exr else 1
        if asked.exceeds_exr:
            why = f"EXR of {asked.size_px} px: written to {self.temporary_folder.name} as .npy"
            done.left_out.append((MICROSTRUCTURE, why))
            note += f"; one of {step} pixels per axis"
        for name, height, more in (
            ("displacement_neutral", neutral, ""),
            ("displacement", moved.height, ", under strain"),
        ):
            shown = np.array(height[::step, ::step]) if asked.exceeds_exr else np.asarray(height)
            done.maps[name] = SkinMap(shown, "um", None, None, note + more)
        side = min(asked.size_px, STRAIN_SIDE_PX)
        field = rasterize(moved.strain, self.mesh.faces, self.mesh.uv, (side, side))
        done.maps["strain"] = SkinMap(strain_image(field), "1", None, field.covered, STRAIN_NOTE)
        figures = asdict(moved.report)
        seconds = {f"{key[:-2]}_seconds": figures.pop(key) for key in SECONDS_KEYS}
        done.figures[MICROSTRUCTURE] = {
            "sites": names,
            **select_attributes(asked, "source", "seed"),
            "tables": [table.source for table in tables],
            "own_shapes": list(self.own_shapes),
            "spectrum": None if spectrum is None else spectrum.to_json(),
            **figures,
            **seconds,
        }
        done.inputs["mesh"] = self.mesh_sha256
        if asked.mesoscale is not None:
            done.inputs["mesoscale"] = _sha256(asked.mesoscale)
        if asked.exceeds_exr:
            done.figures[MICROSTRUCTURE]["files"] = {
                path.name: _sha256(path)
                for path in sorted(self.temporary_folder.glob("displacement*.npy"))
            }

    def _neutral(
        self, appearance: SkinAppearance, sites: Mapping[str, Any], regions: Float64Array | None
    ) -> tuple[Any, SpectrumMatch | None]:
        """Return the neutral relief on the mesh's texture, um: grown patches or noise.

        Of grown patches, also return the filter that matches their spectrum.
        """
        asked, match = self.request, None
        patches = {
            name: [level_site_patch(name, appearance, entry)] for name, entry in sites.items()
        }
        pixels_um = [float(entry["pixel_um"]) for entry in sites.values()]
        if max(pixels_um) > (1.0 + PIXEL_SIZE_TOL) * min(pixels_um):
            raise ApplyError(
                f"sites: got reliefs with pixels of {sorted(pixels_um)} um, expected one size; "
                "choose one with --relief-site"
            )
        rng, scale = np.random.default_rng(asked.seed), _scale(self.mesh)
        scan = None
        if asked.mesoscale is not None:
            scan = read_mesoscale(asked.mesoscale, _face(self.mesh), scale, asked.size_px)
        shape = f"{asked.size_px} x {asked.size_px}"
        neutral: Any = None
        if asked.exceeds_exr:
            self.temporary_folder.mkdir(parents=True, exist_ok=True)
            growing = self.temporary_folder / "displacement_neutral.npy.part"
            neutral = np.lib.format.open_memmap(growing, "w+", np.float32, (asked.size_px,) * 2)
        if asked.source == "noise":
            if _finest_per_mm(asked.size_px, scale) <= MIN_WAVES_PER_MM:
                raise ApplyError(
                    f"--size-px: got {asked.size_px}, which does not resolve 1 mm; enter more"
                )
            self.progress(f"sample noise at {shape} pixels")
            noise = _draw_noise(_rms(patches), asked.size_px, scale, rng=rng)
            neutral = _noise(self.mesh, asked.size_px, noise, out=neutral)
        else:
            self.progress(f"grow the relief of {', '.join(sites)} to {shape}")
            neutral = displacement_synthesis.grow(
                patches,
                asked.size_px,
                rng=rng,
                regions=regions,
                out=neutral,
                pixel_um=scale / asked.size_px,
                patch_pixel_um=float(np.mean(pixels_um)),
                threads=2,
            )
            self.progress("match the spectrum of the patches")
            match = match_spectrum(
                neutral,
                [(one, pixel) for (one,), pixel in zip(patches.values(), pixels_um, strict=True)],
                _site_shares(regions),
                scale / asked.size_px,
            )
            self.progress("join charts of the texture")
            noise = _draw_noise(_rms(patches), asked.size_px, scale, rng=rng)
            join_charts(neutral, _face(self.mesh), noise)
        if scan is not None:
            self.progress("add the mesoscale")
            add_mesoscale(neutral, *scan, scale / len(scan[0]))
        if asked.exceeds_exr:
            neutral.flush()
            os.replace(growing, self.temporary_folder / "displacement_neutral.npy")
        return neutral, match


def _sha256(path: Path) -> str:
    if path.is_dir():  # OBJ files of a folder
        total = hashlib.sha256()
        for each in sorted(path.iterdir()):
            total.update(each.name.encode() + bytes.fromhex(_sha256(each)))
        return total.hexdigest()
    return hash_file(path)


def _with_states(
    mesh: BlendShapeMesh, names: Sequence[str]
) -> tuple[BlendShapeMesh, tuple[str, ...]]:
    """Add blend shapes for missing expressions; also return the names of the mesh's own shapes."""
    own = tuple(name for name in names if name in mesh.shapes)
    unknown = [name for name in names if name not in mesh.shapes and name not in STATE_NAMES]
    if unknown:
        raise ApplyError(
            f"--weights: got {unknown[0]!r}, expected a state ({', '.join(STATE_NAMES)}) or a "
            f"shape of the mesh ({', '.join(mesh.shapes) or 'it has none'}); name one of them"
        )
    missing = [name for name in names if name not in own and is_moving_state(name)]
    if not missing:
        return mesh, own
    face = build_mesh(mesh.vertices_mm, mesh.faces, mesh.uv, shapes=dict(mesh.shapes))
    made = {name: displacement_mm(face, name) for name in missing}
    return (BlendShapeMesh(mesh.vertices_mm, mesh.uv, mesh.faces, {**mesh.shapes, **made}), own)


def level_site_patch(
    site: str, appearance: SkinAppearance, entry: Mapping[str, Any]
) -> Float32Array:
    """Return the relief of a fitted site without its bulge, um.

    Raises
    ------
    ApplyError
        For a patch smaller than `MIN_PATCH_PX`.
    """
    relief = appearance.maps[str(entry["map"])]
    if min(relief.values.shape) < MIN_PATCH_PX:
        raise ApplyError(
            f"{site}: a patch of {relief.values.shape} px, expected {MIN_PATCH_PX} px or more "
            "a side"
        )
    return level_patch(relief.values, pixel_um=float(entry["pixel_um"]), valid=relief.valid)


def _site_shares(regions: Float64Array | None) -> list[float]:
    """Return the mean square weight of each site in the map."""
    if regions is None:
        return [1.0]
    squares = regions**2
    return [float(one) for one in (squares / squares.sum(axis=0)).mean(axis=(1, 2))]


def _rms(patches: Mapping[str, Sequence[Float32Array]]) -> float:
    """Return the RMS height of the sites' patches together, um."""
    return float(np.sqrt(np.mean([np.nanvar(one) for (one,) in patches.values()])))


def _finest_per_mm(size_px: int, scale_um: Float64Array) -> float:
    """Return the highest spatial frequency of noise on a map's pixels, waves per mm."""
    return NYQUIST_FRACTION * 0.5e3 * size_px / float(np.median(scale_um))


def _draw_noise(
    rms_um: float, size_px: int, scale_um: Float64Array, *, rng: np.random.Generator
) -> VolumeNoise:
    """Draw noise in space below the Nyquist frequency of a map's pixels."""
    finest = max(_finest_per_mm(size_px, scale_um), 1.1 * MIN_WAVES_PER_MM)
    band = (MIN_WAVES_PER_MM, min(finest, MAX_WAVES_PER_MM))
    return VolumeNoise.draw(rms_um=rms_um, band_per_mm=band, rng=rng)


def _noise(
    mesh: BlendShapeMesh, size_px: int, noise: VolumeNoise, *, out: Float32Array | None
) -> Float32Array:
    """Sample noise in space on the mesh's texture."""
    # positions are smooth: interpolation from a smaller atlas deviates by microns at most
    atlas = unwrap(_face(mesh), POSITION_ATLAS_PX)
    places = dilate_texture(atlas.position_mm, atlas.covered, steps=8).astype(np.float64)
    target = np.empty((size_px, size_px), np.float32) if out is None else out
    columns = (np.arange(size_px) + 0.5) * POSITION_ATLAS_PX / size_px - 0.5
    for top in range(0, size_px, ROWS_PER_NOISE_BAND):
        rows = columns[top : top + ROWS_PER_NOISE_BAND]
        at = np.meshgrid(rows, columns, indexing="ij")
        along = (
            ndimage.map_coordinates(places[..., k], at, order=1, mode="nearest") for k in range(3)
        )
        target[top : top + len(rows)] = noise.at(np.stack(list(along), axis=-1))
    return target


def _scale(mesh: BlendShapeMesh) -> Float64Array:
    """Return the length of the texture's side on the skin, um, per texel, (h, w)."""
    atlas = _atlas(mesh)
    area = np.linalg.norm(np.cross(atlas.dp_du_mm, atlas.dp_dv_mm), axis=-1)
    seen = atlas.covered & (area > 0)
    if not seen.any():
        raise ApplyError("mesh: its texture coordinates enclose no area; check the mesh")
    side = np.sqrt(np.where(seen, area, np.median(area[seen])))
    return np.asarray(1e3 * np.clip(side, *np.percentile(side[seen], [2, 98])), np.float64)


def _regions(mesh: BlendShapeMesh, names: Sequence[str]) -> Float64Array | None:
    """Return weights of the sites over the texture, (R, h, w); None for a single site."""
    if len(names) == 1:
        return None
    unknown = [name for name in names if name not in SITE_REGIONS]
    if unknown:
        raise ApplyError(
            f"sites: got {unknown[0]!r}, expected one of {', '.join(SITE_REGIONS)}; "
            "choose one with --relief-site"
        )
    atlas = _atlas(mesh)
    masks = region_masks(to_mean_head(atlas.position_mm, _face(mesh)))
    weights = np.stack([sum(masks[r] for r in SITE_REGIONS[name]) for name in names])
    weights = weights.astype(np.float64) * atlas.covered
    # the constant gives all sites equal weight outside of their regions
    return np.asarray(weights + 1e-3)


def _atlas(mesh: BlendShapeMesh) -> Any:
    return unwrap(_face(mesh), REGION_ATLAS_PX)


def _face(mesh: BlendShapeMesh) -> Any:
    return build_mesh(mesh.vertices_mm, mesh.faces, mesh.uv)
