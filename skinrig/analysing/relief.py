"""Measure seams and spectrum of a synthesized displacement map against the measured patches."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy import ndimage

from model import store
from rigsim.geometry.atlas import Atlas, unwrap
from rigsim.geometry.mesh import Mesh, build_mesh
from skinrig.appearances import dynamic
from skinrig.appearances.dynamic import MICROSTRUCTURE
from skinrig.applying.chart_seams import SEAM_ATLAS_PX, SEAM_FADE_MM, ChartSeams, sample_map
from skinrig.applying.relief import level_site_patch
from skinrig.arrays import Float64Array
from skinrig.atomic_file import write_atomically
from skinrig.blend_shapes import meshes
from skinrig.errors import UnusableError

OUTPUT_FILE: Final = "relief.json"
MAP_NAME: Final = "displacement_neutral"
N_INTERIOR_SAMPLES: Final = 400_000
N_WINDOWS: Final = 24
PERIODS_UM: Final = (2000.0, 1000.0, 500.0, 250.0, 125.0, 62.5)
"""Borders of the judged octaves; 1 mm splits the mesh's own shape from the relief."""
MIN_PERIODS: Final = 2.0
"""Longest period of a judged octave over the window's side, inverse."""
MAX_WINDOW_PX: Final = 1024


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
        neighboring pixels within charts, um; ``octaves``: RMS amplitude over that of the patches.

    Raises
    ------
    UnusableError
        For a folder without this map, or a mesh without texture.
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
    write_atomically(out / OUTPUT_FILE, json.dumps(document, indent=1))
    return document


def _open_map(relief: Path) -> Any:
    large = relief.with_name(f"{relief.name}-large") / f"{MAP_NAME}.npy"
    if large.exists():
        return np.load(large, mmap_mode="r")
    maps = store.read(relief).maps
    if MAP_NAME not in maps:
        raise UnusableError(
            f"{relief}: got no {MAP_NAME}, expected a folder of `skinrig apply microstructure`"
        )
    return maps[MAP_NAME].values


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
    target, target_error = _mean_octaves(
        [window for patch, pixel_um in patches for window in _split_patch(patch, pixel_um)]
    )
    windows = _draw_windows(height, atlas, rng)
    own, own_error = _mean_octaves(windows)
    return [
        {
            "longest_um": longest,
            "shortest_um": shortest,
            "ratio": float(np.sqrt(own[k] / target[k])),
            "stderr": float(
                0.5 * np.sqrt(own[k] / target[k]) * np.hypot(own_error[k], target_error[k])
            ),
            "windows": len(windows),
        }
        for k, (longest, shortest) in enumerate(pairwise(PERIODS_UM))
    ]


def _split_patch(patch: Any, pixel_um: float) -> list[tuple[Float64Array, tuple[float, float]]]:
    """Return nine overlapping windows of a patch, which weigh its parts more evenly than one."""
    known = np.nan_to_num(patch).astype(np.float64)
    wanted = int(np.ceil(1.02 * MIN_PERIODS * PERIODS_UM[0] / pixel_um))
    rows, columns = (min(n, max(wanted, n // 2)) for n in known.shape)
    spare = known.shape[0] - rows, known.shape[1] - columns
    return [
        (known[top : top + rows, left : left + columns], (pixel_um, pixel_um))
        for top in sorted({part * spare[0] // 2 for part in range(3)})
        for left in sorted({part * spare[1] // 2 for part in range(3)})
    ]


def _draw_windows(
    height: Any, atlas: Atlas, rng: np.random.Generator
) -> list[tuple[Float64Array, tuple[float, float]]]:
    """Return windows of the map within charts and away from seams, with their pixels, um."""
    side = len(height)
    along_u, along_v = atlas.texel_mm()
    texel_um = 1e3 * atlas.typical_texel_mm() * atlas.size / side
    wanted = 1.25 * MIN_PERIODS * PERIODS_UM[0] / texel_um
    size = int(min(max(wanted, 64.0), MAX_WINDOW_PX, side))
    margin_mm = 1e-3 * texel_um * size * 0.75 + SEAM_FADE_MM
    inner = ndimage.distance_transform_edt(np.pad(atlas.covered, 1))[1:-1, 1:-1]
    good = np.argwhere(inner * atlas.typical_texel_mm() > margin_mm)
    if not len(good):
        return []
    found = []
    for row, column in good[rng.choice(len(good), min(N_WINDOWS, len(good)), replace=False)]:
        top, left = (
            int(np.clip((at + 0.5) * side / atlas.size - 0.5 * size, 0, side - size))
            for at in (row, column)
        )
        window = np.array(height[top : top + size, left : left + size], np.float64)
        scale = 1e3 * atlas.size / side
        found.append(
            (window, (scale * float(along_u[row, column]), scale * float(along_v[row, column])))
        )
    return found


def _mean_octaves(
    windows: list[tuple[Float64Array, tuple[float, float]]],
) -> tuple[Float64Array, Float64Array]:
    """Return the mean variance in each octave, um^2, and its relative standard error; NaN: none."""
    found = np.full((len(windows), len(PERIODS_UM) - 1), np.nan)
    for row, (window, (pixel_x, pixel_y)) in zip(found, windows, strict=True):
        rows, columns = window.shape
        weight = np.outer(np.hanning(rows), np.hanning(columns))
        level = window - np.sum(window * weight) / weight.sum()
        power = np.abs(np.fft.fft2(level * weight)) ** 2 / (np.sum(weight**2) * window.size)
        per_um = np.hypot(
            np.fft.fftfreq(columns, pixel_x)[None], np.fft.fftfreq(rows, pixel_y)[:, None]
        )
        least = np.sqrt(rows * pixel_y * columns * pixel_x) / MIN_PERIODS
        finest = 2.0 * max(pixel_x, pixel_y)
        for k, (longest, shortest) in enumerate(pairwise(PERIODS_UM)):
            if longest <= least * 1.01 and shortest >= finest:
                band = (per_um >= 1.0 / longest) & (per_um < 1.0 / shortest)
                row[k] = float(power[band].sum())
    count = np.isfinite(found).sum(axis=0)
    known = np.where(np.isfinite(found), found, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = known.sum(axis=0) / count
        spread = np.where(np.isfinite(found), (found - mean) ** 2, 0.0).sum(axis=0)
        return mean, np.sqrt(spread / (count * np.maximum(count - 1, 1))) / mean
