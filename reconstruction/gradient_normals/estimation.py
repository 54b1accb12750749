"""Estimate normals from images under full light, gradients and their complements.

Under light that grows along an axis, a reflection is brighter the further its lobe points that way:
the images are the lobe's first moments, and their vector points along its axis (Ma et al. 2007,
doi 10.2312/EGWR/EGSR07/183-194; complements: Wilson et al. 2010, doi 10.1145/1731047.1731055). For
the specular reflection, parallel less crossed, that is the mirror direction, and the normal is half
way between it and the view. For the diffuse one it is the normal. With `SphereLights` the vector is
corrected by a table of the moments that these lights give for each normal
(:mod:`reconstruction.gradient_normals.lobe_response`).
"""

import logging
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from model.checks import Checks
from model.fresnel import ETA_SKIN
from reconstruction.arrays import FloatArray
from reconstruction.gradient_normals import kernels, lobe_response, moment_kernels
from reconstruction.gradient_normals.channels import (
    PatternSamples,
    Valid,
    Variance,
    sort_by_polarization,
    stack_channels,
)
from reconstruction.gradient_normals.inversion import (
    MomentInversion,
    frame_positions,
    normalize_views,
)
from reconstruction.gradient_normals.lobe_response import LobeResponseTable
from reconstruction.gradient_normals.moments import (
    ReflectionMoments,
    apply_wiener_filter,
    prepare_moments,
    share_dark_frames,
)
from reconstruction.gradient_normals.noise import SensorNoise
from reconstruction.gradient_normals.patterns import GradientError, Key
from reconstruction.gradient_normals.sphere_lights import SphereLights, view_frame
from reconstruction.gradient_normals.wiener import Gain
from reconstruction.normal_maps import NormalMaps
from reconstruction.tiles import map_on_threads

_log = logging.getLogger(__name__)

MAX_MEDIAN_LEAKAGE = 0.02
"""Median leakage above which polarizers are badly crossed: 8 degrees off."""


MAX_RESIDUAL_RATIO = 3.0
"""Mean square of residuals over their variance above which images count as inconsistent."""
ROUGHNESS_LADDER = (0.03, 0.06, 0.12, 0.24, 0.48, 0.9)
"""Grid on which a roughness is searched."""


@dataclass(frozen=True, slots=True)
class Roughness:
    """Roughness common to the lobes of a map.

    Attributes
    ----------
    alpha : float
        GGX roughness of the lobe within a (smoothed) pixel, from facets, unresolved relief and
        smoothing.
    stderr : float
        Standard error of `alpha`.
    pixels : int
        Number of pixels it was estimated from.
    """

    alpha: float
    stderr: float
    pixels: int


Smoothing: TypeAlias = float | tuple[float, float] | Literal["wiener"] | Gain
"""Filter of the moments, see :func:`from_patterns`."""


