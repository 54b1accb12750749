"""The dome's one traversal for all lights against Mitsuba's path tracer, one light at a time.

Rationale: both render the same face (all-texture diffuse term, Beckmann skin, GGX oil, no relief)
before a point or a disc. Mitsuba's runs with different seeds give the standard error; ours is
taken at three grids of rays for its own.
Expected: sums over blocks of 8 x 8 pixels agree. Tolerance: Student's t with Sidak's correction,
false alarm 1e-3 a test, after 0.1 % of each block for what differs by design (where shadow rays
start, and normals from texels against normals from vertices), fixed beforehand.
"""

import dataclasses
import math
from functools import cache

import numpy as np
import pytest
from scipy import stats

from capture.rig import Rig, load_rig
from rigsim.mitsuba.scene_radiance import look_at
from rigsim.scenes.dome import reference as dome_reference
from rigsim.scenes.dome.reference import PlainScene

pytestmark = [pytest.mark.render, pytest.mark.long]

RUNS, SAMPLES, BLOCK = 24, 32, 8
SYSTEMATIC = 1e-3
FALSE_ALARM = 1e-3
DISC_MM = 20.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    dome = load_rig("dome").resized(96).subset(views=["C02", "C06"])
    return dome_reference.point_light_rig(dome)


@pytest.fixture(scope="module")
def face():
    return dome_reference.plain_face("V", size=512)


def in_blocks(image: np.ndarray) -> np.ndarray:
    height, width = (BLOCK * (n // BLOCK) for n in image.shape[:2])
    cut = image[:height, :width].astype(np.float64)
    return cut.reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK, 3).sum(axis=(1, 3))


def ours(rig, face, view_name, light, scene_class=PlainScene):
    """Return the image at the finest grid and the deviation over three grids, per steradian."""
    images = []
    for subpixels in (6, 7, 8):
        scene = scene_class(rig, face, subpixels=subpixels)
        image = scene.radiance(view_name, [light])[0] / scene.intensity(light) / math.pi
        images.append(in_blocks(image))
    return images[-1], np.std(images, axis=0, ddof=1)


def worst_z(found, deviation, runs):
    """Return the largest |z| of the blocks that Mitsuba lights, and its limit."""
    mean = np.mean(runs, axis=0)
    stderr = np.std(runs, axis=0, ddof=1) / math.sqrt(len(runs))
    lit = mean > 1e-3 * mean.max()
    # The ratio of a difference to its error, where three grids give a rough error of their own.
    error = np.sqrt(stderr**2 + deviation**2 + (SYSTEMATIC * mean) ** 2)
    z = (found - mean)[lit] / error[lit]
    limit = stats.t.isf(0.5 * (1.0 - (1.0 - FALSE_ALARM) ** (1.0 / lit.sum())), RUNS - 1)
    return np.abs(z).max(), limit


def theirs(scene, view, light):
    return [
        in_blocks(
            2.0 * dome_reference.render_with_mitsuba(scene, view, light, samples=SAMPLES, seed=k)
        )
        for k in range(RUNS)
    ]


@pytest.fixture(scope="module")
def point_images(rig, face):
    """Mitsuba's images of a view under a light that is a point; each is rendered once."""
    scene = PlainScene(rig, face, subpixels=1)

    @cache
    def render(view, light):
        point = {
            "type": "point",
            "position": list(rig.lights[light].position_mm),
            "intensity": {"type": "rgb", "value": [1.0, 1.0, 1.0]},
        }
        return theirs(scene, rig.view(view), point)

    return render


@pytest.mark.parametrize(("view", "light"), [("C02", 45), ("C06", 20), ("C02", 100)])
def test_each_light_of_view_matches_mitsuba_image(rig, face, point_images, view, light):
    worst, limit = worst_z(*ours(rig, face, view, light), point_images(view, light))
    assert worst < limit


class Rougher(PlainScene):
    def _surface(self, camera):
        surface = super()._surface(camera)
        return dataclasses.replace(surface, roughness=surface.roughness * np.float32(1.03))


class Paler(PlainScene):
    def _surface(self, camera):
        surface = super()._surface(camera)
        return dataclasses.replace(surface, r_d=surface.r_d * np.float32(1.01))


@pytest.mark.parametrize("scene_class", [Rougher, Paler])
def test_three_percent_roughness_or_albedo_error_is_detectable(
    rig, face, point_images, scene_class
):
    worst, limit = worst_z(*ours(rig, face, "C02", 45, scene_class), point_images("C02", 45))
    assert worst > limit


def test_soft_shadows_of_a_disc_are_mitsubas(rig, face):
    """A Lambertian disc of 20 mm: its intensity falls with the cosine, half at 60 degrees."""
    place = np.array(rig.lights[20].position_mm)
    lights = tuple(
        dataclasses.replace(light, half_intensity_deg=60.0, radius_mm=DISC_MM)
        for light in rig.lights
    )
    disc_rig = dataclasses.replace(rig, lights=lights)
    matrix = look_at(place, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    matrix[:3, :3] *= DISC_MM
    glow = 1.0 / (math.pi * DISC_MM**2)
    light = {
        "type": "disk",
        "to_world": matrix,
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [glow] * 3}},
    }
    scene = PlainScene(disc_rig, face, subpixels=1)
    runs = theirs(scene, rig.view("C06"), light)
    worst, limit = worst_z(*ours(disc_rig, face, "C06", 20), runs)
    assert worst < limit
    hard, _ = worst_z(*ours(rig, face, "C06", 20), runs)
    assert hard > limit  # a point with its even lobe would be seen
