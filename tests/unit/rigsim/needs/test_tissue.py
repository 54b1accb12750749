"""Selection of a person's tissue properties by their change of pixels."""

import dataclasses
from collections import Counter

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.fiber.probe_profile import ProfileCache
from rigsim.fiber.probe_tissue import SkinTissue
from rigsim.needs.effects import EffectSelection, PixelNoise, SceneEffects
from rigsim.needs.probe import predict_profiles
from rigsim.needs.tissue import TISSUE_RULES, select_tissue, select_tissue_effects
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.flash.scene import FlashScene
from rigsim.scenes.gradient.reference import NEUTRAL_GRIP
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.scenes.probe.scene import ProbeScene
from rigsim.skin_patch.microrelief import change_patch_tissue, make_micro_skin
from rigsim.subject.person import make_subject
from rigsim.subject.person_skin import PersonSkin, draw_tissue
from rigsim.tissue.skin_layers import TYPICAL_SKIN, TissueProperties

pytestmark = pytest.mark.render

PERSON = TissueProperties(
    epidermis_mm=0.1,
    basal_melanin_fraction=0.4,
    oxygenation=0.65,
    scattering_per_mm=10.0,
    baseline_amplitude=1.2,
)
PROPERTIES = [rule.name for rule in TISSUE_RULES]


@pytest.fixture(scope="module")
def flash():
    return load_rig("flash").resized(48)


