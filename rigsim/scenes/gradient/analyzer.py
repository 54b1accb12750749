"""Apply the analyzer of the gradient rig's camera at the samples of its pixels."""

from typing import Final

import numpy as np

from capture.rig import View
from rigsim import shading
from rigsim.arrays import Float32Array
from rigsim.as_built.polarizers import Polarizers
from rigsim.caching import LruCache
from rigsim.scenes.gradient.patch import sample_grid

MAX_CACHED_FRAMES: Final = 4


class GridAnalyzer:
    """Polarizers of a camera that views the plane z = 0."""

    def __init__(self, films: Polarizers, view: View) -> None:
        self._films, self._view = films, view
        self._frames: LruCache[tuple[float, int], tuple[Float32Array, Float32Array]] = LruCache(
            lambda _: MAX_CACHED_FRAMES
        )

    def analyze(
        self, stokes: Float32Array, reading_deg: float, *, border_px: int = 0
    ) -> Float32Array:
        """Apply the analyzer to Stokes vectors of shape (3, H, W)."""
        key = (reading_deg, border_px)
        cos2, sin2 = self._frames.get(key, lambda: self._frame(*key))
        leak = 1.0 / self._films.analyzer_extinction
        turned = stokes[1] * cos2 + stokes[2] * sin2
        return np.asarray(
            np.float32(0.5 * (1.0 + leak)) * stokes[0] + np.float32(0.5 * (1.0 - leak)) * turned
        )

    def _frame(self, reading_deg: float, border_px: int) -> tuple[Float32Array, Float32Array]:
        view = self._view
        passes_deg = self._films.analyzer_axis_deg(view, "parallel", reading_deg)
        x, y = sample_grid(view, subpixels=1, border_px=border_px)
        right, up, _ = view.axes
        to_camera = np.empty((len(y), len(x), 3), np.float32)
        to_camera[..., 0], to_camera[..., 1] = -x[None, :], -y[:, None]
        to_camera[..., 2] = view.distance_mm
        to_camera /= np.linalg.norm(to_camera, axis=-1, keepdims=True)
        axes = {"image_right": right, "image_up": up}
        return shading.analyzer_frame(to_camera, passes_deg=passes_deg, **axes)
