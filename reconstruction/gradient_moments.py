"""Moments of a reflection under a sphere's patterns, by tiles of rows, smoothed or not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from reconstruction import gradient_kernels as kernels
from reconstruction.gradient_noise import SensorNoise, estimate_noise
from reconstruction.gradient_patterns import GradientError, MissingPatterns, Stack, require

Floating = NDArray[np.floating]

TILE_PIXELS = 65_536
REACH_SIGMA = 3.5
"""Where a smoothing kernel ends, in its standard deviations."""


@dataclass(frozen=True, slots=True)
class Reflection:
    """What is needed to compute the moments of a component, tile by tile.

    Attributes
    ----------
    component : "specular" or "diffuse"
    parallel : Stack or None
        None for diffuse moments of crossed pictures alone.
    crossed : Stack
    noise : SensorNoise or None
        None where the stacks hold variances, or nothing is known.
    told : int
        0: noise is unknown; 1: the stacks' variances; 2: `noise`.
    judged : bool
        Whether the noise was given, and residuals can be judged by it.
    leakage : float
        Of the specular reflection what passes crossed, over parallel; for diffuse moments.
    smooth_px : tuple of float
        Standard deviations of the Gaussians, parallel and crossed, px.
    kind : dtype
        float32 or float64.
    """

    component: Literal["specular", "diffuse"]
    parallel: Stack | None
    crossed: Stack
    noise: SensorNoise | None
    told: int
    judged: bool
    leakage: float
    smooth_px: tuple[float, float]
    kind: Any

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.crossed.shape

    def tiles(self) -> Iterator[slice]:
        """Yield slices of rows that cover the pictures."""
        height, width = self.shape
        step = max(1, TILE_PIXELS // width)
        for start in range(0, height, step):
            yield slice(start, min(start + step, height))

    def moments(self, rows: slice) -> tuple[Floating, Floating]:
        """Return what is to be inverted (MOMENT_ROWS, P), and what is to be taken off it.

        The second one is (MOMENT_ROWS, 0) where nothing is.
        """
        crossed = self._of(self.crossed, rows, self.smooth_px[1])
        if self.parallel is None:
            return crossed, crossed[:, :0]
        parallel = self._of(self.parallel, rows, self.smooth_px[0])
        if self.component == "specular":
            return parallel, crossed
        k = self.leakage / (1.0 - self.leakage)
        values, spread = slice(kernels.C_0, kernels.V_0), slice(kernels.V_0, kernels.CHI)
        cleaned = crossed.copy()
        cleaned[values] -= k * (parallel[values] - crossed[values])
        cleaned[spread] = (1.0 + k) ** 2 * crossed[spread] + k**2 * parallel[spread]
        return cleaned, crossed[:, :0]

    def _of(self, stack: Stack, rows: slice, sigma: float) -> Floating:
        taps = _taps(sigma).astype(self.kind)
        reach = len(taps) - 1
        start, stop = max(0, rows.start - reach), min(self.shape[0], rows.stop + reach)
        y = stack.samples(slice(start, stop), self.kind)
        noise = stack.variances(slice(start, stop), self.kind)
        height, width = y.shape[1:]
        out = np.empty((kernels.MOMENT_ROWS, height * width), self.kind)
        # a view that repeats itself keeps doing so
        flat = (
            np.broadcast_to(noise[:, :1, 0], (len(y), height * width))
            if noise.strides[2] == 0
            else noise.reshape(len(y), -1)
        )
        gain, read = (self.noise.gain, self.noise.read_variance) if self.noise else (0.0, 1.0)
        kernels.moments(y.reshape(len(y), -1), flat, gain, read, self.told, stack.dark, out)
        if reach:
            _smooth(out.reshape(-1, height, width), taps)
        inner = out.reshape(-1, height, width)[:, rows.start - start : rows.stop - start]
        return np.ascontiguousarray(inner).reshape(kernels.MOMENT_ROWS, -1)


def _taps(sigma: float) -> NDArray[np.float64]:
    """Return a Gaussian's taps from its middle outward, the whole kernel's sum 1."""
    if sigma == 0.0:
        return np.ones(1)
    k = np.arange(int(np.ceil(REACH_SIGMA * sigma)) + 1)
    taps = np.exp(-0.5 * (k / sigma) ** 2)
    return np.asarray(taps / (2.0 * taps.sum() - taps[0]))


def _smooth(moments: Floating, taps: Floating) -> None:
    """Smooth moments (MOMENT_ROWS, H, W) in place over their valid pixels; variances follow."""
    mask = np.isfinite(moments[kernels.C_0])
    if not mask.any():
        return
    line, found = np.empty_like(moments[0]), np.empty_like(moments[0])
    share = np.empty_like(moments[0])
    kernels.smooth(np.ones_like(share), taps, mask, share, line)
    share[~mask] = 1.0
    squared = taps * taps
    for row in range(kernels.CHI):
        mean = row < kernels.V_0
        kernels.smooth(moments[row], taps if mean else squared, mask, found, line)
        moments[row] = found / share if mean else found / share**2
        moments[row][~mask] = np.nan


def prepare(
    stacks: Mapping[str, Stack],
    component: Literal["specular", "diffuse"],
    *,
    noise: SensorNoise | None,
    leakage: float,
    smooth_px: float,
    smooth_crossed_px: float | None,
) -> Reflection:
    """Check that the pictures tell the component, and what is known of their noise.

    Parameters
    ----------
    stacks
        By polarization; with variances, or with `noise`, or neither.
    component, noise, leakage
        See :class:`Reflection`.
    smooth_px, smooth_crossed_px
        Standard deviations of the Gaussians.

    Raises
    ------
    MissingPatterns
        Where a polarization, or patterns of it, are missing.
    """
    for name, sigma in (("smooth_px", smooth_px), ("smooth_crossed_px", smooth_crossed_px or 0.0)):
        if not 0.0 <= sigma <= 100.0:
            raise GradientError(f"{name}: got {sigma}, expected pixels in [0, 100]")
    wanted = ("parallel", "crossed") if component == "specular" else ("crossed",)
    for polarizer in wanted:
        if polarizer not in stacks:
            raise MissingPatterns(
                f"patterns: got no {polarizer} pictures; {component} normals need"
                f" {' and '.join(wanted)} ones, full, x, y, z at least"
                + (
                    ": parallel pictures hold both reflections, and crossed ones tell the diffuse"
                    if component == "specular"
                    else ""
                )
            )
        require(stacks[polarizer].pictures, polarizer=polarizer, purpose=f"{component} normals")
    used = {name: stacks[name] for name in wanted}
    parallel = stacks.get("parallel")
    if component == "diffuse" and (leakage == 0.0 or parallel is None or parallel.redundant < 0):
        parallel = None
    elif parallel is not None:
        used["parallel"] = parallel
    judged = noise is not None or used["crossed"].variance is not None
    told = 1 if used["crossed"].variance is not None else 2
    if told == 2:
        noise = noise or estimate_noise(used)
        told = 0 if noise is None else 2
    kinds = {image.dtype for stack in used.values() for image in stack.pictures.values()}
    return Reflection(
        component, parallel, stacks["crossed"], noise if told == 2 else None, told, judged, leakage,
        (smooth_px, smooth_px if smooth_crossed_px is None else smooth_crossed_px),
        np.float64 if np.dtype(np.float64) in kinds else np.float32,
    )  # fmt: skip


def with_shared_dark(stacks: Mapping[str, Stack]) -> dict[str, Stack]:
    """Give a dark frame that was taken in one polarization only to the other, too.

    The analyser does not change it where no other light is about. Its noise then counts in both,
    though it cancels in their difference: standard errors err to the large side.
    """
    out = dict(stacks)
    dark = [name for name, stack in stacks.items() if stack.dark]
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
        out[other] = replace(
            stack, pictures={**stack.pictures, "dark": source.pictures["dark"]},
            variance=variance, valid=valid,
        )  # fmt: skip
    return out
