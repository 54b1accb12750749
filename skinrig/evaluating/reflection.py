"""Evaluate the predicted reflection in held-out light directions against ground truth."""

import io
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model import metrics
from model.brdf import tables as brdf_tables
from model.brdf.tables import BrdfBasis
from model.skin import SkinAppearance
from model.skin_reflectance import BASIS_FILE
from reconstruction import brdf_basis
from reconstruction.lumitexels.boundary_kernels import boundary_transmittance
from reconstruction.pipeline.dome.lobes import weight_names
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import Float64Array
from skinrig.evaluating.reflection_truth import TEST_FILE, render_sphere
from skinrig.evaluating.surface import MAX_MATCH_DISTANCE_MM

MAX_HELD_OUT_ERROR = 0.05


@dataclass(frozen=True, slots=True)
class HeldOutAccuracy:
    """Accuracy of the predicted reflection in held-out directions.

    Attributes
    ----------
    points, directions
        Numbers of compared points and directions.
    median, interval
        Median of |predicted - true| / true over points, directions and channels, with its 68 %
        bootstrap interval over points.
    highlights
        The same where specular reflection exceeds subsurface scattering; NaN if nowhere.
    """

    points: int
    directions: int
    median: float
    interval: tuple[float, float]
    highlights: float


def read_basis(appearance: SkinAppearance) -> BrdfBasis | None:
    """Return the reduced basis of an appearance's weights, or None."""
    if BASIS_FILE not in appearance.files:
        return None
    with np.load(io.BytesIO(appearance.files[BASIS_FILE]), allow_pickle=False) as stored:
        table, radius = stored["table"], float(stored["light_radius_rad"])
    if any(name not in appearance.maps for name in weight_names(table.shape[-1])):
        return None
    names = [f"mix {k}" for k in range(table.shape[-1])]
    return brdf_tables.basis_from_columns(table, names, light_radius_rad=radius)


def compare(
    appearance: SkinAppearance, truth: SkinAppearance, *, rng: np.random.Generator
) -> HeldOutAccuracy | None:
    """Predict the reflection at the test's points and directions, and compare it with the truth.

    Parameters
    ----------
    appearance
        With normals, albedo and lobes.
    truth
        With the file that `reflection_truth.make_test` made.
    rng
        For the bootstrap interval.

    Returns
    -------
    HeldOutAccuracy or None
        None if a required map or file is missing.
    """
    held = _read_test(appearance, truth)
    if held is None or not held[1].size:
        return None
    basis, at, test = held
    light, true_f = test["light"], test["f_r"]
    predicted = predict(appearance, basis, at, light, test["view"])
    usable = np.asarray((true_f > 0).all(axis=-1) & np.isfinite(predicted).all(axis=-1))
    error = np.abs(predicted - true_f) / np.where(true_f > 0, true_f, 1.0)
    by_point = np.array(
        [np.median(e[u]) if u.any() else math.nan for e, u in zip(error, usable, strict=True)]
    )
    _, interval = metrics.median_with_interval(by_point, rng=rng)
    shiny = usable & (test["surface"] > 0.5 * true_f.mean(axis=-1))
    return HeldOutAccuracy(
        points=at.size,
        directions=light.shape[1],
        median=float(np.median(error[usable])),
        interval=interval,
        highlights=float(np.median(error[shiny])) if shiny.any() else math.nan,
    )


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceTest:
    """Specular reflection at the test's points, by the fitted lobes and in truth.

    Attributes
    ----------
    texels
        Flat indices into the appearance, (S,).
    fitted, true
        f_r of the surface times the light's cosine at the appearance's normal, (S, K), 1/sr; 0
        below that normal's horizon.
    """

    texels: NDArray[np.intp]
    fitted: Float64Array
    true: Float64Array


def surface_test(appearance: SkinAppearance, truth: SkinAppearance) -> SurfaceTest | None:
    """Return the specular reflection of the lobes and of the truth at the test's points.

    Parameters
    ----------
    appearance
        With normals, albedo and lobes.
    truth
        With the file that `reflection_truth.make_test` made.

    Returns
    -------
    SurfaceTest or None
        None if a required map or file is missing.
    """
    held = _read_test(appearance, truth)
    if held is None:
        return None
    basis, at, test = held
    lobes, cos_light, cos_view = _lobes(appearance, basis, at, test["light"], test["view"])
    cosine = np.where((cos_light > 0) & (cos_view > 0), cos_light, 0.0)
    return SurfaceTest(at, lobes * cosine, test["surface"] * cosine)


