"""Render a face in the dome by Mitsuba's path tracer, with all reflections of skin on skin.

The reference for renderers of interreflection: it has the face's maps in common with them, but
neither paths nor sampling.
"""

from typing import Final

import numpy as np

from capture.rig import View
from rigsim.arrays import Float32Array, Float64Array
from rigsim.light.skin_material import describe_skin
from rigsim.mitsuba.led_array import led_table
from rigsim.mitsuba.rig_camera import describe_camera
from rigsim.mitsuba.scene_radiance import radiance
from rigsim.scenes.dome.scene import DomeScene
from rigsim.subject import SimulatedSubject

DIRECT_DEPTH: Final = 2
"""Path length of light that one reflection turns to the camera."""
GLOBAL_DEPTH: Final = 8
"""Path length of light that up to seven reflections turn to the camera."""


def render_transport(
    scene: DomeScene, view: View, light: int, *, depth: int, samples: int, runs: int
) -> Float64Array:
    """Render one light of a dome with paths up to a length.

    Parameters
    ----------
    scene
        A face with direct light only, whose lights are uniform points.
    view
        The camera.
    light
        Index of the light.
    depth
        Path length, 2: direct light.
    samples, runs
        Samples per pixel, and runs with different seeds; run k of any depth has the same seed.

    Returns
    -------
    ndarray of float64, shape (runs, H, W, 3)
        Camera RGB, up to one factor for all images of a light.
    """
    if not isinstance(scene.subject, SimulatedSubject):
        raise TypeError(f"scene: got the target {scene.subject.name!r}, expected a face")
    place = np.array(scene.rig.lights[light].position_mm)
    table = led_table(place, -place / np.linalg.norm(place))
    skin = describe_skin(scene.texture(view))
    described = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth},
        "sensor": describe_camera(view),
        "skin": {"type": "mesh", "mesh": scene.subject.mesh, "bsdf": skin},
        "led": {"type": "ledarray", "table": table},
    }
    images: list[Float32Array] = [
        radiance(described, kind="rgb", samples=samples, seed=run)[..., :3] for run in range(runs)
    ]
    return np.array(images, np.float64)
