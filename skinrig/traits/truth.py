"""Simulate populations with known traits: noisy samples and ground truth.

Surface samples are mean mixtures of materials fitted to noisy BRDF samples at points of a face.
Albedo samples are noisy R_d maps in a common map. The ground truth is from the simulator alone: the
reflection of the same points without noise, with and without the trait.

Constant specular reflection cannot be separated from subsurface scattering: eq. (6) of Weyrich et
al. estimates R_d as the minimum of pi f / (T T), which includes the specular minimum (floor). The
true change of the surface is therefore the change beyond this floor. The difference matters only
for powder, whose grains scatter nearly uniformly.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from model.brdf.tables import BrdfBasis
from reconstruction import brdf_basis, diffuse_albedo
from reconstruction.correspondence import charts as common_charts
from reconstruction.correspondence import common_parameterization as parameterization
from reconstruction.correspondence.charts import TexelChart
from reconstruction.correspondence.common_parameterization import CommonFrame
from rigsim.light import surface_brdf
from rigsim.population import conditions as skin_conditions
from rigsim.population.population import Member
from skinrig.arrays import BoolArray, Float32Array, Float64Array
from skinrig.traits.albedo_vectors import AlbedoSample

LabelMasks = dict[str, BoolArray]

TRUTH_CAMERA: Final = "Nikon 5100 (NPL)"
TRUTH_ILLUMINANT: Final = "D55"
TRUTH_TEXELS: Final = 64
"""Texels per side of the textures from which points of the surface are sampled."""
ETA: Final = 1.4
MIN_SAMPLED_COSINE: Final = 0.12
MIN_BARE_FRACTION: Final = 0.98
ALBEDO_NOISE: Final = 0.01
"""Relative noise of R_d at a pixel of the common map."""


def assign_conditions(
    members: Sequence[Member],
    conditions: Sequence[str],
    *,
    amounts: tuple[float, float] = (0.8, 1.0),
    rng: np.random.Generator,
) -> tuple[Member, ...]:
    """Assign one condition to each person, in turn over a random order, replacing their own.

    Parameters
    ----------
    members
        The population.
    conditions
        Of `rigsim.population.conditions.CONDITION_NAMES`; "normal" is without a condition.
    amounts
        Range of the uniformly distributed amounts.
    rng
        Generator of order and amounts.
    """
    order = rng.permutation(len(members))
    given: list[Member] = list(members)
    for place, index in enumerate(order):
        name = conditions[place % len(conditions)]
        worn = {} if name == "normal" else {name: float(rng.uniform(*amounts))}
        applied = tuple(skin_conditions.validate_conditions(worn).items())
        given[index] = dataclasses.replace(members[index], applied=applied)
    return tuple(given)


def label_members(members: Sequence[Member], names: Sequence[str]) -> LabelMasks:
    """Return the members with each label, (n,) bool by label."""
    return {name: np.array([name in person.labels for person in members]) for name in names}


def surface_points(person: Member, count: int, *, rng: np.random.Generator) -> Float32Array:
    """Return reflectance parameters at `count` random points of bare skin, (count, 7 or 11)."""
    surface = person.surface(TRUTH_TEXELS, TRUTH_CAMERA, TRUTH_ILLUMINANT)
    packed = surface.packed()
    length = np.linalg.norm(surface.normal, axis=-1)
    bare = np.flatnonzero(((surface.bare > MIN_BARE_FRACTION) & (length > 0.5)).reshape(-1))
    return packed.reshape(-1, packed.shape[-1])[rng.choice(bare, count)]


def mean_mixture(
    points: Float32Array,
    basis: BrdfBasis,
    *,
    pairs: int = 240,
    noise: float = 0.02,
    rng: np.random.Generator,
) -> Float64Array:
    """Fit the materials' weights at points of a face and return their mean, (59,).

    Parameters
    ----------
    points
        See `surface_points`.
    basis
        Basis BRDFs of the materials.
    pairs
        Pairs of light and view per point; R_d is estimated from the same samples.
    noise
        Standard deviation of a sample, as a fraction of its radiance plus 2 % of white's.
    rng
        Generator of directions and noise.
    """
    shape = (len(points), pairs)
    light, view = sample_directions(shape, rng=rng), sample_directions(shape, rng=rng)
    up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    each = zip(points, up, light, view, strict=True)
    f = np.stack([surface_brdf.evaluate_brdf(*one)[0] for one in each]).astype(np.float64)
    cosine = light[..., 2:]
    sigma = noise * (f * cosine + 0.02 / np.pi) / cosine
    f += sigma * rng.standard_normal(f.shape)
    variance = sigma**2
    r_d = diffuse_albedo.estimate(f, light, view, up, eta=ETA, variance=variance).r_d
    samples = brdf_basis.surface_samples(f, light, view, up, r_d, eta=ETA, variance=variance)
    found = brdf_basis.fit_weights(samples, basis)
    return np.asarray(found.weights[found.valid].mean(axis=0))


def sample_directions(shape: tuple[int, ...], *, rng: np.random.Generator) -> Float64Array:
    """Sample unit vectors (..., 3) uniformly in solid angle over a cap about +z."""
    z = rng.uniform(MIN_SAMPLED_COSINE, 1.0, shape)
    turn = rng.uniform(0.0, 2.0 * np.pi, shape)
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class LobeChange:
    """True change of specular reflection by a trait.

    Attributes
    ----------
    light, view : ndarray, shape (M, 3)
        Directions about +z.
    radiance : ndarray, shape (M,)
        Change of the mean BRDF of the surface beyond its floor, times the cosine of the light,
        1/sr.
    """

    light: Float64Array
    view: Float64Array
    radiance: Float64Array

    def cosine(self, vector: ArrayLike, basis: BrdfBasis) -> float:
        """Return the cosine between the true change and that of a mixture of materials, (59,)."""
        shown = basis.evaluate(self.light, self.view, [0.0, 0.0, 1.0]) @ np.asarray(vector)
        shown = shown * self.light[:, 2]
        size = float(np.linalg.norm(shown) * np.linalg.norm(self.radiance))
        return float(shown @ self.radiance) / size if size > 0.0 else 0.0


def lobe_changes(
    before: Sequence[Member],
    after: Mapping[str, Sequence[Member]],
    *,
    points: int = 60,
    pairs: int = 1000,
    rng: np.random.Generator,
) -> dict[str, LobeChange]:
    """Return the mean change of specular reflection by each trait, over the same people.

    Parameters
    ----------
    before, after
        The same people without traits, and with each trait.
    points
        Points per face.
    pairs
        Pairs of light and view.
    rng
        Generator of points and directions.
    """
    light, view = sample_directions((pairs,), rng=rng), sample_directions((pairs,), rng=rng)
    heights = zip(light[:, 2], view[:, 2], strict=True)
    through = np.array([surface_brdf.boundary_transmittance(*pair) for pair in heights])
    streams = [int(n) for n in rng.integers(2**31, size=len(before))]

    def mean(people: Sequence[Member]) -> Float64Array:
        total = np.zeros(pairs)
        for person, stream in zip(people, streams, strict=True):
            # the same seed samples the same points of a face with and without the trait
            packed = surface_points(person, points, rng=np.random.default_rng(stream))
            floors = surface_brdf.min_surface_reflection(packed) / np.pi
            for one, floor in zip(packed, floors, strict=True):
                lobe = surface_brdf.evaluate_brdf(one, [0.0, 0.0, 1.0], light, view)[1]
                total += (lobe - floor * through) * light[:, 2]
        return total / (points * len(people))

    bare = mean(before)
    return {name: LobeChange(light, view, mean(people) - bare) for name, people in after.items()}


@dataclass(frozen=True, slots=True, eq=False)
class CommonFaces:
    """Heads of a population in one common map.

    Attributes
    ----------
    frame : CommonFrame
    charts : mapping of int to Chart
        Chart of each head.
    size : int
        Texels per side of the faces' textures.
    """

    frame: CommonFrame
    charts: Mapping[int, TexelChart]
    size: int

    @classmethod
    def of(cls, members: Sequence[Member], *, size: int, common: int) -> CommonFaces:
        """Map the heads of members into a common map by their true landmarks.

        Parameters
        ----------
        size
            Texels per side of the faces' textures.
        common
            Pixels per side of the common map.
        """
        by_head = {person.head: person for person in members}
        faces = {head: person.face(size) for head, person in by_head.items()}
        marks = {head: face.landmarks_mm() for head, face in faces.items()}
        names, places = parameterization.average_landmarks(list(marks.values()))
        unrolled = [
            parameterization.Cylinder(marks[head]["nose tip"]).unroll(
                face.atlas.position_mm[face.atlas.covered]
            )
            for head, face in faces.items()
        ]
        frame = parameterization.fit_common_frame(names, places, unrolled, size=common)
        charts = {
            head: common_charts.chart_texels(
                face.atlas.position_mm,
                face.atlas.covered,
                parameterization.fit_correspondence(marks[head], frame),
                frame,
            )
            for head, face in faces.items()
        }
        return cls(frame, charts, size)

    def albedo(self, person: Member, *, noise: float, rng: np.random.Generator) -> AlbedoSample:
        """Return a face's R_d in the common map, with relative noise per pixel."""
        r_d, skin = person.r_d(self.size, TRUTH_CAMERA, TRUTH_ILLUMINANT)
        image, valid = self.charts[person.head].gather(r_d, skin)
        image = image * (1.0 + noise * rng.standard_normal(image.shape).astype(np.float32))
        return AlbedoSample(np.maximum(image, 1e-4).astype(np.float32), valid)
