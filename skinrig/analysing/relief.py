"""Measure seams and spectrum of a synthesized displacement map against the measured patches."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from model import store
from rigsim.geometry.atlas import Atlas, unwrap
from rigsim.geometry.mesh import Mesh, build_mesh
from skinrig.appearances import dynamic
from skinrig.appearances.contents import hash_file
from skinrig.appearances.dynamic import MICROSTRUCTURE
from skinrig.applying.chart_seams import SEAM_ATLAS_PX, SEAM_FADE_MM, ChartSeams, sample_map
from skinrig.applying.relief import level_site_patch
from skinrig.arrays import Float64Array
from skinrig.atomic_file import write_atomically
from skinrig.blend_shapes import meshes
from skinrig.console import to_json_value
from skinrig.errors import UnusableError

OUTPUT_FILE: Final = "relief.json"
MAP_NAME: Final = "displacement_neutral"
N_INTERIOR_SAMPLES: Final = 400_000
N_WINDOWS: Final = 24
PERIODS_UM: Final = (2000.0, 1000.0, 500.0, 250.0, 125.0, 62.5)
"""Borders of the judged octaves; 1 mm splits the mesh's own shape from the relief."""
MIN_PERIODS: Final = 2.0
"""Side of a window over the longest period of a judged octave, at least."""
PERIOD_TOL: Final = 1.01
"""Factor on a window's longest judged period, for sides of whole pixels."""
MIN_WINDOW_PX: Final = 16
MAX_WINDOW_PX: Final = 2048
MAX_TEXEL_ASPECT: Final = 1.25
"""Longer over shorter side of the texels in a judged window, at most."""


def measure_relief(
    out: Path, relief: Path, *, moving: Path, mesh: Path, seed: int
) -> dict[str, Any]:
    """Measure a neutral displacement map, and write `OUTPUT_FILE`.

    Parameters
    ----------
    out
        Folder to write.
    relief
        Folder written by ``skinrig apply microstructure``.
    moving
        Fitted folder with the patches.
    mesh
        Mesh that the map belongs to.
    seed
        Seed of the interior samples and windows.

    Returns
    -------
    dict
        JSON values. ``seam``: steps between both sides, um; ``interior``: differences of
        neighboring pixels within charts, um; ``octaves``: RMS amplitude over that of the patches,
        its standard error over disjoint windows, and their number; NaN for fewer than two.

    Raises
    ------
    UnusableError
        For a folder without this map, one whose large map is missing or of another run, a map that
        is not square, or a mesh without texture.
    """
    appearance, found = dynamic.read(moving, parts=(MICROSTRUCTURE,))
    sites = found.get(MICROSTRUCTURE, {}).get("sites", {})
    if not sites:
        raise UnusableError(f"{moving}: got no microstructure; use `skinrig fit microstructure`")
    height = _open_map(relief)
    shape = meshes.load(mesh)
    face = build_mesh(shape.vertices_mm, shape.faces, shape.uv)
    atlas = unwrap(face, SEAM_ATLAS_PX)
    if not atlas.covered.any():
        raise UnusableError(f"{mesh}: got no surface in the texture, expected some")
    rng = np.random.default_rng(seed)
    document: dict[str, Any] = {
        "schema": "skinrig.relief/1",
        "relief": str(relief),
        "size_px": len(height),
        **_measure_seams(height, face, rng),
    }
    patches = [
        (level_site_patch(name, appearance, site), float(site["pixel_um"]))
        for name, site in sites.items()
    ]
    document["octaves"] = _compare_spectra(height, atlas, patches, rng)
    text = json.dumps(to_json_value(document), indent=1, allow_nan=False)
    write_atomically(out / OUTPUT_FILE, text)
    return document


