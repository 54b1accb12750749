"""The skin of a person: sites, states and tones."""

import numpy as np
import pytest

from model import skin_tone
from model.tissue_optics.uncertainty import NUISANCE_PARAMETERS
from rigsim.fiber.probe_tissue import TissueError
from rigsim.population.files import SubjectFile, load_subject, load_tissue
from rigsim.population.population import draw_population, get_member
from rigsim.population.textures import SubjectFileError
from rigsim.subject.face_regions import from_mean_head
from rigsim.subject.head import LANDMARKS_MM
from rigsim.subject.perfusion import StateError
from rigsim.subject.person import make_subject
from rigsim.subject.person_skin import SITE_NAMES, PersonSkin, PersonSkinError, draw_tissue, layers
from rigsim.subject.skin_tone import MONK_ITA_DEG, melanin_of_tone, typology_angle_deg
from rigsim.tissue.skin_layers import (
    PAPER_SKIN,
    TYPICAL_SKIN,
    TissueProperties,
    melanin_per_mm,
    skin_coefficients,
)
from rigsim.tissue.skin_table import WAVELENGTH_NM, interpolate_spectra


@pytest.mark.parametrize("seed", [0, 3])
def test_cheek_is_that_of_the_face(seed):
    person, face = PersonSkin.of_preset("IV", seed=seed), make_subject("IV", seed=seed, size=128)
    center = from_mean_head(np.array(LANDMARKS_MM["cheek left"]), face.mesh)
    away = face.atlas.position_mm - center
    near = face.atlas.covered & (np.hypot(away[..., 0], away[..., 1]) < 8.0) & (away[..., 2] > -30)
    skin = person.at("cheek")
    assert np.exp(np.log(face.melanin[near]).mean()) == pytest.approx(skin.c_m, rel=0.02)
    assert face.hemoglobin()[near].mean() == pytest.approx(skin.c_hd, rel=0.03)
    # Another person of the same preset differs by more.
    other = PersonSkin.of_preset("IV", seed=seed + 1).at("cheek")
    assert abs(other.c_m / skin.c_m - 1.0) > 0.02 or abs(other.c_hd / skin.c_hd - 1.0) > 0.03


def test_states_without_movement_change_blood_at_sites():
    person = PersonSkin.of_preset("III")
    rest = person.at("cheek")
    assert person.at("cheek", "exercise").c_hd > 1.1 * rest.c_hd
    assert person.at("cheek", "exercise").c_m == rest.c_m
    with pytest.raises(StateError, match="state: got 'asleep'"):
        person.at("cheek", "asleep")


def test_layers_have_the_pigments_of_the_site():
    person = PersonSkin(0.05, seed=2, tissue=PAPER_SKIN)
    for site in SITE_NAMES:
        skin = person.at(site)
        stack = layers(person, site, "neutral", 540.0)
        assert [layer.thickness_mm for layer in stack.layers] == [0.25, np.inf]
        dark = layers(PersonSkin(0.1, seed=2, tissue=PAPER_SKIN), site, "neutral", 540.0)
        assert dark.layers[0].sigma_a_per_mm > stack.layers[0].sigma_a_per_mm
        assert skin.tissue == PAPER_SKIN


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"melanin": 0.6}, "melanin: got 0.6, expected 0.001 to 0.45"),
        ({"melanin": 0.1, "blood": 9.0}, "blood: got 9.0, expected 0.1 to 4"),
        ({"melanin": 0.1, "seed": -1}, "seed: got -1, expected >= 0"),
    ],
)
def test_impossible_people_are_refused(change, message):
    with pytest.raises(PersonSkinError, match=message):
        PersonSkin(**change)


def test_unknown_site_and_preset_are_refused():
    with pytest.raises(PersonSkinError, match="site: got 'elbow', expected one of forehead"):
        PersonSkin(0.1).at("elbow")
    with pytest.raises(PersonSkinError, match="preset: got 'VII'"):
        PersonSkin.of_preset("VII")


def measured_angle(person):
    """Return the typology angle of the mean of three sites as an instrument measures it."""
    sites = [person.at(site) for site in ("forehead", "cheek", "chin")]
    spectrum = np.mean(
        [
            interpolate_spectra(np.array([s.c_m]), np.array([s.c_hd]), s.tissue, WAVELENGTH_NM)[0]
            for s in sites
        ],
        axis=0,
    )
    lab = skin_tone.lab_of_spectra(spectrum + skin_tone.sphere_specular(), WAVELENGTH_NM)
    return float(skin_tone.ita(lab))


def test_thickness_differs_between_people_and_sites():
    people = [load_subject("III").skin(seed=seed) for seed in range(60)]
    thickness = np.array([[p.at(site).tissue.epidermis_mm for site in SITE_NAMES] for p in people])
    assert 0.05 < thickness.min() < 0.085
    assert 0.1 < thickness.max() < 0.125
    ratio = thickness[:, SITE_NAMES.index("forehead")] / thickness[:, SITE_NAMES.index("cheek")]
    np.testing.assert_allclose(ratio, 0.21 / 0.195, rtol=0.02)  # of the publication
    even = PersonSkin.of_preset("III")
    assert {even.at(site).tissue for site in SITE_NAMES} == {TYPICAL_SKIN}


