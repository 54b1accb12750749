"""Light directions from images alone, up to a linear map: the space that a matte surface spans.

Under N lights the lit samples of P points of a matte surface have rank 3, Y = S B^T. Shadows and
highlights do not follow and lose their weight. The list of lights is not used: a wrong list leaves
S unchanged, and a linear map A that takes most rows of S to the listed directions shows which rows
of the list are wrong (Hayakawa 1994; Belhumeur, Kriegman and Yuille 1999).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float64Array

MAX_POINTS = 1500
SHADOW_FRACTION = 0.12
"""Of a point's bright sample: darker samples count as shadowed."""
HIGHLIGHT_FACTOR = 1.6
"""Of a point's bright sample: brighter samples count as highlights."""
BRIGHT_QUANTILE = 0.85
N_STEPS, N_PLAIN_STEPS = 30, 5
START_FRACTION = 0.5
"""Of the points, those lit by most lights, that are factored first."""
TUKEY_CONSTANT = 4.7
"""Residual, in standard deviations, at which Tukey's biweight is zero."""
N_FRAMES_PER_DRAW = 4
MIN_ANGLE_DEG = 6.0
"""Least angle between an estimated and a listed direction that calls the listed one wrong."""
MAX_COUNTED_DEG = 15.0
MAX_CONDITION = 1e6
MIN_RESIDUAL = 2e-3
"""Residual, over a bright sample, below which lights fit equally well."""
SPREAD_FACTOR = 4.0
"""The limit is at least this many robust deviations of the angles that agree."""


@dataclass(frozen=True, slots=True)
class ShadingSpace:
    """Factors of the lit samples: ``samples = lights @ points.T``.

    Attributes
    ----------
    lights
        (N, 3), up to a common linear map.
    points
        (P, 3), up to the inverse of its transpose; over each point's bright sample.
    weights
        (N, P), 0 for shadows, highlights and unusable samples.
    misfit
        Robust standard deviation of the residual, over a bright sample.
    singular_ratio
        Third singular value of the light vectors over the first; near 0 where the images hardly
        differ.
    """

    lights: Float64Array
    points: Float64Array
    weights: Float64Array
    misfit: float
    singular_ratio: float


@dataclass(frozen=True, slots=True)
class Agreement:
    """Directions of a shading space in the frame of a list.

    Attributes
    ----------
    directions
        (N, 3), unit vectors.
    strength
        (N,), over the median of the agreeing lights.
    angle_deg
        (N,), between estimated and listed direction.
    limit_deg
        Angle from which a listed direction is wrong.
    misfit
        Median length of the difference to the listed unit vectors, at equal strengths, of the
        lights that agree.
    """

    directions: Float64Array
    strength: Float64Array
    angle_deg: Float64Array
    limit_deg: float
    misfit: float

    @property
    def score_deg(self) -> float:
        """Mean angle between estimated and listed directions, each counted up to 15 degrees."""
        return float(np.minimum(self.angle_deg, MAX_COUNTED_DEG).mean())

    @property
    def agrees(self) -> BoolArray:
        """(N,): whether the listed direction is right."""
        return self.angle_deg < self.limit_deg


def choose_points(
    gray: Float64Array, usable: BoolArray, inside: BoolArray, rng: np.random.Generator
) -> tuple[Float64Array, BoolArray]:
    """Return samples (N, P) of bright points, and which of them are usable."""
    n = len(gray)
    flat, good = gray.reshape(n, -1), usable.reshape(n, -1)
    places = np.flatnonzero(inside.reshape(-1) & (good.sum(axis=0) * 2 > n))
    if places.size > 20 * MAX_POINTS:
        places = np.sort(rng.choice(places, 20 * MAX_POINTS, replace=False))
    bright = np.quantile(flat[:, places], 0.9, axis=0)
    places = places[bright > 0.2 * np.quantile(bright, 0.95)] if places.size else places
    if places.size > MAX_POINTS:
        places = np.sort(rng.choice(places, MAX_POINTS, replace=False))
    return flat[:, places].astype(np.float64), good[:, places]