def _open_map(relief: Path) -> Any:
    kept = store.read(relief)
    if MAP_NAME not in kept.maps:
        raise UnusableError(
            f"{relief}: got no {MAP_NAME}, expected a folder of `skinrig apply microstructure`"
        )
    height = kept.maps[MAP_NAME].values
    figures: Any = kept.parameters.get("figures", {})
    digest = figures.get(MICROSTRUCTURE, {}).get("files", {}).get(f"{MAP_NAME}.npy")
    if digest is not None:
        folder = relief.resolve()
        large = folder.with_name(f"{folder.name}-large") / f"{MAP_NAME}.npy"
        if not large.is_file() or hash_file(large) != digest:
            got = "a file of another run" if large.is_file() else "no such file"
            raise UnusableError(
                f"{large}: got {got}, expected the map that {relief} lists; "
                "repeat `skinrig apply microstructure`"
            )
        height = np.load(large, mmap_mode="r")
    if height.ndim != 2 or height.shape[0] != height.shape[1]:
        got = " x ".join(str(n) for n in height.shape)
        raise UnusableError(f"{relief}: {MAP_NAME} has {got} pixels, expected a square map")
    return height


def _measure_seams(height: Any, face: Mesh, rng: np.random.Generator) -> dict[str, Any]:
    """Return steps across seams, and differences of neighboring pixels of the charts."""
    side = len(height)
    corners = face.uv[face.faces].astype(np.float64)
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    chosen = rng.choice(len(area), N_INTERIOR_SAMPLES, p=area / area.sum())
    part = rng.random((N_INTERIOR_SAMPLES, 2))
    part = np.where(part.sum(axis=1, keepdims=True) > 1.0, 1.0 - part, part)
    uv = corners[chosen, 0] + part[:, :1] * a[chosen] + part[:, 1:] * b[chosen]
    step = np.zeros_like(uv)
    step[np.arange(len(uv)), rng.integers(0, 2, len(uv))] = 1.0 / side
    inside = np.abs(sample_map(height, uv + step) - sample_map(height, uv))
    seams = ChartSeams.of(face.vertices_mm, face.faces, face.uv)
    found: dict[str, Any] = {
        "interior": {"99": float(np.percentile(inside, 99.0))},
        "seam_length_mm": float(seams.length_mm.sum()),
        "seam": None,
    }
    if len(seams.length_mm):
        first, second = seams.sample(1.0 / side)
        jump = np.abs(sample_map(height, first) - sample_map(height, second))
        found["seam"] = {str(p): float(np.percentile(jump, p)) for p in (50, 99)}
    return found


def _compare_spectra(
    height: Any, atlas: Atlas, patches: list[tuple[Any, float]], rng: np.random.Generator
) -> list[dict[str, Any]]:
    """Return the RMS amplitude of the map's octaves over that of the patches."""
    windows = [window for patch, pixel_um in patches for window in _split_patch(patch, pixel_um)]
    side_um = min(float(np.sqrt(one.size * np.prod(pixel))) for one, pixel in windows)
    target, target_error, target_count = mean_octaves(windows)
    own, own_error, count = mean_octaves(draw_windows(height, atlas, rng, side_um))
    return [
        {
            "longest_um": longest,
            "shortest_um": shortest,
            "ratio": float(np.sqrt(own[k] / target[k])),
            "stderr": float(
                0.5 * np.sqrt(own[k] / target[k]) * np.hypot(own_error[k], target_error[k])
            ),
            "windows": int(count[k]),
            "patch_windows": int(target_count[k]),
            "patch_rms_um": float(np.sqrt(target[k])),
        }
        for k, (longest, shortest) in enumerate(pairwise(PERIODS_UM))
    ]