@pytest.fixture(scope="module")
def dome():
    """One camera and ten lights on all sides."""
    rig = load_rig("dome").resized(48)
    return rig.subset(
        views=["C02"], lights=[light.name for light in rig.lights[:: len(rig.lights) // 10]]
    )


@pytest.fixture(scope="module")
def face():
    return make_subject("III", seed=0, size=64)


def nearly_typical(step):
    """Return tissue that deviates from typical skin by a fraction of the person's deviation."""
    names = [field.name for field in dataclasses.fields(TissueProperties)]
    own, usual = ([getattr(t, name) for name in names] for t in (PERSON, TYPICAL_SKIN))
    return TissueProperties(
        **{n: u + step * (o - u) for n, o, u in zip(names, own, usual, strict=True)}
    )


def test_each_tissue_property_has_one_rule():
    fields = Counter(name for rule in TISSUE_RULES for name in rule.fields)
    names = {field.name for field in dataclasses.fields(TissueProperties)}
    assert fields == Counter(names - {"melanin_reference_mm"})  # a convention, not a property
    assert {rule.switch for rule in TISSUE_RULES} <= {
        field.name for field in dataclasses.fields(SceneEffects)
    }


def test_typical_tissue_is_absent_and_not_evaluated():
    def never(other):
        raise AssertionError(other)

    made = select_tissue_effects(TYPICAL_SKIN, never, SceneEffects())
    assert [effect.verdict for effect in made] == ["absent"] * len(TISSUE_RULES)


@pytest.mark.long
@pytest.mark.parametrize("rule", TISSUE_RULES, ids=lambda rule: rule.switch)
def test_tissue_size_bounds_change_of_face(rule, flash, face):
    """The bound may exceed the change as it takes the brightest skin; 30 times at most."""
    person = dataclasses.replace(face, tissue=PERSON)
    scenes = [
        FlashScene(flash, person, effects=SceneEffects(**{rule.switch: on})) for on in (True, False)
    ]
    have, lack = (
        np.stack([scene.radiance(stop) for stop in ("parallel", "crossed")]) for scene in scenes
    )
    noise = PixelNoise.of(scenes[0].sensor())
    change = np.abs(np.minimum(have, 1.0) - np.minimum(lack, 1.0)) / noise.sigma(have)
    predicted = scenes[0].needs[rule.name].over_noise
    assert predicted / 30.0 < change.max() <= predicted
    assert scenes[1].needs[rule.name].verdict == "asked"


def test_negligible_tissue_makes_scene_use_typical_table(flash, dome, face):
    small, large = (dataclasses.replace(face, tissue=nearly_typical(s)) for s in (1e-3, 1.0))
    scene = FlashScene(flash, small)
    assert {scene.needs[name].verdict for name in PROPERTIES} == {"negligible"}
    assert scene.subject.tissue == TYPICAL_SKIN
    assert FlashScene(flash, large).subject.tissue == PERSON
    assert DomeScene(dome, small).subject.tissue == TYPICAL_SKIN
    assert DomeScene(dome, large).subject.tissue == PERSON


def test_dim_light_needs_fewer_properties(flash, face):
    person = dataclasses.replace(face, tissue=nearly_typical(0.02))
    bright, dim = (FlashScene(flash, person, power=power).needs for power in (1.0, 1e-4))
    assert any(bright.builds(name) for name in PROPERTIES)
    assert not any(dim.builds(name) for name in PROPERTIES)


@pytest.mark.long
def test_thickness_of_sites_alone_is_built(flash, face):
    person = dataclasses.replace(face, tissue=TissueProperties(site_contrast=1.0))
    scenes = [
        FlashScene(flash, person, effects=SceneEffects(thickness=built)) for built in (None, False)
    ]
    rule = scenes[0].needs["thickness of the epidermis"]
    assert rule.verdict == "built"
    have, lack = (scene.radiance("crossed") for scene in scenes)
    noise = PixelNoise.of(scenes[0].sensor())
    change = np.abs(np.minimum(have, 1.0) - np.minimum(lack, 1.0)) / noise.sigma(have)
    assert 0.1 < change.max() <= rule.over_noise


def test_posed_face_changes_tissue_at_rest(flash, face):
    person = dataclasses.replace(face, tissue=nearly_typical(1e-3))
    scene = FlashScene(flash, person, state="smile")
    assert scene.subject.tissue == scene.subject.rest.tissue == TYPICAL_SKIN


def test_patch_of_changed_tissue_equals_drawn_patch():
    one, other = (
        make_micro_skin("cheek", seed=2, size_mm=0.5, person=PersonSkin(0.1, seed=2, tissue=tissue))
        for tissue in (TYPICAL_SKIN, PERSON)
    )
    np.testing.assert_allclose(change_patch_tissue(one, PERSON).albedo, other.albedo, atol=2e-7)
    assert np.abs(one.albedo - other.albedo).max() > 1e-3
    assert change_patch_tissue(one, TYPICAL_SKIN) is one


@pytest.mark.long
def test_tissue_size_bounds_change_of_patch():
    rig = load_rig("gradient").cropped(32)
    patch = make_micro_skin("cheek", seed=2, size_mm=0.8, person=PersonSkin(0.02, tissue=PERSON))
    on, off = (
        GradientScene(rig, patch, effects=SceneEffects(oxygenation=built))
        for built in (True, False)
    )
    have, lack = (scene.moments(NEUTRAL_GRIP)["parallel"][0] for scene in (on, off))
    full = have.max()
    sigma = PixelNoise.of(on.sensor()).sigma(have / full)
    change = (np.abs(have - lack) / full / sigma).max()
    predicted = on.needs["oxygenation of blood"].over_noise
    assert predicted / 30.0 < change <= predicted


@pytest.mark.long
def test_predicted_fiber_profiles_agree_with_photons():
    """Logarithm of the ratio of two people's readings, mean over 14 fibers; photon noise 0.06."""
    rig, person = load_rig("probe"), PersonSkin(0.03, tissue=PERSON)
    other = dataclasses.replace(PERSON, oxygenation=0.1, scattering_per_mm=18.0)
    tissue = SkinTissue(person)
    predicted = np.log(
        predict_profiles(rig, tissue, other)[0] / predict_profiles(rig, tissue, PERSON)[0]
    )
    each = [
        ProfileCache(rig, SkinTissue(one), photons=10_000, seed=2).profile("forehead")
        for one in (dataclasses.replace(person, tissue=other), person)
    ]
    found = np.log(each[0].reflectance_per_mm2 / each[1].reflectance_per_mm2)
    near = slice(0, 14)
    assert np.abs((found - predicted)[near].mean(axis=0)).max() < 0.2
    assert np.abs(predicted[near].mean(axis=0)).min() > 0.8


@pytest.mark.long
def test_probe_builds_what_readings_show():
    rig = load_rig("probe")
    shown, hidden = (
        ProbeScene(rig, SkinTissue(PersonSkin(0.03, tissue=nearly_typical(step))))
        for step in (1.0, 1e-7)
    )
    assert all(shown.needs.builds(name) for name in PROPERTIES)
    assert not any(hidden.needs.builds(name) for name in PROPERTIES)
    assert hidden.profiles.tissue.person.tissue == TYPICAL_SKIN
    assert {shown.needs[name].switch for name in PROPERTIES} == {
        rule.switch for rule in TISSUE_RULES
    }


def test_selection_keeps_built_properties_only():
    tissue = draw_tissue(3)

    def size(other):
        return 1.0 if other.oxygenation != tissue.oxygenation else 0.0

    made = select_tissue_effects(tissue, size, SceneEffects(scattering=True))
    verdicts = {effect.name: effect.verdict for effect in made}
    assert verdicts["oxygenation of blood"] == verdicts["scattering of skin"] == "built"
    assert verdicts["other absorption of skin"] == "negligible"
    found = select_tissue(tissue, EffectSelection(tuple(made)))
    assert (found.oxygenation, found.scattering_slope) == (
        tissue.oxygenation,
        tissue.scattering_slope,
    )
    assert found.baseline_amplitude == TYPICAL_SKIN.baseline_amplitude
