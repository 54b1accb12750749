"""Make model/data/trait_space.npz: trait spaces of a simulated population.

Run from the repository root, ``python tools/make_trait_space.py`` (about 3 minutes of one core;
see `main` for options).

- People: the 87 of `rigsim.population.table_1`. A random half of them gets a tan (1.5 times the
  melanin); everybody gets one of normal (twice as often), cold, hot, sweat, lotion, makeup and
  powder instead of what they wore.
- Surface: materials fitted to 2 % noisy light from 40 points of each face in 240 pairs of light
  and view, R_d estimated from the same samples; mean mixtures; 8 common ones as in figure 15 of
  Weyrich et al.; traits are the conditions, sex and age.
- Albedo: R_d at 256 texels with 1 % noise in a common map of 192 pixels; vectors of quantiles for
  the face and its regions as `skinrig fit traits` makes them; traits are what shows in color.
- "regression": what a trait adds beside all others, as everybody has several.
- Truth: for some traits the same people are simulated twice, without and with, free of noise. The
  cosines between this mean change and the traits' vectors are printed and stored. For the
  albedo it is that of the vectors of the whole face.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from model import brdf_tables
from model.trait_storage import PACKAGED, TraitLibrary, from_bytes
from model.traits import TraitSpace, cosine
from reconstruction import brdf_basis, common_regions
from rigsim.population import Member, shifted, table_1
from rigsim.skin_conditions import CONDITIONS
from skinrig import albedo_vectors, fitting_traits, trait_regions, trait_truth
from skinrig.fitting_traits import AlbedoSample
from skinrig.trait_labels import Labels
from skinrig.trait_truth import CommonFaces

TAN = 1.5
WORN = ("normal", *CONDITIONS)
SEEN_ON_SURFACE = (*CONDITIONS[1:], "female")
SEEN_IN_COLOR = ("tan", "beard", "freckles", "female", "asian", "cold", "hot", "makeup", "powder")
OPPOSITES = {"female": "male", "asian": "caucasian"}
RANK, POINTS = 8, 40
COMPARED = 8
"""People who are simulated twice for the truth."""
DIRECTIONS = 8
"""Of the albedo's space that are stored."""
LIMIT_BYTES = 1_500_000


def population(seed: int) -> tuple[Member, ...]:
    people = shifted(table_1(seed=seed), "tan", melanin=TAN, rng=np.random.default_rng([seed, 1]))
    return trait_truth.assigned(people, WORN, rng=np.random.default_rng([seed, 2]))


def mixtures(people: Sequence[Member], seed: int) -> np.ndarray:
    basis = brdf_tables.default()
    means = []
    for k, person in enumerate(people):
        rng = np.random.default_rng([seed, 3, k])
        points = trait_truth.surface_points(person, POINTS, rng=rng)
        means.append(trait_truth.mean_mixture(points, basis, rng=rng))
    return np.array(means)


def kept(work: Path | None, name: str, make: Callable[[], np.ndarray]) -> np.ndarray:
    """Return what an earlier run left in the work folder, or make it."""
    path = None if work is None else work / f"{name}.npy"
    if path is not None and path.is_file():
        return np.load(path)
    made = make()
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, made)
    return made


def surface_space(people: Sequence[Member], means: np.ndarray, seed: int) -> TraitSpace:
    basis = brdf_tables.default()
    strength = basis.strength()
    return TraitSpace.fit(
        means,
        trait_truth.labels_of(people, SEEN_ON_SURFACE),
        continuous={"age": np.array([person.age_years for person in people])},
        space="nmf",
        basis=brdf_basis.reduce(means, RANK, basis=basis)[1],
        metric=basis.kinship() * np.outer(strength, strength),
        contrast="regression",
        names=basis.names,
        seed=seed,
    )


def packaged(space: TraitSpace) -> TraitSpace:
    """Leave out all but the first directions, which vectors do not need, and add opposites."""
    traits = {
        name: dataclasses.replace(trait, coordinates=trait.coordinates[:DIRECTIONS])
        for name, trait in space.traits.items()
    }
    notes = {}
    if len(space.basis) > DIRECTIONS:
        notes["basis"] = f"the first {DIRECTIONS} of {len(space.basis)}; vectors are of all"
    space = dataclasses.replace(space, basis=space.basis[:DIRECTIONS], notes=notes)
    for name, other in OPPOSITES.items():
        if name in traits:
            traits[other] = traits[name].opposite(other)
    return dataclasses.replace(space, traits=traits)


def surface_truth(space: TraitSpace, people: Sequence[Member], seed: int) -> dict[str, float]:
    basis = brdf_tables.default()
    some = [people[i] for i in np.random.default_rng([seed, 4]).permutation(len(people))[:COMPARED]]
    bare = [dataclasses.replace(person, applied=()) for person in some]
    worn = {
        name: [dataclasses.replace(person, applied=((name, 1.0),)) for person in bare]
        for name in CONDITIONS[1:]
    }
    changes = trait_truth.lobe_changes(bare, worn, rng=np.random.default_rng([seed, 5]))
    return {
        name: change.cosine(space.trait(name).vector, basis) for name, change in changes.items()
    }


