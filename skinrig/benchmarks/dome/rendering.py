"""Benchmark of rendering a fitted model: rays, texture, light that spreads."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Final

import numpy as np

from capture.calibration.geometry import CameraPose
from capture.rig import Rig, load_rig
from rigsim.needs.effects import SceneEffects
from rigsim.render import Caster
from rigsim.scenes.dome.scene import DomeScene
from rigsim.subject import make_subject
from skinrig.arrays import FloatArray
from skinrig.benchmarks.measurement import BandError, Limit, Point, StageBenchmark, Timing, measure
from skinrig.benchmarks.resampling import tiled_rms
from skinrig.evaluating.skin_bands import MELANIN_BANDS
from skinrig.rendering.geometry import FittedSurface
from skinrig.rendering.interior import Interior
from skinrig.rendering.render import Rendering, Subsurface, render
from skinrig.rendering.truth import true_light, true_model

MAX_MEDIAN_ERROR_PERCENT: Final = 1.0
MAX_SUM_ERROR_PERCENT: Final = 1.0
VIEW_NAME: Final = "C07"
LIGHT_INDEX: Final = 62
REFERENCE_SUBPIXELS: Final = 6
MEAN_SIGMA_TR_PER_MM: Final = (0.598, 1.069, 1.672)
"""Of a mean face, 1/mm: Weyrich et al. 2005, table 2."""


def model(*, toy: bool) -> StageBenchmark:
    """Render a simulated face's true maps, and compare with the simulator's own pictures.

    Rays and textures are judged by the simulator at 36 rays a pixel, with every light from inside
    leaving where it entered; the tolerance of light that spreads by our own finest one.
    """
    width, size, fine = (48, 128, 3) if toy else (325, 512, REFERENCE_SUBPIXELS)
    rays = (1, 2) if toy else (1, 2, 3, 4)
    rig = load_rig("dome").resized(width + width % 2).subset(views=[VIEW_NAME])
    face = make_subject("III", seed=5, size=size)
    # as the model has it
    direct = partial(DomeScene, effects=SceneEffects(lateral=False, interreflections=False))
    scene = direct(rig, face)
    true = direct(rig, face, subpixels=fine).radiance(VIEW_NAME, [LIGHT_INDEX])[0]
    camera = CameraPose.nominal(rig.views[0])
    light = true_light(scene, LIGHT_INDEX, VIEW_NAME)
    caster = Caster(face.mesh)
    points = []
    binnings = (1, 2) if toy else (1, 2, 4, 8)
    laid = {
        k: FittedSurface.of(true_model(scene, VIEW_NAME, binning=k), face.mesh) for k in binnings
    }

    def shown(
        on: FittedSurface,
        way: Subsurface = "local",
        interior: Interior | None = None,
        subpixels: int = 2,
        tolerance: float = 0.01,
    ) -> Rendering:
        return render(
            on,
            camera,
            light,
            subsurface=way,
            subpixels=subpixels,
            caster=caster,
            interior=interior,
            tolerance=tolerance,
        )

    for subpixels in rays:
        timing = measure(lambda k=subpixels: shown(laid[1], subpixels=k), repeats=2, memory=None)  # type: ignore[misc]
        seen = shown(laid[1], subpixels=subpixels)
        error = _relative(seen.radiance, true)
        points.append(_point({"vary": "rays", "rays": subpixels**2}, timing, error))
    for binning in binnings[1:]:
        timing = measure(lambda k=binning: shown(laid[k]), repeats=2, memory=None)  # type: ignore[misc]
        error = _relative(shown(laid[binning]).radiance, true)
        points.append(_point({"vary": "texture", "texels": size // binning}, timing, error))
    skin = laid[1].of_medium(MEAN_SIGMA_TR_PER_MM)
    interior = Interior.of(skin)
    best = shown(skin, "dipole", interior, 1, 0.001).diffuse
    for tolerance in (0.1, 0.01) if toy else (3.0, 1.0, 0.3, 0.1, 0.01):
        timing = measure(
            lambda t=tolerance: shown(skin, "dipole", interior, 1, t),  # type: ignore[misc]
            repeats=1,
            memory=None,
        )
        error = _relative(shown(skin, "dipole", interior, 1, tolerance).diffuse, best)
        points.append(_point({"vary": "spreading", "tolerance": tolerance}, timing, error))
    seen = shown(laid[1])
    lit = seen.lit & seen.covered & (true.mean(axis=-1) > 0.0)
    gap = np.abs(seen.radiance - true).mean(axis=-1)[lit] / true.mean(axis=-1)[lit]
    two = [
        dataclasses.replace(light, name=n, intensity=_part(light.intensity, w))
        for n, w in (("a", 0.3), ("b", 0.7))
    ]
    both = render(laid[1], camera, two, subpixels=2, caster=caster).radiance
    bands = {
        name: _on_skin(band.preset, rig, size=128 if toy else 256, fine=fine)
        for name, band in MELANIN_BANDS.items()
    }
    return StageBenchmark(
        "render-model",
        "RMS error over the mean radiance of skin, %",
        f"the simulator's pictures at {fine**2} rays a pixel; of spreading our own at tolerance "
        "0.001. Its own error falls at least with the root of the rays from ours with the most",
        points[len(rays) - 1].error * rays[-1] / fine,
        tuple(points),
        (
            Limit(
                "median relative error of true maps on lit pixels",
                100.0 * float(np.median(gap)),
                MAX_MEDIAN_ERROR_PERCENT,
                "<=",
                "%",
            ),
            Limit(
                "two lights of 0.3 and 0.7 beside one of 1",
                _relative(both, seen.radiance)[0],
                MAX_SUM_ERROR_PERCENT,
                "<=",
                "%",
            ),
        ),
        left_out=(
            ("a peer that renders these maps", "no renderer at hand reads tabulated mixtures"),
        ),
        condition=("vary",),
        by_band=bands,
        interval_of="tiles of the picture",
    )


def _on_skin(preset: str, rig: Rig, *, size: int, fine: int) -> BandError:
    """Return the error of a face of a preset's melanin, at 4 rays a pixel."""
    face = make_subject(preset, seed=5, size=size)
    # as the model has it
    direct = partial(DomeScene, effects=SceneEffects(lateral=False, interreflections=False))
    scene = direct(rig, face)
    true = direct(rig, face, subpixels=fine).radiance(VIEW_NAME, [LIGHT_INDEX])[0]
    on = FittedSurface.of(true_model(scene, VIEW_NAME), face.mesh)
    camera = CameraPose.nominal(rig.views[0])
    light = true_light(scene, LIGHT_INDEX, VIEW_NAME)
    seen = render(on, camera, light, subpixels=2, caster=Caster(face.mesh))
    return BandError(*_relative(seen.radiance, true))


def _part(color: tuple[float, float, float], share: float) -> tuple[float, float, float]:
    return color[0] * share, color[1] * share, color[2] * share


def _relative(found: FloatArray, true: FloatArray) -> tuple[float, tuple[float, float]]:
    """Return the RMS error over the mean on skin, %, with its interval over 16 x 16 tiles."""
    skin = true.mean(axis=-1) > 0.0
    to_percent = 100.0 / float(true[skin].mean())
    told = tiled_rms((found.astype(np.float64) - true) * to_percent, skin)
    return told.error, told.error_interval


def _point(
    knobs: dict[str, str | int | float | bool],
    timing: Timing,
    error: tuple[float, tuple[float, float]],
) -> Point:
    return Point(knobs, timing, error[0], error[1])
