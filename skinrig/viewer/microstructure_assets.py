"""What the page needs to show microstructure: a patch, its table of kernels, and its roughness.

The page grows a displacement from the patch (`skinrig.viewer.relief_growth`) and convolves it by
the strain of the pose. What a screen's pixel cannot resolve does not vanish: the variance of the
slopes that are not drawn goes into the roughness of the highlight, by two tables that are computed
here: how much of the variance each level of the pyramid keeps, and how the variance changes with
the stretch of the skin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from model.microstructure import (
    ALPHA_LIMITS,
    FOREHEAD,
    KernelTable,
    gaussian_weights,
    kernel_parameters,
)
from skinrig.viewer import relief_growth
from skinrig.viewer.relief_growth import GrownRelief
from skinrig.viewer.scene import Assets, SceneSource, Texture, ViewerMesh, ViewerScene
from skinrig.viewer.tiles import TILE_PX, Pyramid

if TYPE_CHECKING:
    from model.skin import SkinAppearance

Floats = NDArray[np.float64]
Float32 = NDArray[np.float32]

SAMPLE_PX: Final = 512
"""Side of the part of a displacement that its slopes are known from."""
PATCH_PX: Final = 256
"""Side of the patch in the page: 3 to 4 mm of skin; some 80 kB."""
CELL_PX: Final = 56
STRETCHES: Final = 33
"""Stretch ratios a side of the table of variances, evenly from 0.5 to 1.5."""
STRETCH_RANGE: Final = (0.5, 1.5)
FEWEST_PX: Final = 6
"""Pixels a side of the coarsest level whose slopes are counted."""
MOST_BREAKS: Final = 8
"""Lines of alpha that the shader has room for, less one."""
MOST_REACH_PX: Final = 64
"""Kernels that reach farther than this leave nothing of the window."""


class MicrostructureAssetError(ValueError):
    """Relief that the page cannot show."""


@dataclass(frozen=True, slots=True, eq=False)
class MicroRelief:
    """A measured or simulated neutral relief with the kernels of that skin.

    Attributes
    ----------
    height_um : ndarray of float32, shape (h, w)
        Finite; row 0 is the top.
    pixel_um : float
        Length of skin that a pixel has.
    table : KernelTable
    source : str
        "measured" or "simulated", and from where; shown in the page.
    """

    height_um: Float32
    pixel_um: float
    table: KernelTable = FOREHEAD
    source: str = "simulated"


def assets(source: SceneSource) -> Assets:
    """Return the microstructure of a scene, or why there is none.

    Examples
    --------
    >>> sorted(assets.__annotations__)
    ['return', 'source']
    """
    relief = relief_of(source)
    if relief is None:
        return Assets(
            left_out=(
                (
                    "microstructure",
                    "no relief of microstructure in the appearance; "
                    "`skinrig fit microstructure` adds it",
                ),
            )
        )
    return from_relief(relief, source.mesh, seed=source.seed)


def relief_of(source: SceneSource) -> MicroRelief | None:
    """Return the relief that belongs to a scene: fitted before simulated; None where neither."""
    dynamic = source.appearances.get("dynamic")
    if dynamic is not None:
        return fitted_relief(dynamic)
    if source.kind in ("procedural", "mesh"):
        return simulated_relief(source.seed)
    return None


def fitted_relief(appearance: SkinAppearance) -> MicroRelief | None:
    """Return the first site's relief of `skinrig fit microstructure`; None without that part."""
    from skinrig.dynamic_appearance import MICROSTRUCTURE, parts_of

    part = parts_of(appearance).get(MICROSTRUCTURE)
    if part is None:
        return None
    site, entry = sorted(part["sites"].items())[0]
    found = appearance.maps[entry["map"]]
    text = bytes(appearance.files[entry["table"]]).decode("utf-8")
    valid = np.ones(found.values.shape[:2], bool) if found.valid is None else found.valid
    return MicroRelief(
        largest_square(np.squeeze(found.values).astype(np.float32), valid),
        float(entry["pixel_um"]),
        KernelTable.from_json(text),
        f"{part['source']}: {site}",
    )


def simulated_relief(seed: int, *, site: str = "forehead", pixel_um: float = 15.0) -> MicroRelief:
    """Return relief of the simulated skin of a site, `PATCH_PX` a side."""
    from rigsim.microrelief import make_micro_skin

    skin = make_micro_skin(site, seed=seed, size_mm=1e-3 * pixel_um * PATCH_PX, texel_um=pixel_um)
    return MicroRelief(skin.height_um, pixel_um, FOREHEAD, f"simulated: {site}")


