"""The analyser before the gradient rig's camera, at the samples of its pixels."""

from typing import Final

import numpy as np

from capture.rig import View
from rigsim import shading
from rigsim.arrays import Float32Array
from rigsim.as_built.polarizers import Polarizers
from rigsim.scenes.gradient.patch import sample_grid

MAX_KEPT_FRAMES: Final = 4


class GridAnalyser:
    """Films before a camera that looks at the plane z = 0."""

    def __init__(self, films: Polarizers, view: View) -> None:
        self._films, self._view = films, view
        self._frames: dict[tuple[float, int], tuple[Float32Array, Float32Array]] = {}

    def analyse(
        self, stokes: Float32Array, reading_deg: float, *, border_px: int = 0
    ) -> Float32Array:
        """Apply the analyser to Stokes vectors of shape (3, H, W)."""
        cos2, sin2 = self._frame(reading_deg, border_px)
        leak = 1.0 / self._films.analyser_extinction
        turned = stokes[1] * cos2 + stokes[2] * sin2
        return np.asarray(
            np.float32(0.5 * (1.0 + leak)) * stokes[0] + np.float32(0.5 * (1.0 - leak)) * turned
        )

    def _frame(self, reading_deg: float, border_px: int) -> tuple[Float32Array, Float32Array]:
        key, view = (reading_deg, border_px), self._view
        if key not in self._frames:
            if len(self._frames) >= MAX_KEPT_FRAMES:
                self._frames.clear()
            passes_deg = self._films.passes_deg(view, "parallel", reading_deg)
            x, y = sample_grid(view, subpixels=1, border_px=border_px)
            right, up, _ = view.axes
            to_camera = np.empty((len(y), len(x), 3), np.float32)
            to_camera[..., 0], to_camera[..., 1] = -x[None, :], -y[:, None]
            to_camera[..., 2] = view.distance_mm
            to_camera /= np.linalg.norm(to_camera, axis=-1, keepdims=True)
            self._frames[key] = shading.analyser_frame(
                to_camera, passes_deg=passes_deg, image_right=right, image_up=up
            )
        return self._frames[key]