def fit_shading_space(samples: Float64Array, usable: BoolArray) -> ShadingSpace:
    """Factor samples (N, P) by alternating weighted least squares with Tukey's biweight.

    The half of the points that most lights reach is factored first: where many points are in cast
    shadow, a start from all of them can end with the lights of one side wrong.
    """
    bright = np.quantile(np.where(usable, samples, 0.0), BRIGHT_QUANTILE, axis=0)
    kept = bright > 0.0
    scaled = samples[:, kept] / bright[kept]
    clear = usable[:, kept]
    lit = clear & (scaled > SHADOW_FRACTION) & (scaled < HIGHLIGHT_FACTOR)
    count = lit.sum(axis=0)
    most = count >= np.quantile(count, 1.0 - START_FRACTION) if count.size else kept[kept]
    left, size, _ = np.linalg.svd(np.where(clear, scaled, 0.0)[:, most], full_matrices=False)
    first = _alternate(scaled[:, most], lit[:, most], left[:, :3] * size[:3], N_PLAIN_STEPS)
    lights, points, weights, misfit = _alternate(scaled, lit, first[0], 0)
    whole = np.zeros(samples.shape)
    whole[:, kept] = weights
    every = np.zeros((samples.shape[1], 3))
    every[kept] = points
    singular = np.linalg.svd(lights, compute_uv=False)
    return ShadingSpace(lights, every, whole, misfit, float(singular[2] / singular[0]))


def _alternate(
    scaled: Float64Array, lit: BoolArray, lights: Float64Array, plain_steps: int
) -> tuple[Float64Array, Float64Array, Float64Array, float]:
    """Return lights (N, 3), points (P, 3), weights (N, P) and misfit of scaled samples (N, P).

    The first steps, `plain_steps`, weight all lit samples alike.
    """
    weights, misfit = lit.astype(np.float64), 1.0
    points = np.zeros((scaled.shape[1], 3))
    for step in range(N_STEPS):
        points = _solve(weights.T, scaled.T, lights)
        lights = _solve(weights, scaled, points)
        spread = np.linalg.cholesky(np.linalg.inv(points.T @ points / len(points) + _ridge(points)))
        points, lights = points @ spread, lights @ np.linalg.inv(spread).T
        if step >= plain_steps:
            residual = scaled - lights @ points.T
            misfit = max(1.4826 * float(np.median(np.abs(residual[lit]))), 1e-5)
            weights = lit * np.maximum(1.0 - (residual / (TUKEY_CONSTANT * misfit)) ** 2, 0.0) ** 2
    return lights, points, weights, misfit


def _ridge(rows: Float64Array) -> Float64Array:
    return np.asarray(1e-9 * max(float(np.mean(rows**2)), 1e-12) * np.eye(3))


def _solve(weights: Float64Array, values: Float64Array, rows: Float64Array) -> Float64Array:
    """Return x (M, 3) of the weighted least squares ``values ~ x @ rows.T``, row by row."""
    products = (rows[:, :, None] * rows[:, None, :]).reshape(len(rows), -1)
    normal = (weights @ products).reshape(-1, 3, 3) + _ridge(rows)
    right = (weights * values) @ rows
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])


