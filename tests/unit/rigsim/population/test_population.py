"""The simulated population: table 1's groups, what members differ by, and known shifts."""

import dataclasses
from collections import Counter

import numpy as np
import pytest

from rigsim.population import population
from rigsim.population.population import (
    POPULATION_GROUPS,
    Member,
    PopulationError,
    draw_population,
    shift_trait,
)
from rigsim.subject import face_regions

CAMERA, LIGHT = "Nikon 5100 (NPL)", "D55"
PEOPLE = draw_population()


def test_the_groups_have_the_papers_numbers_and_ages():
    counts = Counter(p.group for p in PEOPLE)
    assert [counts[g.name] for g in POPULATION_GROUPS] == [50, 5, 6, 20, 4, 2]
    for group in POPULATION_GROUPS:
        ages = [p.age_years for p in PEOPLE if p.group == group.name]
        assert (min(ages), max(ages)) == group.age_years
    worn = [p for p in PEOPLE if p.conditions]
    assert {p.group for p in worn} == {g.name for g in POPULATION_GROUPS if g.wears}
    assert len(worn) == 8
    assert len({p.name for p in PEOPLE}) == len({p.seed for p in PEOPLE}) == 87


def test_same_seed_draws_same_people_another_seed_others():
    assert draw_population() == PEOPLE
    other = draw_population(seed=1)
    assert not {p.melanin for p in other} & {p.melanin for p in PEOPLE}


def test_a_face_is_its_members_alone():
    person = PEOPLE[3]
    one, again = person.r_d(64, CAMERA, LIGHT), person.r_d(64, CAMERA, LIGHT)
    np.testing.assert_array_equal(one[0], again[0])
    np.testing.assert_array_equal(one[1], again[1])
    np.testing.assert_array_equal(one[0], person.surface(64, CAMERA, LIGHT).r_d)
    other = dataclasses.replace(person, seed=person.seed + 1)
    assert np.abs(other.r_d(64, CAMERA, LIGHT)[0] - one[0]).max() > 0.01


def test_more_melanin_is_darker_and_more_blood_redder():
    """Without freckles, of which darker skin has fewer."""
    person = dataclasses.replace(PEOPLE[4], beard=0.0, freckles=0.0)
    skin, mask = person.r_d(64, CAMERA, LIGHT)
    dark, _ = dataclasses.replace(person, melanin=1.5 * person.melanin).r_d(64, CAMERA, LIGHT)
    red, _ = dataclasses.replace(person, blood=1.4 * person.blood).r_d(64, CAMERA, LIGHT)
    assert np.all(dark[mask] < skin[mask])
    ratio = skin[..., 0] / skin[..., 1]
    assert np.all((red[..., 0] / red[..., 1] > ratio)[mask])


def test_stubble_darkens_the_beard_and_nothing_else():
    person = dataclasses.replace(PEOPLE[4], beard=0.0, head=0)
    bearded = dataclasses.replace(person, beard=0.9)
    skin, mask = person.r_d(128, CAMERA, LIGHT)
    shade = bearded.r_d(128, CAMERA, LIGHT)[0] / skin
    points = face_regions.to_mean_head(person.face(128).atlas.position_mm, person.face(128).mesh)
    x, y = points[..., 0], points[..., 1]
    chin = mask & (np.abs(x) < 15.0) & (y < -58.0) & (y > -75.0)
    forehead = mask & (y > 50.0)
    assert chin.sum() > 50
    assert shade[chin].mean() < 0.8
    # blue is taken least
    assert shade[chin][:, 2].mean() > shade[chin][:, 0].mean()
    np.testing.assert_allclose(shade[forehead], 1.0, atol=1e-5)


def test_age_adds_spots_and_deepens_grooves():
    young = dataclasses.replace(PEOPLE[4], age_years=20.0, beard=0.0, freckles=0.0)
    old = dataclasses.replace(young, age_years=75.0)
    a, b = young.face(128), old.face(128)
    mask = a.atlas.covered & (a.hair == 0.0)
    assert b.height_um[mask].std() > 1.5 * a.height_um[mask].std()
    assert np.log(b.melanin[mask]).std() > 1.2 * np.log(a.melanin[mask]).std()
    assert b.roughness[mask].mean() > a.roughness[mask].mean()


def test_shift_changes_half_of_people_and_named_trait(rng):
    tanned = shift_trait(PEOPLE, "tan", melanin=1.5, rng=rng)
    changed = [(p, q) for p, q in zip(PEOPLE, tanned, strict=True) if p != q]
    assert len(changed) == 44
    for person, other in changed:
        assert other.melanin == 1.5 * person.melanin
        assert "tan" in other.labels
        back = dataclasses.replace(other, melanin=person.melanin, marks=person.marks)
        assert back == person
    assert not any("tan" in q.labels for p, q in zip(PEOPLE, tanned, strict=True) if p == q)


def test_a_shift_of_lotion_reaches_the_surface(rng):
    worn = shift_trait(PEOPLE[:4], "glossy", products={"lotion": 0.6}, fraction=1.0, rng=rng)
    assert all(p.conditions == {"lotion"} for p in worn)
    surface = worn[0].surface(64, CAMERA, LIGHT)
    assert surface.coating is not None
    assert surface.coating.film.mean() > 0.3
    assert PEOPLE[0].surface(64, CAMERA, LIGHT).coating is None


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"melanin": 0.5}, "melanin of P01: got 0.5"),
        ({"beard": -0.1}, "beard of P01"),
        ({"head": population.HEAD_SHAPES}, "head of P01"),
        ({"melanin": float("nan")}, "melanin of P01"),
        ({"applied": (("lotion", 0.5), ("lotion", 0.6))}, "each condition once"),
        ({"applied": (("mud", 0.5),)}, "mud"),
    ],
)
def test_a_member_out_of_range_is_refused(change, match):
    with pytest.raises(ValueError, match=match):
        dataclasses.replace(PEOPLE[0], **change)


def test_faces_and_shifts_out_of_range_are_refused(rng):
    with pytest.raises(PopulationError, match="size: got 32"):
        PEOPLE[0].r_d(32, CAMERA, LIGHT)
    with pytest.raises(PopulationError, match="fraction"):
        shift_trait(PEOPLE, "tan", fraction=1.5, rng=rng)
    with pytest.raises(PopulationError, match="seed"):
        draw_population(seed=-1)


def test_palest_and_darkest_member_can_be_drawn():
    low, high = population.POPULATION_MELANIN_RANGE
    for melanin in (low, high):
        person: Member = dataclasses.replace(PEOPLE[1], melanin=melanin, age_years=90.0)
        skin, mask = person.r_d(64, CAMERA, LIGHT)
        assert np.isfinite(skin).all()
        assert 0.0 < skin[mask].min() <= skin[mask].max() < 1.0


def test_members_are_found_by_name():
    assert population.get_member("P87") == PEOPLE[-1]
    with pytest.raises(PopulationError, match="P01 to P87"):
        population.get_member("P88")
