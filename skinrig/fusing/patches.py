"""Place the gradient rig's patch on a face, with the microstructure that was fitted to it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from model.skin import SkinMap
from model.skin_reflectance import NORMAL_MAPS
from reconstruction.fusion.patch_normals import (
    FusedPatch,
    PatchCheck,
    PatchNormals,
    SurfaceFrame,
    check_patch,
    fuse_patch,
)
from reconstruction.fusion.signals import FusionError
from skinrig.appearances.contents import intersect_valid
from skinrig.appearances.dynamic import MICROSTRUCTURE
from skinrig.fitting import probe_sites
from skinrig.fitting.microstructure import MicrostructureFitError, fit_part
from skinrig.fusing.sources import Source

PATCH_PREFIX: Final = "patch_"
"""Prefix of maps on the pixels of a patch instead of the face's texture."""
TABLE_PLACE_SD_MM: Final = 2.0
"""Standard deviation of a place in a table, per axis: of a mark on skin, assumed."""
MEAN_FACE_PLACE_SD_MM: Final = 8.0
"""Standard deviation of a place as on a mean face, per axis; assumed."""
MIN_FRAME_RADIUS_MM: Final = 4.0
"""Least radius around a patch whose normals are those of its frame."""


@dataclass(frozen=True, slots=True, eq=False)
class PlacedPatch:
    """A patch on a face.

    Attributes
    ----------
    site
        Its name.
    maps, files, parameters
        Additions to the appearance of the face.
    fused
        Normals on the face; None without a mesh.
    check
        Agreement of its normals with a surface.
    assumed, left_out
        What was assumed and omitted.
    """

    site: str
    maps: dict[str, SkinMap]
    files: dict[str, bytes]
    parameters: dict[str, Any]
    fused: FusedPatch | None
    check: PatchCheck
    assumed: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...]


def place_patch(gradient: Source, dome: Source | None, *, sites: Path | None) -> PlacedPatch:
    """Fuse a patch's normals with those of the face, and carry its relief and microstructure.

    Parameters
    ----------
    gradient
        Maps of the gradient rig; the last word of their folder is the site.
    dome
        Maps of the face; None: the patch has no place.
    sites
        Table `name,x,y` of places in texels of the face's maps; None: as on a mean face.
    """
    appearance = gradient.appearance
    state = next(name for name in sorted(appearance.maps) if _is_neutral_normals(name))
    normals = appearance.maps[state]
    pixel_um = float(str(appearance.parameters["pixel_um"]))
    stderr = np.zeros(normals.mask.shape, np.float32)
    if normals.stderr is not None:
        stderr = normals.stderr.reshape(*normals.mask.shape, -1)[..., 0]
    patch = PatchNormals(normals.values, stderr, normals.mask, pixel_um)
    site = gradient.site()
    maps: dict[str, SkinMap] = {}
    files: dict[str, bytes] = {}
    parameters: dict[str, Any] = {}
    left_out: list[tuple[str, str]] = []
    height = f"height_{state.removeprefix('normals_')}"
    try:
        _, part = fit_part([Path(f"{site}={gradient.path}")], paper_table=True)
        maps |= part.maps
        files |= part.files
        parameters[MICROSTRUCTURE] = {
            "maps": sorted(part.maps),
            "files": sorted(part.files),
            "source": part.source,
            **part.parameters,
        }
        left_out += list(part.left_out)
    except MicrostructureFitError as error:
        left_out.append(("gradient: microstructure", str(error).partition("; ")[0]))
        if height in appearance.maps:
            maps[f"microrelief_{site}"] = appearance.maps[height]
    fused: FusedPatch | None = None
    assumed: tuple[str, ...] = ()
    if dome is None:
        left_out.append(
            ("gradient: normals", "a patch is placed on a dome's mesh, which is missing")
        )
    else:
        try:
            fused, assumed = _fuse(patch, site, dome, sites)
        except (FusionError, probe_sites.ProbeSiteError) as error:
            left_out.append(("gradient: normals", str(error)))
    if fused is not None:
        spread = np.sqrt(np.einsum("hwaa->hw", fused.covariance) / 2.0)
        what = "fused, rig frame: low frequencies by the dome, high by the gradient rig"
        three = np.repeat(spread[..., None], 3, axis=-1).astype(np.float32)
        pairs = fused.covariance[..., [0, 0, 1], [0, 1, 1]].astype(np.float32)
        normals_map = fused.normals.astype(np.float32)
        points = fused.position_mm.astype(np.float32)
        maps |= {
            f"{PATCH_PREFIX}normals_{site}": SkinMap(normals_map, "1", three, fused.valid, what),
            f"{PATCH_PREFIX}normals_covariance_{site}": SkinMap(
                pairs, "1", None, fused.valid, "rad^2: to the right; of both; up"
            ),
            f"{PATCH_PREFIX}position_{site}": SkinMap(points, "mm", None, fused.valid),
        }
    return PlacedPatch(
        site, maps, files, parameters, fused, check_patch(patch), assumed, tuple(left_out)
    )


def _is_neutral_normals(name: str) -> bool:
    return name.startswith("normals_") and name.endswith("_n0")


def _fuse(
    patch: PatchNormals, site: str, dome: Source, sites: Path | None
) -> tuple[FusedPatch, tuple[str, ...]]:
    """Return the normals on the face, and what was assumed of the place."""
    position = dome.appearance.maps["position"]
    normals = next(dome.appearance.maps[n] for n in NORMAL_MAPS if n in dome.appearance.maps)
    at_mm, is_guess = probe_sites.locate_site(site, position, landmarks=sites)
    place_sd = MEAN_FACE_PLACE_SD_MM if is_guess else TABLE_PLACE_SD_MM
    known = intersect_valid(position, normals)
    away = np.linalg.norm(position.values - at_mm, axis=-1)
    texel_mm = _texel_mm(position, known)
    near = known & (away < max(MIN_FRAME_RADIUS_MM, 1.5 * place_sd, 2.0 * texel_mm))
    stderr = np.zeros(int(near.sum()))
    if normals.stderr is not None:
        stderr = normals.stderr.reshape(*near.shape, -1)[near, 0]
    frame = SurfaceFrame.fit(
        at_mm, position.values[near], normals.values[near], stderr, place_sd_mm=place_sd
    )
    how = "placed as on a mean face" if is_guess else "placed by the table of sites"
    assumed = f"the gradient rig's patch is {how}, standard deviation {place_sd:g} mm, its top up"
    return fuse_patch(patch, frame, cutoff_um=2e3 * texel_mm), (assumed,)


def _texel_mm(position: SkinMap, known: np.ndarray[Any, Any]) -> float:
    """Return the median distance of neighboring texels."""
    both = known[:, 1:] & known[:, :-1]
    step = np.linalg.norm(np.diff(position.values, axis=1), axis=-1)
    return float(np.median(step[both]))
