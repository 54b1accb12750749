"""Judge traits by sessions: compare their vectors with the simulator's own changes.

    python tools/judge_trait_sessions.py albedo|surface

Albedo: the people of skinrig/data/population_sessions.npz have a map of R_d each by a simulated
session of the light dome. Their true maps, without noise and at the same pixels, come from the
simulator alone. Effects of sex, group, age, pigment, freckles and stubble on the vectors of both
are estimated by least squares with equal covariates. Printed are the cosine between both effects,
the length of the sessions' effect over the true one, and the same for the mean vector.

Surface: traits by regression on the mean mixtures of all people and of one member's session under
each condition. Printed are the number of sessions with the condition, p over exchanged sessions,
and the cosine with the mean change of other faces by it, here and of the packaged trait.
"""

from __future__ import annotations

import argparse
import dataclasses

import numpy as np

from model.brdf import tables as brdf_tables
from model.texture_statistics.space import TextureSpace
from model.traits import TraitSpace, cosine
from model.traits.storage import load_packaged_traits
from reconstruction import brdf_basis
from rigsim.population.population import draw_population, get_member
from skinrig.analysing.brdf_space_datasets import DATASET_A_MEMBER, Dataset
from skinrig.analysing.population_sessions import decode_r_d, encode_r_d, load_population_sessions
from skinrig.arrays import Float64Array
from skinrig.traits import albedo_vectors
from skinrig.traits.albedo_vectors import AlbedoSample
from skinrig.traits.truth import CommonFaces, lobe_changes

FACE_TEXELS = 256
RANK = 8
COMPARED = 8
"""People with true changes of the surface, none of them the one with a session per condition."""


def judge_albedo() -> None:
    sessions = load_population_sessions()
    people = [get_member(name) for name in sessions.captured]
    faces = CommonFaces.of(draw_population(), size=FACE_TEXELS, common=2 * sessions.frame.size)
    rng = np.random.default_rng(0)
    exact = [faces.albedo(person, noise=0.0, rng=rng) for person in people]
    true = [decode_r_d(encode_r_d(one.r_d, one.valid)) for one in exact]
    # both are compared where the sessions have an estimate
    true = [
        AlbedoSample(one.r_d, one.valid & seen.valid)
        for one, seen in zip(true, sessions.r_d, strict=True)
    ]
    texture = TextureSpace.fit(
        [albedo_vectors.encode_albedo(one.r_d, "quantiles") for one in sessions.r_d],
        valid=[one.valid for one in sessions.r_d],
    )
    columns: dict[str, list[float]] = {
        "female": [person.sex == "female" for person in people],
        "asian": [person.ethnicity == "asian" for person in people],
        "age": [person.age_years for person in people],
        "ln melanin": [np.log(person.melanin) for person in people],
        "ln blood": [np.log(person.blood) for person in people],
        "freckles": [person.freckles for person in people],
        "beard": [person.beard for person in people],
    }
    design = np.column_stack([np.ones(len(people)), *columns.values()]).astype(np.float64)
    design[:, 1:] -= design[:, 1:].mean(axis=0)
    found, wanted = (effects(maps, texture, design) for maps in (sessions.r_d, true))
    print(f"{len(people)} people")
    for name, one, truth in zip(("mean", *columns), found, wanted, strict=True):
        ratio = float(np.linalg.norm(one) / np.linalg.norm(truth))
        print(f"| {name} | {cosine(one, truth):.3f} | {ratio:.2f} |")


def effects(
    maps: tuple[AlbedoSample, ...] | list[AlbedoSample], texture: TextureSpace, design: Float64Array
) -> Float64Array:
    """Return the least-squares effect of each column of the design on vectors of maps."""
    rows = [
        albedo_vectors.vector(one.r_d, texture, "quantiles", valid=one.valid, region=one.valid)
        for one in maps
    ]
    return np.asarray(np.linalg.lstsq(design, np.array(rows), rcond=None)[0], np.float64)


def judge_surface() -> None:
    sessions, everybody = load_population_sessions(), draw_population()
    one, worn = everybody[DATASET_A_MEMBER], sessions.conditions.labels
    people = [*map(get_member, sessions.captured), *[one] * len(worn)]
    conditions = [person.conditions for person in people[: -len(worn)]]
    conditions += [frozenset({name}) for name in worn]
    names = worn[1:]
    labels = {name: [name in each for each in conditions] for name in names}
    labels |= {
        "female": [person.sex == "female" for person in people],
        "one": [person.name == one.name for person in people],
    }
    means = np.concatenate([mean_weights(sessions.people), mean_weights(sessions.conditions)])
    basis = brdf_tables.default_basis()
    strength = basis.strength()
    space = TraitSpace.fit(
        means,
        labels,
        continuous={"age": [person.age_years for person in people]},
        space="nmf",
        basis=brdf_basis.reduce(means, RANK, basis=basis)[1],
        metric=basis.cosine_similarity() * np.outer(strength, strength),
        contrast="regression",
    )
    others = [person for person in everybody if person.name != one.name]
    order = np.random.default_rng(0).permutation(len(others))[:COMPARED]
    bare = [dataclasses.replace(others[k], applied=()) for k in order]
    after = {n: [dataclasses.replace(p, applied=((n, 1.0),)) for p in bare] for n in names}
    changes = lobe_changes(bare, after, rng=np.random.default_rng(1))
    packaged = load_packaged_traits().spaces["surface"]
    for name, change in changes.items():
        trait = space.trait(name)
        found, given = (change.cosine(x.vector, basis) for x in (trait, packaged.trait(name)))
        chance = trait.confidence.p_value
        print(f"| {name} | {trait.members} | {chance:.3f} | {found:.3f} | {given:.3f} |")


def mean_weights(data: Dataset) -> Float64Array:
    """Return the mean mixture of each label's points, (labels, materials)."""
    return np.array([data.weights[data.label == k].mean(axis=0) for k in range(len(data.labels))])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=("albedo", "surface"))
    judge_albedo() if parser.parse_args().part == "albedo" else judge_surface()


if __name__ == "__main__":
    main()
