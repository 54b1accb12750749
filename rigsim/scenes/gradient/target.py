"""Light the gradient rig's targets, which replace the patch of skin."""

from typing import Final

import numpy as np

from capture.rig import View
from rigsim.arrays import Float32Array
from rigsim.as_built.sphere import ActualSphere, diffuser_radiance
from rigsim.scenes.gradient.patch import sample_grid
from rigsim.targets.glass_ball import draw_ball_center_mm, render_ball_stokes

FLAT_REFLECTANCE: Final = 0.3
"""Reflectance of the diffuser in place of the patch: 30 ms at level 1 give 0.9 of full scale."""


def target_moments(
    name: str, view: View, sphere: ActualSphere, extinction: float, *, seed: int
) -> Float32Array:
    """Return the Stokes vectors of a target for each moment of the light, before the lens.

    Parameters
    ----------
    name
        "ball", "flat" or "dark".
    view, sphere
        The camera, and the actual LEDs.
    extinction
        Extinction ratio of the polarizers on the LEDs.
    seed
        Determines the operator's placement of the ball.

    Returns
    -------
    ndarray of float32
        Shape (12, H, W).
    """
    if name == "ball":
        return render_ball_stokes(
            view, sphere, extinction=extinction, center_mm=draw_ball_center_mm(seed)
        )
    out = np.zeros((12, view.height_px, view.width_px), np.float32)
    if name == "flat":
        x, y = sample_grid(view, subpixels=1, border_px=0)
        out[::3] = FLAT_REFLECTANCE * diffuser_radiance(
            sphere, x[None, :], y[:, None], extinction=extinction
        )
    return out
