"""Make model/data/trait_space.npz: trait spaces of a simulated population.

Run from the repository root, ``python tools/make_trait_space.py`` (about 3 minutes of one core;
see `main` for options).

- People: the 87 of `rigsim.population.population.draw_population`. A random half of them gets a
tan (1.5 times the
  melanin); everybody gets one condition out of normal (twice as often), cold, hot, sweat, lotion,
  makeup and powder instead of their own.
- Surface: materials fitted to 2 % noisy light from 40 points of each face in 240 pairs of light
  and view, R_d estimated from the same samples; mean mixtures; 8 common ones as in figure 15 of
  Weyrich et al.; traits are the conditions, sex and age.
- Albedo: R_d at 256 texels with 1 % noise in a common map of 192 pixels; vectors of quantiles for
  the face and its regions as `skinrig fit traits` makes them. What one can put on or take off (tan,
  freckles, beard, conditions) is learned from ten people seen without and with each; sex, group
  and age from the 87. From the 87 alone, tan comes to a cosine of about 0.92 with the truth, as
  people differ more than a tan.
- "regression": a trait's effect with all other traits as covariates and, of the ten, their
  identities.
- Ground truth: other people are each simulated without and with each trait, without noise. The
  cosines between their mean change and the traits' vectors are printed and stored; for the albedo,
  those of the vectors of the whole face.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from model.brdf import tables as brdf_tables
from model.texture_statistics.space import TextureSpace
from model.traits import TraitSpace, cosine
from model.traits.storage import PACKAGED_FILE, TraitLibrary, from_bytes
from reconstruction import brdf_basis
from reconstruction.correspondence import common_regions
from rigsim.population.conditions import CONDITION_NAMES
from rigsim.population.population import Member, draw_population, shift_trait
from skinrig.traits import albedo_vectors, regions
from skinrig.traits import truth as trait_truth
from skinrig.traits.truth import CommonFaces

TAN = 1.5
WORN = ("normal", *CONDITION_NAMES)
SEEN_ON_SURFACE = (*CONDITION_NAMES[1:], "female")
BORN = ("female", "asian")
WITHOUT = {"freckles": 0.1, "beard": 0.1}
PUT_ON = {
    "tan": lambda p: {"melanin": TAN * p.melanin},
    "freckles": lambda p: {"freckles": 0.7},
    "beard": lambda p: {"beard": 0.7},
    **{n: lambda p, n=n: {"applied": ((n, 1.0),)} for n in ("cold", "hot", "makeup", "powder")},
}
REPEATED, COMPARED_IN_COLOR = 10, 4
REGIONS = ("face", "beard", "no-beard")
OPPOSITES = {"female": "male", "asian": "caucasian"}
RANK, POINTS = 8, 40
COMPARED = 8
"""People who are simulated twice, for the ground truth."""
DIRECTIONS = 8
"""Of the albedo's space that are stored."""
LIMIT_BYTES = 1_500_000


def population(seed: int) -> tuple[Member, ...]:
    people = shift_trait(
        draw_population(seed=seed), "tan", melanin=TAN, rng=np.random.default_rng([seed, 1])
    )
    return trait_truth.assign_conditions(people, WORN, rng=np.random.default_rng([seed, 2]))


def mixtures(people: Sequence[Member], seed: int) -> np.ndarray:
    basis = brdf_tables.default_basis()
    means = []
    for k, person in enumerate(people):
        rng = np.random.default_rng([seed, 3, k])
        points = trait_truth.surface_points(person, POINTS, rng=rng)
        means.append(trait_truth.mean_mixture(points, basis, rng=rng))
    return np.array(means)


def kept(work: Path | None, name: str, make: Callable[[], np.ndarray]) -> np.ndarray:
    """Return an array of an earlier run from the work folder, or compute it."""
    path = None if work is None else work / f"{name}.npy"
    if path is not None and path.is_file():
        return np.load(path)
    made = make()
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, made)
    return made


def surface_space(people: Sequence[Member], means: np.ndarray, seed: int) -> TraitSpace:
    basis = brdf_tables.default_basis()
    strength = basis.strength()
    return TraitSpace.fit(
        means,
        trait_truth.label_members(people, SEEN_ON_SURFACE),
        continuous={"age": np.array([person.age_years for person in people])},
        space="nmf",
        basis=brdf_basis.reduce(means, RANK, basis=basis)[1],
        metric=basis.cosine_similarity() * np.outer(strength, strength),
        contrast="regression",
        names=basis.names,
        seed=seed,
    )


