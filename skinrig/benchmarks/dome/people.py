"""Benchmark of the reflectance of facial regions over people, from simulated dome sessions.

Members of the population pass through the dome's simulator with sensor noise, through its
calibration and through the reconstruction. Two statistics describe the specular reflection of a
region. Both are defined for any BRDF, so that the ground truth needs no fitted lobe:

- specular reflectance: fraction of the light from `INCIDENCE_DEG` that the surface reflects within
  `MAX_REFLECTED_DEG` of the normal;
- roughness: that of Beckmann facets whose slopes contain as much light within the same angle. With
  t the slope of the half vector at a fixed difference angle, half of the facets of roughness m have
  t below m sqrt(ln 2).

The constant part of the reflection is subtracted from the truth, as eq. (6) of Weyrich et al. adds
it to R_d.
"""

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from model.skin import SkinAppearance
from reconstruction import brdf_basis
from reconstruction.pipeline.dome.lobes import weight_names
from reconstruction.pipeline.inputs import DomeOptions
from rigsim.light import surface_brdf
from rigsim.population.population import Member
from rigsim.scenes.dome.truth import COATING_MAPS
from skinrig.appearances.contents import intersect_valid
from skinrig.appearances.face_textures import TRUE_LANDMARKS_KEY
from skinrig.arrays import BoolArray, Float64Array, Int64Array
from skinrig.benchmarks.intervals.trials import reconstruct_maps, resimulate
from skinrig.benchmarks.people import PeopleValues, choose_members
from skinrig.benchmarks.results import Knobs, Timing
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.editing import surface_mixtures
from skinrig.planning.confirmation import calibrate_simulated

REGION_LANDMARKS: Final = {
    "forehead": ("forehead",),
    "nose": ("nose tip", "nose bridge"),
    "cheeks": ("cheek left", "cheek right"),
    "chin": ("chin",),
}
"""Landmarks at the centers of each region."""
REGION_RADIUS_MM: Final = 12.0
QUANTITY_NAMES: Final = ("specular reflectance", "roughness", "R_d red", "R_d green", "R_d blue")
INCIDENCE_DEG, MAX_REFLECTED_DEG, DIFFERENCE_DEG = 30.0, 70.0, 20.0
MAX_SLOPE: Final = 1.0
N_SLOPES: Final = 100
CAP_GRID: Final = (24, 24)
"""Directions of the specular reflectance, by polar angle and azimuth."""
N_TRUE_TEXELS: Final = 300
"""Texels of a region at which the true BRDF is evaluated, drawn at random."""
N_BASIS_BRDFS: Final = 16
"""Basis BRDFs of a face; with the 4 of the default, regions become alike."""
FULL_DOME: Final = {"lights": 48, "views": 6, "width_px": 480}
TOY_DOME: Final = {"lights": 24, "views": 4, "width_px": 200}
OMITTED_EFFECTS: Final = ("subsurface", "interreflections")
"""They take four fifths of the time. Without them no quantity changes by more than 1.5 %."""
DOME_SEED: Final = 0
"""Seed of the dome, the same for all people: one calibration serves all."""
TOY_PEOPLE: Final = 2
SURFACE_NORMAL: Final = (0.0, 0.0, 1.0)

Reflection = Callable[[Float64Array, Float64Array], Float64Array]
"""Return f_r of a surface with normal +z, (M,), 1/sr, by directions of light and view, (M, 3)."""


def measure_people(stage: BenchmarkStage) -> None:
    """Measure means, deviations and trends of regions' reflectance over people."""
    members = choose_members(1)[:TOY_PEOPLE] if stage.toy else choose_members(2)
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as place:
        people = capture_people(Path(place), members, TOY_DOME if stage.toy else FULL_DOME)
    timing = Timing.single((time.perf_counter() - began) / len(members))
    columns = np.arange(people.true.shape[1]).reshape(len(REGION_LANDMARKS), -1)
    for q, quantity in enumerate(QUANTITY_NAMES):
        for k, region in zip(columns[:, q].tolist(), REGION_LANDMARKS, strict=True):
            knobs: Knobs = {"region": region, "quantity": quantity}
            stage.add(knobs, timing, people.error(k), people.describe(k) | people.trends(k))
        stage.limits["exchange", quantity] = people.exchange_probability(columns[:, q])
    stage.limits["pull"] = people.largest_pull()


def capture_people(
    folder: Path, members: Sequence[Member], size: Mapping[str, int]
) -> PeopleValues:
    """Simulate, calibrate and reconstruct dome sessions of people.

    Parameters
    ----------
    folder
        Empty folder of the sessions.
    members
        Members of the population.
    size
        Lights, cameras and image width of the dome.

    Returns
    -------
    PeopleValues
        `QUANTITY_NAMES` of each region of `REGION_LANDMARKS`, quantities running fastest.
    """
    calibrate_dome(folder, size)
    rows = []
    for member in members:
        found, truth = capture_face(folder, size, subject=member.name)
        rows.append((*estimate_regions(found, truth), true_regions(truth)))
    values = np.array(rows).reshape(len(members), 3, -1)
    return PeopleValues(tuple(members), values[:, 0], values[:, 1], values[:, 2])


