"""Extremes of the simulation: inputs with silent errors in a renderer or a sensor."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from capture.rig import load_rig
from model.brdf import microfacet
from rigsim import sensor
from rigsim.geometry.mesh import MeshError, build_mesh, vertex_normals
from rigsim.light import surface_brdf
from rigsim.mitsuba import render_error, scene_radiance
from rigsim.render import Caster, visibility
from rigsim.sensor import make_sensor
from skinrig.arrays import Float64Array, FloatArray
from skinrig.extremes.expectations import ExpectationError, expect_error, expect_near, expect_within
from skinrig.extremes.inputs import InputPrecision, sheet_faces

if TYPE_CHECKING:
    from rigsim.sensor import Sensor


def _sheet(height_mm, offset_mm=(0.0, 0.0, 0.0), side: int = 33, pitch_mm: float = 1.0):  # type: ignore[no-untyped-def]
    """Return the mesh of a square height field that faces +z, in the rig frame."""
    across = (np.arange(side) - (side - 1) / 2) * pitch_mm
    x, y = np.meshgrid(across, across)
    points = np.stack([x, y, height_mm(x, y)], -1).reshape(-1, 3) + np.asarray(offset_mm)
    uv = np.stack([(x / across[-1] + 1) / 2, (y / across[-1] + 1) / 2], -1).reshape(-1, 2)
    return build_mesh(points, sheet_faces(side), uv)


def _visible(mesh, light_mm) -> FloatArray:  # type: ignore[no-untyped-def]
    return visibility(
        Caster(mesh), mesh.vertices_mm, mesh.normals, np.asarray(light_mm, np.float64)
    )


def _shadow_off_origin(_: InputPrecision) -> str:
    # the shadow of a wall of 4 mm is the same at any distance from the origin
    def wall(x, y):  # type: ignore[no-untyped-def]
        return 4.0 * (np.abs(x) < 0.5)

    away = np.array([60.0, -40.0, 300.0])
    light = np.array([300.0, 0.0, 100.0])
    here = _visible(_sheet(wall), light)
    there = _visible(_sheet(wall, away), light + away)
    changed = float(np.mean(here != there))
    if float(np.mean(here == 0)) < 0.05:
        raise ExpectationError("got no shadow, expected the shadow of a wall")
    return "points that differ: " + expect_within(changed, 0.0, 0.01, label="fraction")


def _fine_shadow_off_origin(_: InputPrecision) -> str:
    # grooves of 60 um under light at 80 degrees, where the renderer's ray offsets are 90 um
    def grooves(x, y):  # type: ignore[no-untyped-def]
        return 0.03 * np.cos(2.0 * np.pi * x / 0.2)

    away = np.array([100.0, 100.0, 1000.0])
    light = 500.0 * _tilted(80.0)
    here = _visible(_sheet(grooves, side=101, pitch_mm=0.02), light)
    there = _visible(_sheet(grooves, away, side=101, pitch_mm=0.02), light + away)
    shadowed = float(np.mean(here == 0))
    if not 0.2 < shadowed < 0.9:
        raise ExpectationError(
            f"got {shadowed:.2g} in shadow, expected grooves that shade each other"
        )
    changed = float(np.mean(here != there))
    return f"{shadowed:.2g} in shadow; points that differ: " + expect_within(
        changed, 0, 0.02, label="fraction"
    )


def _no_self_shadow(_: InputPrecision) -> str:
    lit = _visible(_sheet(lambda x, y: 0.0 * x), (5700.0, 0.0, 10.0))  # 0.1 degrees over the sheet
    return "lit " + expect_within(lit, 1.0, 1.0, label="fraction")


def _light_on_skin(_: InputPrecision) -> str:
    lit = _visible(_sheet(lambda x, y: 0.0 * x), (0.3, 0.3, 1.0))
    return expect_within(lit, 1.0, 1.0, label="fraction lit at 1 mm")


def _light_near_far_skin(_: InputPrecision) -> str:
    # the renderer's ray offsets grow with the distance from the origin: here to the ray's length
    lit = _visible(_sheet(lambda x, y: 0.0 * x, (0.0, 0.0, 1000.0)), (0.3, 0.3, 1000.1))
    return expect_within(lit, 1.0, 1.0, label="fraction lit at 0.1 mm")


def _light_behind(_: InputPrecision) -> str:
    return expect_within(
        _visible(_sheet(lambda x, y: 0.0 * x), (0.0, 0.0, -300.0)), 0.0, 0.0, label="fraction"
    )


def _zero_triangles(real: InputPrecision) -> str:
    points = real(np.array([[0, 0, 0], [40, 0, 0], [0, 40, 0], [80, 0, 0], [40, 40, 9]]))
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 4, 2]])  # the second is degenerate
    normals = vertex_normals(points, faces)
    expect_near(np.linalg.norm(normals, axis=-1)[[0, 1, 2]], np.ones(3), absolute=1e-5)
    lit = _visible(build_mesh(points, faces, points[:, :2] / 80.0), (0, 0, 300))
    return "vertices of the others: lit " + expect_within(lit[:3], 1.0, 1.0, label="fraction")


def _wrong_unit(real: InputPrecision) -> str:
    points = real(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]))
    return expect_error(
        lambda: build_mesh(points, np.array([[0, 1, 2]]), np.zeros((3, 2))),
        MeshError,
        "millimeters",
    )


def _surface(
    direction: Float64Array, roughness: float, real: InputPrecision
) -> tuple[float, float]:
    packed = real([0.5, 0.4, 0.3, roughness, 0.5, 0.0015, 1.0])
    up = np.array([0.0, 0.0, 1.0])
    total, specular = surface_brdf.evaluate_brdf(packed, up, direction, direction * [-1, -1, 1])
    return float(total[0].max()), float(specular[0])


def _tilted(degrees: float) -> Float64Array:
    angle = math.radians(degrees)
    return np.array([math.sin(angle), 0.0, math.cos(angle)])


def _grazing(real: InputPrecision) -> str:
    values = [_surface(_tilted(d), 0.3, real)[0] for d in (0.0, 60.0, 89.0, 89.9)]
    cosine = math.cos(math.radians(89.9))
    expect_within(values[-1] * cosine, 0.0, 1e3, label="radiance")
    up, low = real(1.0), real(cosine)
    half = real(math.cos(math.radians(89.9 / 2)))
    there, back = (
        microfacet.brdf(a, b, half, half, roughness=0.3, eta=1.4, kind="ggx")
        for a, b in ((up, low), (low, up))
    )
    expect_near(there, back, relative=1e-6)
    # integral of the lobe, peak value times its solid angle 4 pi a^2 cos: a fraction of a mirror's
    # reflected light, which approaches 1 at grazing incidence
    flat = microfacet.brdf(low, low, up, low, roughness=0.3, eta=1.4, kind="ggx")
    lobe = float(flat) * cosine * 4 * math.pi * 0.3**2 * cosine
    expect_within(lobe, 0.0, 1.0, label="fraction of a mirror's light")
    return expect_within(values, 0.0, 1e6, label="f_r")


def _roughness_ends(real: InputPrecision) -> str:
    along = [real(1.0)] * 4
    sharp = microfacet.brdf(*along, roughness=0.01, eta=1.4, kind="ggx")
    # at the peak D = 1 / (pi a^2), G = 1: F0 / (4 pi a^2)
    expect_near(sharp, (0.4 / 2.4) ** 2 / (4 * math.pi * 0.01**2), relative=1e-3)
    flat = microfacet.brdf(*along, roughness=1.0, eta=1.4, kind="ggx")
    # D = 1 / pi everywhere
    return f"peak {float(sharp):.4g}; at 1 " + expect_near(
        flat, (0.4 / 2.4) ** 2 / (4 * math.pi), relative=1e-4
    )


def _furnace(real: InputPrecision) -> str:
    rng = np.random.default_rng(7)
    count = 200_000
    # cosine-weighted directions: the mean of pi f_r is the albedo
    u, v = rng.random(count), rng.random(count)
    light = np.stack(
        [np.sqrt(u) * np.cos(2 * np.pi * v), np.sqrt(u) * np.sin(2 * np.pi * v), np.sqrt(1 - u)], -1
    )
    packed = real([1.0, 1.0, 1.0, 0.35, 0.6, 0.0015, 1.0])
    back = []
    for degrees in (0.0, 45.0, 80.0):
        total, _ = surface_brdf.evaluate_brdf(packed, [0.0, 0.0, 1.0], light, _tilted(degrees))
        back.append(float(np.pi * np.mean(np.asarray(total, np.float64)[:, 0])))
    return expect_within(back, 0.7, 1.01, label="fraction reflected")


def _chip() -> Sensor:
    return make_sensor(load_rig("flash").views[0])


def _bad_light(real: InputPrecision) -> str:
    def exposed(value: float) -> object:
        light = real(np.full((2, 2, 3), value))
        return sensor.expose_sensor(light, sensor=_chip(), rng=np.random.default_rng(0))

    for value in (np.nan, np.inf):
        expect_error(partial(exposed, value), sensor.SensorError)
    return expect_error(partial(exposed, -1.0), sensor.SensorError)


def _very_bright(real: InputPrecision) -> str:
    chip = _chip()
    dn = sensor.expose_sensor(
        real(np.full((4, 4, 3), 1e9)), sensor=chip, rng=np.random.default_rng(0)
    )
    return expect_near(dn, np.full((4, 4), chip.white), absolute=0.0)


def _negative_environment(_: InputPrecision) -> str:
    scene = {
        "type": "scene",
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
        "light": {"type": "constant", "radiance": {"type": "rgb", "value": [-1.0, -1.0, -1.0]}},
        "integrator": {"type": "path"},
    }
    return expect_error(
        lambda: scene_radiance.radiance(scene, kind="rgb", samples=1),
        render_error.RenderError,
        "light.radiance",
    )
