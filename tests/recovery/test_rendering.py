"""Rendering of true maps against the simulator's own pictures, which share no shading code."""

import dataclasses

import numpy as np
import pytest

from capture.calibration.geometry import CameraPose
from capture.rig import load_rig
from model import brdf_tables
from model.skin_reflectance import SkinReflectance
from rigsim import surface_brdf
from rigsim.atlas import spread
from rigsim.scenes.dome import DomeScene
from rigsim.subject import make_subject
from skinrig.rendering import Light, render
from skinrig.rendering_geometry import FittedSurface

ROUGHNESS = np.linspace(0.12, 0.6, 9)
LIGHTS = (20, 62)


@pytest.fixture(scope="module")
def scene():
    rig = load_rig("dome").resized(100).subset(views=["C03", "C07"])
    return DomeScene(rig, make_subject("III", seed=5, size=256))


@pytest.fixture(scope="module")
def model(scene):
    """Return the truth as a fitted model would hold it: lobes at some roughnesses, and shares."""

    def lobe(roughness, oil, fuzz, light, view):
        up = np.array([0.0, 0.0, 1.0])
        flat = [np.ascontiguousarray(w.reshape(-1, 3), np.float32) for w in (light, view)]
        packed = np.float32([0, 0, 0, roughness, oil, fuzz, 1.0])
        return surface_brdf.evaluate(packed, up, *flat)[1].reshape(light.shape[:-1])

    fuzz = 1e-3
    materials = {}
    for roughness in ROUGHNESS:
        for oil in (0.0, 1.0):
            name = f"{roughness:.2f} {oil:g}"
            materials[name] = lambda w, v, r=roughness, o=oil: lobe(r, o, 0.0, w, v)
    materials["fuzz"] = lambda w, v: lobe(0.3, 0.0, fuzz, w, v) - lobe(0.3, 0.0, 0.0, w, v)
    truth = scene.truth_appearance("C03")
    surface = scene.surface(scene.rig.view("C03"))
    at = (surface.roughness - ROUGHNESS[0]) / (ROUGHNESS[1] - ROUGHNESS[0])
    assert (at >= 0.0).all()
    hat = np.maximum(1.0 - np.abs(at[..., None] - np.arange(len(ROUGHNESS))), 0.0)
    shares = [hat * (1.0 - surface.oil[..., None]), hat * surface.oil[..., None]]
    weights = np.stack(shares, axis=-1).reshape(*at.shape, -1)
    weights = np.concatenate([weights, surface.fuzz[..., None] / fuzz], axis=-1)
    covered = scene.subject.atlas.covered
    layers = [truth.maps[n].values for n in ("r_d", "normals", "position")]
    wide = spread(np.concatenate([*layers, weights], axis=-1).astype(np.float32), covered)
    normals = wide[..., 3:6] / np.maximum(
        np.linalg.norm(wide[..., 3:6], axis=-1, keepdims=True), 1e-6
    )
    return SkinReflectance(
        r_d=wide[..., :3],
        weights=np.maximum(wide[..., 9:], 0.0),
        lobes=brdf_tables.tabulate(materials),
        translucency_mm=np.ones_like(normals),
        normals=normals,
        position_mm=wide[..., 6:9],
        valid=truth.maps["r_d"].valid,
    )


def lamp(scene, index, view):
    led = scene.rig.lights[index]
    away = float(np.linalg.norm(led.position_mm))
    return Light(
        name=led.name, position_mm=led.position_mm, radius=led.radius_mm, reference_mm=away,
        intensity=tuple(scene.intensity(index, view_name=view) / away**2),
        exponent=float(np.log(0.5) / np.log(np.cos(np.radians(led.half_intensity_deg)))),
    )  # fmt: skip


def error(scene, model, view, light, *, shown=None, **options):
    """Return the median relative error of luminance on lit pixels, and how many there are."""
    laid = FittedSurface.of(model, scene.subject.mesh)
    camera = CameraPose.nominal(scene.rig.view(view))
    seen = render(model, laid, camera, lamp(scene, light, view), **options)
    true = scene.radiance(view, [light if shown is None else shown])[0]
    good = seen.lit & seen.covered & (true.mean(axis=-1) > 0)
    gap = np.abs(seen.radiance - true).mean(axis=-1) / np.maximum(true.mean(axis=-1), 1e-9)
    return float(np.median(gap[good])), int(good.sum())


@pytest.mark.long
@pytest.mark.render
def test_true_maps_render_to_the_simulators_pictures(scene, model):
    """The tables' grid, bilinear maps and the LED's width leave less than a percent."""
    for view, light in (("C03", LIGHTS[0]), ("C07", LIGHTS[1])):
        found, pixels = error(scene, model, view, light)
        assert pixels > 300
        assert found < 0.01


@pytest.mark.long
@pytest.mark.render
def test_wrong_normals_light_or_lobes_show_in_the_picture(scene, model):
    view, light = "C03", LIGHTS[0]
    right, _ = error(scene, model, view, light)
    mirrored = dataclasses.replace(model, normals=model.normals * np.float32([-1, 1, 1]))
    assert error(scene, mirrored, view, light)[0] > 0.1
    assert error(scene, model, view, light, shown=LIGHTS[1])[0] > 0.1
    assert error(scene, model, view, light, subsurface="none")[0] > 0.1
    bare = dataclasses.replace(model, weights=np.zeros_like(model.weights))
    assert error(scene, bare, view, light)[0] > 3.0 * right
