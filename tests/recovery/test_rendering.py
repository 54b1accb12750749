"""Rendering of true maps against the simulator's own pictures, which share no shading code."""

import dataclasses

import numpy as np
import pytest

from capture.calibration.geometry import CameraPose
from capture.rig import load_rig
from rigsim.needs.effects import SceneEffects
from rigsim.scenes.dome.scene import DomeScene
from rigsim.subject import make_subject
from skinrig.rendering.geometry import FittedSurface
from skinrig.rendering.render import render_surface
from skinrig.rendering.truth import build_true_light, build_true_model

LIGHTS = (20, 62)


@pytest.fixture(scope="module")
def scene():
    rig = load_rig("dome").resized(100).subset(views=["C03", "C07"])
    face = make_subject("III", seed=5, size=256)
    return DomeScene(rig, face, effects=SceneEffects(lateral=False, interreflections=False))


@pytest.fixture(scope="module")
def model(scene):
    return build_true_model(scene, "C03")


def error(scene, model, view, light, *, shown=None, **options):
    """Return the median relative error of luminance on lit pixels, and how many there are."""
    laid = FittedSurface.of(model, scene.subject.mesh)
    camera = CameraPose.nominal(scene.rig.view(view))
    seen = render_surface(laid, camera, build_true_light(scene, light, view), **options)
    true = scene.radiance(view, [light if shown is None else shown])[0]
    good = seen.lit & seen.covered & (true.mean(axis=-1) > 0)
    gap = np.abs(seen.radiance - true).mean(axis=-1) / np.maximum(true.mean(axis=-1), 1e-9)
    return float(np.median(gap[good])), int(good.sum())


@pytest.mark.long
@pytest.mark.render
def test_true_maps_render_to_simulated_images(scene, model):
    """The tables' grid, bilinear maps and the LED's width leave less than a percent."""
    for view, light in (("C03", LIGHTS[0]), ("C07", LIGHTS[1])):
        found, pixels = error(scene, model, view, light)
        assert pixels > 300
        assert found < 0.01


@pytest.mark.long
@pytest.mark.render
def test_wrong_normals_light_or_lobes_appear_in_image(scene, model):
    view, light = "C03", LIGHTS[0]
    right, _ = error(scene, model, view, light)
    mirrored = dataclasses.replace(model, normals=model.normals * np.float32([-1, 1, 1]))
    assert error(scene, mirrored, view, light)[0] > 0.1
    assert error(scene, model, view, light, shown=LIGHTS[1])[0] > 0.1
    assert error(scene, model, view, light, subsurface="none")[0] > 0.1
    bare = dataclasses.replace(model, weights=np.zeros_like(model.weights))
    assert error(scene, bare, view, light)[0] > 3.0 * right


@pytest.mark.long
@pytest.mark.render
def test_smiling_face_renders_with_carried_neutral_normals(scene, model):
    """The simulator moves mesh and relief by code of its own; blood and wrinkles change a little.

    Expected: nine in ten lit pixels within 2 %; with normals left as they were, three times as far
    or more.
    """
    view, light = "C07", LIGHTS[1]
    smiling = scene.subject.with_expression("happiness")
    moved = DomeScene(
        scene.rig, smiling, effects=SceneEffects(lateral=False, interreflections=False)
    )
    true = moved.radiance(view, [light])[0]
    camera = CameraPose.nominal(scene.rig.view(view))
    carried = FittedSurface.of(model, smiling.mesh, rest=scene.subject.mesh)
    place = np.where(model.valid[..., None], carried.atlas.position_mm, model.position_mm)
    left = FittedSurface.of(dataclasses.replace(model, position_mm=place), smiling.mesh)
    far = []
    for laid in (carried, left):
        seen = render_surface(laid, camera, build_true_light(scene, light, view))
        good = seen.lit & seen.covered & (true.mean(axis=-1) > 0)
        assert good.sum() > 1000
        gap = np.abs(seen.radiance - true).mean(axis=-1)[good] / true.mean(axis=-1)[good]
        far.append(float(np.percentile(gap, 90)))
    assert far[0] < 0.02
    assert far[1] > 3.0 * far[0]