def largest_square(height: Float32, valid: NDArray[np.bool_]) -> Float32:
    """Return the largest square without holes; the first one in reading order of several.

    Examples
    --------
    >>> holes = np.array([[0, 1, 1], [1, 1, 1]], bool)
    >>> largest_square(np.arange(6, dtype=np.float32).reshape(2, 3), holes).tolist()
    [[1.0, 2.0], [4.0, 5.0]]
    """
    good = np.asarray(valid, bool) & np.isfinite(height)
    size = np.zeros(good.shape, np.int64)
    for y in range(good.shape[0]):
        row = good[y].astype(np.int64)
        if y:
            # side of the largest square that ends at each pixel
            above = size[y - 1]
            for x in np.flatnonzero(row):
                if x:
                    row[x] = 1 + min(above[x], above[x - 1], row[x - 1])
        size[y] = row
    side = int(size.max(initial=0))
    if side == 0:
        raise MicrostructureAssetError("relief: got no valid pixel, expected some millimetres")
    bottom, right = np.argwhere(size == side)[0] + 1
    return np.ascontiguousarray(height[bottom - side : bottom, right - side : right])


def grown(relief: MicroRelief, *, seed: int = 0) -> GrownRelief:
    """Return what is grown in the page: the middle of the relief, without its mean and tilt.

    Raises
    ------
    MicrostructureAssetError
        For a relief too small to choose places from.
    """
    side = min(*relief.height_um.shape, PATCH_PX) // relief_growth.STEP_PX * relief_growth.STEP_PX
    cell = min(CELL_PX, relief_growth.largest_cell_px(side))
    if cell < 2 * relief_growth.STEP_PX:
        raise MicrostructureAssetError(
            f"relief: got {relief.height_um.shape}, expected at least 96 pixels a side"
        )
    top, left = ((n - side) // 2 for n in relief.height_um.shape)
    part = relief.height_um[top : top + side, left : left + side].astype(np.float64)
    # a tilt would be a slope that no skin has, and steps where places meet
    y, x = (np.mgrid[:side, :side] - 0.5 * (side - 1)).reshape(2, -1)
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    part -= (plane @ np.linalg.lstsq(plane, part.ravel(), rcond=None)[0]).reshape(side, side)
    return GrownRelief(part.astype(np.float32), relief.pixel_um, cell, seed % 2**32)


def from_relief(relief: MicroRelief, mesh: ViewerMesh, *, seed: int = 0) -> Assets:
    """Return textures, tables and parameters of a relief on a mesh.

    Parameters
    ----------
    relief : MicroRelief
    mesh : ViewerMesh
        Its texture's scale says how many pixels the grown displacement has.
    seed : int

    Raises
    ------
    MicrostructureAssetError
        For a table of more lines than the shader holds, or a texture whose scale is so uneven
        that kernels reach too far.
    """
    growth = grown(relief, seed=seed)
    table = relief.table
    if len(table.alpha_breaks) > MOST_BREAKS:
        raise MicrostructureAssetError(
            f"table: got {len(table.alpha_breaks)} breaks, expected at most {MOST_BREAKS}"
        )
    scale = px_per_mm(mesh)
    virtual = round(1e3 / (relief.pixel_um * float(np.median(scale))))
    virtual = max(relief_growth.STEP_PX, virtual // relief_growth.STEP_PX * relief_growth.STEP_PX)
    virtual = min(virtual, relief_growth.LARGEST_PX // 2)
    reach = reach_px(table, scale, virtual)
    below, above = table.sigma_lines_um()
    return Assets(
        textures={"relief_patch": Texture(growth.patch[..., None], "u16", "nearest")},
        tables={
            "kernel_alpha_breaks": np.asarray([table.alpha_breaks], np.float32),
            "kernel_alpha_lines": np.asarray(table.alpha_lines, np.float32),
            "kernel_sigma_lines_mm": 1e-3 * np.asarray([below, above], np.float32),
            "strained_variance": strained_variance(growth, table).astype(np.float32),
        },
        facts={
            "microstructure": {
                "pixel_um": growth.pixel_um,
                "patch_px": growth.patch.shape[0],
                "cell_px": growth.cell_px,
                "choices": growth.choices,
                "seed": growth.seed,
                "virtual_px": virtual,
                "levels": relief_growth.LEVELS,
                "reach_px": reach,
                "stretch_range": list(table.stretch_range),
                "alpha_limits": list(ALPHA_LIMITS),
                "variance_stretch_range": list(STRETCH_RANGE),
                "slope_rms": slope_rms(growth),
                "source": relief.source,
                "table": table.source,
            }
        },
    )


def reach_px(table: KernelTable, scale: Floats, virtual_px: int) -> int:
    """Return how many pixels of the displacement a kernel reaches, and two for its samples.

    Parameters
    ----------
    table : KernelTable
    scale : ndarray
        Texture units per mm of skin, see `px_per_mm`.
    virtual_px : int
        Side of the displacement.

    Raises
    ------
    MicrostructureAssetError
        For more than `MOST_REACH_PX`.
    """
    # the finest 1 % of a texture is slivers: kernels there are held at the window's margin
    finest = float(np.percentile(scale, 99.0))
    reach = math.ceil(4.0 * largest_sigma_um(table) * 1e-3 * virtual_px * finest + 0.5) + 2
    if reach > MOST_REACH_PX:
        raise MicrostructureAssetError(
            f"mesh: got kernels of {reach} px at the texture's finest places, expected at most "
            f"{MOST_REACH_PX}: lengths differ too much over its texture"
        )
    return reach


def with_displacement(
    scene: ViewerScene, pyramid: Pyramid, *, table: KernelTable = FOREHEAD
) -> ViewerScene:
    """Return a scene that fetches its relief as tiles in place of growing it from a patch.

    Parameters
    ----------
    scene : ViewerScene
        Its own relief, where it has one, is left out.
    pyramid : Pyramid
        Of the displacement, in the texture of the scene's mesh.
    table : KernelTable
        Of that skin.

    Raises
    ------
    MicrostructureAssetError
        As of `from_relief`.
    """
    scale = px_per_mm(scene.mesh)
    pixel_um = 1e3 / (pyramid.size * float(np.median(scale)))
    source = pyramid.levels[0]
    first = (pyramid.size - SAMPLE_PX) // 2
    middle = np.asarray(source[first : first + SAMPLE_PX, first : first + SAMPLE_PX], np.float32)
    made = from_relief(MicroRelief(middle, pixel_um, table, "displacement"), scene.mesh)
    facts = dict(made["facts"]["microstructure"])
    for unused in ("patch_px", "cell_px", "choices", "seed"):
        del facts[unused]
    facts |= {
        "virtual_px": pyramid.size,
        "levels": len(pyramid.levels),
        "reach_px": reach_px(table, scale, pyramid.size),
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


def px_per_mm(mesh: ViewerMesh) -> Floats:
    """Return texture units per mm of skin at the vertices of a mesh, by the root of areas."""
    from model.mesh_strain import strain

    rest = mesh.positions.astype(np.float64)
    found = strain(rest, rest, mesh.faces, mesh.uv)
    if not found.valid.any():
        raise MicrostructureAssetError("mesh: got no triangle with an area in the texture")
    a, b, c = found.uv_metric[found.valid].T
    return np.asarray(np.sqrt(np.abs(a * c - b * b)))


def largest_sigma_um(table: KernelTable) -> float:
    """Return the widest kernel of a table within its range, um."""
    ends = np.array([*table.stretch_range, np.nextafter(1.0, 0.0), 1.0])
    return float(kernel_parameters(ends, table)[1].max())


def slope_rms(growth: GrownRelief) -> list[float]:
    """Return the rms of slopes that pixels of 2^level px still show, by level of a relief.

    A slope is the gradient by central differences over two pixels of the level, as the page's
    normals are; levels end where less than six pixels a side are left.
    """
    found = []
    height = growth.patch.astype(np.float64)
    step = growth.pixel_um
    while height.shape[0] >= FEWEST_PX:
        dx = (height[1:-1, 2:] - height[1:-1, :-2]) / (2.0 * step)
        dy = (height[2:, 1:-1] - height[:-2, 1:-1]) / (2.0 * step)
        found.append(float(np.sqrt(np.mean(dx**2 + dy**2))))
        side = height.shape[0] // 2
        height = height[: 2 * side, : 2 * side].reshape(side, 2, side, 2).mean(axis=(1, 3))
        step *= 2.0
    return found


def strained_variance(growth: GrownRelief, table: KernelTable) -> Floats:
    """Return how the variance of slopes changes under strain, relative to neutral skin.

    The kernels' transfer functions on the patch's power spectrum, averaged with that of the
    patch turned by 90 degrees: what direction the relief has of its own is not followed. Slopes
    are those of the deformed surface: heights over lengths that are stretched too.

    Parameters
    ----------
    growth : GrownRelief
    table : KernelTable

    Returns
    -------
    ndarray, shape (STRETCHES, STRETCHES, 2)
        Variance along s and along t by r_s (rows) and r_t (columns), over `STRETCH_RANGE`.
    """
    side = growth.patch.shape[0]
    window = np.hanning(side + 2)[1:-1]
    spectrum = np.abs(np.fft.fft2(growth.patch * window[:, None] * window)) ** 2
    spectrum = 0.5 * (spectrum + spectrum.T)
    turn = 2.0 * np.pi * np.fft.fftfreq(side)
    slope = np.sin(turn) ** 2
    ratios = np.linspace(*STRETCH_RANGE, STRETCHES)
    alpha, sigma_um = kernel_parameters(ratios, table)
    transfer = np.empty((STRETCHES, side))
    for row, (a, s) in enumerate(zip(alpha, sigma_um / growth.pixel_um, strict=True)):
        weights = gaussian_weights(s)
        wave = np.cos(turn[:, None] * np.arange(weights.size)) @ (
            weights * np.where(np.arange(weights.size) > 0, 2.0, 1.0)
        )
        transfer[row] = (1.0 - a + a * wave) ** 2
    neutral = float(slope @ spectrum.sum(axis=1))
    along = (transfer * slope) @ spectrum @ transfer.T / neutral
    return np.stack([along / ratios[:, None] ** 2, along.T / ratios[None, :] ** 2], axis=2)
