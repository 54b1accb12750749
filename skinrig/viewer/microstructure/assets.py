"""Build the microstructure assets of the page: a patch, its table of kernels, and its roughness.

The page grows a displacement from the patch (`skinrig.viewer.microstructure.relief_growth`) and
convolves it by the strain of the pose. The variance of slopes below a screen pixel is added to the
roughness of the highlight. Two tables for this are computed here: the variance that each level of
the pyramid retains, and its change with the stretch of the skin.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from model.microstructure import ALPHA_LIMITS, FOREHEAD, KernelTable, kernel_parameters
from model.microstructure.mesh_strain import strain
from model.skin import SkinAppearance
from rigsim.geometry.mesh import Mesh
from rigsim.skin_patch.microrelief import make_micro_skin
from skinrig.appearances.contents import is_fused
from skinrig.appearances.dynamic import MICROSTRUCTURE, describe_parts
from skinrig.arrays import BoolArray, Float32Array, Float64Array
from skinrig.viewer.microstructure import relief_growth
from skinrig.viewer.microstructure.relief_growth import (
    STRETCH_RANGE,
    GrownRelief,
    compute_slope_rms,
    compute_strained_variance,
)
from skinrig.viewer.microstructure.tiles import TILE_PX, Pyramid
from skinrig.viewer.scene import Assets, SceneError, SceneSource, Texture, ViewerScene

PATCH_PX: Final = 256
"""Side of the patch in the page: 3 to 4 mm of skin, about 80 kB."""


@dataclass(frozen=True, slots=True, eq=False)
class MicroRelief:
    """A measured or simulated neutral relief with the kernels of that skin.

    Attributes
    ----------
    height_um : ndarray of float32, shape (h, w)
        Finite; row 0 is the top.
    pixel_um : float
        Pixel size on the skin.
    table : KernelTable
    source : str
        "measured" or "simulated", with the origin; displayed in the page.
    """

    height_um: Float32Array
    pixel_um: float
    table: KernelTable = FOREHEAD
    source: str = "simulated"


def read_fitted_relief(appearance: SkinAppearance) -> MicroRelief | None:
    """Read the first site's relief of `skinrig fit microstructure`; None without that part."""
    part = describe_parts(appearance).get(MICROSTRUCTURE)
    if part is None:
        return None
    site, entry = sorted(part["sites"].items())[0]
    found = appearance.maps[entry["map"]]
    text = bytes(appearance.files[entry["table"]]).decode("utf-8")
    return MicroRelief(
        find_largest_square(np.squeeze(found.values).astype(np.float32), found.mask),
        float(entry["pixel_um"]),
        KernelTable.from_json(text),
        f"{part['source']}: {site}",
    )


def simulate_relief(seed: int) -> MicroRelief:
    """Simulate relief of a forehead's skin, `PATCH_PX` per side."""
    site, pixel_um = "forehead", 15.0
    skin = make_micro_skin(site, seed=seed, size_mm=1e-3 * pixel_um * PATCH_PX, texel_um=pixel_um)
    return MicroRelief(skin.height_um, pixel_um, FOREHEAD, f"simulated: {site}")


