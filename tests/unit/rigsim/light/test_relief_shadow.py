"""Shadows of wrinkles that only the texture knows, against a relief's own geometry."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.light.relief_shadow import HORIZON_DIRECTIONS, HORIZON_SOFTNESS_RAD, ReliefShadow
from rigsim.mitsuba.variant import VariantChoice, choose_variant
from rigsim.needs.effects import SceneEffects
from rigsim.needs.face import RELIEF_SHADOW_EFFECT
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.flash.scene import FlashScene
from rigsim.subject.person import make_subject
from skinrig.simulating.dome import small_dome

EMBREE = VariantChoice("scalar_rgb", "asked for by the test", "")
MM = 0.5  # texel
SIDE = 96


@dataclasses.dataclass
class Frame:
    """A level texture, as much of an atlas as shadows need."""

    dp_du_mm: np.ndarray
    dp_dv_mm: np.ndarray
    covered: np.ndarray
    size: int = SIDE


@dataclasses.dataclass
class Plane:
    atlas: Frame
    height_um: np.ndarray


def level(height_um: np.ndarray, *, across: float = 1.0) -> ReliefShadow:
    du, dv = np.zeros((SIDE, SIDE, 3), np.float32), np.zeros((SIDE, SIDE, 3), np.float32)
    du[..., 0], dv[..., 1] = across * MM * SIDE, MM * SIDE
    frame = Frame(du, dv, np.ones((SIDE, SIDE), np.bool_))
    return ReliefShadow(Plane(frame, height_um.astype(np.float32)))


def seen_from(shadow: ReliefShadow, azimuth_deg: float, elevation_deg: float, across=1.0):
    x, y = np.meshgrid((np.arange(SIDE) + 0.5) * MM, ((np.arange(SIDE) + 0.5) * MM)[::-1])
    points = np.stack([across * x, y, np.zeros_like(x)], axis=-1).astype(np.float32)
    a, e = np.radians([azimuth_deg, elevation_deg])
    way = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    return shadow.on_texture(points, 1e6 * way)


def test_lights_above_bound_have_fraction_of_full_computation(monkeypatch):
    """A skewed, stretched texture with grooves; the bound decides for lights above all horizons."""
    rng = np.random.default_rng(3)
    height = 60.0 * np.cumsum(rng.standard_normal((SIDE, SIDE)), axis=1)
    shadow = level(height, across=1.5)
    shadow._dv[..., 0] = 0.4 * MM * SIDE
    points = rng.uniform(0.0, 48.0, (5000, 3)).astype(np.float32)
    points[:, 2] = 0.0
    uv = rng.random((5000, 2)).astype(np.float32)
    ways = rng.standard_normal((12, 3))
    lights = 700.0 * np.abs(ways) / np.linalg.norm(ways, axis=1, keepdims=True)
    radii = np.linspace(0.0, 40.0, 12)
    found = shadow.visible_fractions(uv, points, lights, radii)
    assert 0.02 < (found < 1.0).mean() < 0.98
    for fraction, light, radius in zip(found, lights, radii, strict=True):
        one = shadow.visible_fraction(uv, points, light, radius_mm=radius)
        assert np.array_equal(one, fraction)
    monkeypatch.setattr(shadow, "_highest", np.full_like(shadow._highest, np.inf))
    assert np.array_equal(found, shadow.visible_fractions(uv, points, lights, radii))
    monkeypatch.setattr(shadow, "_highest", np.zeros_like(shadow._highest))
    assert not np.array_equal(found, shadow.visible_fractions(uv, points, lights, radii))


@pytest.mark.parametrize("across", [1.0, 2.0])
@pytest.mark.parametrize(
    ("azimuth_deg", "before"), [(0.0, "left"), (180.0, "right"), (90.0, "below")]
)
def test_wall_shadows_light_to_height_over_tangent(azimuth_deg, before, across):
    """A wall of 2 mm and a light 20 degrees up: 5.5 mm of shadow, on the side away from the light.

    Tolerance: a texel, and the soft edge, 0.02 rad or 0.3 mm.
    """
    height = np.zeros((SIDE, SIDE))
    if before == "below":
        height[40:42] = 2000.0
    else:
        height[:, 40:42] = 2000.0
    scale = across if before != "below" else 1.0
    seen = seen_from(level(height, across=across), azimuth_deg, 20.0, across)
    line = seen[:, 48] if before == "below" else seen[48]
    told = 2.0 / math.tan(math.radians(20.0)) / (MM * scale)
    hidden = {"left": line[:40], "right": line[42:], "below": line[42:]}[before]
    assert (1.0 - hidden).sum() == pytest.approx(told, abs=1.2)
    other = {"left": line[42:], "right": line[:40], "below": line[:40]}[before]
    assert other.min() == 1.0


def test_level_skin_and_high_lights_are_never_shadowed():
    ramp = np.abs(np.arange(SIDE) - 48.0)[None, :].repeat(SIDE, 0) * MM * 1e3 * 0.5
    assert seen_from(level(np.zeros((SIDE, SIDE))), 33.0, 1.0).min() == 1.0
    steep_deg = math.degrees(math.atan(0.5) + 1.1 * HORIZON_SOFTNESS_RAD)
    assert seen_from(level(ramp), 0.0, steep_deg).min() == 1.0
    assert seen_from(level(ramp), 0.0, 10.0).min() == 0.0
    assert HORIZON_DIRECTIONS % 4 == 0


@pytest.fixture(scope="module")
def face():
    return make_subject("III", seed=0, size=192)


@pytest.mark.long
def test_wrinkles_shade_moved_face_equally_in_both_renderers(face):
    rig = small_dome(load_rig("dome"), lights=4, views=1, width_px=64)
    view = rig.views[0].name
    plain = SceneEffects(lateral=False, interreflections=False)
    flat = dataclasses.replace(plain, relief_shadows=False)
    lit = DomeScene(rig, face, state="surprise", effects=flat, choice=EMBREE).radiance(view)
    scene = DomeScene(rig, face, state="surprise", effects=plain, choice=EMBREE)
    shaded = scene.radiance(view)
    assert scene.needs[RELIEF_SHADOW_EFFECT].verdict == "built"
    assert (shaded <= lit + 1e-6 * lit.max()).all()
    assert (lit - shaded).max() > 0.02 * lit.max()
    compiled = DomeScene(rig, face, state="surprise", effects=plain)
    if not choose_variant("rgb").is_vectorized:
        pytest.skip("no LLVM for the compiled kernel")
    other = compiled.radiance(view)
    differ = np.abs(other - shaded) > 2e-3 * lit.max()
    assert differ.mean() < 0.002  # rays that two tracers judge differently


@pytest.mark.long
@pytest.mark.parametrize("state", ["neutral", "surprise"])
def test_relief_shades_face_at_rest_and_moved(face, state):
    rig = load_rig("flash").resized(64)
    shaded, plain = (
        FlashScene(
            rig,
            face,
            state=state,
            effects=SceneEffects(relief_shadows=on, lateral=False, interreflections=False),
            choice=EMBREE,
        )
        for on in (None, False)
    )
    assert shaded.needs[RELIEF_SHADOW_EFFECT].verdict == "built"
    assert plain.needs[RELIEF_SHADOW_EFFECT].verdict == "asked"
    assert (shaded.radiance() <= plain.radiance() + 1e-6).all()
    assert (shaded.radiance() < plain.radiance() - 1e-5).any()


def test_level_skin_at_rest_needs_no_shadows(face):
    level = dataclasses.replace(face, height_um=np.zeros_like(face.height_um))
    scene = FlashScene(load_rig("flash").resized(64), level, choice=EMBREE)
    assert scene.needs[RELIEF_SHADOW_EFFECT].verdict == "negligible"
