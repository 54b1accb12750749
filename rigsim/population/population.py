"""Draw a simulated population: 87 members in the groups of table 1 of Weyrich et al. 2006.

Members are draws from distributions of melanin, blood, oil, freckles, age and beard. The groups
differ only in the distributions below. Those of melanin and blood follow measured faces (Lu et al.
2025, doi:10.1038/s41597-025-04857-5). **All others are chosen** so that an analysis has something
to find, and nothing here is a statement about people.

================= =========================================================================
age               the paper's range of each group; both ends occur, otherwise uniform
melanin           log-normal: median 0.0195 (caucasian) or 0.031 (asian), sigma 0.45 or 0.40,
                  drawn again outside 0.0085 to 0.047 or 0.011 to 0.084; times 0.69 in women
blood             log-normal, median 1, sigma 0.15; times 0.8 in women
oil               log-normal, median 1, sigma 0.25; times 0.9 in women, less with age
freckles          uniform, 0 to 0.9 (caucasian) or 0 to 0.35 (asian); fewer on dark skin
beard             men of 17 and older: uniform, 0.05 to 1 (caucasian) or 0.05 to 0.65 (asian)
age spots         from 35 years on, up to 0.8 at 75
mottle            uneven melanin: 0.03 at 15 to 0.12 at 75
relief, roughness depth of grooves 0.7 to 1.45 times, roughness 0.95 to 1.12 times, 15 to 75 years
conditions        none, or lotion, makeup or both in the groups that use them, amounts 0.6 to 1
================= =========================================================================

Members share `HEAD_SHAPES` head shapes, so that many faces are drawn quickly; everything else is
individual. Their textures share one layout, and their landmarks differ with the head.

References
----------
Weyrich et al. 2006, doi:10.1145/1141911.1141987, table 1 and section 10 (groups and ages).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import numpy as np

from rigsim.arrays import BoolArray, Float32Array
from rigsim.geometry.atlas import Atlas, unwrap
from rigsim.geometry.mesh import Mesh
from rigsim.geometry.surface_noise import random_spots, smooth_noise
from rigsim.light.surface_brdf import SkinSurface
from rigsim.population.conditions import conditioned_surface, validate_conditions
from rigsim.subject import SimulatedSubject, face_regions, pigment, relief
from rigsim.subject.head import build_head
from rigsim.subject.perfusion import draw_perfusion
from rigsim.subject.person import SIZE_RANGE
from rigsim.subject.person_skin import PersonSkin, draw_tissue

HEAD_SHAPES: Final = 6
"""Number of head shapes that the members share."""

MAX_KEPT_HEADS: Final = 6
"""Number of cached heads with their texture layout."""

MAX_SKIN_HAIR: Final = 0.02
"""Texels with a larger fraction of hair are not skin."""

POPULATION_MELANIN_RANGE: Final = (0.004, 0.3)
MIN_LABELED_STUBBLE: Final = 0.35
"""Members with at least this much stubble are labeled "beard"."""
MIN_LABELED_FRECKLES: Final = 0.45

Sex = Literal["male", "female"]
Ethnicity = Literal["caucasian", "asian"]


class PopulationError(ValueError):
    """A member or a shift of a population with an invalid description."""


@dataclass(frozen=True, slots=True)
class Member:
    """One person; the same fields make the same face."""

    name: str
    group: str
    """One of `POPULATION_GROUPS`."""
    sex: Sex
    ethnicity: Ethnicity
    age_years: float
    melanin: float
    """Volume fraction of melanosomes around which the map varies, 0.004 to 0.3."""
    blood: float
    """Factor of all blood, 0.1 to 4."""
    oil: float
    """Factor of the surface fraction covered by oil, 0 to 3."""
    freckles: float
    """0 to 1."""
    beard: float
    """Stubble, 0 to 1."""
    seed: int
    """Seed of all random draws of the face."""
    head: int
    """Shape of the head, 0 to `HEAD_SHAPES` - 1."""
    applied: tuple[tuple[str, float], ...] = ()
    """Conditions of `rigsim.population.conditions.CONDITION_NAMES` with their amounts."""
    marks: frozenset[str] = frozenset()
    """Names of added traits, see `shift_trait`."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for field, (low, high) in _FIELD_RANGES.items():
            value = getattr(self, field)
            if not low <= value <= high:
                raise PopulationError(
                    f"{field} of {self.name}: got {value}, expected {low} to {high}"
                )
        if len({name for name, _ in self.applied}) < len(self.applied):
            raise PopulationError(
                f"applied to {self.name}: got {self.applied}, expected each condition once; "
                "remove one"
            )
        validate_conditions(dict(self.applied))

    @property
    def conditions(self) -> frozenset[str]:
        """Names of the conditions with an amount above 0."""
        return frozenset(name for name, amount in self.applied if amount > 0.0)

    @property
    def labels(self) -> frozenset[str]:
        """Labels that an observer would assign to this face.

        Sex, ethnicity, "beard" and "freckles" above their thresholds, conditions, marks.
        """
        seen = {self.sex, self.ethnicity, *self.conditions, *self.marks}
        seen |= {"beard"} if self.beard >= MIN_LABELED_STUBBLE else set()
        seen |= {"freckles"} if self.freckles >= MIN_LABELED_FRECKLES else set()
        return frozenset(seen)

    @property
    def skin(self) -> PersonSkin:
        """The person's skin without conditions."""
        return PersonSkin(
            self.melanin, self.blood, self.seed, self.freckles, draw_tissue(self.seed)
        )

    def face(self, size: int = 256) -> SimulatedSubject:
        """Return the face, without conditions (see `surface`).

        Parameters
        ----------
        size
            Texels along each side, 64 to 8192.
        """
        flat = self._flat(size)
        points, regions = flat.perfusion.points_mm, flat.perfusion.regions
        old = (self.age_years - 15.0) / 60.0
        height = relief.height_um(
            points, regions, texel_mm=flat.atlas.typical_texel_mm(), seed=self.seed
        )
        height = np.asarray(height * np.float32(0.7 + 0.75 * old), np.float32)
        roughness = relief.roughness_map(points, regions, seed=self.seed)
        rougher = np.clip(roughness * np.float32(0.95 + 0.17 * old), 0.15, 0.5)
        return dataclasses.replace(
            flat,
            roughness=np.asarray(rougher, np.float32),
            height_um=height,
            normal=relief.relief_normals(flat.atlas, height),
        )

    def _flat(self, size: int) -> SimulatedSubject:
        """Return the face without relief and with uniform roughness, for its color."""
        mesh, atlas, points, regions = _lay_out_head(self.head, size)
        even = np.zeros((size, size), np.float32)
        return SimulatedSubject(
            preset=pigment.nearest_preset(self.melanin),
            seed=self.seed,
            mesh=mesh,
            atlas=atlas,
            melanin=self._melanin(points, regions),
            perfusion=draw_perfusion(points, regions, self.skin.base_blood, seed=self.seed),
            roughness=even + np.float32(0.3),
            height_um=even,
            hair=relief.hair_map(points, seed=self.seed),
            normal=atlas.normal,
            beard=relief.stubble_map(
                points, regions, self.beard, atlas.typical_texel_mm(), seed=self.seed
            ),
            tissue=self.skin.tissue,
            oiliness=self.oil,
        )

    def surface(self, size: int, camera: str, light: str) -> SkinSurface:
        """Return the face's reflection under its conditions.

        Parameters
        ----------
        size
            Texels along each side, 64 to 8192.
        camera, light
            Names in `model.spectra`.
        """
        return conditioned_surface(self.face(size), camera, light, dict(self.applied))

    def r_d(self, size: int, camera: str, light: str) -> tuple[Float32Array, BoolArray]:
        """Return the texture of R_d.

        Parameters
        ----------
        size
            Texels along each side, 64 to 8192.
        camera, light
            Names in `model.spectra`.

        Returns
        -------
        r_d : ndarray of float32
            Factor of eq. (6), white-balanced camera RGB, shape (N, N, 3).
        mask : ndarray of bool
            Bare skin, shape (N, N).
        """
        face = self._flat(size)
        surface = conditioned_surface(face, camera, light, dict(self.applied))
        return surface.r_d, face.atlas.covered & (face.hair < MAX_SKIN_HAIR)

    def _melanin(self, points: Float32Array, regions: Mapping[str, Float32Array]) -> Float32Array:
        drawn = pigment.draw_melanin_map(
            points, regions, self.melanin, seed=self.seed, freckles=self.freckles
        )
        old = (self.age_years - 15.0) / 60.0
        step = (0.03 + 0.09 * old) * smooth_noise(points, (11.0, 5.0), seed=self.seed + 501)
        sunny = 0.2 + 0.8 * np.maximum(
            np.maximum(regions["forehead"], regions["temples"]), regions["cheeks"]
        )
        amount = 0.8 * min(max((self.age_years - 35.0) / 40.0, 0.0), 1.0)
        step += 0.8 * random_spots(
            points,
            0.5 * amount * sunny * (1.0 - regions["lips"]),
            cell_mm=9.0,
            radius_mm=(1.0, 3.2),
            seed=self.seed + 502,
            softness=6.0,
        )
        # Steps of log-odds relative to the limit, as in the map itself.
        odds = drawn / (pigment.MAX_MELANIN - drawn) * np.exp(step)
        return np.asarray(pigment.MAX_MELANIN * odds / (1.0 + odds), np.float32)


