"""Selection of simulated effects by their size over the sensor's noise."""

import dataclasses
import math
import weakref
from functools import partial

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.fiber.probe_tissue import HomogeneousTissue, parse_tissue
from rigsim.geometry.mesh import build_mesh
from rigsim.light import interreflection
from rigsim.light.interreflection import WAVELENGTH_STEPS
from rigsim.light.lateral import scatter_laterally
from rigsim.light.relief_shadow import hidden_sky_fraction
from rigsim.needs import effect_sizes
from rigsim.needs import face as face_needs
from rigsim.needs.effects import (
    NEGLIGIBLE_NOISE_RATIO,
    Effect,
    EffectSelection,
    NeedsError,
    PixelNoise,
    SceneEffects,
    decide_effect,
)
from rigsim.population.files import SubjectFile
from rigsim.render.caster import Caster
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.flash.scene import FlashScene
from rigsim.scenes.probe.scene import ProbeScene
from rigsim.sensor import expose_sensor, make_sensor
from rigsim.subject.person import make_subject
from rigsim.targets.flat import make_target
from rigsim.tissue.skin_layers import PAPER_SKIN

pytestmark = pytest.mark.render


def plate(*corners):
    faces = np.arange(4 * len(corners)).reshape(-1, 4)
    uv = [
        (x + 0.05 + 0.5 * k, y)
        for k in range(len(corners))
        for x, y in ((0, 0), (0.4, 0), (0.4, 0.9), (0, 0.9))
    ]
    triangles = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    return Caster(build_mesh(np.concatenate(corners).astype(float), triangles, uv))


SQUARE = np.array([[0, 0, 0], [40, 0, 0], [40, 40, 0], [0, 40, 0]])


def test_the_noise_is_that_of_exposures(rng):
    """4000 pixels; the sample deviation of n normal numbers scatters by 1 / sqrt(2 n), 1.1 %."""
    sensor = make_sensor(load_rig("flash").views[0], prnu=0.0, dsnu_e=0.0, vignetting=0.0)
    noise = PixelNoise.of(sensor)
    for level in (0.02, 0.5):
        light = np.full((64, 64, 3), level, np.float32)
        dn = expose_sensor(light, sensor=sensor, rng=rng).astype(float)
        found = dn.std(ddof=1) / (sensor.white - sensor.black)
        assert found == pytest.approx(float(noise.sigma(level)), rel=0.045)  # 1e-4 twice


def test_effect_record_rejects_wrong_negligible_verdict():
    with pytest.raises(NeedsError, match="build it"):
        Effect("bounces", "negligible", "flat", NEGLIGIBLE_NOISE_RATIO)
    with pytest.raises(NeedsError, match="expected one of built"):
        Effect("bounces", "maybe", "flat")
    with pytest.raises(NeedsError, match="bounces twice"):
        EffectSelection((Effect("bounces", "built", "a"), Effect("bounces", "absent", "b")))
    assert decide_effect("b", NEGLIGIBLE_NOISE_RATIO, None, switch="", reason="x").is_built
    assert not decide_effect(
        "b", 0.999 * NEGLIGIBLE_NOISE_RATIO, None, switch="", reason="x"
    ).is_built


