"""Effects of the actual probe: rules against images, and switches."""

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.fiber.probe_tissue import parse_tissue
from rigsim.needs.effects import PixelNoise, SceneEffects
from rigsim.needs.probe import CROSSTALK_EFFECT, DARK_CURRENT_EFFECT, WINGS_EFFECT, predict_light
from rigsim.scenes.probe.scene import MAX_USUAL_EXPOSURE_S, ProbeScene

RIG = load_rig("probe")
LAYERED, MEDIUM = "III", "homogeneous:0.05,1.5"


def scene_without(text, *switches):
    effects = SceneEffects.from_switches(dict.fromkeys(switches, False))
    return ProbeScene(RIG, parse_tissue(text, seed=0), photons=1, effects=effects)


@pytest.fixture(scope="module")
def whole():
    return {text: scene_without(text) for text in (LAYERED, MEDIUM)}


def readings(scene, light, masks):
    image = scene.image(scene.transmit_through_fibers(light)).reshape(-1, 3)
    return MAX_USUAL_EXPOSURE_S * (masks @ image) / masks.sum(axis=1)[:, None]


@pytest.mark.parametrize("text", [LAYERED, MEDIUM])
@pytest.mark.parametrize("name", [CROSSTALK_EFFECT, WINGS_EFFECT])
def test_rule_bounds_change_of_readings_closely(whole, text, name):
    scene = whole[text]
    effect, build = scene.needs[name], scene.build
    light = predict_light(RIG, scene.tissue)[0] * np.ones(3)
    y, x = np.mgrid[: RIG.views[0].height_px, : RIG.views[0].width_px].reshape(2, 1, -1)
    left, top = build.spot_px.T[:, :, None]
    masks = (np.hypot(x - left, y - top) <= build.radius_px[:, None]).astype(np.float32)
    have, lack = (
        readings(one, light, masks) for one in (scene, scene_without(text, effect.switch))
    )
    share = 1.0 / np.maximum(have, 1.0)
    over = np.abs(have - lack) * share / PixelNoise.of(scene.sensor()).sigma(have * share)
    found = float((over * masks.sum(axis=1)[:, None] ** 0.5).max())
    assert effect.is_built
    assert 1.0 < effect.over_noise / found < 5.0


def test_switches_omit_effects_of_probe(whole):
    names = {
        CROSSTALK_EFFECT: "crosstalk",
        WINGS_EFFECT: "wings",
        DARK_CURRENT_EFFECT: "dark_current",
    }
    bare = scene_without(LAYERED, *names.values())
    assert {name: bare.needs[name].verdict for name in names} == dict.fromkeys(names, "asked")
    np.testing.assert_array_equal(bare.build.crosstalk, np.eye(len(bare.build.gain)))
    assert bare.build.wings == bare.sensor().dark_e_per_s == bare.hot_e_per_s.max() == 0.0
    assert whole[LAYERED].hot_e_per_s.max() > 0.0
    # a fiber that carries all light: without leaks and wings other spots stay dark, but for veil
    alone = np.zeros((len(bare.build.gain), 3))
    alone[0] = 1.0
    shown, hidden = (
        one.image(one.transmit_through_fibers(alone)) for one in (whole[LAYERED], bare)
    )
    x, y = np.rint(bare.build.spot_px[1]).astype(int)
    assert 10.0 * hidden[y, x].max() < shown[y, x].max()