def compare_directions(
    lights: Float64Array, directions: Float64Array, rng: np.random.Generator, *, draws: int = 400
) -> Agreement:
    """Map a shading space's lights to the listed directions that most of them agree with.

    Parameters
    ----------
    lights
        (N, 3), of a `ShadingSpace`.
    directions
        (N, 3), listed unit vectors.
    rng
        Draws the sets of lights from which maps are computed.
    draws
        Number of sets of four lights.
    """
    chosen = np.array(
        [rng.choice(len(lights), N_FRAMES_PER_DRAW, replace=False) for _ in range(draws)]
    )
    some, listed = lights[chosen], directions[chosen]
    normal = np.einsum("tki,tkj->tij", some, some)
    normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    maps = np.linalg.solve(normal, np.einsum("tki,tkj->tij", some, listed))
    angles = _angles_deg(np.einsum("ni,tij->tnj", lights, maps), directions)
    best = int(np.minimum(angles, MIN_ANGLE_DEG).sum(axis=1).argmin())
    found, limit = maps[best], MIN_ANGLE_DEG
    for _ in range(10):
        mapped = lights @ found
        size = np.linalg.norm(mapped, axis=1)
        angle = _angles_deg(mapped, directions)
        agreeing = angle < limit
        if np.count_nonzero(agreeing) < N_FRAMES_PER_DRAW:
            break
        limit = max(MIN_ANGLE_DEG, SPREAD_FACTOR * 1.4826 * float(np.median(angle[agreeing])))
        target = directions[agreeing] * size[agreeing, None]
        found = np.linalg.lstsq(lights[agreeing], target, rcond=None)[0]
        found = found / np.median(np.linalg.norm(lights[agreeing] @ found, axis=1))
    mapped = lights @ found
    size = np.linalg.norm(mapped, axis=1)
    angle = _angles_deg(mapped, directions)
    right = angle < limit
    middle = float(np.median(size[right])) if right.any() else 1.0
    unit = unit_vectors(mapped, min_length=1e-12)
    misfit = _misfit_equal(lights[right], directions[right]) if right.any() else 1.0
    return Agreement(unit, size / middle, angle, limit, misfit)


def _misfit_equal(lights: Float64Array, directions: Float64Array) -> float:
    """Return the median misfit of lights of one strength, by least squares without the worst."""
    kept = np.ones(len(lights), bool)
    error = np.ones(len(lights))
    for _ in range(5):
        equal = np.linalg.lstsq(lights[kept], directions[kept], rcond=None)[0]
        error = np.linalg.norm(lights @ equal - directions, axis=1)
        kept = error <= 3.0 * np.median(error)
    return float(np.median(error))


def _angles_deg(vectors: Float64Array, unit: Float64Array) -> Float64Array:
    cosine = np.sum(unit_vectors(vectors, min_length=1e-12) * unit, axis=-1)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def compare_residuals(
    space: ShadingSpace,
    samples: Float64Array,
    usable: BoolArray,
    listed: Float64Array,
    agreement: Agreement,
) -> Float64Array:
    """Return each image's residual under its listed light over that under its estimated light.

    An image whose residual hardly falls has another fault than a wrong light: its light cannot be
    estimated from it.

    Parameters
    ----------
    space
        Of these samples.
    samples, usable
        (N, P).
    listed
        (N, 3), unit vectors in the order of the images.
    agreement
        Of the space with the list.

    Returns
    -------
    ndarray, shape (N,)
        1 where both lights fit alike.
    """
    right = agreement.agrees
    scaled_directions = listed[right] * agreement.strength[right, None]
    found = np.linalg.lstsq(space.lights[right], scaled_directions, rcond=None)[0]
    if not right.any() or np.linalg.cond(found) > MAX_CONDITION:
        return np.ones(len(listed))
    expected = listed @ np.linalg.inv(found)
    bright = np.quantile(np.where(usable, samples, 0.0), BRIGHT_QUANTILE, axis=0)
    scaled = samples / np.where(bright > 0.0, bright, 1.0)
    lit = usable & (scaled > SHADOW_FRACTION) & (scaled < HIGHLIGHT_FACTOR)
    ratio = np.ones(len(listed))
    for number in np.flatnonzero(lit.sum(axis=1) > N_FRAMES_PER_DRAW):
        values, points = scaled[number, lit[number]], space.points[lit[number]]
        rest = []
        for light in (expected[number], space.lights[number]):
            shading = points @ light
            gain = np.median(values * shading) / max(float(np.median(shading**2)), 1e-12)
            rest.append(float(np.median(np.abs(values - gain * shading))))
        ratio[number] = rest[0] / max(rest[1], MIN_RESIDUAL)
    return ratio