@pytest.mark.parametrize("texels", [3, 15])
def test_edge_light_loss_matches_lateral_scattering(texels):
    """Expected: the mean over a lit pixel beside a shadow; the edge and the pixel's sides run
    between texels. Tolerance: 5 %; texels of a quarter of the kernel's width lose 2 to 4 % less,
    those of half of it 6 %."""
    from rigsim.geometry.atlas import unwrap

    mesh = plate(SQUARE).mesh
    atlas = unwrap(mesh, 512)
    x = atlas.position_mm[..., 0]
    row = np.sort(x[256][atlas.covered[256]])
    texel_mm = float(np.median(np.diff(row)))
    edge = float(row[len(row) // 2]) - 0.5 * texel_mm
    lit = ((x >= edge) & atlas.covered).astype(np.float32)[..., None]
    spread = scatter_laterally(lit, atlas, [0.8], [[1.0]])[..., 0]
    inside = atlas.covered & (x >= edge) & (x < edge + texels * texel_mm)
    inside &= np.abs(atlas.position_mm[..., 1] - 20.0) < 10.0
    lost = 1.0 - float(spread[inside].mean())
    predicted = effect_sizes.edge_loss([0.8], [[1.0]], texels * texel_mm)[0]
    assert lost == pytest.approx(predicted, rel=0.05)
    assert lost != pytest.approx(effect_sizes.edge_loss([0.7], [[1.0]], 1.0)[0], rel=0.05)


@pytest.fixture
def few_patches(monkeypatch):
    """All patches of a corner see each other: with as many as of a face, 20 million pairs."""
    made = partial(interreflection.Interreflection, patches=32)
    monkeypatch.setattr(interreflection, "Interreflection", made)


def corner():
    return plate(SQUARE, (SQUARE[:, [2, 1, 0]] - [0.01, 0.0, 0.0])[::-1])


def test_exchange_outlives_its_scene_until_two_later(few_patches):
    mesh = corner().mesh
    kept = weakref.ref(interreflection.interreflection_for(Caster(mesh)))
    assert interreflection.interreflection_for(Caster(mesh)) is kept()
    for _ in range(2):
        assert kept() is not None
        interreflection.interreflection_for(corner())
    assert kept() is None


def test_large_exchange_ends_with_its_scene(few_patches, monkeypatch):
    monkeypatch.setattr(interreflection, "MAX_KEPT_PAIRS", 1000)
    kept = weakref.ref(interreflection.interreflection_for(corner()))
    assert kept() is None


def test_interreflection_is_zero_on_plate_not_in_corner(few_patches):
    flat = plate(SQUARE)
    assert effect_sizes.is_flat(flat.mesh)
    assert effect_sizes.exchange_unless_flat(flat) is None
    assert effect_sizes.max_exchange_fraction(None) == 0.0
    assert not effect_sizes.is_flat(corner().mesh)
    # beside the edge a patch sees up to half a hemisphere of wall, through two boundaries
    exchange = effect_sizes.exchange_unless_flat(corner())
    assert 0.15 < effect_sizes.max_exchange_fraction(exchange) < 0.5


@pytest.mark.long
def test_groove_occludes_sky_like_two_walls():
    """In a V of 90 degrees the other wall, of length L, hides (1 - d / sqrt(L^2 + d^2)) / 2 of the
    sky of a point a distance d from the bottom. Tolerance: sectors, and a groove of finite length.
    """
    x = np.abs(np.arange(257) - 128.0)
    height = np.repeat(x[None, :], 1025, axis=0).astype(np.float32)
    slope = np.sign(np.arange(257) - 128.0)
    normals = np.zeros((1025, 257, 3), np.float32)
    normals[..., 0], normals[..., 2] = -slope / math.sqrt(2.0), 1.0 / math.sqrt(2.0)
    found = hidden_sky_fraction(height, normals, margin=0, pixel_um=1.0, sectors=64)
    d = np.arange(8, 60)
    predicted = 0.5 * (1.0 - d / np.hypot(128.0, d))
    np.testing.assert_allclose(found[512, 128 + d], predicted, rtol=0.06)
    assert (
        hidden_sky_fraction(
            np.zeros((4, 4), np.float32),
            np.float32([[[0, 0, 1]]]).repeat(4, 0).repeat(4, 1),
            margin=0,
            pixel_um=1.0,
            sectors=8,
        ).max()
        == 0.0
    )


@pytest.fixture(scope="module")
def faces():
    black = SubjectFile(melanin=0.45).face(seed=3, size=96)
    return {
        "II": make_subject("II", seed=3, size=96),
        "black": dataclasses.replace(black, tissue=PAPER_SKIN),  # an epidermis of 0.25 mm
    }


@pytest.fixture(scope="module")
def flash():
    return load_rig("flash").resized(64)


@pytest.fixture(scope="module")
def dome():
    """One camera and ten lights on all sides."""
    rig = load_rig("dome").resized(64)
    return rig.subset(
        views=["C02"], lights=[light.name for light in rig.lights[:: len(rig.lights) // 10]]
    )


def test_pale_skin_needs_effects_negligible_on_black(flash, faces):
    pale, dark = (FlashScene(flash, faces[name]).needs for name in ("II", "black"))
    assert pale.builds(face_needs.SPECTRAL_EFFECT)
    assert dark[face_needs.SPECTRAL_EFFECT].verdict == "negligible"
    sizes = [needs[face_needs.INTERREFLECTION_EFFECT].over_noise for needs in (pale, dark)]
    assert sizes[0] > 20.0 * sizes[1]


def test_a_noisier_sensor_needs_less(flash, faces):
    sensor = make_sensor(flash.views[0])
    noisy = dataclasses.replace(sensor, read_noise_e=1e4)
    sharp = FlashScene(flash, faces["black"], sensor=sensor).needs
    coarse = FlashScene(flash, faces["black"], sensor=noisy).needs
    for name in (face_needs.INTERREFLECTION_EFFECT, face_needs.LATERAL_EFFECT):
        assert sharp.builds(name)
        assert coarse[name].verdict == "negligible"
    assert coarse[face_needs.SPECTRAL_EFFECT].reason.startswith("interreflection is absent")


def test_requested_effect_is_built_and_reported(flash, faces):
    asked = FlashScene(
        flash, faces["II"], effects=SceneEffects(lateral=False, interreflections=False)
    )
    for name in (face_needs.INTERREFLECTION_EFFECT, face_needs.LATERAL_EFFECT):
        effect = asked.needs[name]
        assert effect.verdict == "asked"
        assert f"{effect.switch}=False requests it" in effect.reason
    assert (asked.lateral, asked.interreflections) == (False, False)
    forced = FlashScene(flash, faces["black"], effects=SceneEffects(spectral=True))
    assert forced.needs[face_needs.SPECTRAL_EFFECT].verdict == "built"
    assert "spectral=True requests it" in forced.needs[face_needs.SPECTRAL_EFFECT].reason


def grazing(rig, angle_deg=88.0):
    """Return the rig with one of its lights alone, far off the camera's axis."""
    light = rig.lights[0]
    far, angle = math.hypot(*light.position_mm), math.radians(angle_deg)
    place = (far * math.sin(angle), 0.0, far * math.cos(angle))
    return dataclasses.replace(rig, lights=(dataclasses.replace(light, position_mm=place),))


@pytest.mark.long
@pytest.mark.parametrize("power", [1.0, 0.02])
def test_effect_sizes_are_bounds_under_grazing_light(flash, faces, power):
    """What faces the light is 29 times as bright as the plate, and beyond full scale."""
    rig, face = grazing(flash), faces["black"]
    scene = FlashScene(rig, face, power=power)
    noise = PixelNoise.of(scene.sensor())

    def light(**settings):
        made = FlashScene(rig, face, power=power, effects=SceneEffects(**settings))
        return power * np.stack([made.radiance(name) for name in ("parallel", "crossed")])

    predicted = {effect.switch: effect.over_noise for effect in scene.needs}
    for switch in ("lateral", "interreflections", "spectral", "optics"):
        have, lack = light(**{switch: True}), light(**{switch: False})
        # what is full shows no change, but what it sends to others does
        change = np.abs(np.minimum(have, 1.0) - np.minimum(lack, 1.0)) / noise.sigma(have)
        assert change.max() <= predicted[switch]
    assert predicted["interreflections"] < 40.0 * max(predicted["spectral"], 0.02)


@pytest.mark.long
def test_sampled_highlights_reach_those_of_image(flash, faces):
    """Texels sample what pixels average: at least as bright, though a few times at most."""
    for rig in (flash, grazing(flash, 60.0)):
        scene = FlashScene(rig, faces["black"], effects=SceneEffects(lateral=False, optics=False))
        shown = scene.radiance("parallel") - scene.radiance("crossed")
        light = scene._stage.sample_light(scene.subject, scene._flashes, rig.views[0])
        peak = float((light.highlight.max() * scene.white_rgb()).max())
        assert shown.max() < 1.2 * peak < 6.0 * shown.max()


@pytest.mark.long
def test_fewer_wavelengths_change_pixels_below_stated_bound(flash, faces):
    """Of light from skin to skin: its predicted share bounds that between any two skins."""
    face = faces["II"]
    scene = FlashScene(flash, face)
    noise = PixelNoise.of(scene.sensor())
    effect = scene.needs[face_needs.WAVELENGTH_STEP_EFFECT]
    assert effect.verdict == "built"
    assert "each 20 nm would not be enough" in effect.reason
    fine = scene.radiance()
    sensor = dataclasses.replace(scene.sensor(), read_noise_e=2e3)
    coarse = FlashScene(flash, face, sensor=sensor).needs[face_needs.WAVELENGTH_STEP_EFFECT]
    assert coarse.verdict == "negligible"
    changes = []
    for step in WAVELENGTH_STEPS:
        lack = FlashScene(flash, face, effects=SceneEffects(spectral_step=step)).radiance()
        changes.append(float((np.abs(lack - fine) / noise.sigma(fine)).max()))
    assert 0.0 < changes[-1] <= effect.over_noise < 5.0 * changes[-1]  # each 20 nm
    assert changes[0] > 3.0 * changes[-1]  # 50 nm miss what 20 nm see


def test_more_sensitive_of_two_cameras_decides(flash, faces):
    view = flash.views[0]
    dull = dataclasses.replace(view, read_noise_e=2e4)
    keen = dataclasses.replace(view, name="keen", serial="SR-0002")
    alone, both, swapped = (
        FlashScene(dataclasses.replace(flash, views=views), faces["black"]).needs
        for views in ((dull,), (dull, keen), (keen, dull))
    )
    assert alone[face_needs.INTERREFLECTION_EFFECT].verdict == "negligible"
    for needs in (both, swapped):
        assert needs.builds(face_needs.INTERREFLECTION_EFFECT)
        assert (
            needs[face_needs.LATERAL_EFFECT].over_noise
            > alone[face_needs.LATERAL_EFFECT].over_noise
        )


def test_flat_targets_need_neither_shadows_nor_bounces(flash, dome):
    for scene in (FlashScene(flash, make_target("chart")), DomeScene(dome, make_target("white"))):
        assert scene.needs[face_needs.INTERREFLECTION_EFFECT].verdict == "negligible"
        assert scene.needs[face_needs.LATERAL_EFFECT].verdict == "absent"


def test_polarizers_alone_require_polarization(flash, dome, faces):
    assert FlashScene(flash, faces["II"]).needs.builds(face_needs.POLARIZATION_EFFECT)
    assert DomeScene(dome, faces["II"]).needs[face_needs.POLARIZATION_EFFECT].verdict == "absent"


def test_gray_tissue_is_traced_once_skin_by_color():
    rig = load_rig("probe")
    gray = ProbeScene(rig, HomogeneousTissue(0.04, 1.5)).needs
    assert gray["tissue traced per color band"].verdict == "negligible"
    assert gray["layers of the tissue"].verdict == "absent"
    skin = ProbeScene(rig, parse_tissue("III", seed=0)).needs
    assert skin.builds("tissue traced per color band")
    assert skin.builds("layers of the tissue")


@pytest.mark.long
def test_spectral_interreflection_is_redder_than_band_interreflection(flash, faces):
    """The mean of a square is larger than the square of the mean, in red most."""
    one = FlashScene(flash, faces["II"]).radiance()
    plain = FlashScene(flash, faces["II"], effects=SceneEffects(spectral=False)).radiance()
    none = FlashScene(flash, faces["II"], effects=SceneEffects(interreflections=False)).radiance()
    more, bounced = (one - plain).sum(axis=(0, 1)), (plain - none).sum(axis=(0, 1))
    assert (bounced > 0.0).all()
    assert more[0] / bounced[0] > 0.01
    assert more[0] / bounced[0] > 1.5 * abs(more[1] / bounced[1])