def find_largest_square(height: Float32Array, valid: BoolArray) -> Float32Array:
    """Return the largest square without holes; of several, the first in row order.

    Examples
    --------
    >>> holes = np.array([[0, 1, 1], [1, 1, 1]], bool)
    >>> find_largest_square(np.arange(6, dtype=np.float32).reshape(2, 3), holes).tolist()
    [[1.0, 2.0], [4.0, 5.0]]
    """
    good = np.asarray(valid, bool) & np.isfinite(height)
    total = np.pad(good.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    for n in range(min(good.shape), 0, -1):
        inside = total[n:, n:] - total[:-n, n:] - total[n:, :-n] + total[:-n, :-n]
        if (inside == n * n).any():
            top, left = np.argwhere(inside == n * n)[0]
            return np.ascontiguousarray(height[top : top + n, left : left + n])
    raise SceneError(
        "relief: got no valid pixel, expected some millimeters of skin; fit another session"
    )


SAMPLE_PX: Final = 512
"""Side of the part of a displacement from which slope statistics are computed."""
CELL_PX: Final = 56
MAX_BREAKS: Final = 8
"""Maximum number of breakpoints of alpha in the shader."""
MAX_REACH_PX: Final = 64
"""Maximum radius of kernels; larger ones would exceed the window."""


def build_assets(source: SceneSource) -> Assets:
    """Build the microstructure of a scene, or the reason for its omission.

    A fitted relief precedes a simulated one; simulated relief on a captured face is reported. That
    of a fused person comes without a choice, so that one too fine for the page is replaced.
    """
    dynamic = source.appearances.get("dynamic")
    relief = None if dynamic is None else read_fitted_relief(dynamic)
    unusable = ""
    if relief is not None:
        try:
            return build_relief_assets(relief, source.mesh, seed=source.seed)
        except SceneError as error:
            if dynamic is None or not is_fused(dynamic):
                raise
            unusable = f"; the measured relief is not displayed: {error}"
    made = build_relief_assets(simulate_relief(source.seed), source.mesh, seed=source.seed)
    if source.captured:
        reason = "simulated, with the published kernels of a forehead"
        reason += unusable or "; `skinrig fit microstructure` adds measured ones"
        made["left_out"] = (("microstructure of this face", reason),)
    return made


def grow_relief(relief: MicroRelief, *, seed: int = 0) -> GrownRelief:
    """Prepare the center of a relief for growth, without its mean and tilt.

    Raises
    ------
    SceneError
        If the relief is too small.
    """
    side = min(*relief.height_um.shape, PATCH_PX) // relief_growth.STEP_PX * relief_growth.STEP_PX
    cell = min(CELL_PX, relief_growth.compute_max_cell_px(side))
    if cell < 2 * relief_growth.STEP_PX:
        raise SceneError(
            f"relief: got {relief.height_um.shape}, expected at least 96 pixels per side; measure "
            "a larger patch"
        )
    top, left = ((n - side) // 2 for n in relief.height_um.shape)
    part = relief.height_um[top : top + side, left : left + side].astype(np.float64)
    # a tilt would add a constant slope, and steps between blended positions
    y, x = (np.mgrid[:side, :side] - 0.5 * (side - 1)).reshape(2, -1)
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    part -= (plane @ np.linalg.lstsq(plane, part.ravel(), rcond=None)[0]).reshape(side, side)
    return GrownRelief(part.astype(np.float32), relief.pixel_um, cell, seed % 2**32)


def build_relief_assets(relief: MicroRelief, mesh: Mesh, *, seed: int = 0) -> Assets:
    """Build textures, tables and parameters of a relief on a mesh.

    Parameters
    ----------
    relief : MicroRelief
    mesh : Mesh
        Mesh; the scale of its texture determines the size of the grown displacement.
    seed : int

    Raises
    ------
    SceneError
        If the table has more lines than the shader supports, or the texture's scale varies so much
        that kernels are too wide.
    """
    growth = grow_relief(relief, seed=seed)
    table = relief.table
    if len(table.alpha_breaks) > MAX_BREAKS:
        raise SceneError(
            f"table: got {len(table.alpha_breaks)} breaks, expected at most {MAX_BREAKS}"
        )
    scale = compute_px_per_mm(mesh)
    virtual = round(1e3 / (relief.pixel_um * float(np.median(scale))))
    virtual = max(relief_growth.STEP_PX, virtual // relief_growth.STEP_PX * relief_growth.STEP_PX)
    virtual = min(virtual, relief_growth.MAX_LATTICE_PX // 2)
    reach = compute_kernel_reach_px(table, scale, virtual)
    facts = {
        **{name: getattr(growth, name) for name in ("pixel_um", "cell_px", "choices", "seed")},
        "patch_px": growth.patch.shape[0],
        "virtual_px": virtual,
        "levels": relief_growth.GROWN_LEVELS,
        "reach_px": reach,
        "stretch_range": list(table.stretch_range),
        "alpha_limits": list(ALPHA_LIMITS),
        "variance_stretch_range": list(STRETCH_RANGE),
        "slope_rms": compute_slope_rms(growth),
        "source": relief.source,
        "table": table.source,
    }
    tables = {
        "kernel_alpha_breaks": np.asarray([table.alpha_breaks], np.float32),
        "kernel_alpha_lines": np.asarray(table.alpha_lines, np.float32),
        "kernel_sigma_lines_mm": 1e-3 * np.asarray(table.sigma_lines_um(), np.float32),
        "strained_variance": compute_strained_variance(growth, table).astype(np.float32),
    }
    patch = Texture(growth.patch[..., None], "u16", "nearest")
    return Assets(textures={"relief_patch": patch}, tables=tables, facts={"microstructure": facts})


def compute_kernel_reach_px(table: KernelTable, scale: Float64Array, virtual_px: int) -> int:
    """Return the radius of the widest kernel in pixels, plus two for interpolation.

    Parameters
    ----------
    table : KernelTable
    scale : ndarray
        Texture units per mm of skin, see `compute_px_per_mm`.
    virtual_px : int
        Side of the displacement.

    Raises
    ------
    SceneError
        If it exceeds `MAX_REACH_PX`.
    """
    # the finest 1 % of a texture is slivers; kernels there are clipped at the window's margin
    finest = float(np.percentile(scale, 99.0))
    ends = np.array([*table.stretch_range, np.nextafter(1.0, 0.0), 1.0])
    widest_um = float(kernel_parameters(ends, table)[1].max())
    reach = math.ceil(4.0 * widest_um * 1e-3 * virtual_px * finest + 0.5) + 2
    if reach > MAX_REACH_PX:
        raise SceneError(
            f"mesh: got kernels of {reach} px where the texture is finest, expected at most "
            f"{MAX_REACH_PX}; give a mesh with a more uniform texture scale"
        )
    return reach


def add_displacement_tiles(scene: ViewerScene, pyramid: Pyramid) -> ViewerScene:
    """Return a scene that fetches its relief as tiles instead of growing it from a patch.

    Parameters
    ----------
    scene : ViewerScene
        Scene; its own relief is omitted.
    pyramid : Pyramid
        Pyramid of the displacement in the texture of the scene's mesh.

    Raises
    ------
    SceneError
        See `build_relief_assets`.
    """
    scale = compute_px_per_mm(scene.mesh)
    pixel_um = 1e3 / (pyramid.size * float(np.median(scale)))
    source = pyramid.levels[0]
    first = (pyramid.size - SAMPLE_PX) // 2
    middle = np.asarray(source[first : first + SAMPLE_PX, first : first + SAMPLE_PX], np.float32)
    made = build_relief_assets(MicroRelief(middle, pixel_um, FOREHEAD, "displacement"), scene.mesh)
    facts = dict(made["facts"]["microstructure"])
    for unused in ("patch_px", "cell_px", "choices", "seed"):
        del facts[unused]
    facts |= {
        "virtual_px": pyramid.size,
        "levels": len(pyramid.levels),
        "reach_px": compute_kernel_reach_px(FOREHEAD, scale, pyramid.size),
        "tiles": {"tile_px": TILE_PX, "low": pyramid.low, "high": pyramid.high},
    }
    bare = replace(
        scene,
        textures={k: v for k, v in scene.textures.items() if k != "relief_patch"},
        tables={k: v for k, v in scene.tables.items() if k not in made["tables"]},
        facts={k: v for k, v in scene.facts.items() if k != "microstructure"},
        left_out=tuple(row for row in scene.left_out if row[0] != "microstructure"),
    )
    return bare.with_assets(Assets(tables=made["tables"], facts={"microstructure": facts}))


def compute_px_per_mm(mesh: Mesh) -> Float64Array:
    """Return texture units per mm of skin at vertices: square root of the ratio of areas."""
    rest = mesh.vertices_mm.astype(np.float64)
    found = strain(rest, rest, mesh.faces, mesh.uv)
    if not found.valid.any():
        raise SceneError(
            "mesh: got no triangle with an area in the texture, expected some; check its texture"
        )
    a, b, c = found.uv_metric[found.valid].T
    return np.asarray(np.sqrt(np.abs(a * c - b * b)))
