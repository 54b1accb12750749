"""Benchmark of the flash rig's renderer: both polarization images, and Mitsuba's polarizers."""

from functools import partial

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
from skinrig.benchmarks.resampling import tiled_rms
from skinrig.benchmarks.results import BandError
from skinrig.benchmarks.stage import Stage

REFERENCE_RAYS = 144


def render(stage: Stage) -> None:
    """Time both polarization images by closed forms and by Mitsuba's own polarizers."""
    efforts = ((1, 2), (2, 4)) if stage.toy else ((1, 4), (2, 16), (3, 64))
    width = 48 if stage.toy else 256
    rig, view = reference_rig(width)
    caster = Caster(sphere_mesh(), choice=choose_variant("mono_polarized"))
    truth = closed_forms(rig, view, caster, subpixels=round(REFERENCE_RAYS**0.5))
    worse = partial(_worse, truth=truth)
    for subpixels, _ in efforts:
        stage.measure(
            {"way": "closed form", "subpixels": subpixels},
            lambda: closed_forms(rig, view, caster, subpixels=subpixels),
            worse,
            repeats=3,
            memory=None,
        )
    stage.reference_error = stage.points[-1].error * efforts[-1][0] / REFERENCE_RAYS**0.5
    for _, samples in efforts:
        image = partial(mitsuba_image, rig, view, samples=samples)
        stage.measure(
            {"way": "mitsuba", "samples": samples},
            lambda: {name: image(name, seed=k) for k, name in enumerate(ANALYZER_AXIS_DEG)},
            worse,
            repeats=3,
            memory=None,
        )
    if not stage.toy:
        final = polarizer_reference(width_px=width, samples=efforts[-1][1], subpixels=1)
        stage.limits = {"speed_up": final.speed_up, "noise": final.noise_ratio}


def _worse(found: dict[str, Float32Array], truth: dict[str, Float32Array]) -> BandError:
    """Return the larger of both images' relative errors, %, where the sphere fills pixels."""
    errors = []
    for name, true in truth.items():
        whole = binary_erosion(true > 0.0, iterations=2)
        difference = (found[name].astype(np.float64) - true) * 100.0 / true[whole].mean()
        errors.append(tiled_rms(difference, whole, tile_px=8))
    return max(errors, key=lambda one: one.error)