def calibrate_dome(folder: Path, size: Mapping[str, int]) -> None:
    """Simulate the targets of a dome and calibrate it into FOLDER/calibration.

    Parameters
    ----------
    folder
        Empty folder.
    size
        Lights, cameras and image width of the dome.
    """
    shown = dict.fromkeys(("charuco", "mirror", "white"), size)
    kinds = (("geometry", ("charuco",)), ("lights", ("mirror", "white")))
    calibrate_simulated("dome", folder, shown, kinds, seed=DOME_SEED)


def capture_face(
    folder: Path, size: Mapping[str, int], **subject: Any
) -> tuple[SkinAppearance, SkinAppearance]:
    """Simulate and reconstruct a face in a calibrated dome; return its maps and the ground truth.

    Parameters
    ----------
    folder
        Folder of `calibrate_dome`.
    size
        Lights, cameras and image width of the dome.
    subject
        Further fields of the dome's order, such as the subject and its conditions.
    """
    kept: Any = {"leave_out": OMITTED_EFFECTS, **size, **subject}
    done = resimulate("dome", folder, seed=DOME_SEED, **kept)
    want = ("normals_refined", "r_d", *weight_names(N_BASIS_BRDFS))
    return reconstruct_maps(folder, done, want, dome=DomeOptions(rank=N_BASIS_BRDFS))


def estimate_regions(
    found: SkinAppearance, truth: SkinAppearance
) -> tuple[Float64Array, Float64Array]:
    """Return the estimated quantities of each region, and their stated standard errors.

    Parameters
    ----------
    found
        Maps of R_d and weights of basis BRDFs.
    truth
        Ground truth, of which only the landmarks are used.

    Returns
    -------
    values, stderr : ndarray of float64, shape (R, 5)
        NaN without a valid texel; roughness has no stated standard error.
    """
    lobes = surface_mixtures.read(found)
    basis = surface_mixtures.load_materials(lobes.materials, lobes.light_radius_rad)
    albedo = found.maps["r_d"]
    valid = lobes.valid & intersect_valid(found.maps["position"], albedo)
    weights = lobes.weights().reshape(-1, len(lobes.mix))
    strength = lobes.mix @ basis.strength()
    values, errors = np.full((2, len(REGION_LANDMARKS), len(QUANTITY_NAMES)), np.nan)
    for r, texels in enumerate(_region_texels(found, truth, valid)):
        if not len(texels):
            continue
        own = weights[texels]
        mixture = own.mean(axis=0) @ lobes.mix

        def reflect(light: Float64Array, view: Float64Array, x: Float64Array = mixture) -> Any:
            return brdf_basis.evaluate(x, basis, light, view, SURFACE_NORMAL)

        specular = specular_reflectance(reflect)
        values[r] = specular, facet_roughness(reflect), *_mean(albedo.values, texels)
        if albedo.stderr is not None:
            errors[r, 2:] = _mean(albedo.stderr, texels)
        stated = np.stack([_stderr(one, texels) for one in lobes.maps], axis=-1)
        # errors of the weights at a point are one error of their common scale
        errors[r, 0] = specular * float((stated @ strength).sum() / (own @ strength).sum())
    return values, errors


def true_regions(truth: SkinAppearance) -> Float64Array:
    """Return the true quantities of each region, (R, 5), from the simulator's own BRDF.

    Parameters
    ----------
    truth
        Ground truth of a simulated dome session.
    """
    maps = truth.maps
    valid = intersect_valid(maps["position"], maps["r_d"])
    coating = COATING_MAPS if COATING_MAPS[0] in maps else ()
    rng = np.random.default_rng(0)
    values = np.full((len(REGION_LANDMARKS), len(QUANTITY_NAMES)), np.nan)
    for r, texels in enumerate(_region_texels(truth, truth, valid)):
        some = rng.choice(texels, min(N_TRUE_TEXELS, len(texels)), replace=False)
        names = ("roughness", "oil", "fuzz")
        parts = [maps["r_d"].values.reshape(-1, 3)[some]]
        parts += [maps[name].values.reshape(-1, 1)[some] for name in names]
        parts += [np.ones((len(some), 1))]  # valid texels have no hair
        parts += [maps[name].values.reshape(-1, 1)[some] for name in coating]
        packed = np.concatenate(parts, axis=1).astype(np.float32)
        floor = float(maps["r_d_floor"].values.reshape(-1)[some].mean())

        def reflect(
            light: Float64Array, view: Float64Array, packed: Any = packed, floor: float = floor
        ) -> Float64Array:
            heights = zip(light[:, 2], view[:, 2], strict=True)
            through = np.array([surface_brdf.boundary_transmittance(*pair) for pair in heights])
            each = np.repeat(packed, len(light), axis=0)
            pairs = (np.tile(directions, (len(packed), 1)) for directions in (light, view))
            lobes = surface_brdf.evaluate_brdf(each, SURFACE_NORMAL, *pairs)[1]
            mean = lobes.reshape(len(packed), -1).mean(axis=0)
            return np.asarray(mean - floor / np.pi * through)

        values[r] = (
            specular_reflectance(reflect),
            facet_roughness(reflect),
            *_mean(maps["r_d"].values, texels),
        )
    return values


