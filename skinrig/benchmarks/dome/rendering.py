"""Benchmark of rendering a fitted model: rays, texture size, lateral scattering."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np

from capture.calibration.geometry import CameraPose
from capture.rig import Rig, load_rig
from rigsim.needs.effects import SceneEffects
from rigsim.render import Caster
from rigsim.scenes.dome.scene import DomeScene
from rigsim.subject import make_subject
from skinrig.arrays import FloatArray
from skinrig.benchmarks.resampling import bootstrap_tiled_rms
from skinrig.benchmarks.results import ErrorEstimate, Knobs
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.evaluating.skin_bands import MelaninBand
from skinrig.rendering.geometry import FittedSurface
from skinrig.rendering.interior import Interior
from skinrig.rendering.lights import Light
from skinrig.rendering.render import Rendering, render_surface
from skinrig.rendering.truth import build_true_light, build_true_model

VIEW_NAME: Final = "C07"
LIGHT_INDEX: Final = 62
REFERENCE_SUBPIXELS: Final = 6
MEAN_SIGMA_TR_PER_MM: Final = (0.598, 1.069, 1.672)
"""Effective transport coefficient of a mean face, 1/mm: Weyrich et al. 2005, table 2."""


def measure_model_rendering(stage: BenchmarkStage) -> None:
    """Render the true maps of a simulated face and compare with the simulator's images.

    The reference for rays and textures is the simulator at 36 rays per pixel without lateral
    scattering. The reference for tolerances of lateral scattering is our own finest tolerance.
    """
    width, size, fine = (48, 128, 3) if stage.toy else (325, 512, REFERENCE_SUBPIXELS)
    rays = (1, 2) if stage.toy else (1, 2, 3, 4)
    rig = load_rig("dome").resized(width + width % 2).subset(views=[VIEW_NAME])
    face = _SimulatedFace.of("III", rig, size=size, subpixels=fine)
    binnings = (1, 2) if stage.toy else (1, 2, 4, 8)
    surfaces = {k: face.fitted_surface(binning=k) for k in binnings}

    def add(knobs: Knobs, call: Callable[[], FloatArray], true: FloatArray, repeats: int) -> None:
        stage.measure(knobs, call, partial(_relative, true=true), repeats=repeats, memory=None)

    for k in rays:
        knobs: Knobs = {"vary": "rays", "rays": k**2}
        add(knobs, lambda: face.render(surfaces[1], subpixels=k).radiance, face.true, 2)
    for k in binnings[1:]:
        knobs = {"vary": "texture", "texels": size // k}
        add(knobs, lambda: face.render(surfaces[k]).radiance, face.true, 2)
    skin = surfaces[1].with_sigma_tr(MEAN_SIGMA_TR_PER_MM)
    inside = Interior.of(skin)

    def render_scattered(tolerance: float) -> FloatArray:
        aimed = dataclasses.replace(inside, tolerance=tolerance)
        return face.render(skin, subsurface="dipole", interior=aimed, subpixels=1).diffuse

    best = render_scattered(0.001)
    for tolerance in (0.1, 0.01) if stage.toy else (3.0, 1.0, 0.3, 0.1, 0.01):
        knobs = {"vary": "spreading", "tolerance": tolerance}
        add(knobs, lambda: render_scattered(tolerance), best, 1)
    usual, true = face.render(surfaces[1]), face.true
    lit = usual.lit & usual.covered & (true.mean(axis=-1) > 0.0)
    gap = np.abs(usual.radiance - true).mean(axis=-1)[lit] / true.mean(axis=-1)[lit]
    color = np.array(face.light.intensity)
    two = [
        dataclasses.replace(face.light, name=n, intensity=tuple((w * color).tolist()))
        for n, w in (("a", 0.3), ("b", 0.7))
    ]
    both = render_surface(surfaces[1], face.camera, two, subpixels=2, caster=face.caster).radiance

    def on_skin(band: MelaninBand) -> ErrorEstimate:
        other = _SimulatedFace.of(band.preset, rig, size=128 if stage.toy else 256, subpixels=fine)
        return _relative(other.render(other.fitted_surface()).radiance, other.true)

    stage.measure_bands(on_skin)
    stage.limits["median"] = 100.0 * float(np.median(gap))
    stage.limits["sum"] = _relative(both, usual.radiance).error
    stage.reference_error = stage.points[len(rays) - 1].error * rays[-1] / fine
    stage.description_values["rays"] = fine**2


@dataclass(frozen=True, slots=True)
class _SimulatedFace:
    """Face in the dome under one light, for the simulator and for the fitted model."""

    scene: DomeScene
    true: FloatArray
    camera: CameraPose
    light: Light
    caster: Caster

    @classmethod
    def of(cls, preset: str, rig: Rig, *, size: int, subpixels: int) -> _SimulatedFace:
        """Simulate a face of a melanin preset under one light, and render its reference image."""
        face = make_subject(preset, seed=5, size=size)
        # the fitted model has neither lateral scattering nor interreflection
        direct = partial(DomeScene, effects=SceneEffects(lateral=False, interreflections=False))
        scene = direct(rig, face)
        return cls(
            scene,
            direct(rig, face, subpixels=subpixels).radiance(VIEW_NAME, [LIGHT_INDEX])[0],
            CameraPose.nominal(rig.views[0]),
            build_true_light(scene, LIGHT_INDEX, VIEW_NAME),
            Caster(face.mesh),
        )

    def fitted_surface(self, **binning: int) -> FittedSurface:
        """Return the true maps on the face's mesh."""
        return FittedSurface.of(
            build_true_model(self.scene, VIEW_NAME, **binning), self.scene.subject.mesh
        )

    def render(self, surface: FittedSurface, **settings: Any) -> Rendering:
        """Render the surface, by default with 4 rays per pixel."""
        return render_surface(
            surface, self.camera, self.light, caster=self.caster, **{"subpixels": 2} | settings
        )


def _relative(found: FloatArray, true: FloatArray) -> ErrorEstimate:
    """Return the RMS error over the mean on skin, %, with its interval over 16 x 16 px tiles."""
    skin = true.mean(axis=-1) > 0.0
    to_percent = 100.0 / float(true[skin].mean())
    return bootstrap_tiled_rms((found.astype(np.float64) - true) * to_percent, skin)