def from_patterns(
    patterns: Mapping[Key, ArrayLike],
    *,
    component: Literal["specular", "diffuse"] = "specular",
    view: ArrayLike = (0.0, 0.0, 1.0),
    variance: Variance = None,
    valid: Valid = None,
    saturation: float | None = None,
    lights: SphereLights | None = None,
    alpha: float | Roughness | None = None,
    eta: float = ETA_SKIN,
    points_mm: ArrayLike | None = None,
    smoothing: Smoothing = 0.0,
    executor: Executor | None = None,
) -> NormalMaps:
    """Compute normals from images under a sphere's patterns.

    Parameters
    ----------
    patterns : mapping of (str, str) to array_like, shape (H, W) or (H, W, C)
        Linear images by pattern ("full", "x", "y", "z", "-x", "-y", "-z", "dark") and polarizer
        ("parallel", "crossed"), one unit, all at one level and exposure. Dark frames are
        subtracted; without them, the images must have no dark level. Any set suffices that
        determines full light and three gradients, as full, x, y, z or x, -x, y, z; NaN
        where there is not a sample.
    component : "specular" or "diffuse"
        Which reflection. Specular needs both polarizers; its channels are summed, as it has no
        color. Diffuse needs crossed images; each channel has its own normals.
    view : array_like, shape (3,) or (H, W, 3)
        Unit vectors to the camera, rig frame (y up).
    variance : float, SensorNoise, or mapping like `patterns` of arrays or numbers, optional
        Of the samples. None: estimated from the contradictions of redundant patterns; where
        none are redundant, noise stays unknown, and standard errors are pi.
    valid : ndarray of bool, shape (H, W), or mapping like `patterns`, optional
        Samples to use.
    saturation : float, optional
        Value from which a sample counts as saturated, before the dark frame is subtracted.
    lights : SphereLights, optional
        The actual lights. None: an even sphere of light, and narrow lobes.
    alpha : float or Roughness, optional
        GGX roughness of the facets within a pixel, for specular normals with `lights`. None:
        estimated over the map (:func:`estimate_roughness`).
    eta : float
        Refractive index of the surface, with `lights`.
    points_mm : array_like, shape (H, W, 2) or (H, W, 3), optional
        Positions of the pixels on the patch, rig frame, for lights at a finite distance: directions
        to the lights then vary. Give `view` per pixel, too.
    smoothing : float, (float, float), "wiener" or function
        Standard deviation of a Gaussian that smooths the moments before any nonlinear step, px; of
        two numbers the second is that of the crossed images, where subsurface scattering removes
        detail. The optics' own blur is a good choice; noise falls about as 1 / (3.5 px). "wiener"
        filters the moments by the fraction of signal at each spatial frequency
        (:mod:`reconstruction.gradient_normals.wiener`): as much as noise and optics require.
        Standard errors then include the detail that is lost. A function does the same for specular
        normals, and multiplies the waves of their light by its value, of cycles per pixel along x
        and y: the lens's inverse transfer. A lens averages light, not normals, so that blur is to
        be undone in the light.
    executor : Executor, optional
        Threads to map tiles of rows over; default one thread per core, at most 8.

    Returns
    -------
    NormalMaps
        Shape (H, W), or (H, W, C) for diffuse normals of C channels; float64 where an image is
        float64, else float32. With `lights`, `albedo` is the reflection over that of a dielectric
        of `eta` (specular) or of a white interior below it (diffuse), in units of a white
        diffuser facing the view in full light; without `lights` the full light itself.
        `stderr_rad` includes the noise and the stated errors of `lights` and `alpha`, which are
        correlated between neighboring pixels.

    Raises
    ------
    MissingPatternsError
        If patterns do not determine the moments, or one polarizer's images are missing.
    GradientError, SphereLightsError
        For arrays, settings and lights that do not fit.

    Notes
    -----
    Cast shadows and interreflection between grooves are not corrected. Diffuse light leaves a
    smooth surface partly polarized; with `lights` the part in parallel less crossed is subtracted.
    An analyzer that is off by an angle d in both states scales the specular signal by cos 2d and
    turns no normal; the images do not reveal it, so leakage has to be calibrated.

    Examples
    --------
    >>> n = np.array([0.1, 0.2, 0.97]) / np.linalg.norm([0.1, 0.2, 0.97])
    >>> r = 2 * n[2] * n - [0, 0, 1]
    >>> gray = {name: np.full((2, 2), 0.5) for name in ("full", "x", "y", "z")}
    >>> pictures = {(name, "crossed"): image for name, image in gray.items()}
    >>> for name, w in zip(gray, (1, *(1 + r) / 2)):
    ...     pictures[name, "parallel"] = gray[name] + 0.1 * w
    >>> bool(np.allclose(from_patterns(pictures).normals[0, 0], n))
    True
    """
    Checks(GradientError).choice("component", component, ("specular", "diffuse"))
    sharpen = smoothing if callable(smoothing) else None
    if sharpen is not None and component != "specular":
        raise GradientError("smoothing: got a function for diffuse normals, expected a number")
    wiener = sharpen is not None or smoothing == "wiener"
    smooth = (0.0, 0.0) if wiener else tuple(np.broadcast_to(cast(Any, smoothing), 2))
    samples = PatternSamples(patterns, variance, valid, saturation)

    def normals_of(flat: PatternSamples) -> NormalMaps:
        reflection = _reflection_of(flat, component, lights, smooth)
        filtered = apply_wiener_filter(reflection, sharpen) if wiener else reflection
        rough = filtered if sharpen is not None else reflection
        return _normals(filtered, rough, view, lights, alpha, eta, points_mm, executor)

    if samples.channels is None:
        return normals_of(samples)
    if component == "specular":
        return normals_of(samples.sum_channels())
    return stack_channels([normals_of(samples.channel(k)) for k in range(samples.channels)])


