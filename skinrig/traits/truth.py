"""Simulated populations whose traits are known: samples as measured, and what is true of them.

Samples of the surface are mean mixtures of materials fitted to noisy light from points of a face;
those of the albedo are noisy R_d maps in a common map. The truth comes from the simulator alone:
the light of the same points without noise, with the trait and without.

What of the surface's light looks like light from inside cannot be told from it: eq. (6) of Weyrich
et al. gives R_d the least of pi f / (T T), floor of the surface included. The true change of the
surface is therefore that beyond its floor. It matters for powder alone, whose grains scatter nearly
evenly.
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
"""Texels a side of the textures that points of the surface are drawn from."""
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
    """Give each person one condition in turn, instead of those they had, in random order.

    Parameters
    ----------
    members
        The population.
    conditions
        Of `rigsim.population.conditions.CONDITION_NAMES`; "normal" is nothing.
    amounts
        Range of even draws.
    rng
        Draws order and amounts.
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
    """Return which members have which labels, (n,) each."""
    return {name: np.array([name in person.labels for person in members]) for name in names}


def surface_points(person: Member, count: int, *, rng: np.random.Generator) -> Float32Array:
    """Return what `count` random places of a face's bare skin reflect by, (count, 7 or 11)."""
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
    """Fit materials to points of a face and return their mean mixture, (59,).

    Parameters
    ----------
    points
        See `surface_points`.
    basis
        The materials.
    pairs
        Of light and view at each point; R_d is estimated from the same samples.
    noise
        Standard deviation of a sample as a fraction of the radiance plus 2 % of white's.
    rng
        Draws directions and noise.
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
    """Draw unit vectors (..., 3) evenly over the cap above the horizon about +z."""
    z = rng.uniform(MIN_SAMPLED_COSINE, 1.0, shape)
    turn = rng.uniform(0.0, 2.0 * np.pi, shape)
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class LobeChange:
    """What a trait truly changes in what surfaces reflect.

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
        """Return the cosine between the truth and what a mixture of materials (59,) reflects."""
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
    """Return the mean changes of the surface's light between the same people twice.

    Parameters
    ----------
    before, after
        The same people without any trait, and with each of several.
    points
        Of each face.
    pairs
        Of light and view.
    rng
        Draws points and directions.
    """
    light, view = sample_directions((pairs,), rng=rng), sample_directions((pairs,), rng=rng)
    heights = zip(light[:, 2], view[:, 2], strict=True)
    through = np.array([surface_brdf.boundary_transmittance(*pair) for pair in heights])
    streams = [int(n) for n in rng.integers(2**31, size=len(before))]

    def mean(people: Sequence[Member]) -> Float64Array:
        total = np.zeros(pairs)
        for person, stream in zip(people, streams, strict=True):
            # the same stream draws the same points of the same face again
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
    """The heads of a population laid out in one common map.

    Attributes
    ----------
    frame : CommonFrame
    charts : mapping of int to Chart
        Of each head.
    size : int
        Texels a side of the faces' textures.
    """

    frame: CommonFrame
    charts: Mapping[int, TexelChart]
    size: int

    @classmethod
    def of(cls, members: Sequence[Member], *, size: int, common: int) -> CommonFaces:
        """Lay out the heads of some members, by their true landmarks.

        Parameters
        ----------
        size
            Texels a side of the faces' textures.
        common
            Pixels a side of the common map.
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
        """Return a face's R_d in the common map, with relative noise at each pixel."""
        r_d, skin = person.r_d(self.size, TRUTH_CAMERA, TRUTH_ILLUMINANT)
        image, valid = self.charts[person.head].gather(r_d, skin)
        image = image * (1.0 + noise * rng.standard_normal(image.shape).astype(np.float32))
        return AlbedoSample(np.maximum(image, 1e-4).astype(np.float32), valid)
