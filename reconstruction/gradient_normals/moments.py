"""Compute moments of a reflection under a sphere's patterns, by tiles of rows, smoothed or not."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from model.checks import Checks
from reconstruction.arrays import Float64Array, FloatArray
from reconstruction.gradient_normals import moment_kernels
from reconstruction.gradient_normals.noise import SensorNoise, estimate_noise
from reconstruction.gradient_normals.patterns import (
    GradientError,
    MissingPatternsError,
    PatternStack,
    require_patterns,
)
from reconstruction.gradient_normals.wiener import Gain, filter_image

TILE_PIXELS = 65_536
_VALUE_ROWS = slice(moment_kernels.C_0, moment_kernels.V_0)
_VARIANCE_ROWS = slice(moment_kernels.V_0, moment_kernels.CHI)
_VARIANCE_PAIRS = (
    (moment_kernels.V_0, 0, 0),
    (moment_kernels.V_XX, 1, 1),
    (moment_kernels.V_YY, 2, 2),
    (moment_kernels.V_ZZ, 3, 3),
    (moment_kernels.V_XY, 1, 2),
    (moment_kernels.V_XZ, 1, 3),
    (moment_kernels.V_YZ, 2, 3),
)
"""Rows of variances, and the moments they belong to."""
KERNEL_RADIUS_SIGMAS = 3.5
"""Radius of a smoothing kernel, in its standard deviations."""


@dataclass(frozen=True, slots=True)
class ReflectionMoments:
    """Images and settings from which the moments of a component are computed, tile by tile.

    Attributes
    ----------
    component : "specular" or "diffuse"
    parallel : Stack or None
        None for diffuse moments of crossed images alone.
    crossed : Stack
    noise : SensorNoise or None
        None if the stacks contain variances, or noise is unknown.
    noise_source : int
        0: noise is unknown; 1: the stacks' variances; 2: `noise`.
    has_given_noise : bool
        Whether the noise was given, so that residuals can be tested against it.
    leakage : float
        Crossed over parallel transmission of the specular reflection; for diffuse moments.
    smooth_px : tuple of float
        Standard deviations of the Gaussians, parallel and crossed, px.
    kind : dtype
        float32 or float64.
    filtered_moments : tuple of ndarray, shape (4, H, W), or None
        Filtered moments, parallel and crossed, that replace the images' own.
    variance_ratios : tuple of ndarray, shape (2, 4), or None
        Variance of the moments to invert, over that of the images' own parallel and crossed
        moments, with `filtered_moments`.
    """

    component: Literal["specular", "diffuse"]
    parallel: PatternStack | None
    crossed: PatternStack
    noise: SensorNoise | None
    noise_source: int
    has_given_noise: bool
    leakage: float
    smooth_px: tuple[float, float]
    kind: Any
    filtered_moments: tuple[FloatArray, FloatArray] | None = None
    variance_ratios: tuple[FloatArray, FloatArray] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.crossed.shape

    def tiles(self) -> Iterator[slice]:
        """Yield slices of rows that cover the images."""
        height, width = self.shape
        step = max(1, TILE_PIXELS // width)
        for start in range(0, height, step):
            yield slice(start, min(start + step, height))

    def moments(self, rows: slice) -> tuple[FloatArray, FloatArray]:
        """Return the moments to invert (MOMENT_ROWS, P), and those to subtract from them.

        The second are (MOMENT_ROWS, 0) if there are none.
        """
        crossed = self._of(self.crossed, rows, self.smooth_px[1])
        if self.parallel is None:
            if self.filtered_moments is not None:
                self._replace(crossed, crossed, rows)
            return crossed, crossed[:, :0]
        parallel = self._of(self.parallel, rows, self.smooth_px[0])
        if self.component == "specular":
            if self.filtered_moments is not None:
                self._replace(parallel, crossed, rows)
            return parallel, crossed
        k = self.leakage / (1.0 - self.leakage)
        cleaned, values, variances = crossed.copy(), _VALUE_ROWS, _VARIANCE_ROWS
        cleaned[values] -= k * (parallel[values] - crossed[values])
        cleaned[variances] = (1.0 + k) ** 2 * crossed[variances] + k**2 * parallel[variances]
        if self.filtered_moments is not None:
            self._replace(cleaned, cleaned, rows)
        return cleaned, crossed[:, :0]

    def _replace(self, first: FloatArray, second: FloatArray, rows: slice) -> None:
        """Insert filtered moments, with all of their variance in the first."""
        if self.filtered_moments is None or self.variance_ratios is None:
            return
        lost = ~np.isfinite(first[0]) | ~np.isfinite(second[0])
        a, b = (np.sqrt(share) for share in self.variance_ratios)
        for row, i, j in _VARIANCE_PAIRS:
            first[row] *= a[i] * a[j]
            if second is not first:
                first[row] += b[i] * b[j] * second[row]
                second[row] = 0.0
        for moments, clean in (
            (first, self.filtered_moments[0]),
            (second, self.filtered_moments[1]),
        ):
            moments[_VALUE_ROWS] = clean[:, rows].reshape(4, -1)
            moments[: moment_kernels.CHI, lost] = np.nan

    def _of(self, stack: PatternStack, rows: slice, sigma: float) -> FloatArray:
        taps = _taps(sigma).astype(self.kind)
        reach = len(taps) - 1
        start, stop = max(0, rows.start - reach), min(self.shape[0], rows.stop + reach)
        y = stack.samples(slice(start, stop), self.kind)
        noise = stack.variances(slice(start, stop), self.kind)
        height, width = y.shape[1:]
        out = np.empty((moment_kernels.MOMENT_ROWS, height * width), self.kind)
        # a broadcast view stays broadcast
        flat = noise.reshape(len(y), -1)
        if noise.strides[2] == 0:
            flat = np.broadcast_to(noise[:, :1, 0], flat.shape)
        gain, read = (self.noise.gain, self.noise.read_variance) if self.noise else (0.0, 1.0)
        moment_kernels.fit_moments(
            y.reshape(len(y), -1), flat, gain, read, self.noise_source, stack.has_dark, out
        )
        if reach:
            _smooth(out.reshape(-1, height, width), taps)
        inner = out.reshape(-1, height, width)[:, rows.start - start : rows.stop - start]
        return np.ascontiguousarray(inner).reshape(moment_kernels.MOMENT_ROWS, -1)


def _taps(sigma: float) -> Float64Array:
    """Return a Gaussian's taps from its middle outward, the whole kernel's sum 1."""
    if sigma == 0.0:
        return np.ones(1)
    k = np.arange(int(np.ceil(KERNEL_RADIUS_SIGMAS * sigma)) + 1)
    taps = np.exp(-0.5 * (k / sigma) ** 2)
    return np.asarray(taps / (2.0 * taps.sum() - taps[0]))


def _smooth(moments: FloatArray, taps: FloatArray) -> None:
    """Smooth moments (MOMENT_ROWS, H, W) in place over their valid pixels; variances follow."""
    mask = np.isfinite(moments[moment_kernels.C_0])
    if not mask.any():
        return
    line, found = np.empty_like(moments[0]), np.empty_like(moments[0])
    share = np.empty_like(moments[0])
    moment_kernels.convolve_separable(np.ones_like(share), taps, mask, share, line)
    share[~mask] = 1.0
    squared = taps * taps
    for row in range(moment_kernels.CHI):
        mean = row < moment_kernels.V_0
        moment_kernels.convolve_separable(
            moments[row], taps if mean else squared, mask, found, line
        )
        moments[row] = found / share if mean else found / share**2
        moments[row][~mask] = np.nan


def prepare_moments(
    stacks: Mapping[str, PatternStack],
    component: Literal["specular", "diffuse"],
    *,
    noise: SensorNoise | None,
    leakage: float,
    smooth_px: tuple[float, float],
) -> ReflectionMoments:
    """Check that the images determine the component, and how their noise is known.

    Parameters
    ----------
    stacks
        By polarization; with variances, or with `noise`, or neither.
    component, noise, leakage, smooth_px
        See :class:`ReflectionMoments`.

    Raises
    ------
    MissingPatterns
        Where a polarization, or patterns of it, are missing.
    """
    Checks(GradientError).within("smoothing", smooth_px, "[0, 100]")
    wanted = ("parallel", "crossed") if component == "specular" else ("crossed",)
    for polarizer in wanted:
        if polarizer not in stacks:
            text = (
                f"patterns: got no {polarizer} images; {component} normals need"
                f" {' and '.join(wanted)} ones, full, x, y, z at least; add them"
            )
            why = ": parallel images contain both reflections, crossed ones only the diffuse"
            raise MissingPatternsError(text + why if component == "specular" else text)
        require_patterns(
            stacks[polarizer].images, polarizer=polarizer, purpose=f"{component} normals"
        )
    used = {name: stacks[name] for name in wanted}
    parallel = stacks.get("parallel")
    if component == "diffuse" and (leakage == 0.0 or parallel is None or parallel.redundancy < 0):
        parallel = None
    elif parallel is not None:
        used["parallel"] = parallel
    judged = noise is not None or used["crossed"].variance is not None
    noise_source = 1 if used["crossed"].variance is not None else 2
    if noise_source == 2:
        noise = noise or estimate_noise(used)
        noise_source = 0 if noise is None else 2
    kinds = {image.dtype for stack in used.values() for image in stack.images.values()}
    return ReflectionMoments(
        component,
        parallel,
        stacks["crossed"],
        noise if noise_source == 2 else None,
        noise_source,
        judged,
        leakage,
        smooth_px,
        np.float64 if np.dtype(np.float64) in kinds else np.float32,
    )


def apply_wiener_filter(
    reflection: ReflectionMoments, sharpen: Gain | None = None
) -> ReflectionMoments:
    """Filter a reflection's moments by the fraction of signal at each frequency.

    Diffuse moments are filtered first, then the parallel ones less these: the specular reflection
    has finer detail than the diffuse one. `sharpen` multiplies the waves of the specular reflection
    alone.

    Raises
    ------
    GradientError
        If the noise is unknown.
    """
    if not reflection.noise_source:
        raise GradientError(
            "wiener: noise is unknown, as no patterns are redundant; give variance or smoothing"
            " in px"
        )
    height, width = reflection.shape
    two = reflection.component == "specular"
    raw = [np.empty((4, height, width), reflection.kind) for _ in range(2 if two else 1)]
    noise = np.zeros((2, 4))
    count = 0
    for rows in reflection.tiles():
        for number, moments in enumerate(reflection.moments(rows)[: len(raw)]):
            raw[number][:, rows] = moments[_VALUE_ROWS].reshape(4, -1, width)
            good = np.isfinite(moments[0])
            variances = moments[moment_kernels.V_0 : moment_kernels.V_ZZ + 1]
            noise[number] += variances[:, good].sum(axis=1)
            count += int(good.sum()) if number == 0 else 0
    noise /= max(count, 1)
    valid = np.isfinite(raw[0][0]) & np.isfinite(raw[-1][0])
    shares = np.ones((2, 4))
    for m in range(4):
        base = raw[-1][m]
        glow, kept = filter_image(base, noise[len(raw) - 1, m], valid)
        if not two:
            raw[0][m], shares[0, m] = glow, kept
            continue
        spark, left = filter_image(
            raw[0][m] - glow, noise[0, m] + kept * noise[1, m], valid, sharpen
        )
        raw[0][m], raw[1][m] = spark + glow, glow
        shares[:, m] = left, left * kept
    return replace(
        reflection, filtered_moments=(raw[0], raw[-1]), variance_ratios=(shares[0], shares[1])
    )


def share_dark_frames(stacks: Mapping[str, PatternStack]) -> dict[str, PatternStack]:
    """Use a dark frame of one polarization for the other, too.

    The analyzer does not change it without other light. Its noise then counts in both,
    though it cancels in their difference: standard errors are conservative.
    """
    out = dict(stacks)
    dark = [name for name, stack in stacks.items() if stack.has_dark]
    if len(stacks) == 2 and len(dark) == 1:
        source = stacks[dark[0]]
        other = next(name for name in stacks if name != dark[0])
        stack = stacks[other]
        variance = stack.variance
        if variance is not None and source.variance is not None:
            variance = {**variance, "dark": source.variance["dark"]}
        valid = dict(stack.valid)
        if "dark" in source.valid:
            valid["dark"] = source.valid["dark"]
        pictures = {**stack.images, "dark": source.images["dark"]}
        out[other] = PatternStack(pictures, variance, valid)
    return out
