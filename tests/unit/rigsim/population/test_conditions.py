"""Conditions and coatings of skin: energy, reciprocity, directions of change, extremes."""

import dataclasses
import math

import numpy as np
import pytest

from rigsim.light import surface_brdf
from rigsim.light.surface_brdf import Coating, SurfaceError
from rigsim.population.conditions import (
    CONDITION_NAMES,
    ConditionError,
    apply_condition,
    apply_conditions,
    condition_subject,
    conditioned_surface,
)
from rigsim.subject.person import make_subject

CAMERA, LIGHT = "Nikon 5100 (NPL)", "LED-B3"
UP = np.array([0.0, 0.0, 1.0])
ETA = {"water": 1.333, "lotion": 1.45, "foundation": 1.5}


@pytest.fixture(scope="module")
def face():
    return make_subject("II", seed=2, size=64)


@pytest.fixture(scope="module")
def bare(face):
    return surface_brdf.skin_surface(face, CAMERA, LIGHT)


def gloss(surface, light, view, points):
    """Return the mean surface term of the chosen texels, 1/sr."""
    return surface_brdf.evaluate_brdf(surface.packed()[points], UP, light, view)[1].mean()


def slanted(angle_deg, turn_deg=0.0):
    angle, turn = math.radians(angle_deg), math.radians(turn_deg)
    return np.array(
        [math.sin(angle) * math.cos(turn), math.sin(angle) * math.sin(turn), math.cos(angle)]
    )


def hemisphere(polar=200, around=256):
    """Return directions and weights of solid angle times cosine; Gauss in cosine squared."""
    node, weight = np.polynomial.legendre.leggauss(polar)
    sine2 = 0.5 * (node + 1.0)
    phi = 2.0 * np.pi * (np.arange(around) + 0.5) / around
    sine, cosine = np.sqrt(sine2)[:, None], np.sqrt(1.0 - sine2)[:, None]
    way = np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine * np.ones_like(phi)], axis=-1)
    return way.reshape(-1, 3), np.repeat(weight * 0.5 * math.pi / around, around)