def _normals(
    reflection: ReflectionMoments,
    of_roughness: ReflectionMoments,
    view: ArrayLike,
    lights: SphereLights | None,
    alpha: float | Roughness | None,
    eta: float,
    points_mm: ArrayLike | None,
    executor: Executor | None,
) -> NormalMaps:
    shape = reflection.shape
    middle, each_view = normalize_views(view, shape)
    places = frame_positions(points_mm, shape, middle, lights)
    if lights is None:
        got = "it without lights"
        Checks(GradientError).require(alpha is None, "alpha", got, "both or neither")
        table = LobeResponseTable(np.zeros((0, 0, 0)), 0.0, 1.0, view_frame(middle))
    elif reflection.component == "diffuse":
        table = lobe_response.diffuse_response(
            lights, view=middle, eta=eta, near=places is not None
        )
    else:
        if alpha is None:
            alpha = _roughness(of_roughness, lights, middle, eta)
        known = alpha if isinstance(alpha, Roughness) else Roughness(float(alpha), 0.0, 0)
        table = lobe_response.specular_response(
            lights,
            view=middle,
            alpha=known.alpha,
            eta=eta,
            near=places is not None,
            alpha_stderr=known.stderr,
        )
    return _maps(
        MomentInversion.prepare(reflection, table, lights, eta), each_view, places, executor
    )


def estimate_roughness(
    patterns: Mapping[Key, ArrayLike],
    *,
    lights: SphereLights,
    view: ArrayLike = (0.0, 0.0, 1.0),
    variance: Variance = None,
    valid: Valid = None,
    saturation: float | None = None,
    eta: float = ETA_SKIN,
    smooth_px: float = 0.0,
    smooth_crossed_px: float | None = None,
    sharpen: Gain | None = None,
) -> Roughness:
    """Estimate the roughness under which the map's specular moment vectors have their lengths.

    Relative to the full light the vector is shorter for a wider lobe. Parameters and errors are
    those of :func:`from_patterns`; with `sharpen` the moments are filtered, and the roughness is
    that of the restored reflection, without the lens's mixture of neighbors.

    Returns
    -------
    Roughness
        At an end of the range searched, 0.03 to 0.9, if the lobes are beyond it, with a warning
        in the log.

    Raises
    ------
    GradientError
        Where no pixel has a specular signal.
    """
    samples = PatternSamples(patterns, variance, valid, saturation)
    if samples.channels is not None:
        samples = samples.sum_channels()
    smooth = smooth_px, smooth_px if smooth_crossed_px is None else smooth_crossed_px
    reflection = _reflection_of(samples, "specular", lights, smooth)
    if sharpen is not None:
        reflection = apply_wiener_filter(reflection, sharpen)
    found = _roughness(reflection, lights, normalize_views(view, reflection.shape)[0], eta)
    if found.pixels == 0:
        raise GradientError(
            "patterns: got no pixel with a specular signal above its noise, expected some; "
            "check exposure and polarizers"
        )
    return found


def _reflection_of(
    samples: PatternSamples,
    component: Literal["specular", "diffuse"],
    lights: SphereLights | None,
    smooth_px: tuple[float, float],
) -> ReflectionMoments:
    """Return the moments of one component's reflection, corrected for leaking polarizers."""
    leakage = 0.0
    if lights is not None:
        # the median, as lights near Brewster's angle reflect little, most of it crossed
        leakage = float(np.median(lights.leakage[lights.intensities > 0]))
        if leakage > MAX_MEDIAN_LEAKAGE:
            _warn_of_leakage(round(leakage, 4))
    noise = samples.variance if isinstance(samples.variance, SensorNoise) else None
    stacks = share_dark_frames(sort_by_polarization(samples))
    return prepare_moments(stacks, component, noise=noise, leakage=leakage, smooth_px=smooth_px)


@lru_cache(maxsize=64)
def _warn_of_leakage(leakage: float) -> None:
    """Warn once for all images of one sphere about light that passes crossed polarizers."""
    _log.warning(
        "polarizers leak: crossed images contain %.1f %% of the specular reflection, as if the"
        " analyzer were %.0f degrees off; corrected, at the cost of signal",
        100.0 * leakage,
        np.degrees(np.arctan(np.sqrt(leakage))),
    )


