"""Find what is wrong with the light itself: curve, ambient light, near lights, drift, strengths."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.stack_diagnosis.finding import Finding
from reconstruction.stack_diagnosis.shading_space import compare_directions, fit_shading_space

MIN_CURVE_AGREEING = 0.6
"""Fraction of lights that must agree with the list for a curve to be judged."""
MIN_TREND_LIGHTS = 6
MIN_CURVE_MISFIT = 0.02
"""Misfit to equal lights from which another curve is considered."""
CURVE_RATIO = 0.6
"""Ratio of misfits below which another curve is reported."""
MAX_CURVE_MISFIT = 0.05
"""Misfit under another curve, above which that curve does not explain the images either."""
MAX_AMBIENT = 0.03
"""Light in attached shadows over the albedo."""
SHADOW_COSINE = -0.15
"""Shading below which a point is turned away from a light."""
MIRROR_COSINES = (0.85, 0.65)
"""Samples with larger cosines may hold a highlight; the second limit leaves out wide lobes too."""
MIN_KEPT_FRACTION = 0.5
"""Fraction of the coefficient that remains from the first limit to the second: highlights lose
more, near lights do not."""
MIN_NEAR_LIGHTS, MIN_NEAR_POINTS = 6, 50
MIN_NEAR_COEFFICIENT, MIN_NEAR_SIGMAS = 0.15, 6.0
"""Twice half a width of the object over the distance of the lights, and its certainty."""
STRENGTH_RANGE = (0.75, 1.35)
MIN_DRIFT, MIN_DRIFT_SIGMAS = 0.05, 6.0
MIN_CERTAIN_LIGHTS, MIN_DRIFT_OF_FEW = 12, 0.15
"""Fewer lights have a larger limit: highlights change their strengths by 10 %."""
MIN_FLICKER = 0.04
"""Spread of the light from line to line, relative, beyond that across the lines."""
MIN_LIT = 0.5
"""Light over matte shading; cast shadows have less."""
MIN_LINES, MIN_LINE_SAMPLES = 16, 8


def _decode_srgb(values: Float64Array) -> Float64Array:
    """Return the light of sRGB values from 0 to 1 (IEC 61966-2-1)."""
    low = values / 12.92
    return np.where(values <= 0.04045, low, ((np.maximum(values, 0.0) + 0.055) / 1.055) ** 2.4)


def _encode_srgb(light: Float64Array) -> Float64Array:
    """Return the sRGB values of light from 0 to 1 (IEC 61966-2-1)."""
    light = np.maximum(light, 0.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


CURVES_BY_NAME: dict[str, Callable[[Float64Array], Float64Array]] = {
    "sRGB values that were read as linear": _decode_srgb,
    "values of gamma 2.2 that were read as linear": lambda v: np.maximum(v, 0.0) ** 2.2,
    "values of gamma 1.8 that were read as linear": lambda v: np.maximum(v, 0.0) ** 1.8,
    "linear values that were decoded as sRGB": _encode_srgb,
    "linear values that were decoded by gamma 2.2": lambda v: np.maximum(v, 0.0) ** (1 / 2.2),
}
"""What the values are, with the function that makes them linear."""


def find_curve(
    samples: Float64Array, usable: BoolArray, directions: Float64Array, rng: np.random.Generator
) -> Iterator[Finding]:
    """Yield the transfer curve under which lights of one strength fit clearly better.

    Parameters
    ----------
    samples
        (N, P), as read, over the white level.
    usable
        (N, P).
    directions
        (N, 3), of the lights in the order of the images.
    rng
        Draws sets of lights.
    """
    listed = _misfit(samples, usable, directions, rng, with_trend=True)
    if listed < MIN_CURVE_MISFIT:
        return
    found = {
        name: _misfit(decode(samples), usable, directions, rng, with_trend=False)
        for name, decode in CURVES_BY_NAME.items()
    }
    best = min(found, key=lambda name: found[name])
    if found[best] < min(CURVE_RATIO * listed, MAX_CURVE_MISFIT):
        yield Finding(
            "transfer curve", (),
            f"equal lights fit to {found[best]:.1%} if these are {best}, else to {listed:.1%}",
            listed / found[best], 1.0 / CURVE_RATIO,
            f"import again with the right encoding: these are {best}",
        )  # fmt: skip


def _misfit(
    samples: Float64Array,
    usable: BoolArray,
    directions: Float64Array,
    rng: np.random.Generator,
    *,
    with_trend: bool,
) -> float:
    """Return how well equal lights fit the list; 1 where most lights are elsewhere."""
    lights = fit_shading_space(samples, usable).lights
    found = compare_directions(lights, directions, rng, draws=150)
    if found.agrees.mean() < MIN_CURVE_AGREEING:
        return 1.0
    if not with_trend:
        return found.misfit
    slope, _, _ = fit_trend(found.strength, found.agrees)
    trend = np.exp(slope * np.linspace(-0.5, 0.5, len(lights)))
    straight = compare_directions(lights / trend[:, None], directions, rng, draws=150)
    return min(found.misfit, straight.misfit)


def find_ambient(
    gray: Float64Array, inside: BoolArray, normals: Float64Array, albedo: Float64Array,
    directions: Float64Array,
) -> Iterator[Finding]:  # fmt: skip
    """Yield light where the surface is turned away from the lamp: ambient light, black level.

    Parameters
    ----------
    gray
        (N, H, W).
    inside
        (H, W), where `normals`, (H, W, 3), and `albedo`, (H, W), are valid.
    directions
        (N, 3).
    """
    cosine = np.einsum("hwi,ni->nhw", normals, directions)
    turned = (cosine < SHADOW_COSINE) & inside
    if np.count_nonzero(turned) < 50:
        return
    ratio = (gray / np.maximum(albedo, 1e-9))[turned]
    level = float(np.median(ratio))
    if level > MAX_AMBIENT:
        yield Finding(
            "ambient light", (),
            f"points turned away from the lamp still have {level:.1%} of the light",
            level, MAX_AMBIENT,
            "subtract an image without lamps, or the black level",
        )  # fmt: skip


def find_near(
    samples: Float64Array, weights: Float64Array, mirror_cosine: Float64Array,
    directions: Float64Array, places: Float64Array,
) -> Iterator[Finding]:  # fmt: skip
    """Yield that lights are near: images are brighter towards their lamp.

    A lamp at the distance D gives a point x of the object ``1 + 2 x . l / D`` of the light of the
    middle. This is quadratic in the direction l, and normals and albedo cannot take it up. So are
    the highlights of a convex object, whose share falls the further samples are from mirroring.

    Parameters
    ----------
    samples, weights
        (N, P).
    mirror_cosine
        (N, P), between normal and half vector.
    directions
        (N, 3).
    places
        (P, 2), x to the right and y up, over half the object's width.
    """
    wide, error = _fit_near(
        samples, weights * (mirror_cosine < MIRROR_COSINES[0]), directions, places
    )
    far, _ = _fit_near(samples, weights * (mirror_cosine < MIRROR_COSINES[1]), directions, places)
    limit = max(MIN_NEAR_COEFFICIENT, MIN_NEAR_SIGMAS * error)
    if wide > limit and far > MIN_KEPT_FRACTION * wide:
        yield Finding(
            "near lights", (),
            f"images are brighter towards their lamp, as from {2.0 / wide:.0f} half widths of the "
            "object",
            wide, limit,
            "give the positions of the lights and the size of a pixel (--mm-per-px)",
        )  # fmt: skip


def _fit_near(
    samples: Float64Array, weights: Float64Array, directions: Float64Array, places: Float64Array
) -> tuple[float, float]:
    """Return the coefficient of `find_near` and its standard error over the lights."""
    kept = weights.sum(axis=0) >= MIN_NEAR_LIGHTS
    if np.count_nonzero(kept) < MIN_NEAR_POINTS:
        return 0.0, 0.0
    samples, weights, places = samples[:, kept], weights[:, kept], places[kept]
    products = (directions[:, :, None] * directions[:, None, :]).reshape(len(directions), -1)
    inner = (weights.T @ products).reshape(-1, 3, 3) + 1e-9 * np.eye(3)

    def fit(values: Float64Array) -> Float64Array:
        right = (weights * values).T @ directions
        return np.asarray(directions @ np.linalg.solve(inner, right[..., None])[..., 0].T)

    matte = fit(samples)
    tilt = np.maximum(matte, 0.0) * (directions[:, :2] @ places.T)
    tilt = tilt - fit(tilt)
    above = np.sum(weights * (samples - matte) * tilt, axis=1)
    below = np.sum(weights * tilt**2, axis=1)
    whole = max(float(below.sum()), 1e-30)
    coefficient = float(above.sum()) / whole
    return coefficient, float(np.sqrt(np.sum((above - coefficient * below) ** 2))) / whole


def find_flicker(
    gray: Float64Array, usable: BoolArray, inside: BoolArray, predicted: Float64Array
) -> Iterator[Finding]:
    """Yield that the light changes from row to row: rolling shutters image flicker as bands.

    Each image is compared with its matte shading line by line, without a smooth trend. What
    surface and highlights leave is alike along rows and columns; bands lie along one of them.

    Parameters
    ----------
    gray, usable
        (N, H, W).
    inside
        (H, W).
    predicted
        (N, H, W), by normals and albedo of all images.
    """
    spreads = []
    for image, clear, shading in zip(gray, usable, predicted, strict=True):
        lit = inside & clear & (image > MIN_LIT * shading)  # not in cast shadows
        if not lit.any():
            continue
        lit &= shading > 0.3 * np.quantile(shading[inside], 0.9)
        ratio = np.where(lit, np.log(np.where(lit, image, 1.0) / np.where(lit, shading, 1.0)), 0.0)
        spreads.append(
            [_spread_of_lines(one, good) for one, good in ((ratio, lit), (ratio.T, lit.T))]
        )
    if not spreads:
        return
    rows, columns = np.median(np.array(spreads), axis=0)
    excess = float(np.sqrt(abs(rows**2 - columns**2)))
    if excess > MIN_FLICKER:
        name = "row to row" if rows > columns else "column to column"
        yield Finding(
            "rolling flicker", (),
            f"light changes by {excess:.1%} from {name} in most images", excess, MIN_FLICKER,
            "use lamps without flicker, or exposure times of whole periods of the mains",
        )  # fmt: skip


def _spread_of_lines(ratio: Float64Array, good: BoolArray) -> float:
    """Return the robust standard deviation of the medians of lines, without their trend."""
    lines = np.flatnonzero(good.sum(axis=1) >= MIN_LINE_SAMPLES)
    if len(lines) < MIN_LINES:
        return 0.0
    level = np.array([float(np.median(ratio[line, good[line]])) for line in lines])
    rest = level - np.polyval(np.polyfit(lines, level, 2), lines)
    return 1.4826 * float(np.median(np.abs(rest)))


def find_strengths(strength: Float64Array, right: BoolArray) -> Iterator[Finding]:
    """Yield a drift of the exposure, and single dim or bright lights."""
    kept = right & (strength > 0.0)
    if np.count_nonzero(kept) < MIN_TREND_LIGHTS:
        return
    slope, error, rest = fit_trend(strength, kept)
    least = MIN_DRIFT if len(strength) >= MIN_CERTAIN_LIGHTS else MIN_DRIFT_OF_FEW
    limit = max(least, MIN_DRIFT_SIGMAS * error)
    drifts = abs(slope) > limit
    if drifts:
        yield Finding(
            "exposure drift", (),
            f"light changes by {np.expm1(slope):+.0%} from the first image to the last",
            abs(slope), limit, "give each image's exposure, or correct the images by this trend",
        )  # fmt: skip
    # without the trend where there is one
    level = np.exp(rest) if drifts else strength[kept] / np.median(strength[kept])
    for number, value in zip(np.flatnonzero(kept), level, strict=True):
        if not STRENGTH_RANGE[0] <= value <= STRENGTH_RANGE[1]:
            yield Finding(
                "unequal light", (int(number),),
                f"light of image {number + 1} has {value:.2f} of the median strength",
                abs(float(np.log(value))), float(-np.log(STRENGTH_RANGE[0])),
                "give the strengths of the lights, or replace the lamp",
            )  # fmt: skip


def fit_trend(strength: Float64Array, kept: BoolArray) -> tuple[float, float, Float64Array]:
    """Return slope of the logarithm over all images, its standard error, and the rest.

    The median of the slopes of all pairs (Theil 1950; Sen 1968): one dim light does not tilt it.
    """
    place = np.flatnonzero(kept)
    log = np.log(np.maximum(strength[place], 1e-9))
    x = place / max(len(strength) - 1, 1) - 0.5
    i, j = np.triu_indices(len(x), 1)
    slope = float(np.median((log[j] - log[i]) / (x[j] - x[i])))
    rest = log - slope * x
    rest = rest - np.median(rest)
    spread = 1.4826 * float(np.median(np.abs(rest))) + 1e-4
    return slope, spread / float(np.sqrt(np.sum((x - x.mean()) ** 2))), rest