_FIELD_RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "age_years": (13.0, 90.0),
    "melanin": POPULATION_MELANIN_RANGE,
    "blood": (0.1, 4.0),
    "oil": (0.0, 3.0),
    "freckles": (0.0, 1.0),
    "beard": (0.0, 1.0),
    "head": (0, HEAD_SHAPES - 1),
    "seed": (0, 2**31 - 1),
}


@dataclass(frozen=True, slots=True)
class Group:
    """One row of table 1."""

    name: str
    count: int
    sex: Sex
    ethnicity: Ethnicity
    age_years: tuple[int, int]
    wears: bool = False
    """Whether its members use lotion or makeup."""


POPULATION_GROUPS: Final = (
    Group("caucasian male", 50, "male", "caucasian", (13, 59)),
    Group("caucasian female", 5, "female", "caucasian", (24, 55)),
    Group("caucasian female, lotion or makeup", 6, "female", "caucasian", (23, 56), wears=True),
    Group("asian male", 20, "male", "asian", (22, 74)),
    Group("asian female", 4, "female", "asian", (22, 65)),
    Group("asian female, lotion or makeup", 2, "female", "asian", (24, 30), wears=True),
)
"""Table 1: 87 people, 70 of them male."""

_WORN_PRODUCTS: Final = (("lotion",), ("makeup",), ("lotion", "makeup"))


