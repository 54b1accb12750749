"""Judge seams and spectrum of synthesized relief, with and without a mesoscale surface.

    python tools/judge_relief_split.py OUT SEED sheet:2048:20 plane:4096:82 head:16384:1

Each case is a mesh of two charts, the side of the map, and a size: a bent square and its width in
mm, or the simulated head cut along its middle and its scale. A head reduced as its map is has the
texels of the whole one. A plane is one chart; its octaves are printed unmatched and matched. The
patch is a simulated forehead of 8 mm. Rows: RMS amplitude of octaves over that of the patch; of
relief and mesoscale together over that of the mesoscale, in the same windows; height differences at
seams. The mesoscale is noise in space, which has no seams.
"""

import resource
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from model.displacement_synthesis.growth import grow
from model.displacement_synthesis.sources import level_patch
from model.displacement_synthesis.split import add_mesoscale, match_spectrum
from model.displacement_synthesis.volume_noise import VolumeNoise
from model.microstructure import FOREHEAD
from model.skin import SkinAppearance, SkinMap
from rigsim.geometry.atlas import dilate_texture, unwrap
from rigsim.geometry.mesh import build_mesh
from rigsim.skin_patch.microrelief import make_micro_skin
from rigsim.subject.head import build_head
from skinrig.analysing.relief import draw_windows, mean_octaves, measure_relief
from skinrig.appearances import dynamic
from skinrig.applying.expression import ExpressionRequest, apply_expression
from skinrig.applying.relief import ReliefEvaluator, ReliefRequest
from skinrig.arrays import Float64Array, Int64Array

PATCH_SEED = 4
PATCH_MM = 8.0
PATCH_PIXEL_UM = 16.0
MESOSCALE_PX = 2048
MESOSCALE_UM = 10.6
MESOSCALE_PER_MM = (0.1, 2.0)
"""Noise of 4.5 um per octave: an octave of the unfiltered patch, 2 to 1 mm, has 4.5 um."""
MESOSCALE_PERIODS_UM = (2000.0, 1000.0)
WINDOW_UM = 4000.0
GAP = 0.02
WINDOW_GAP = 0.13
"""Distance between windows over their side."""


def main(out: Path, seed: int, *cases: str) -> None:
    """Print the rows of all cases."""
    moving = out / "moving"
    _write_patch(moving)
    for case in cases:
        kind, size_px, size = case.split(":")
        if kind == "plane":
            _judge_plane(int(size_px), 1e3 * float(size) / int(size_px), seed)
            continue
        folder = out / case.replace(":", "-")
        folder.mkdir(parents=True, exist_ok=True)
        mesh = folder / "mesh.npz"
        _write_charts(mesh, *(_sheet if kind == "sheet" else _head)(float(size)))
        begin = time.process_time()
        _judge(folder, mesh, moving, int(size_px), seed)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(f"{case}: {time.process_time() - begin:.0f} processor s, {peak:.1f} GB", flush=True)


def _judge_plane(size_px: int, pixel_um: float, seed: int) -> None:
    """Print octaves of a grown plane over the patch's, unmatched and matched."""
    skin = make_micro_skin("forehead", seed=PATCH_SEED, size_mm=PATCH_MM, texel_um=PATCH_PIXEL_UM)
    patch = level_patch(skin.height_um, pixel_um=PATCH_PIXEL_UM)
    rng = np.random.default_rng(seed)
    height = grow([patch], size_px, rng=rng, pixel_um=pixel_um, patch_pixel_um=PATCH_PIXEL_UM)
    target = _split_octaves(patch, PATCH_PIXEL_UM, 0.0)[0]
    for name in ("unmatched", "matched"):
        if name == "matched":
            match_spectrum(height, [(patch, PATCH_PIXEL_UM)], [1.0], pixel_um)
        power, error, count = _split_octaves(height, pixel_um, WINDOW_GAP)
        ratio = np.sqrt(power / target)
        pairs = zip(ratio, 0.5 * ratio * error, strict=True)
        row = ", ".join(f"{a:.3f} ({b:.3f})" for a, b in pairs)
        print(f"plane, {size_px} px, {name}: {row}, n = {count[0]}", flush=True)


def _split_octaves(height: Any, pixel_um: float, gap: float) -> Any:
    """Return octaves, errors and counts of disjoint windows, out of step with the cells of 2 mm."""
    side = round(WINDOW_UM / pixel_um)
    starts = range(0, len(height) - side + 1, round((1.0 + gap) * side))
    parts = (height[y : y + side, x : x + side] for y in starts for x in starts)
    return mean_octaves([(np.array(one, np.float64), (pixel_um, pixel_um)) for one in parts])


def _write_patch(moving: Path) -> None:
    skin = make_micro_skin("forehead", seed=PATCH_SEED, size_mm=PATCH_MM, texel_um=PATCH_PIXEL_UM)
    site = {
        "pixel_um": PATCH_PIXEL_UM,
        "map": "microrelief_forehead",
        "table": "kernel_table_forehead.json",
    }
    files = {"kernel_table_forehead.json": FOREHEAD.to_json().encode()}
    maps = {"microrelief_forehead": SkinMap(skin.height_um.astype(np.float32), "um")}
    part = SkinAppearance(maps, "simulated", {"sites": {"forehead": site}}, {}, files=files)
    dynamic.add(moving, dynamic.MICROSTRUCTURE, part)