def packaged(space: TraitSpace) -> TraitSpace:
    """Omit directions that the vectors do not need, and add each trait's opposite."""
    notes = {}
    if len(space.basis) > DIRECTIONS:
        notes["basis"] = f"the first {DIRECTIONS} of {len(space.basis)}; vectors are of all"
    names = {trait for trait in (*BORN, *PUT_ON, *CONDITION_NAMES, "age") if trait in space.traits}
    traits = {
        name: dataclasses.replace(
            trait,
            coordinates=trait.coordinates[:DIRECTIONS],
            confounded=tuple(c for c in trait.confounded if c[0] in names),
        )
        for name, trait in space.traits.items()
    }
    space = dataclasses.replace(space, basis=space.basis[:DIRECTIONS], notes=notes, traits=traits)
    for name, other in OPPOSITES.items():
        if name in traits:
            traits[other] = traits[name].opposite(other)
    return dataclasses.replace(space, traits=traits)


def surface_truth(space: TraitSpace, people: Sequence[Member], seed: int) -> dict[str, float]:
    basis = brdf_tables.default_basis()
    some = [people[i] for i in np.random.default_rng([seed, 4]).permutation(len(people))[:COMPARED]]
    bare = [dataclasses.replace(person, applied=()) for person in some]
    worn = {
        name: [dataclasses.replace(person, applied=((name, 1.0),)) for person in bare]
        for name in CONDITION_NAMES[1:]
    }
    changes = trait_truth.lobe_changes(bare, worn, rng=np.random.default_rng([seed, 5]))
    return {
        name: change.cosine(space.trait(name).vector, basis) for name, change in changes.items()
    }


def visits(people: Sequence[Member]) -> tuple[list[Member], list[str], list[str]]:
    """Return people without and with each trait, and the trait and the person of each visit."""
    seen, shows, whose = [], [], []
    for person in people:
        bare = dataclasses.replace(person, applied=(), marks=frozenset(), **WITHOUT)
        if person.sex == "female":
            bare = dataclasses.replace(bare, beard=0.0)
        for name in ("", *PUT_ON):
            if name == "beard" and person.sex == "female":
                continue
            changes = PUT_ON[name](bare) if name else {}
            seen.append(dataclasses.replace(bare, **changes))
            shows.append(name)
            whose.append(person.name)
    return seen, shows, whose


def drawn(
    faces: CommonFaces, people: Sequence[Member], noise: float, stream: tuple[int, int]
) -> np.ndarray:
    """Draw albedo maps, (n, N, N, 4), the mask as last channel."""
    found = []
    for k, person in enumerate(people):
        one = faces.albedo(person, noise=noise, rng=np.random.default_rng([*stream, k]))
        found.append(np.concatenate([one.r_d, one.valid[..., None]], axis=-1))
    return np.array(found, np.float32)


def vectors(maps: np.ndarray, faces: CommonFaces, texture: TextureSpace, region: str) -> np.ndarray:
    inside = common_regions.region_mask(region, faces.frame)
    return np.array(
        [
            albedo_vectors.vector(
                np.ascontiguousarray(one[..., :3]),
                texture,
                "quantiles",
                valid=one[..., 3] > 0,
                region=inside & (one[..., 3] > 0),
            )
            for one in maps
        ]
    )


def albedo_space(
    many: np.ndarray,
    people: Sequence[Member],
    again: np.ndarray,
    shows: Sequence[str],
    whose: Sequence[str],
    texture: TextureSpace,
    seed: int,
) -> TraitSpace:
    ages = {"age": np.array([person.age_years for person in people])}
    labels = trait_truth.label_members(people, BORN)
    worn = {n: np.array([n in p.labels for p in people]) for n in PUT_ON}
    space = fitted(many, {**labels, **worn}, ages, texture, seed)
    worn = {name: np.array([one == name for one in shows]) for name in PUT_ON}
    persons = {name: np.array([w == name for w in whose]) for name in dict.fromkeys(whose)}
    persons.pop(whose[0])
    within = fitted(again, {**worn, **persons}, {}, texture, seed)
    traits = {name: space.traits[name] for name in (*BORN, "age")}
    traits |= {name: within.traits[name] for name in PUT_ON}
    # vectors are projected to the population's directions
    traits = {
        name: dataclasses.replace(trait, coordinates=space.basis @ trait.vector)
        for name, trait in traits.items()
    }
    return dataclasses.replace(space, traits=traits)


def fitted(rows, labels, continuous, texture, seed) -> TraitSpace:
    return albedo_vectors.fit_albedo_traits(
        rows, labels, continuous, texture, "quantiles", contrast="regression", seed=seed
    ).traits


