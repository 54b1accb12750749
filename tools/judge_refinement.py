"""Compare the dome's stages with a joint fit of the renderer's own material to voxel skin.

Usage: python tools/judge_refinement.py [PRESET ...]

The fit is what analysis by synthesis reaches at best on a plane patch: normal, R_d, roughness and
oil of `skincoat`'s equations, by least squares on all LEDs and cameras without noise. Its images
are those of `skinrig bench --stage reference-dome`, voxels below Mitsuba's facets.
"""

import sys

import numpy as np
from scipy.optimize import least_squares

from capture.rig import Rig
from model import metrics
from rigsim.light.surface_brdf import evaluate_brdf
from rigsim.population.files import load_subject
from rigsim.scenes.reference.directions import (
    DirectionalReflectance,
    normal_reflectance,
    render_directions,
)
from rigsim.scenes.reference.facets import FACET_OIL_FRACTION, FACET_ROUGHNESS, SkinFacets
from skinrig.arrays import Float64Array
from skinrig.benchmarks.simulation import reference_dome as dome

TILT_DEG = 20.0
SAMPLES = 256
MIN_COSINE = 0.25
"""Light and camera are within 75 degrees of the normal."""


def main() -> None:
    """Print the errors of each person by both ways."""
    rig = dome.dome_of_patches()
    colors = rig.views[0].spectral_sensitivity, str(rig.lights[0].illuminant)
    print("type  way     normal, degrees  R_d red; green; blue, %")
    for preset in sys.argv[1:] or ("II", "IV", "VI"):
        seed = dome.FIRST_SEED + dome.MELANIN_PRESETS.index(preset)
        skin = load_subject(preset).skin(seed=seed).at(dome.FACE_SITE)
        below = render_directions(skin, *colors, samples=SAMPLES, seed=seed)
        truth = normal_reflectance(skin, *colors)
        stages = dome.estimate_patch(rig, "voxels", below, truth, tilt_deg=TILT_DEG, seed=[seed, 0])
        angle = float(np.degrees(np.median(stages.error[dome.NORMAL_QUANTITY])))
        errors = [100.0 * float(stages.error[name].mean()) for name in dome.CHANNEL_NAMES]
        print(f"{preset:4}  stages  {angle:15.2f}  " + "; ".join(f"{e:+.1f}" for e in errors))
        angle, errors = refine(rig, below, truth, seed)
        print(f"{preset:4}  fit     {angle:15.2f}  " + "; ".join(f"{e:+.1f}" for e in errors))


def refine(
    rig: Rig, below: DirectionalReflectance, truth: Float64Array, seed: int
) -> tuple[float, list[float]]:
    """Return errors of the normal in degrees and of R_d in % after the joint fit."""
    normal = dome.tilt_vector(np.array([0.0, 0.0, 1.0]), TILT_DEG, np.random.default_rng([seed, 0]))
    lights, cameras = (
        np.array([one.position_mm for one in some]) for some in (rig.lights, rig.views)
    )
    light, camera = (
        (way / np.linalg.norm(way, axis=1, keepdims=True)) for way in (lights, cameras)
    )
    to_light = np.repeat(light, len(camera), axis=0)
    to_camera = np.tile(camera, (len(light), 1))
    seen = (to_light @ normal > MIN_COSINE) & (to_camera @ normal > MIN_COSINE)
    to_light, to_camera = to_light[seen], to_camera[seen]
    facets = SkinFacets(FACET_ROUGHNESS, FACET_OIL_FRACTION)
    surface = facets.evaluate(normal, to_light, to_camera)
    image = below.evaluate(normal, to_light, to_camera) + surface[:, None]
    image *= (to_light @ normal)[:, None]
    side = np.cross(normal, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(normal, side)])

    def residual(x: Float64Array) -> Float64Array:
        turned = normal + x[:2] @ frame
        turned /= np.linalg.norm(turned)
        packed = np.array([*x[2:5], x[5], x[6], 0.0, 1.0])
        found = evaluate_brdf(packed, turned, to_light, to_camera)[0]
        return ((found * (to_light @ turned)[:, None] - image) / truth).ravel()

    start = np.array([0.0, 0.0, *truth, FACET_ROUGHNESS, FACET_OIL_FRACTION])
    low, high = [-1, -1, 0, 0, 0, 0.1, 0.0], [1, 1, 1, 1, 1, 0.8, 1.0]
    # float32 of the material: differences of 1e-3
    found = least_squares(residual, start, bounds=(low, high), diff_step=1e-3, x_scale=0.1).x
    turned = normal + found[:2] @ frame
    turned /= np.linalg.norm(turned)
    angle = metrics.angular_error_rad(turned[None], normal)
    return float(np.degrees(angle[0])), list(100.0 * (found[2:5] / truth - 1.0))


if __name__ == "__main__":
    main()
