"""Benchmark of the flash rig's renderer: both polarization images, and Mitsuba's polarizers."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_erosion

from rigsim.render import Caster
from rigsim.render.variant import choose_variant
from rigsim.scenes.flash.polarizer_reference import (
    ANALYZER_AXIS_DEG,
    closed_forms,
    mitsuba_image,
    polarizer_reference,
    reference_rig,
    sphere_mesh,
)
from skinrig.arrays import Float32Array
from skinrig.benchmarks.measurement import BandError, Limit, Point, StageBenchmark, measure
from skinrig.benchmarks.resampling import tiled_rms

MIN_SPEEDUP_OVER_MITSUBA = 8.0
MIN_NOISE_RATIO = 20.0
REFERENCE_RAYS = 144


def render(*, toy: bool) -> StageBenchmark:
    """Time both polarization images by closed forms and by Mitsuba's own polarizers."""
    efforts = ((1, 2), (2, 4)) if toy else ((1, 4), (2, 16), (3, 64))
    width = 48 if toy else 256
    rig, view = reference_rig(width)
    caster = Caster(sphere_mesh(), choice=choose_variant("mono_polarized"))
    truth = closed_forms(rig, view, caster, subpixels=round(REFERENCE_RAYS**0.5))
    ours, theirs = [], []
    for subpixels, samples in efforts:

        def by_closed_forms(subpixels: int = subpixels) -> dict[str, Float32Array]:
            return closed_forms(rig, view, caster, subpixels=subpixels)

        def by_mitsuba(samples: int = samples) -> dict[str, Float32Array]:
            return {
                name: np.asarray(mitsuba_image(rig, view, name, samples=samples, seed=k))
                for k, name in enumerate(ANALYZER_AXIS_DEG)
            }

        timing = measure(by_closed_forms, memory=None)
        told = _worse(by_closed_forms(), truth)
        knobs: dict[str, str | int | float] = {"way": "closed form", "subpixels": subpixels}
        ours.append(Point(knobs, timing, told.error, told.error_interval))
        timing = measure(by_mitsuba, memory=None)
        told = _worse(by_mitsuba(), truth)
        knobs = {"way": "mitsuba", "samples": samples}
        theirs.append(Point(knobs, timing, told.error, told.error_interval))
    limits: tuple[Limit, ...] = ()
    if not toy:
        final = polarizer_reference(width_px=width, samples=efforts[-1][1], subpixels=1)
        limits = (
            Limit(
                "times faster than Mitsuba's polarizers",
                final.speed_up,
                MIN_SPEEDUP_OVER_MITSUBA,
                ">=",
            ),
            Limit(
                "times less noisy than Mitsuba's polarizers",
                final.noise_ratio,
                MIN_NOISE_RATIO,
                ">=",
            ),
        )
    return StageBenchmark(
        "render-flash",
        "RMS error of the worse image, %",
        f"closed forms with {REFERENCE_RAYS} rays a pixel; Mitsuba's mean agrees with it but for "
        "noise. Its own error falls at least with the root of the rays from that of the most here",
        ours[-1].error * efforts[-1][0] / REFERENCE_RAYS**0.5,
        (*ours, *theirs),
        limits,
        interval_of="tiles of the pictures",
        no_bands="a plastic sphere, as Mitsuba can render it too",
    )


def _worse(found: dict[str, Float32Array], truth: dict[str, Float32Array]) -> BandError:
    """Return the larger of both images' relative errors, %, where the sphere fills pixels."""
    told = []
    for name, true in truth.items():
        whole = binary_erosion(true > 0.0, iterations=2)
        difference = (found[name].astype(np.float64) - true) * 100.0 / true[whole].mean()
        told.append(tiled_rms(difference, whole, tile_px=8))
    return max(told, key=lambda one: one.error)