def specular_reflectance(reflect: Reflection) -> float:
    """Return the fraction of light that a surface reflects, see the module's docstring.

    Examples
    --------
    >>> lambertian = lambda light, view: np.full(len(light), 1.0 / np.pi)
    >>> round(specular_reflectance(lambertian), 3), round(float(np.sin(np.radians(70))) ** 2, 3)
    (0.883, 0.883)
    """
    reflected, incident, projected_sr = _cap_directions()
    return float(reflect(incident, reflected) @ projected_sr)


def facet_roughness(reflect: Reflection) -> float:
    """Return the roughness of Beckmann facets with the same median slope.

    Examples
    --------
    >>> def facets(light, view):
    ...     half = light + view
    ...     cos = half[:, 2] / np.linalg.norm(half, axis=1)
    ...     slopes = np.exp((1.0 - cos**-2) / 0.3**2) / cos**4
    ...     return slopes / (light[:, 2] * view[:, 2])
    >>> round(facet_roughness(facets), 3)
    0.3
    """
    light, view, slope, to_density = _slope_directions()
    # the density of slopes times their measure t dt, cumulated to the middle of each step
    density = np.maximum(reflect(light, view) * to_density, 0.0) * slope
    below = np.cumsum(density) - 0.5 * density
    if not below[-1] > 0.0:
        return float("nan")
    middle = float(np.interp(0.5 * density.sum(), below, slope))
    return middle / float(np.sqrt(np.log(2.0)))


@cache
def _cap_directions() -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return reflected and incident directions (M, 3), and projected solid angles (M,), sr."""
    rows, columns = CAP_GRID
    bottom = np.cos(np.radians(MAX_REFLECTED_DEG))
    z, azimuth = np.meshgrid(
        1.0 - (1.0 - bottom) * (np.arange(rows) + 0.5) / rows,
        2.0 * np.pi * (np.arange(columns) + 0.5) / columns,
        indexing="ij",
    )
    ring = np.sqrt(1.0 - z**2)
    reflected = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], -1).reshape(-1, 3)
    angle = np.radians(INCIDENCE_DEG)
    incident = np.tile([np.sin(angle), 0.0, np.cos(angle)], (len(reflected), 1))
    each_sr = 2.0 * np.pi * (1.0 - bottom) / len(reflected)
    return reflected, incident, reflected[:, 2] * each_sr


@cache
def _slope_directions() -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Return light, view (M, 3), slope of the half vector (M,), and density over f_r (M,)."""
    slope = (np.arange(N_SLOPES) + 0.5) / N_SLOPES * MAX_SLOPE
    cos_h = 1.0 / np.sqrt(1.0 + slope**2)
    half = np.stack([slope * cos_h, np.zeros(N_SLOPES), cos_h], axis=-1)
    angle = np.radians(DIFFERENCE_DEG)
    aside = np.array([0.0, np.sin(angle), 0.0])
    light, view = (np.cos(angle) * half + side * aside for side in (1.0, -1.0))
    # f_r = D F G / (4 cos cos) with D = p(slope) / cos_h^4; F is constant, G nearly so
    return light, view, slope, light[:, 2] * view[:, 2] * cos_h**4


def _region_texels(
    appearance: SkinAppearance, truth: SkinAppearance, valid: BoolArray
) -> list[Int64Array]:
    """Return the flat indices of valid texels of each region."""
    landmarks: Any = truth.parameters[TRUE_LANDMARKS_KEY]
    place = appearance.maps["position"].values.reshape(-1, 3).astype(np.float64)
    out = []
    for names in REGION_LANDMARKS.values():
        far = [np.linalg.norm(place - np.array(landmarks[name]), axis=1) for name in names]
        near = np.min(far, axis=0) < REGION_RADIUS_MM
        out.append(np.flatnonzero(near & valid.reshape(-1)))
    return out


def _mean(values: Any, texels: Int64Array) -> Float64Array:
    return np.asarray(values.reshape(-1, 3)[texels].mean(axis=0), np.float64)


def _stderr(weights: Any, texels: Int64Array) -> Float64Array:
    if weights.stderr is None:
        return np.full(len(texels), np.nan)
    return np.asarray(weights.stderr.reshape(-1)[texels], np.float64)