def _roughness(
    reflection: ReflectionMoments, lights: SphereLights, middle: FloatArray, eta: float
) -> Roughness:
    rows = list(reflection.tiles())
    height, width = reflection.shape
    if len(rows) > 8:  # some strips suffice
        rows = [slice(r.start, min(r.start + 16, r.stop)) for r in rows[:: len(rows) // 8]]
    columns = max(1, height * width // 65_536)
    picked = []
    for span in rows:
        parallel, crossed = reflection.moments(span)
        good = np.flatnonzero(np.isfinite(parallel[0]) & np.isfinite(crossed[0]))
        good = good[:: min(columns, 8)]
        picked.append((parallel[:, good], crossed[:, good]))
    first, second = (np.concatenate(parts, axis=1) for parts in zip(*picked, strict=True))
    moments = np.ascontiguousarray(first), np.ascontiguousarray(second)

    def excess(log_alpha: float) -> tuple[float, FloatArray]:
        """Return the vectors' mean excess length over this roughness's, and each one's part."""
        table = lobe_response.specular_response(
            lights, view=middle, alpha=float(np.exp(log_alpha)), eta=eta
        )
        found = MomentInversion.prepare(reflection, table, lights, eta).normals(moments)
        # a vector is at most as long as its light; a lobe between lights has no defined length
        length = found[:, kernels.CONCENTRATION]
        good = (found[:, kernels.STATUS] == kernels.GOOD) & (length >= 0.0) & (length <= 1.0)
        if not good.any():
            return float("nan"), np.zeros(0)
        light = found[good, kernels.ALBEDO]
        each = light * (found[good, kernels.CONCENTRATION_SEEN] - length[good])
        whole = max(light.sum(), 1e-300)
        return float(each.sum() / whole), each / whole

    ladder = np.log(ROUGHNESS_LADDER)
    steps = [excess(a) for a in ladder]
    pixels = max(len(each) for _, each in steps)
    if pixels == 0:
        taken = ROUGHNESS_LADDER[len(ROUGHNESS_LADDER) // 2]
        return Roughness(taken, taken, 0)
    values = np.array([value for value, _ in steps])
    change = np.flatnonzero((values[:-1] < 0.0) & (values[1:] >= 0.0))
    if change.size == 0:
        best = int(np.nanargmin(np.abs(values)))
        _log.warning(
            "roughness: lobes are %s than those of roughness %g to %g; %g is used",
            "narrower" if values[best] > 0.0 else "wider",
            ROUGHNESS_LADDER[0],
            ROUGHNESS_LADDER[-1],
            ROUGHNESS_LADDER[best],
        )
        return Roughness(ROUGHNESS_LADDER[best], ROUGHNESS_LADDER[best], pixels)
    low, high = ladder[change[0]], ladder[change[0] + 1]
    root = float(brentq(lambda a: excess(a)[0], low, high, xtol=2e-3))
    value, each = excess(root)
    slope = (excess(root + 0.02)[0] - value) / 0.02
    spread = float(np.sqrt(np.sum((each - each.mean()) ** 2)))
    alpha = float(np.exp(root))
    stderr = alpha * spread / max(slope, 1e-9) if len(each) >= 8 else alpha
    return Roughness(alpha, min(stderr, alpha), len(each))


def _maps(
    inversion: MomentInversion,
    view: FloatArray | None,
    places: FloatArray | None,
    executor: Executor | None,
) -> NormalMaps:
    reflection = inversion.reflection
    (height, width), kind = reflection.shape, reflection.kind
    normals = np.zeros((height, width, 3), kind)
    flats = [np.zeros((height, width), kind) for _ in range(4)]
    valid, used = np.zeros((height, width), bool), np.zeros((height, width), np.int32)

    def solve(rows: slice) -> tuple[float, float]:
        span = slice(rows.start * width, rows.stop * width)
        moments = reflection.moments(rows)
        each = (None if given is None else given[span] for given in (view, places))
        found = inversion.normals(moments, *each).reshape(-1, width, kernels.NORMAL_COLUMNS)
        good = found[..., kernels.STATUS] == kernels.GOOD
        valid[rows] = good
        normals[rows] = found[..., :3]
        misfit, count = np.zeros(good.size), np.zeros(good.size)
        chi = free = 0.0
        for one in moments:
            if one.shape[1]:
                misfit += one[moment_kernels.MISFIT]
                count += one[moment_kernels.USED]
                known = np.isfinite(one[moment_kernels.CHI])
                chi += float(one[moment_kernels.CHI][known].sum())
                free += float(one[moment_kernels.FREE][known].sum())
        residual = np.sqrt(misfit / np.maximum(count, 1)).reshape(good.shape)
        for flat, values, none in (
            (flats[0], found[..., kernels.ALBEDO], 0.0),
            (flats[1], residual, 0.0),
            (flats[2], found[..., kernels.STDERR], np.pi),
            (flats[3], found[..., kernels.STDERR_ALBEDO], np.inf),
        ):
            flat[rows] = np.where(good, values, none)
        used[rows] = count.reshape(good.shape)
        return chi, free

    contradiction = map_on_threads(solve, list(reflection.tiles()), executor)
    chi, free = (sum(part) for part in zip(*contradiction, strict=True))
    if reflection.has_given_noise and free and chi > MAX_RESIDUAL_RATIO * free:
        _log.warning(
            "patterns contradict each other: residuals of redundant images are %.1f times their"
            " noise; check that subject and light did not change between them",
            np.sqrt(chi / free),
        )
    return NormalMaps(normals, flats[0], flats[1], valid, flats[2], flats[3], used)