def albedo_truth(
    space: TraitSpace, faces: CommonFaces, texture: TextureSpace, people: Sequence[Member]
) -> dict[str, float]:
    seen, shows, _ = visits(people)
    found = vectors(drawn(faces, seen, 0.0, (0, 0)), faces, texture, "face")
    at = np.flatnonzero([not name for name in shows])
    bare = found[at[np.searchsorted(at, np.arange(len(shows)), side="right") - 1]]
    return {
        name: cosine(
            space.trait(name).vector, (found - bare)[[one == name for one in shows]].mean(axis=0)
        )
        for name in PUT_ON
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("model/data") / PACKAGED_FILE)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, default=256, help="texels per side of the faces")
    parser.add_argument("--common", type=int, default=192, help="pixels per side of the common map")
    parser.add_argument("--people", type=int, default=87, help="people, drawn at random")
    parser.add_argument("--work", type=Path, help="folder that keeps samples for later runs")
    given = parser.parse_args()
    start = time.process_time()

    def report(text: str) -> None:
        print(f"{time.process_time() - start:6.0f} s  {text}", flush=True)

    people = population(given.seed)
    order = np.random.default_rng([given.seed, 6]).permutation(len(people))[: given.people]
    people = tuple(people[i] for i in sorted(order))
    means = kept(given.work, "surface", lambda: mixtures(people, given.seed))
    surface = surface_space(people, means, given.seed)
    report("surface learned")
    found = kept(
        given.work,
        "surface_truth",
        lambda: np.array(list(surface_truth(surface, people, given.seed).values())),
    )
    truth = {"surface": dict(zip(CONDITION_NAMES[1:], found.tolist(), strict=True))}
    report(f"cosines to the truth: {truth['surface']}")
    faces = CommonFaces.of(people, size=given.size, common=given.common)
    noise = trait_truth.ALBEDO_NOISE
    once = kept(given.work, "albedo", lambda: drawn(faces, people, noise, (given.seed, 7)))
    mixed = np.random.default_rng([given.seed, 8]).permutation(len(people))
    some = [people[i] for i in mixed[:REPEATED]]
    others = [people[i] for i in mixed[REPEATED : REPEATED + COMPARED_IN_COLOR]]
    seen, shows, whose = visits(some)
    again = kept(given.work, "again", lambda: drawn(faces, seen, noise, (given.seed, 9)))
    report("albedo maps drawn")
    texture = TextureSpace.fit(
        [albedo_vectors.encode_albedo(one[..., :3], "quantiles") for one in (*once, *again)],
        valid=[one[..., 3] > 0 for one in (*once, *again)],
    )
    spaces = {}
    for region in REGIONS:
        both = [vectors(maps, faces, texture, region) for maps in (once, again)]
        spaces[regions.space_name(region)] = albedo_space(
            both[0], people, both[1], shows, whose, texture, given.seed
        )
        report(f"albedo of {region} learned")
    truth["albedo"] = albedo_truth(spaces["albedo"], faces, texture, others)
    report(f"cosines to the truth: {truth['albedo']}")
    library = TraitLibrary(
        {name: packaged(space) for name, space in {**spaces, "surface": surface}.items()},
        "simulated",
        regions.library_parameters(
            faces.frame,
            "quantiles",
            contrast="regression",
            seed=given.seed,
            people=len(people),
            made_by="tools/make_trait_space.py",
            tan_factor=TAN,
            cosine_to_truth={
                part: {n: round(c, 4) for n, c in row.items()} for part, row in truth.items()
            },
        ),
        {regions.TEXTURE_SPACE_FILE: regions.texture_bytes(texture)},
    )
    content = library.to_bytes(precision="int8")
    back = from_bytes(content)
    for name, space in back.spaces.items():
        worst = max(space.storage_error.values())
        report(f"{name}: {len(space.basis)} directions, storage error at most {100 * worst:.2f} %")
        for trait in space.traits.values():
            sure = trait.confidence
            print(
                f"    {trait.name:10s} {trait.members:3d} {trait.others:3d}  "
                f"p {sure.p_value:.3f}  expected cosine {sure.expected_cosine:.3f}  {trait.warning}"
            )
    if len(content) > LIMIT_BYTES:
        raise SystemExit(f"{len(content)} bytes, expected at most {LIMIT_BYTES}")
    given.out.write_bytes(content)
    report(f"{given.out}: {len(content)} bytes")


if __name__ == "__main__":
    main()