def _sheet(width_mm: float) -> tuple[Float64Array, Float64Array, Int64Array]:
    """Return points, texture coordinates and triangles of a bent square."""
    x, y = np.meshgrid(np.linspace(0.0, 1.0, 33), np.linspace(0.0, 1.0, 33))
    uv = np.stack([x.ravel(), y.ravel()], axis=1)
    points = width_mm * np.column_stack([uv, -0.02 * width_mm * (uv[:, 0] - 0.5) ** 2])
    first = np.arange(32 * 33).reshape(32, 33)[:, :32].ravel()
    a, b, c = first, first + 1, first + 33
    return points, uv, np.concatenate([np.stack([a, b, c + 1], 1), np.stack([a, c + 1, c], 1)])


def _head(scale: float) -> tuple[Float64Array, Float64Array, Int64Array]:
    head = build_head(np.random.default_rng(0))
    return (
        scale * head.vertices_mm.astype(float),
        head.uv.astype(float),
        head.faces.astype(np.int64),
    )


def _write_charts(path: Path, points: Float64Array, uv: Float64Array, faces: Int64Array) -> None:
    """Write a mesh cut at u = 1/2 into two charts with a gap, the right one turned over."""
    right = uv[faces].mean(axis=1)[:, 0] > 0.5
    texture = GAP + (1.0 - 2.0 * GAP) * uv
    turned = texture * [-1.0, -1.0] + [1.5 - 0.5 * GAP, 1.0]
    texture[:, 0] -= 0.5 * GAP
    np.savez(
        path,
        vertices_mm=np.concatenate([points, points]).astype(np.float32),
        uv=np.clip(np.concatenate([texture, turned]), 0.0, 1.0).astype(np.float32),
        faces=np.concatenate([faces[~right], faces[right] + len(points)]).astype(np.int32),
        shape_names=np.array(["still"]),
        shape_deltas_mm=np.zeros((1, 2 * len(points), 3), np.float16),
    )


def _judge(folder: Path, mesh: Path, moving: Path, size_px: int, seed: int) -> None:
    relief = folder / "relief"
    request = ReliefRequest(size_px, seed=seed)
    evaluator = ReliefEvaluator.of(mesh, {}, request, out=relief, progress=lambda text: None)
    parts = (dynamic.MICROSTRUCTURE,)
    done = apply_expression(
        moving, ExpressionRequest({}), out=relief, parts=parts, relief=evaluator
    )
    found = measure_relief(folder / "measured", relief, moving=moving, mesh=mesh, seed=seed)
    for one in found["octaves"]:
        print(
            f"{one['longest_um']:.0f} to {one['shortest_um']:.0f} um: {one['patch_rms_um']:.2f}, "
            f"{one['ratio']:.3f} ({one['stderr']:.3f}), n = {one['windows']}"
        )
    print("differences, um: interior", found["interior"], "seam", found["seam"])
    large = relief.with_name("relief-large") / "displacement_neutral.npy"
    height = (
        np.load(large, mmap_mode="r+")
        if large.is_file()
        else np.array(done.maps["displacement_neutral"].values)
    )
    _judge_mesoscale(height, mesh, seed)


def _judge_mesoscale(height: Any, mesh: Path, seed: int) -> None:
    """Add a mesoscale surface and print its octaves over those of the mesoscale alone."""
    rng = np.random.default_rng([seed, 1])
    with np.load(mesh) as kept:
        face = build_mesh(kept["vertices_mm"], kept["faces"], kept["uv"])
    atlas = unwrap(face, MESOSCALE_PX)
    places = dilate_texture(atlas.position_mm, atlas.covered, steps=8).astype(np.float64)
    noise = VolumeNoise.draw(rms_um=MESOSCALE_UM, band_per_mm=MESOSCALE_PER_MM, waves=64, rng=rng)
    mesoscale = noise.at(places)
    area = np.linalg.norm(np.cross(atlas.dp_du_mm, atlas.dp_dv_mm), axis=-1)
    side_um = np.sqrt(np.where(atlas.covered, area, np.median(area[atlas.covered])))
    add_mesoscale(height, mesoscale, atlas.covered, 1e3 * side_um / MESOSCALE_PX)
    both = [
        draw_windows(one, atlas, np.random.default_rng(seed), WINDOW_UM)
        for one in (height, mesoscale)
    ]
    whole, alone = (mean_octaves(windows, MESOSCALE_PERIODS_UM) for windows in both)
    for k, (longest, shortest) in enumerate(pairwise(MESOSCALE_PERIODS_UM)):
        ratio = np.sqrt(whole[0][k] / alone[0][k])
        print(
            f"with mesoscale, {longest:.0f} to {shortest:.0f} um: {np.sqrt(alone[0][k]):.2f} um, "
            f"{ratio:.3f}, n = {whole[2][k]}"
        )


if __name__ == "__main__":
    if len(sys.argv) < 4:
        raise SystemExit(__doc__)
    main(Path(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])