def draw_population(*, seed: int = 0) -> tuple[Member, ...]:
    """Draw the population of table 1.

    Parameters
    ----------
    seed
        Seed of all draws, >= 0.

    Returns
    -------
    tuple of Member
        87, group by group in the order of `POPULATION_GROUPS`.

    Examples
    --------
    >>> people = draw_population()
    >>> len(people), sum(p.sex == "female" for p in people)
    (87, 17)
    >>> sorted(people[55].labels - {"freckles"})
    ['caucasian', 'female', 'lotion']
    """
    if seed < 0:
        raise PopulationError(f"seed: got {seed}, expected >= 0")
    members: list[Member] = []
    for row, group in enumerate(POPULATION_GROUPS):
        rng = np.random.default_rng([seed, 600, row])
        for index in range(group.count):
            members.append(_draw_member(group, index, len(members), rng))
    return tuple(members)


def get_member(name: str) -> Member:
    """Return a member of `draw_population` by name, "P01" to "P87".

    Raises
    ------
    PopulationError
        Unknown name.

    Examples
    --------
    >>> get_member("P56").group
    'caucasian female, lotion or makeup'
    """
    found = {person.name: person for person in draw_population()}
    if name not in found:
        raise PopulationError(f"member: got {name!r}, expected P01 to P{len(found)}")
    return found[name]