@pytest.mark.parametrize("angle_deg", [0.0, 40.0, 70.0, 85.0])
@pytest.mark.parametrize("powder", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(("eta", "alpha"), [(1.333, 0.09), (1.5, 0.3)])
def test_coated_skin_reflects_less_light_than_received(angle_deg, powder, eta, alpha):
    """The whitest that there is: R_d of 0.9 under a whole film, or of powder's own under grains."""
    way, weight = hemisphere()
    r_d = (1.0 - powder) * 0.9 + powder * 0.55
    packed = [r_d, r_d, r_d, 0.3, 0.6, surface_brdf.FUZZ_DEPTH, 1.0, 1.0, alpha, eta, powder]
    total, specular = surface_brdf.evaluate_brdf(packed, UP, slanted(angle_deg), way)
    assert 0.0 < weight @ specular
    assert weight @ total[:, 0] < 1.0


def test_coated_skin_brdf_is_reciprocal(rng):
    way = rng.standard_normal((500, 2, 3))
    way[..., 2] = np.abs(way[..., 2]) + 1e-3
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    low = np.array([0, 0, 0, 0.1, 0, 0, 0, 0, 0.05, 1.2, 0])
    high = np.array([1, 1, 1, 0.5, 0.6, 0.003, 1, 1, 0.6, 1.7, 1])
    packed = rng.uniform(low, high, (500, 11))
    there = surface_brdf.evaluate_brdf(packed, UP, way[:, 0], way[:, 1])
    back = surface_brdf.evaluate_brdf(packed, UP, way[:, 1], way[:, 0])
    for a, b in zip(there, back, strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-7)


def test_zero_film_and_no_grains_give_bare_skin(rng):
    way, _ = hemisphere(12, 16)
    bare = [0.5, 0.4, 0.3, 0.3, 0.3, 0.001, 0.9]
    one = surface_brdf.evaluate_brdf(bare, UP, slanted(50.0), way)
    two = surface_brdf.evaluate_brdf([*bare, 0.0, 0.2, 1.4, 0.0], UP, slanted(50.0), way)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_grains_match_closed_form_of_thick_layer():
    """Light from above and back: w p(pi) / (4 pi 2), p = (1 - g^2) / (1 + g)^3 for g < 0."""
    g, w = surface_brdf.POWDER_ASYMMETRY, surface_brdf.POWDER_ALBEDO
    packed = [0.0, 0.0, 0.0, 0.3, 0.2, 0.0, 1.0, 0.0, 0.2, 1.4, 1.0]
    back = surface_brdf.evaluate_brdf(packed, UP, UP, UP)[1][0]
    assert back == pytest.approx(w * (1.0 - g * g) / (1.0 + g) ** 3 / (8.0 * math.pi), rel=1e-5)
    way, weight = hemisphere(64, 128)
    for angle in (0.0, 40.0, 85.0):
        sent = weight @ surface_brdf.evaluate_brdf(packed, UP, slanted(angle), way)[1]
        assert sent < w
        # grains that scatter evenly send back w / 2 (1 - c ln(1 + 1 / c)); these ones more
        c = math.cos(math.radians(angle))
        if angle < 60.0:
            assert sent > 0.5 * w * (1.0 - c * math.log1p(1.0 / c))


@pytest.mark.parametrize("condition", CONDITION_NAMES)
def test_condition_of_zero_amount_keeps_surface(condition, face, bare):
    assert apply_condition(bare, condition, 0.0) is bare
    assert apply_conditions(face, bare, {condition: 0.0}) is bare
    assert condition_subject(face, {condition: 0.0}) is face


def test_normal_condition_keeps_surface(face, bare):
    assert apply_condition(bare, "normal") is bare
    again = conditioned_surface(face, CAMERA, LIGHT, {"normal": 1.0})
    np.testing.assert_array_equal(again.packed(), bare.packed())


def test_films_raise_specular_powder_and_cold_lower(face, bare):
    points = face.hair == 0.0
    light, view = slanted(30.0), slanted(30.0, 180.0)
    before = gloss(bare, light, view, points)
    now = {
        name: gloss(conditioned_surface(face, CAMERA, LIGHT, {name: 1.0}), light, view, points)
        for name in CONDITION_NAMES
    }
    assert now["cold"] < before < now["hot"] < now["sweat"]
    assert now["lotion"] > 1.5 * before
    assert now["powder"] < 0.8 * before


def test_powder_scatters_light_backward(face, bare):
    points = face.hair == 0.0
    light = slanted(65.0)
    powdered = conditioned_surface(face, CAMERA, LIGHT, {"powder": 1.0})
    assert gloss(powdered, light, light, points) > 2.0 * gloss(bare, light, light, points)


def test_heat_reddens_and_cold_pales(face, bare):
    skin = (face.hair == 0.0) & face.atlas.covered
    ratio = {
        name: np.median((s.r_d[..., 0] / s.r_d[..., 1])[skin])
        for name, s in (
            ("normal", bare),
            *((n, conditioned_surface(face, CAMERA, LIGHT, {n: 1.0})) for n in ("hot", "cold")),
        )
    }
    assert ratio["cold"] < 0.995 * ratio["normal"]
    assert ratio["hot"] > 1.005 * ratio["normal"]


def test_makeup_evens_color_and_covers_towards_own_color(face, bare):
    skin = (face.hair == 0.0) & face.atlas.covered
    even = apply_condition(bare, "makeup")
    assert np.all(even.r_d[skin].std(axis=0) < 0.4 * bare.r_d[skin].std(axis=0))
    np.testing.assert_allclose(
        np.median(even.r_d[skin], axis=0), np.median(bare.r_d[skin], axis=0), rtol=0.01
    )
    bronze = apply_condition(bare, "makeup", foundation=[0.4, 0.2, 0.1])
    gap = np.abs(bare.r_d - [0.4, 0.2, 0.1])[skin]
    np.testing.assert_allclose(np.abs(bronze.r_d - [0.4, 0.2, 0.1])[skin], 0.3 * gap, atol=1e-5)


def test_film_grows_with_condition_amount(face, bare):
    film = [apply_condition(bare, "lotion", a).coating.film.mean() for a in (0.3, 0.6, 1.0)]
    np.testing.assert_allclose(np.array(film) / film[-1], [0.3, 0.6, 1.0], rtol=1e-5)


def test_second_film_covers_remainder_of_first(bare):
    both = apply_condition(apply_condition(bare, "lotion"), "sweat").coating
    assert both.film.mean() == pytest.approx(1.0 - 0.25 * 0.3, rel=1e-5)
    assert ETA["water"] < both.film_eta.mean() < ETA["lotion"]


def test_the_darkest_face_under_everything_stays_in_range(face):
    dark = make_subject("darkest", seed=1, size=64)
    surface = conditioned_surface(dark, CAMERA, LIGHT, dict.fromkeys(CONDITION_NAMES, 1.0))
    packed = surface.packed()
    assert np.isfinite(packed).all()
    assert packed.min() >= 0.0
    total, specular = surface_brdf.evaluate_brdf(packed.reshape(-1, 11), UP, slanted(40.0), UP)
    assert np.all(total >= specular[:, None])


def test_posed_face_keeps_pose_under_condition(face):
    smiling = face.with_expression("smile")
    hot = condition_subject(smiling, {"hot": 1.0})
    assert hot.pose is smiling.pose
    assert hot.hemoglobin().mean() > 1.1 * smiling.hemoglobin().mean()
    assert hot.rest.hemoglobin().mean() == pytest.approx(hot.hemoglobin().mean())


@pytest.mark.parametrize(
    ("condition", "amount", "match"),
    [("mud", 1.0, "mud"), ("hot", 1.2, "amount of hot: got 1.2"), ("hot", math.nan, "nan")],
)
def test_an_unknown_condition_is_refused(condition, amount, match, bare):
    with pytest.raises(ConditionError, match=match):
        apply_condition(bare, condition, amount)


def test_coating_or_foundation_out_of_range_is_refused(bare):
    even = np.ones((4, 4), np.float32)
    with pytest.raises(SurfaceError, match="film_eta: got"):
        Coating(even, 0.2 * even, even, even)
    with pytest.raises(SurfaceError, match="powder: got"):
        Coating(even, 0.2 * even, 1.4 * even, dataclasses.replace(bare).oil)
    with pytest.raises(ConditionError, match="foundation"):
        apply_condition(bare, "makeup", foundation=[2.0, 0.0, 0.0])
