"""Sizes of effects by sampled light."""

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.as_built.sphere import nominal_sphere
from rigsim.needs.effects import PixelNoise
from rigsim.needs.sampled_light import (
    SampledLamp,
    SampledLight,
    blur_over_noise,
    sample_light,
    scattering_over_noise,
)
from rigsim.needs.sampled_patch import SampledPatch
from rigsim.render import Caster
from rigsim.render.lens_blur import focused_lens
from rigsim.skin_patch.microrelief import make_micro_skin
from rigsim.subject.person import make_subject

pytestmark = pytest.mark.render

NOISE = PixelNoise(1e-4, 1e-8)


def half_lit(level=1.0, size=8):
    """Return texels of which the right half is lit, seen from the front."""
    full = np.ones((size, size), np.bool_)
    lit = np.zeros((1, size, size), np.float32)
    lit[..., size // 2 :] = level
    front, place = np.ones((size, size), np.float32), np.zeros((size, size, 3), np.float32)
    part = (slice(0, None, 1), slice(0, None, 1))
    return SampledLight(full, front, lit, 0.0 * lit, front, place, (), part)


def test_scattering_size_is_that_of_one_edge():
    """The dark texel next to the edge gains a tenth, and has shot noise of that alone."""
    light = half_lit()
    signal = np.repeat(light.irradiance[0][..., None], 3, axis=-1).astype(np.float64)
    found = scattering_over_noise(signal, light, np.full(3, 0.1), NOISE)
    assert found == pytest.approx(0.1 / np.sqrt(1e-4 * 0.1 + 1e-8))
    even = np.ones_like(signal)
    assert scattering_over_noise(even, light, np.full(3, 0.1), NOISE) == 0.0


def test_blur_size_grows_with_spilled_light():
    light = half_lit()
    signal = np.repeat(light.irradiance[0][..., None], 3, axis=-1).astype(np.float64)
    few, many = (
        blur_over_noise(signal, light, np.full((8, 8), part), NOISE) for part in (0.01, 0.2)
    )
    assert few == pytest.approx(0.01 / np.sqrt(1e-4 * 0.01 + 1e-8))
    assert many > 4.0 * few


def test_sampled_irradiance_follows_distance_and_shadow():
    """A facing texel receives the weight over the squared distance; the back receives nothing."""
    face = make_subject("III", seed=0, size=128)
    lamp = SampledLamp((0.0, 0.0, 1000.0), 0.0, 1000.0**2)
    light = sample_light(face, Caster(face.mesh), [[lamp]], np.array([[0.0, 0.0, 1000.0]]))
    atlas, part = face.atlas, light.part
    way = np.array(lamp.position_mm) - atlas.position_mm[part]
    far = np.linalg.norm(way, axis=-1)
    cosine = np.einsum("ijk,ijk->ij", way / far[..., None], face.normal[part])
    expected = np.clip(cosine, 0.0, None) * (1000.0 / far) ** 2
    lit = light.irradiance[0] > 0.0
    np.testing.assert_allclose(light.irradiance[0][lit], expected[lit], rtol=0.5, atol=1e-4)
    assert np.median(light.irradiance[0][lit] / expected[lit]) == pytest.approx(1.0, rel=1e-4)
    assert not lit[cosine < 0.0].any()


def test_patch_effects_follow_relief_and_exposure():
    """A flat patch has neither shadows nor interreflection; darker exposures show less."""
    rig = load_rig("gradient").cropped(48)
    skin = make_micro_skin("cheek", size_mm=1.2)
    lens = focused_lens(rig.views[0], rig.lights[0].illuminant)
    window = SampledPatch.roughest(skin, nominal_sphere(rig), rig.views[0], lens)
    built = dict.fromkeys(("shadows", "lateral", "interreflections", "optics"), True)
    bright, dim = (window.changes_over_noise(white, NOISE, built) for white in (1.0, 1e-3))
    for name in built:
        assert bright[name] > 3.0 * dim[name] > 0.0
    flat = SampledPatch(skin, window.sphere, window.view, lens, window.corner)
    object.__setattr__(flat.patch, "height_um", np.zeros_like(skin.height_um))
    level = flat.changes_over_noise(1.0, NOISE, built)
    assert level["shadows"] == pytest.approx(0.0, abs=1e-3)
    assert level["interreflections"] == pytest.approx(0.0, abs=1e-3)