def albedo_truth(
    spaces: dict[str, TraitSpace], faces: CommonFaces, texture, people: Sequence[Member], seed: int
) -> dict[str, float]:
    some = [people[i] for i in np.random.default_rng([seed, 4]).permutation(len(people))[:COMPARED]]
    pairs = {
        "tan": ({}, lambda p: {"melanin": TAN * p.melanin}),
        "freckles": ({"freckles": 0.1}, lambda p: {"freckles": 0.7}),
        "beard": ({"beard": 0.1}, lambda p: {"beard": 0.7}),
        **{n: ({}, lambda p, n=n: {"applied": ((n, 1.0),)}) for n in ("cold", "hot", "makeup")},
    }
    inside = common_regions.region("face", faces.frame)
    found = {}
    for name, (without, changes) in pairs.items():
        total = np.zeros(texture.size)
        for person in some:
            bare = dataclasses.replace(person, applied=(), **without)
            if name == "beard" and person.sex == "female":
                continue
            for sign, one in ((-1, bare), (1, dataclasses.replace(bare, **changes(bare)))):
                seen = faces.albedo(one, noise=0.0, rng=np.random.default_rng(0))
                total += sign * albedo_vectors.vector(
                    seen.r_d, texture, "quantiles", valid=seen.valid, region=inside & seen.valid
                )
        found[name] = cosine(spaces["albedo"].trait(name).vector, total)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("model/data") / PACKAGED)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, default=256, help="texels a side of the faces")
    parser.add_argument("--common", type=int, default=192, help="pixels a side of the common map")
    parser.add_argument("--people", type=int, default=87, help="only so many, drawn at random")
    parser.add_argument("--work", type=Path, help="folder that keeps samples for another run")
    given = parser.parse_args()
    start = time.process_time()

    def tell(text: str) -> None:
        print(f"{time.process_time() - start:6.0f} s  {text}", flush=True)

    people = population(given.seed)
    order = np.random.default_rng([given.seed, 6]).permutation(len(people))[: given.people]
    people = tuple(people[i] for i in sorted(order))
    means = kept(given.work, "surface", lambda: mixtures(people, given.seed))
    surface = surface_space(people, means, given.seed)
    tell("surface learned")
    truth = {"surface": surface_truth(surface, people, given.seed)}
    tell(f"cosines to the truth: {truth['surface']}")
    faces = CommonFaces.of(people, size=given.size, common=given.common)

    def maps() -> np.ndarray:
        drawn = []
        for k, person in enumerate(people):
            rng = np.random.default_rng([given.seed, 7, k])
            one = faces.albedo(person, noise=trait_truth.ALBEDO_NOISE, rng=rng)
            drawn.append(np.concatenate([one.r_d, one.valid[..., None]], axis=-1))
        return np.array(drawn, np.float32)

    drawn = kept(given.work, "albedo", maps)
    samples = [AlbedoSample(one[..., :3].copy(), one[..., 3] > 0) for one in drawn]
    tell("albedo maps drawn")
    names = tuple(person.name for person in people)
    ages = {"age": np.array([person.age_years for person in people])}
    labels = Labels(names, trait_truth.labels_of(people, SEEN_IN_COLOR), ages, ())
    left_out: list[tuple[str, str]] = []
    spaces = fitting_traits.albedo_spaces(
        samples, labels, faces.frame, "quantiles", contrast="regression", seed=given.seed,
        left_out=left_out,
    )  # fmt: skip
    texture = spaces.pop("texture")
    tell(f"albedo learned, left out: {left_out}")
    truth["albedo"] = albedo_truth(spaces, faces, texture, people, given.seed)
    tell(f"cosines to the truth: {truth['albedo']}")
    library = TraitLibrary(
        {name: packaged(space) for name, space in {**spaces, "surface": surface}.items()},
        "simulated",
        trait_regions.library_parameters(
            faces.frame, "quantiles", contrast="regression", seed=given.seed, people=len(people),
            made_by="tools/make_trait_space.py", tan_factor=TAN,
            cosine_to_truth={part: {n: round(c, 4) for n, c in row.items()}
                             for part, row in truth.items()},
        ),
        {trait_regions.TEXTURE_SPACE: trait_regions.texture_bytes(texture)},
    )  # fmt: skip
    content = library.to_bytes(precision="int8")
    back = from_bytes(content)
    for name, space in back.spaces.items():
        worst = max(space.storage_error.values())
        tell(f"{name}: {len(space.basis)} directions, storage error at most {100 * worst:.2f} %")
        for trait in space.traits.values():
            sure = trait.confidence
            print(
                f"    {trait.name:10s} {trait.members:3d} {trait.others:3d}  "
                f"p {sure.p_value:.3f}  expected cosine {sure.expected_cosine:.3f}  {trait.warning}"
            )
    if len(content) > LIMIT_BYTES:
        raise SystemExit(f"{len(content)} bytes, expected at most {LIMIT_BYTES}")
    given.out.write_bytes(content)
    tell(f"{given.out}: {len(content)} bytes")


if __name__ == "__main__":
    main()
