"""Simulate datasets A and B: BRDF samples at points of faces in a dome, and their fitted weights.

A point is a random texel of bare skin with its own normal, observed by a dome's cameras under its
lights, without shadows. Samples have noise. R_d is estimated as with the dome and subtracted; the
weights of the tabulated materials are fitted to the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from capture.rig import load_rig
from model import fresnel
from model.brdf import tables as brdf_tables
from reconstruction import brdf_basis, diffuse_albedo
from reconstruction.brdf_basis import space as brdf_space
from rigsim.light import surface_brdf
from rigsim.light.surface_brdf import SkinSurface
from rigsim.population.conditions import CONDITION_NAMES, conditioned_surface
from rigsim.population.population import MAX_SKIN_HAIR, Member, draw_population
from skinrig.arrays import BoolArray, Float32Array, Float64Array, Int64Array

MIN_COS_LIGHT: Final = 0.12
MIN_COS_VIEW: Final = 0.25
RADIANCE_NOISE: Final = 0.02
"""Standard deviation of a sample's radiance, as a fraction of its sum with 2 % of white."""
NOISE_FLOOR_OF_WHITE: Final = 0.02
SAMPLES_PER_POINT: Final = 160
"""Pairs of light and view per point, sampled from those above the horizon."""
POINTS_PER_FIT: Final = 1000
"""Points per batch of the fit."""
MAX_REPEATED_POINTS: Final = 100
"""Maximum number of points per label that are fitted twice to estimate the error of noise."""
DATASET_TEXELS: Final = 256
DATASET_A_MEMBER: Final = 4
"""Member of table 1 whose face is used for dataset A."""


class DatasetError(ValueError):
    """A dataset with these options cannot be created."""


@dataclass(frozen=True, slots=True)
class CapturedSamples:
    """BRDF samples of P points, as `reconstruction.brdf_basis.surface_samples` takes them."""

    f: Float64Array
    """(P, M, 3), 1/sr, with noise."""
    variance: Float64Array
    light: Float64Array
    """(P, M, 3), unit vectors."""
    view: Float64Array
    normals: Float64Array
    """(P, 3)."""
    r_d: Float64Array
    """The true R_d, (P, 3)."""
    surface: Float64Array
    """The true surface term, (P, M), 1/sr."""
    clean: Float64Array
    """The samples without noise, (P, M, 3), 1/sr."""

    def again(self, count: int, *, rng: np.random.Generator) -> CapturedSamples:
        """Return the first points with independent noise."""
        part = {name: getattr(self, name)[:count] for name in self.__dataclass_fields__}
        sigma = np.sqrt(part["variance"])
        noise = sigma * rng.standard_normal(sigma.shape)
        return CapturedSamples(**(part | {"f": part["clean"] + noise}))


@dataclass(frozen=True, slots=True)
class Dataset:
    """Weights of the materials at points, with the labels of the points."""

    name: str
    weights: Float64Array
    """Weights of the materials, (P, K), at least 0."""
    label: Int64Array
    """Index into `labels` of each point."""
    labels: tuple[str, ...]
    """Conditions or people."""
    noise: float
    """Error of noise alone, relative to the BRDFs: the difference of two fits of one point with
    independent noise over sqrt(2). No basis should explain it. NaN if it was not measured."""
    lost: int
    """Number of points without a fit."""


