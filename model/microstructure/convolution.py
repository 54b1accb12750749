"""Convolve a displacement map with spatially varying kernels, in two passes along lines.

Eqs. (3)-(6) of Nagano et al. 2015: ``D_s = D * k_s`` along each pixel's axis s, then
``D' = D_s * k_t`` along its axis t, with ``k = (1 - alpha) delta + alpha G(sigma)``.

Conventions:

- G is the continuous Gaussian at whole steps of one pixel along the line within 4 sigmas, divided
  by its sum, as in `model.microstructure.gaussian_weights`; far below a pixel it is the delta.
  It has the variance of the continuous one within 1 % from sigma = 0.7 px on, 86 % of it at
  0.5 px, half at 0.4 px: maps whose pixels are that coarse are changed less than they should be.
- The delta is the pixel itself, so alpha = 0 changes no bit. Only G samples between pixels, by
  Keys' cubic: bilinear samples blur what is finer than some pixels by themselves, also across the
  line (available as "linear"). On lines along rows and columns both are exact.
- Beyond the map's border it is mirrored about the edges of the outermost pixels.
- Near holes and the borders of islands, samples come in pairs at the same distance to both sides,
  and a pair of which one cannot be taken counts as the pixel itself. That is an odd continuation
  about each pixel: the weights still sum to 1, planes stay planes, and as every pair left out only
  brings the kernel nearer to the delta, nothing is sharpened more than far from any border.

References
----------
Nagano et al. 2015, ACM Trans. Graph. 34(4), 109. doi:10.1145/2766894
Keys 1981, Cubic convolution interpolation, IEEE Trans. ASSP 29(6). doi:10.1109/TASSP.1981.1163711
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import BoolArray, Float32Array, FloatArray, UInt8Array
from model.checks import Checks
from model.microstructure import convolution_kernels as kernels
from model.microstructure.map_windows import MapWindow

Sampling = Literal["cubic", "linear"]
Border = Literal["mirror", "open"]

MAX_SIGMA_PX = 1000.0
"""Upper limit of sigma, px; a wider Gaussian is a mistake in units."""

_INTERPOLATION_CODES = {"linear": kernels.LINEAR, "cubic": kernels.CUBIC}
_BORDER_CODES = {"mirror": kernels.MIRROR, "open": kernels.OPEN}
_ERROR_TEXTS = {
    kernels.NOT_FINITE: "got NaN or infinity",
    kernels.ALPHA: "got a strength beyond [-2, 1]",
    kernels.SIGMA: f"got a standard deviation beyond 0...{MAX_SIGMA_PX:g} px",
    kernels.AXIS: "got an axis that is not of unit length where the kernel is not the identity",
}


class ConvolutionError(ValueError):
    """Error for maps, kernels or settings that cannot be convolved."""


class LineKernels(NamedTuple):
    """Kernels of one pass for a window of a map.

    Attributes
    ----------
    axis : ndarray of float32, shape (h, w, 2) or (1, 1, 2)
        Unit vectors in pixels, x right, y down; the sign is irrelevant.
    alpha : ndarray of float32, shape (h, w) or (1, 1)
        Strength in [-2, 1].
    sigma_px : ndarray of float32, shape (h, w) or (1, 1)
        Standard deviation along the axis, px, >= 0.
    """

    axis: Float32Array
    alpha: Float32Array
    sigma_px: Float32Array

    @classmethod
    def of(
        cls, axis: ArrayLike, alpha: ArrayLike, sigma_px: ArrayLike, shape: tuple[int, int]
    ) -> LineKernels:
        """Make kernels from scalars or fields of a window of the given shape."""
        return cls(
            _field("axis", axis, (*shape, 2)),
            _field("alpha", alpha, shape),
            _field("sigma", sigma_px, shape),
        )

    @property
    def is_identity(self) -> bool:
        """Return whether no pixel changes."""
        return not (self.alpha.any() and self.sigma_px.any())

    def part(self, window: MapWindow) -> LineKernels:
        """Return the kernels of a window within this one."""

        def cut(values: Float32Array) -> Float32Array:
            if values.shape[:2] == (1, 1):
                return values
            return np.ascontiguousarray(values[window.rows, window.columns])

        return LineKernels(cut(self.axis), cut(self.alpha), cut(self.sigma_px))


def _field(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Float32Array:
    given = np.asarray(values, np.float32)
    if given.shape == shape:
        return np.ascontiguousarray(given)
    if given.shape == shape[2:]:
        return given.reshape(1, 1, *shape[2:])
    raise ConvolutionError(f"{name}: got shape {given.shape}, expected {shape} or {shape[2:]}")


def kernel_reach(lines: LineKernels, shape: tuple[int, int], sampling: Sampling = "cubic") -> int:
    """Return the distance of a window's farthest samples, px; 0 if nothing changes.

    Raises
    ------
    ConvolutionError
        For parameters that are not finite or beyond their ranges, or axes that are not unit
        vectors.
    """
    code, largest = kernels.check_rows(lines, shape[0], np.float32(MAX_SIGMA_PX))
    if code.any():
        row = int(np.flatnonzero(code)[0])
        raise ConvolutionError(f"alpha, sigma, axis: {_ERROR_TEXTS[int(code[row])]}, row {row}")
    radius = int(kernels.TRUNCATE_SIGMAS * float(largest.max(initial=0.0)) + 0.5)
    return radius + _INTERPOLATION_CODES[sampling] if radius else 0


def _settings(sampling: str, border: str) -> None:
    Checks(ConvolutionError).choice("sampling", sampling, _INTERPOLATION_CODES)
    Checks(ConvolutionError).choice("border", border, _BORDER_CODES)


def _usable(height: FloatArray, valid: ArrayLike | None) -> UInt8Array:
    """Return distances to pixels that are not valid, empty where there are none."""
    good: BoolArray = np.isfinite(height)
    if valid is not None:
        mask = np.asarray(valid)
        Checks(ConvolutionError).mask("valid", mask, height.shape)
        good &= mask
    if good.all():
        return np.zeros((0, 0), np.uint8)
    return np.asarray(kernels.distance_to_invalid(good))


def _pass(
    source: FloatArray,
    source_window: MapWindow,
    clear: UInt8Array,
    lines: LineKernels,
    window: MapWindow,
    shape: tuple[int, int],
    sampling: Sampling,
    border: Border,
) -> FloatArray:
    """Return one pass in a window of the map."""
    if lines.is_identity:
        inner = window.within(source_window)
        return source[inner.rows, inner.columns]
    out = np.empty(window.shape, source.dtype)
    reach, code = _INTERPOLATION_CODES[sampling], _BORDER_CODES[border]
    kernels.convolve_lines(source, clear, source_window, shape, lines, window, reach, code, out)
    return out


def convolve(
    height: ArrayLike,
    axis_s: ArrayLike,
    axis_t: ArrayLike,
    alpha_s: ArrayLike,
    sigma_s: ArrayLike,
    alpha_t: ArrayLike,
    sigma_t: ArrayLike,
    *,
    valid: ArrayLike | None = None,
    sampling: Sampling = "cubic",
    border: Border = "mirror",
) -> FloatArray:
    """Convolve a map along two axes in turn, with kernels that vary from pixel to pixel.

    Parameters
    ----------
    height : array_like, shape (..., H, W)
        Displacement, any unit; maps of a stack are convolved alike. float32 and float16 are
        computed in float32, everything else in float64. Row 0 is the top.
    axis_s, axis_t : array_like, shape (H, W, 2) or (2,)
        Unit vectors (x right, y down) in pixels; the sign is irrelevant. Ignored where the kernel
        is the identity.
    alpha_s, sigma_s, alpha_t, sigma_t : array_like, shape (H, W) or ()
        Strengths in [-2, 1] and standard deviations along the axes, px, >= 0. They and the axes
        are taken in float32.
    valid : array_like of bool, shape (H, W) or that of `height`, optional
        Heights to sample; heights that are not finite never are. Others keep their value.
    sampling : {"cubic", "linear"}
        Interpolation between pixels: Keys' cubic, or bilinear, which is quicker and blurs.
    border : {"mirror", "open"}
        Continuation beyond the map: its mirror image, or none (as in a hole).

    Returns
    -------
    ndarray of float32 or float64, shape (..., H, W)
        A new array.

    Raises
    ------
    ConvolutionError
        For wrong shapes, parameters beyond their ranges, or axes that are not unit vectors.

    Examples
    --------
    >>> spike = np.zeros((1, 7))
    >>> spike[0, 3] = 1.0
    >>> convolve(spike, (1, 0), (0, 1), 0.5, 0.7, 0.0, 1.0)[0].round(3).tolist()
    [0.0, 0.005, 0.103, 0.785, 0.103, 0.005, 0.0]
    """
    _settings(sampling, border)
    given = np.asarray(height)
    Checks(ConvolutionError).shape("height", given, ("...", "H", "W"))
    shape = (given.shape[-2], given.shape[-1])
    first = LineKernels.of(axis_s, alpha_s, sigma_s, shape)
    second = LineKernels.of(axis_t, alpha_t, sigma_t, shape)
    for lines in (first, second):
        kernel_reach(lines, shape, sampling)
    single = given.dtype in (np.float16, np.float32)
    source: FloatArray = np.ascontiguousarray(given, np.float32 if single else np.float64)
    mask = _mask(valid, source.shape)
    if first.is_identity and second.is_identity:
        return source.copy()
    whole = MapWindow(0, shape[0], 0, shape[1])

    def convolved(at: tuple[int, ...]) -> FloatArray:
        clear = _usable(source[at], None if mask is None else mask[at])
        along_s = _pass(source[at], whole, clear, first, whole, shape, sampling, border)
        return _pass(along_s, whole, clear, second, whole, shape, sampling, border)

    if source.ndim == 2:
        return convolved(())  # without a copy of a large map
    out = np.empty_like(source)
    for at in np.ndindex(source.shape[:-2]):
        out[at] = convolved(at)
    return out


def _mask(valid: ArrayLike | None, shape: tuple[int, ...]) -> BoolArray | None:
    """Return the mask of a stack of maps, given for each map or for all."""
    if valid is None:
        return None
    mask = np.asarray(valid)
    Checks(ConvolutionError).mask("valid", mask, shape, shape[-2:])
    return np.broadcast_to(mask, shape)


def list_tiles(shape: tuple[int, int], tile: int) -> list[MapWindow]:
    """Return the tiles of a map, row by row.

    Examples
    --------
    >>> [t.shape for t in list_tiles((5, 3), 3)]
    [(3, 3), (2, 3)]
    """
    Checks(ConvolutionError).within("tile", tile, "[1, inf)")
    return [
        MapWindow(top, min(top + tile, shape[0]), left, min(left + tile, shape[1]))
        for top in range(0, shape[0], tile)
        for left in range(0, shape[1], tile)
    ]


def convolve_tiled(
    source: Any,
    target: Any,
    fields_at: Callable[[MapWindow], tuple[LineKernels, LineKernels]],
    *,
    tile: int = 2048,
    valid_at: Callable[[MapWindow], BoolArray] | None = None,
    sampling: Sampling = "cubic",
    border: Border = "mirror",
    finished: Collection[int] = (),
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Convolve a map tile by tile; bit-identical to `convolve`.

    Parameters
    ----------
    source, target : array-like with two-dimensional slices, shape (H, W)
        Arrays or memory maps; different ones. The target takes float32.
    fields_at : callable
        Kernels of both passes for a window: ``(LineKernels, LineKernels)``, arrays of the window's
        shape or (1, 1). A pixel's kernels must be the same in every window.
    tile : int
        Side of a tile, px. A tile needs some 20 arrays of float32 of its size and margin.
    valid_at : callable, optional
        Heights to sample in a window, bool; heights that are not finite never are.
    sampling, border
        As of `convolve`.
    finished : collection of int
        Numbers of tiles (in the order of `list_tiles`) that are already in the target.
    progress : callable, optional
        Called as ``progress(number, count)`` after that tile was written. An exception it raises
        ends the work; all tiles reported so far are in the target.

    Raises
    ------
    ConvolutionError
        As of `convolve`, or for a target of another shape or that shares the source's memory.
    """
    _settings(sampling, border)
    shape = tuple(source.shape)
    check = Checks(ConvolutionError)
    check.shape("source", source, ("H", "W"))
    check.shape("target", target, shape)
    check.choice("target", target.dtype, (np.dtype(np.float32),))
    if isinstance(source, np.ndarray) and isinstance(target, np.ndarray):
        if np.may_share_memory(source, target):
            raise ConvolutionError("target: got the source's memory, expected another array")
    tiles = list_tiles(shape, tile)
    margin = 0
    for number, window in enumerate(tiles):
        if number in finished:
            continue
        while True:
            around = window.expand(margin, shape)
            first, second = fields_at(around)
            for lines in (first, second):
                _fits(lines, around)
            inner = second.part(window.within(around))
            needed = kernel_reach(inner, window.shape, sampling)
            if needed <= margin or around == MapWindow(0, shape[0], 0, shape[1]):
                break
            margin = needed
        reach = kernel_reach(first, around.shape, sampling)
        beyond = around.expand(max(reach, needed), shape)
        heights = np.ascontiguousarray(source[beyond.rows, beyond.columns], np.float32)
        changed = heights[window.within(beyond).rows, window.within(beyond).columns]
        if reach or needed:
            clear = _usable(heights, None if valid_at is None else valid_at(beyond))
            along_s = _pass(heights, beyond, clear, first, around, shape, sampling, border)
            if clear.size:
                part = around.within(beyond)
                clear = np.ascontiguousarray(clear[part.rows, part.columns])
            changed = _pass(
                np.ascontiguousarray(along_s), around, clear, inner, window, shape, sampling, border
            )
        target[window.rows, window.columns] = changed
        if progress is not None:
            progress(number, len(tiles))


def _fits(lines: LineKernels, window: MapWindow) -> None:
    for name, values in lines._asdict().items():
        check = Checks(ConvolutionError)
        check.choice(f"{name} of fields_at", values.dtype, (np.dtype(np.float32),))
        ends = values.shape[2:]
        check.shape(f"{name} of fields_at", values, (*window.shape, *ends), (1, 1, *ends))
