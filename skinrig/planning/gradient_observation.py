"""Simulated observation of a small patch of skin by the gradient sphere's camera."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture.plan.steps import LIGHT_PATTERNS
from capture.rig import Rig
from model.metrics import angular_error_rad
from rigsim.as_built.sphere import nominal_sphere
from rigsim.population import files as subject_file
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.scenes.gradient.truth import gradient_truth as ground_truth
from skinrig.arrays import Float32Array, Float64Array
from skinrig.benchmarks.gradient_rig.gradient_normals import (
    NEUTRAL,
    ideal_light_calibration,
    pixel_geometry,
)

Key = tuple[str, str]

PATCH_PX = 96
"""Side of the simulated patch, pixels of the rig, 6 um each."""
BORDER_PX = 6
"""Margin that is not evaluated: the lens blurs light from outside the patch into it, px."""


@dataclass(frozen=True, slots=True, eq=False)
class GradientObservation:
    """A patch of skin as the sphere's camera records it, with the inputs of the reconstruction."""

    rates: Mapping[Key, Float32Array]
    """Signal rate by pattern and polarizer, (H, W), full scales per second at full level."""
    known: Mapping[str, Any]
    """Lights, views and positions: arguments of `reconstruction.gradient_normals.from_patterns`."""
    chip: Any
    """The sensor, see `rigsim.sensor.Sensor`."""
    seen: Float64Array
    """(H, W, 3) normals as imaged by the lens."""
    lost_rad: float
    """Median angle between the topography's normals before and after the lens's blur."""
    seed: int


def simulate_observation(
    rig: Rig, subject: str, *, seed: int = 0, side_px: int = PATCH_PX
) -> GradientObservation:
    """Simulate images of a neutral patch of skin under all patterns.

    Parameters
    ----------
    rig
        The gradient sphere.
    subject, seed
        Preset and seed of the forehead's pigment and topography.
    side_px
        Side of the patch, px.
    """
    small = rig.cropped(side_px) if side_px < rig.views[0].width_px else rig
    size_mm = max(1.2, 0.8 + max(small.views[0].field_mm))
    skin = subject_file.load_subject(subject).patch("forehead", seed=seed, size_mm=size_mm)
    sphere = nominal_sphere(small)
    scene = GradientScene(small, skin, sphere=sphere, seed=seed)
    rates = {
        (pattern, polarizer): scene.radiance(pattern, grip=NEUTRAL, analyzer_deg=reading)
        for pattern in LIGHT_PATTERNS
        if pattern != "dark"
        for polarizer, reading in (("parallel", 0.0), ("crossed", 90.0))
    }
    truth = ground_truth(scene, [NEUTRAL]).maps
    seen, sharp = (
        np.asarray(truth[name].values, np.float64) for name in ("normals_seen_a000_n0", "normals")
    )
    inner = (slice(BORDER_PX, -BORDER_PX),) * 2
    lost = float(np.median(angular_error_rad(seen[inner], sharp[inner])))
    known = {"lights": ideal_light_calibration(sphere), **pixel_geometry(small)}
    return GradientObservation(rates, known, scene.sensor(), seen, lost, seed)