def shift_trait(
    members: Sequence[Member],
    trait: str,
    *,
    melanin: float = 1.0,
    blood: float = 1.0,
    products: Mapping[str, float] | None = None,
    fraction: float = 0.5,
    rng: np.random.Generator,
) -> tuple[Member, ...]:
    """Add a known trait to a random part of a population.

    Parameters
    ----------
    members
        The population.
    trait
        Name of the trait, which becomes a label of the changed members.
    melanin, blood
        Factors of the changed members' melanin and blood: a tan is ``melanin=1.5``.
    products
        Conditions with their amounts, 0 to 1, of the changed members; they replace previous amounts
        of the same conditions.
    fraction
        Fraction of the population that is changed, 0 to 1; rounded to whole members.
    rng
        Selects the changed members.

    Returns
    -------
    tuple of Member
        The same people in the same order; nothing else about them changes, so the ground truth of
        the trait is each one's difference from the member of the same index.

    Raises
    ------
    PopulationError
        The fraction, or a changed member, is out of range.

    Examples
    --------
    >>> people = draw_population()
    >>> tanned = shift_trait(people, "tan", melanin=1.5, rng=np.random.default_rng(1))
    >>> sum("tan" in person.labels for person in tanned)
    44
    """
    if not 0.0 <= fraction <= 1.0:
        raise PopulationError(f"fraction: got {fraction}, expected 0 to 1")
    chosen = set(rng.permutation(len(members))[: round(fraction * len(members))].tolist())
    worn = validate_conditions({} if products is None else products)
    return tuple(
        dataclasses.replace(
            member,
            melanin=member.melanin * melanin,
            blood=member.blood * blood,
            applied=tuple(validate_conditions(dict(member.applied) | worn).items()),
            marks=member.marks | {trait},
        )
        if index in chosen
        else member
        for index, member in enumerate(members)
    )


def _draw_member(group: Group, index: int, number: int, rng: np.random.Generator) -> Member:
    low, high = group.age_years
    age = float((low, high)[index] if index < 2 else rng.integers(low, high + 1))
    male, pale = group.sex == "male", group.ethnicity == "caucasian"
    bounds = (0.0085, 0.047) if pale else (0.011, 0.084)
    melanin = 0.0
    while not bounds[0] <= melanin <= bounds[1]:
        spread = float(rng.standard_normal())
        melanin = 0.0195 * np.exp(0.45 * spread) if pale else 0.031 * np.exp(0.4 * spread)
        melanin *= 1.0 if male else 0.69
    blood = float(np.exp(0.15 * rng.standard_normal())) * (1.0 if male else 0.8)
    aging = 1.0 - 0.006 * max(age - 30.0, 0.0)
    oil = float(np.exp(0.25 * rng.standard_normal())) * aging * (1.0 if male else 0.9)
    freckles = float(rng.uniform(0.0, 0.9 if pale else 0.35))
    stubble = float(rng.uniform(0.05, 1.0 if pale else 0.65))
    amounts = rng.uniform(0.6, 1.0, 2)
    worn = _WORN_PRODUCTS[index % len(_WORN_PRODUCTS)] if group.wears else ()
    return Member(
        name=f"P{number + 1:02d}",
        group=group.name,
        sex=group.sex,
        ethnicity=group.ethnicity,
        age_years=age,
        melanin=float(melanin),
        blood=min(max(blood, 0.1), 4.0),
        oil=min(oil, 3.0),
        freckles=freckles,
        beard=stubble if male and age >= 17.0 else 0.0,
        seed=int(rng.integers(0, 2**31 - 1)),
        head=int(rng.integers(HEAD_SHAPES)),
        applied=tuple((name, float(a)) for name, a in zip(worn, amounts, strict=False)),
    )


@lru_cache(maxsize=HEAD_SHAPES)
def _head_mesh(head: int) -> Mesh:
    return build_head(np.random.default_rng([head, 600]))


@lru_cache(maxsize=MAX_KEPT_HEADS)
def _lay_out_head(
    head: int, size: int
) -> tuple[Mesh, Atlas, Float32Array, Mapping[str, Float32Array]]:
    """Return a head, its texture layout, the texels on the mean head and its regions.

    A head takes 8 MB at 256 texels, 120 MB at 1024.
    """
    if not SIZE_RANGE[0] <= size <= SIZE_RANGE[1]:
        raise PopulationError(
            f"size: got {size}, expected {SIZE_RANGE[0]} to {SIZE_RANGE[1]} texels"
        )
    mesh = _head_mesh(head)
    atlas = unwrap(mesh, size)
    points = face_regions.to_mean_head(atlas.position_mm, mesh)
    return mesh, atlas, points, face_regions.region_masks(points)