def sample_surface(
    surface: SkinSurface,
    position_mm: Float32Array,
    mask: BoolArray,
    count: int,
    *,
    samples: int = SAMPLES_PER_POINT,
    rng: np.random.Generator,
) -> CapturedSamples:
    """Return samples of random points of a face.

    Parameters
    ----------
    surface
        Reflectance of the face.
    position_mm
        Positions of its texels, (N, N, 3), rig frame.
    mask
        Texels to sample from, (N, N).
    count
        Number of points P.
    samples
        Pairs of light and view per point.
    rng
        Generator of texels, pairs and noise.

    Raises
    ------
    DatasetError
        If no texel has this many pairs.

    Notes
    -----
    Texels are drawn without replacement while there are enough of them.
    """
    rig = load_rig("dome")
    lights = np.array([light.position_mm for light in rig.lights])
    views = np.array([view.position_mm for view in rig.views])
    texels = np.flatnonzero(mask)
    # A third more than needed, because some are too oblique to lights or cameras.
    few = max(count + count // 3, 64)
    drawn = rng.choice(texels, few, replace=few > len(texels)) if len(texels) else texels
    normal = surface.normal.reshape(-1, 3)[drawn].astype(np.float64)
    place = position_mm.reshape(-1, 3)[drawn].astype(np.float64)
    above_l, above_v = (
        _cosines_above_horizon(lights, place, normal),
        _cosines_above_horizon(views, place, normal),
    )
    pairs = (above_l >= MIN_COS_LIGHT).sum(1) * (above_v >= MIN_COS_VIEW).sum(1)
    able = np.flatnonzero(pairs >= samples)
    if not len(able):
        raise DatasetError(
            f"samples: got {samples} per point, expected at most {int(pairs.max(initial=0))}, the "
            f"pairs of light and view at the best of {len(drawn)} points"
        )
    chosen = able[:count] if len(able) >= count else rng.choice(able, count)
    normal, place = normal[chosen], place[chosen]
    valid = (above_v[chosen][:, :, None] >= MIN_COS_VIEW) & (
        above_l[chosen][:, None, :] >= MIN_COS_LIGHT
    )
    order = np.argsort(np.where(valid, rng.random(valid.shape), 2.0).reshape(count, -1), axis=1)
    view_index, light_index = np.divmod(order[:, :samples], len(lights))
    to_light = _unit(lights[light_index] - place[:, None])
    to_view = _unit(views[view_index] - place[:, None])
    packed = np.repeat(surface.packed().reshape(len(mask) ** 2, -1)[drawn[chosen]], samples, axis=0)
    clean, specular = surface_brdf.evaluate_brdf(
        packed, np.repeat(normal, samples, axis=0), to_light.reshape(-1, 3), to_view.reshape(-1, 3)
    )
    f = clean.astype(np.float64).reshape(count, samples, 3)
    mu = np.einsum("pmc,pc->pm", to_light, normal)[..., None]
    sigma = RADIANCE_NOISE * (f * mu + NOISE_FLOOR_OF_WHITE / np.pi) / mu
    return CapturedSamples(
        f=f + sigma * rng.standard_normal(f.shape),
        variance=np.maximum(sigma, 1e-9) ** 2,
        light=to_light,
        view=to_view,
        normals=normal,
        r_d=surface.r_d.reshape(-1, 3)[drawn[chosen]].astype(np.float64),
        surface=specular.astype(np.float64).reshape(count, samples),
        clean=f,
    )


def fit_materials(
    captured: CapturedSamples, basis: brdf_tables.BrdfBasis
) -> brdf_basis.BasisWeights:
    """Fit the materials' weights to samples minus their estimated diffuse part."""
    samples = (captured.f, captured.light, captured.view, captured.normals)
    known: dict[str, Any] = {"eta": fresnel.ETA_SKIN, "variance": captured.variance}
    found = diffuse_albedo.estimate(*samples, **known)
    given = brdf_basis.surface_samples(*samples, found.r_d, **known)
    return brdf_basis.fit_weights(given, basis)


def sample_one_person(points: int, *, rng: np.random.Generator) -> Dataset:
    """Return points of dataset A's face without a condition."""
    person = draw_population()[DATASET_A_MEMBER]
    return _collect_points("one person", {"normal": points}, lambda _: _skin(person, {}), rng=rng)


def build_dataset_a(
    points: int,
    *,
    conditions: Sequence[str] = CONDITION_NAMES,
    progress: Callable[[str], None] | None = None,
    rng: np.random.Generator,
) -> Dataset:
    """Return points of one face under seven conditions, as many of each.

    Parameters
    ----------
    points
        Number of points in total.
    conditions
        Of `rigsim.population.conditions.CONDITION_NAMES`, each of amount 1.
    progress
        Called with each condition's name.
    rng
        Generator of points, pairs and noise.
    """
    if not conditions or points < len(conditions):
        raise DatasetError(
            f"points: got {points} for {len(conditions)} conditions, expected at least one per "
            "condition"
        )
    person = draw_population()[DATASET_A_MEMBER]
    share = np.diff(np.linspace(0, points, len(conditions) + 1).round().astype(int))
    counts = dict(zip(conditions, share.tolist(), strict=True))
    return _collect_points(
        "dataset A", counts, lambda k: _skin(person, {conditions[k]: 1.0}), progress, rng=rng
    )


def build_dataset_b(
    points: int,
    *,
    members: Sequence[Member] | None = None,
    progress: Callable[[str], None] | None = None,
    rng: np.random.Generator,
) -> Dataset:
    """Return points of each member of a population.

    Parameters
    ----------
    points
        Number of points per member.
    members
        None: the 87 of `rigsim.population.population.draw_population`.
    progress
        Called with each member's name.
    rng
        Generator of points, pairs and noise.
    """
    people = draw_population() if members is None else tuple(members)
    if not people or points < 1:
        raise DatasetError(
            f"points: got {points} for {len(people)} people, expected 1 or more of each"
        )
    counts = dict.fromkeys((person.name for person in people), points)
    return _collect_points("dataset B", counts, lambda k: _skin(people[k], None), progress, rng=rng)


Skin = tuple[SkinSurface, Float32Array, BoolArray]


def _skin(member: Member, conditions: dict[str, float] | None) -> Skin:
    """Return reflectance, positions and bare-skin mask of a member under conditions."""
    rig = load_rig("dome")
    camera, light = rig.views[0].spectral_sensitivity, rig.lights[0].illuminant
    worn = dict(member.applied) if conditions is None else conditions
    face = member.face(DATASET_TEXELS)
    surface = conditioned_surface(face, camera, light, worn)
    return surface, face.atlas.position_mm, face.atlas.covered & (face.hair < MAX_SKIN_HAIR)


def _collect_points(
    name: str,
    counts: Mapping[str, int],
    skin: Callable[[int], Skin],
    progress: Callable[[str], None] | None = None,
    *,
    rng: np.random.Generator,
) -> Dataset:
    """Return the dataset of points with the given counts per label."""
    basis = brdf_tables.default_basis()
    weights, label = [], []
    twice: tuple[list[Float64Array], list[Float64Array]] = ([], [])
    lost = 0
    for k, (of, count) in enumerate(counts.items()):
        if progress is not None:
            progress(f"{name}: {of}")
        surface, place, where = skin(k)
        for start in range(0, count, POINTS_PER_FIT):
            some = min(POINTS_PER_FIT, count - start)
            seen = sample_surface(surface, place, where, some, rng=rng)
            fit = fit_materials(seen, basis)
            good = fit.valid & (fit.weights @ basis.strength() > 0.0)
            lost += int(np.count_nonzero(~good))
            weights.append(fit.weights[good])
            label.append(np.full(np.count_nonzero(good), k))
            if start == 0:
                few = min(MAX_REPEATED_POINTS, len(good))
                other = fit_materials(seen.again(few, rng=rng), basis)
                both = good[:few] & other.valid
                twice[0].append(fit.weights[:few][both])
                twice[1].append(other.weights[both])
    shares = np.concatenate(weights)
    kept = brdf_space.is_constrained(shares, basis)
    again = [np.concatenate(part) for part in twice]
    held = brdf_space.is_constrained(again[0], basis) & brdf_space.is_constrained(again[1], basis)
    return Dataset(
        name,
        shares[kept],
        np.concatenate(label)[kept],
        tuple(counts),
        brdf_space.repeat_distance(again[0][held], again[1][held], basis),
        lost + int(np.count_nonzero(~kept)),
    )


def _unit(vectors: Float64Array) -> Float64Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _cosines_above_horizon(
    positions_mm: Float64Array, points_mm: Float64Array, normals: Float64Array
) -> Float64Array:
    """Return cosines between normals and directions to positions, (points, positions)."""
    way = _unit(positions_mm[None] - points_mm[:, None])
    return np.einsum("pkc,pc->pk", way, normals)