def test_face_has_the_thickness_of_its_sites():
    face = load_subject("III").face(seed=4, size=128)
    person = load_subject("III").skin(seed=4)
    for site, landmark in (("cheek", "cheek left"), ("forehead", "forehead"), ("chin", "chin")):
        center = from_mean_head(np.array(LANDMARKS_MM[landmark]), face.mesh)
        away = face.atlas.position_mm - center
        near = np.hypot(away[..., 0], away[..., 1]) < 8.0
        there = near & face.atlas.covered & (away[..., 2] > -30.0)
        found = face.tissue.epidermis_mm * face.thickness_ratio[there].mean()
        assert found == pytest.approx(person.at(site).tissue.epidermis_mm, rel=0.01)


@pytest.mark.parametrize("thickness_mm", [0.05, 0.09, 0.2])
def test_thickness_keeps_melanin_per_area(thickness_mm):
    tissue = TissueProperties(epidermis_mm=thickness_mm)
    one, none = (skin_coefficients(550.0, c_m, 0.01, tissue) for c_m in (0.04, 0.0))
    depth = thickness_mm * float(one.upper - none.upper)
    per_mm = float(melanin_per_mm(550.0))
    replaced = 0.04 * 0.09 * float(none.upper)  # melanosomes replace other absorption
    assert depth == pytest.approx(0.04 * 0.09 * per_mm - replaced, rel=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_tone_is_exact_for_any_thickness(seed):
    tissue = draw_tissue(seed)
    assert typology_angle_deg(melanin_of_tone("ita:27", tissue), tissue) == pytest.approx(27.0)
    assert typology_angle_deg(melanin_of_tone("ita:27"), tissue) != pytest.approx(27.0, abs=0.02)


@pytest.mark.parametrize("property_", NUISANCE_PARAMETERS, ids=lambda one: one.name)
def test_published_people_fill_published_ranges(property_):
    name = {"baseline_factor": "baseline_amplitude"}.get(property_.name, property_.name)
    skins = [SubjectFile(tissue_model=model) for model in ("published", "drawn")]
    values = np.array([[getattr(s.properties(seed=k), name) for k in range(400)] for s in skins])
    wide, usual = (np.log(values) if property_.is_log else values).std(axis=1)
    # draws end at two deviations, and fractions at 1, 1.1 deviations above the usual eumelanin
    least = 0.75 if name == "epidermis_mm" else 0.84  # intervals reach to 0.15 mm, people 0.12 mm
    assert least * property_.sd < wide < 1.02 * property_.sd
    assert usual < 0.45 * property_.sd


@pytest.mark.parametrize("angle", [60.0, 27.0, -40.0])
def test_person_of_a_tone_measures_that_tone(angle):
    melanin = melanin_of_tone(f"ita:{angle:g}")
    assert typology_angle_deg(melanin) == pytest.approx(angle, abs=1e-3)
    found = [measured_angle(load_subject(f"ita:{angle:g}").skin(seed=seed)) for seed in range(6)]
    # People vary by some 10 % of melanin, which is 3 degrees.
    assert np.mean(found) == pytest.approx(angle, abs=3.0)
    assert np.mean(found) != pytest.approx(angle + 10.0, abs=3.0)


def test_monk_tones_are_those_of_the_published_colors():
    published = skin_tone.ita(skin_tone.monk_colors())
    np.testing.assert_allclose(MONK_ITA_DEG, published, atol=0.06)
    melanin = [melanin_of_tone(f"monk:{tone}") for tone in range(1, 11)]
    assert melanin == sorted(melanin)
    assert typology_angle_deg(melanin[4]) == pytest.approx(MONK_ITA_DEG[4], abs=1e-3)


@pytest.mark.parametrize("text", ["ita:95", "ita:dark", "monk:0", "monk:2.5", "monk:", "ita:nan"])
def test_impossible_tones_are_refused(text):
    with pytest.raises(SubjectFileError, match=r"expected (ita:DEGREES from|monk:1 to monk:10)"):
        load_subject(text)


def test_member_has_one_skin_in_all_rigs():
    member = get_member("P12")
    assert load_tissue("P12", seed=5).person == member.skin
    face = member.face(64)
    assert face.seed == member.skin.seed
    with pytest.raises(TissueError, match="expected P01 to P87"):
        load_tissue("P88", seed=0)


@pytest.mark.long
def test_population_looks_like_measured_skin():
    angles = np.array([measured_angle(member.skin) for member in draw_population()])
    assert 25.0 < np.median(angles) < 50.0
    assert angles.min() > -30.0
    assert angles.max() < 66.0