def _read_test(
    appearance: SkinAppearance, truth: SkinAppearance
) -> tuple[BrdfBasis, NDArray[np.intp], dict[str, Float64Array]] | None:
    """Return basis, texels and test at the points that the appearance covers; None: no test."""
    basis = read_basis(appearance)
    if basis is None or TEST_FILE not in truth.files or "r_d" not in appearance.maps:
        return None
    with np.load(io.BytesIO(truth.files[TEST_FILE]), allow_pickle=False) as stored:
        at = _nearest_texels(stored["texel"], appearance, truth)
        known = at >= 0
        names = ("light", "view", "f_r", "surface")
        test = {name: stored[name][known].astype(np.float64) for name in names}
    return basis, at[known], test


def _lobes(
    appearance: SkinAppearance,
    basis: BrdfBasis,
    texels: NDArray[np.intp],
    light: Float64Array,
    view: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return f_r of the lobes, 1/sr, and the cosines of light and view, each (S, K)."""
    normals = read_normals(appearance, texels)
    weights = np.stack(
        [appearance.maps[name].values.reshape(-1)[texels] for name in weight_names(basis.size)],
        axis=-1,
    ).astype(np.float64)
    return (
        brdf_basis.evaluate(weights[:, None], basis, light, view, normals[:, None]),
        np.einsum("skc,sc->sk", light, normals),
        np.einsum("skc,sc->sk", view, normals),
    )


def predict(
    appearance: SkinAppearance,
    basis: BrdfBasis,
    texels: NDArray[np.intp],
    light: Float64Array,
    view: Float64Array,
) -> Float64Array:
    """Return f_r of an appearance, shape (S, K, 3), 1/sr; NaN below the horizon.

    Parameters
    ----------
    appearance
        With "r_d", weights and normals; refined normals are preferred.
    basis
        Basis of the weights, see `read_basis`.
    texels
        Flat indices, shape (S,).
    light, view
        Unit vectors away from the surface, rig frame, shape (S, K, 3).
    """
    lobes, cos_light, cos_view = _lobes(appearance, basis, texels, light, view)
    r_d = appearance.maps["r_d"].values.reshape(-1, 3)[texels].astype(np.float64)
    inside = r_d[:, None] / np.pi * boundary_transmittance(cos_light, cos_view)[..., None]
    above = (cos_light > 0) & (cos_view > 0)
    return np.where(above[..., None], inside + lobes[..., None], np.nan)


def read_normals(appearance: SkinAppearance, texels: NDArray[np.integer]) -> Float64Array:
    """Return normals at flat texel indices, (S, 3); refined ones are preferred."""

    def flat(name: str) -> Float64Array:
        return appearance.maps[name].values.reshape(-1, 3)[texels].astype(np.float64)

    if "normals_refined" not in appearance.maps:
        return flat("normals")
    good = intersect_valid(appearance.maps["normals_refined"]).reshape(-1)[texels]
    return np.where(good[:, None], flat("normals_refined"), flat("normals"))


def render_spheres(
    appearance: SkinAppearance, truth: SkinAppearance
) -> list[tuple[str, Float64Array, Float64Array | None]]:
    """Render the reflection of the test's sites on spheres: name, truth and estimate.

    The estimate is None at sites that the appearance does not cover. The list is empty without a
    test file.
    """
    basis = read_basis(appearance)
    if basis is None or TEST_FILE not in truth.files or "r_d" not in appearance.maps:
        return []
    with np.load(io.BytesIO(truth.files[TEST_FILE]), allow_pickle=False) as stored:
        names, texels, images = stored["site"], stored["site_texel"], stored["sphere"]
    own = _nearest_texels(texels, appearance, truth)
    out: list[tuple[str, Float64Array, Float64Array | None]] = []
    for name, texel, image in zip(names, own, images, strict=True):
        at, drawn = np.array([texel]), None

        def reflect(
            light: Float64Array, view: Float64Array, at: NDArray[np.intp] = at
        ) -> Float64Array:
            return predict(appearance, basis, at, light[None], view[None])[0]

        if texel >= 0:
            drawn, _ = render_sphere(reflect, read_normals(appearance, at)[0])
        out.append((str(name), np.asarray(image, np.float64), drawn))
    return out


def _nearest_texels(
    texels: NDArray[np.integer], appearance: SkinAppearance, truth: SkinAppearance
) -> NDArray[np.intp]:
    """Return the appearance's texel nearest to each texel of the truth; -1 if none is near."""
    from scipy.spatial import cKDTree

    place = appearance.maps["position"]
    texel = np.flatnonzero(intersect_valid(place, appearance.maps["r_d"]))
    if not len(texel):
        return np.full(len(texels), -1, np.intp)
    tree = cKDTree(place.values.reshape(-1, 3)[texel])
    true_place = truth.maps["position"].values.reshape(-1, 3)[texels]
    distance, index = tree.query(true_place, distance_upper_bound=MAX_MATCH_DISTANCE_MM)
    return np.where(np.isfinite(distance), texel[np.minimum(index, len(texel) - 1)], -1)
