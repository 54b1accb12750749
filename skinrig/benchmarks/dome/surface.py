"""Benchmarks of work on the surface: gathering lumitexels, filling textures."""

import itertools
import tempfile
import time
import tracemalloc
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.ndimage import distance_transform_edt

from capture.calibration.geometry import CameraPose
from capture.calibration.lights import LightTable
from capture.rig import load_rig
from reconstruction.lumitexels import SampledSurface
from reconstruction.lumitexels.ray_casting import RayCaster
from reconstruction.lumitexels.store import LumitexelStore
from reconstruction.surface import texture_fill
from skinrig.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from skinrig.benchmarks.resampling import bootstrap_tiled_rms, mean_error
from skinrig.benchmarks.results import ErrorEstimate, Timing
from skinrig.benchmarks.stage import BenchmarkStage

SPHERE_RADIUS_MM, SPHERE_ALBEDO = 80.0, 0.4
N_FULL_SAMPLES = 500_000 * 16 * 150
N_ERROR_BLOCKS = 40
"""Blocks of samples whose means are independent."""


def measure_lumitexels(stage: BenchmarkStage) -> None:
    """Gather lumitexels of a Lambertian sphere with tables in memory and on disk."""
    width, step = (130, 30) if stage.toy else (1300, 10)
    names = [f"L{k:03d}" for k in range(0, 150, step)]
    views = ["C02", "C07"] if stage.toy else ["C02", "C07", "C13"]
    rig = load_rig("dome").resized(width).subset(lights=names, views=views)
    cameras = [CameraPose.nominal(view) for view in rig.views]
    lights = LightTable.nominal(rig)
    sphere = trimesh.creation.icosphere(subdivisions=4 if stage.toy else 6, radius=SPHERE_RADIUS_MM)
    caster = RayCaster(sphere.vertices, sphere.faces)
    visible = [_visible_points(camera) for camera in cameras]

    def gathered(count: int, **table: Any) -> tuple[Timing, list[FloatArray]]:
        """Gather points; return time and memory, and relative errors of the samples."""
        where = sphere.vertices[:count]
        surface = SampledSurface(where, where / SPHERE_RADIUS_MM)
        tracemalloc.start()
        start = time.perf_counter()
        store = LumitexelStore(surface, cameras=cameras, lights=lights, caster=caster, **table)
        spent = time.perf_counter() - start
        for view, light in itertools.product(range(len(cameras)), range(len(names))):
            image = _image(visible[view], lights, light)
            start = time.perf_counter()
            store.add(view, light, image, np.full_like(image, 1e-6))
            spent += time.perf_counter() - start
        errors = []
        start = time.perf_counter()
        for _, part in store.chunks(1000):
            inner = part.valid & (part.cos_light > 0.3) & (part.cos_view > 0.4)
            errors.append(part.f[inner][:, 1] * np.pi / SPHERE_ALBEDO - 1)
        spent += time.perf_counter() - start
        peak = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
        return Timing.single(spent, peak), errors

    counts = (250, 500) if stage.toy else (2_000, 10_000, 40_000)
    for count, kind in [(n, k) for n in counts for k in ("memory", "disk")]:
        with tempfile.TemporaryDirectory() as folder:
            if kind == "memory":
                timing, errors = gathered(count, folder=None, dtype=np.float32)
            else:
                timing, errors = gathered(count, folder=Path(folder), dtype=np.float16)
        off = 100 * np.abs(np.concatenate(errors))
        samples = count * len(cameras) * len(names)
        # errors of one point's samples are correlated: means of blocks of points are independent
        blocks = mean_error([part.mean() for part in np.array_split(off, N_ERROR_BLOCKS)])
        outcome = ErrorEstimate(float(off.mean()), blocks.error_interval)
        stage.add({"points": count, "tables": kind}, timing, outcome)
    hours = timing.seconds / samples * N_FULL_SAMPLES / 3600
    stage.limits = {"memory": timing.peak_memory_mb or 0.0, "hours": hours}


def measure_texture_filling(stage: BenchmarkStage) -> None:
    """Fill a smooth texture of three channels from a fraction of its texels."""
    side = 128 if stage.toy else 2048
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0:side, 0:side] / side
    truth = np.stack(
        [np.sin(9 * x) * np.cos(7 * y), x + y, np.exp(-20 * ((x - 0.5) ** 2 + (y - 0.5) ** 2))],
        axis=-1,
    ).astype(np.float32)

    def error(filled: FloatArray, unknown: BoolArray) -> ErrorEstimate:
        off = 100 * (filled - truth) / truth.std()
        return bootstrap_tiled_rms(off, unknown, tile_px=max(side // 16, 8))

    for fraction in (0.05, 0.15, 0.35, 0.75):
        weight = (rng.random((side, side)) < fraction).astype(np.float32)
        weight[side // 3 : side // 3 + side // 16, side // 3 : side // 2] = 0.0
        for way, fill in (("push-pull", _push_pull), ("nearest texel", _nearest)):
            stage.measure(
                {"known": fraction, "way": way, "side": side},
                partial(fill, truth, weight),
                lambda filled: error(filled, weight == 0),
            )


def _push_pull(values: Float32Array, weight: Float32Array) -> FloatArray:
    return texture_fill.push_pull(values, weight).values


def _nearest(values: Float32Array, weight: Float32Array) -> FloatArray:
    """Return a texture whose unknown texels have the value of the nearest known one."""
    rows, columns = distance_transform_edt(weight == 0, return_distances=False, return_indices=True)
    return np.asarray(values[rows, columns])


def _visible_points(camera: CameraPose) -> Float64Array:
    """Return the points of the sphere in each pixel of a camera, NaN elsewhere."""
    width, height = camera.image_size
    row, column = np.mgrid[0:height, 0:width]
    # |c + t d|^2 = R^2 has the near root t = -c.d - sqrt((c.d)^2 - |c|^2 + R^2)
    rays = camera.rays(np.stack([column, row], axis=-1))
    along = rays @ camera.center_mm
    inside = along**2 - camera.center_mm @ camera.center_mm + SPHERE_RADIUS_MM**2
    root = np.sqrt(np.where(inside > 0, inside, np.nan))
    return np.asarray(camera.center_mm + (-along - root)[..., None] * rays)


def _image(points: Float64Array, lights: LightTable, light: int) -> Float32Array:
    """Return the closed-form image of the sphere under one light."""
    direction = lights.position_mm[light] - points
    distance = np.linalg.norm(direction, axis=-1, keepdims=True)
    direction /= distance
    cosine = np.clip((direction * points).sum(axis=-1) / SPHERE_RADIUS_MM, 0.0, None)
    lobe = np.clip(-(direction @ lights.axis[light]), 0.0, None) ** lights.exponent[light]
    strength = (cosine * lobe)[..., None] / distance**2
    return np.asarray(SPHERE_ALBEDO * lights.intensity[light] * strength, np.float32)