def _split_patch(patch: Any, pixel_um: float) -> list[tuple[Float64Array, tuple[float, float]]]:
    """Return disjoint windows of a patch, as many as its longest judged period permits."""
    known = np.nan_to_num(patch).astype(np.float64)
    wanted = int(np.ceil(MIN_PERIODS * PERIODS_UM[0] / PERIOD_TOL / pixel_um))
    rows, columns = (n // max(n // wanted, 1) for n in known.shape)
    return [
        (known[top : top + rows, left : left + columns], (pixel_um, pixel_um))
        for top in range(0, known.shape[0] - rows + 1, rows)
        for left in range(0, known.shape[1] - columns + 1, columns)
    ]


def draw_windows(
    height: Any, atlas: Atlas, rng: np.random.Generator, side_um: float
) -> list[tuple[Float64Array, tuple[float, float]]]:
    """Return disjoint windows within charts and away from seams, with their pixels, um.

    All have the patches' side on the skin, since a window smears steep spectra by its side. Texels
    that are not square are omitted, since synthesis does not correct for them.
    """
    side = len(height)
    scale = 1e3 * atlas.size / side
    along_u, along_v = (scale * part for part in atlas.texel_mm())
    margin_mm = 0.75e-3 * side_um + SEAM_FADE_MM
    inner = ndimage.distance_transform_edt(np.pad(atlas.covered, 1))[1:-1, 1:-1]
    texels = rng.permutation(np.argwhere(inner * atlas.typical_texel_mm() > margin_mm))
    row, column = texels.T
    sizes = np.rint(side_um / np.sqrt(along_u[row, column] * along_v[row, column])).astype(int)
    aspect = along_u[row, column] / along_v[row, column]
    kept = (sizes >= MIN_WINDOW_PX) & (sizes <= min(MAX_WINDOW_PX, side))
    kept &= np.maximum(aspect, 1.0 / aspect) <= MAX_TEXEL_ASPECT
    texels, sizes = texels[kept], sizes[kept]
    middles = (texels + 0.5) * side / atlas.size
    found: list[tuple[Float64Array, tuple[float, float]]] = []
    while len(sizes) and len(found) < N_WINDOWS:
        size, texel = int(sizes[0]), tuple(texels[0])
        top, left = np.clip((middles[0] - 0.5 * size).astype(int), 0, side - size)
        window = np.array(height[top : top + size, left : left + size], np.float64)
        found.append((window, (float(along_u[texel]), float(along_v[texel]))))
        apart = np.abs(middles - middles[0]).max(axis=1) >= 0.5 * (sizes + size) + 1.0
        texels, sizes, middles = texels[apart], sizes[apart], middles[apart]
    return found


def mean_octaves(
    windows: list[tuple[Float64Array, tuple[float, float]]],
    periods_um: tuple[float, ...] = PERIODS_UM,
) -> tuple[Float64Array, Float64Array, NDArray[np.intp]]:
    """Return each octave's mean variance, um^2, its relative standard error, and the windows.

    The error is that of the mean of independent windows; NaN for fewer than two.
    """
    found = np.full((len(windows), len(periods_um) - 1), np.nan)
    for row, (window, (pixel_x, pixel_y)) in zip(found, windows, strict=True):
        rows, columns = window.shape
        weight = np.outer(np.hanning(rows), np.hanning(columns))
        level = window - np.sum(window * weight) / weight.sum()
        power = np.abs(np.fft.fft2(level * weight)) ** 2 / (np.sum(weight**2) * window.size)
        per_um = np.hypot(
            np.fft.fftfreq(columns, pixel_x)[None], np.fft.fftfreq(rows, pixel_y)[:, None]
        )
        side_um = np.sqrt(rows * pixel_y * columns * pixel_x)
        least, resolution = side_um / MIN_PERIODS, 1.0 / side_um
        finest = 2.0 * max(pixel_x, pixel_y)
        for k, (longest, shortest) in enumerate(pairwise(periods_um)):
            if longest <= least * PERIOD_TOL and shortest >= finest:
                # a wave at an octave's border counts in both, by the part of its resolution
                above = per_um + 0.5 * resolution - 1.0 / longest
                below = 1.0 / shortest - per_um + 0.5 * resolution
                part = np.clip(np.minimum(above, below) / resolution, 0.0, 1.0)
                row[k] = float(np.sum(power * part))
    count = np.isfinite(found).sum(axis=0)
    known = np.where(np.isfinite(found), found, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = known.sum(axis=0) / count
        spread = np.where(np.isfinite(found), (found - mean) ** 2, 0.0).sum(axis=0)
        return (
            mean,
            np.sqrt(spread / (count * np.where(count > 1, count - 1, np.nan))) / mean,
            count,
        )
