"""Light from inside a face in the dome, light after light, kept between the cameras."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from capture.rig import View
from rigsim.arrays import Float32Array
from rigsim.geometry.atlas import sample
from rigsim.light.lateral_scattering import LateralScattering
from rigsim.light.olat import Hits, Lamp
from rigsim.scenes.exposing import Kept

Float16Array = NDArray[np.float16]

KEPT_GLOW_BYTES: Final = 2**29
"""Latest light from inside that is kept: it is the same for all cameras, which ask one after the
other for many lights."""

HALF_RANGE: Final = 1000.0
"""Its greatest value where it is kept with 11 bits, which resolve 1e-10 of that."""


class DomeSubsurfaceRadiance:
    """What leaves the interior of one face besides what its own points send back.

    Parameters
    ----------
    scattering
        Returns the face, ready to be lit from within, for a camera.
    """

    def __init__(self, scattering: Callable[[View], LateralScattering]) -> None:
        self._make = scattering
        self._scattering: dict[str, LateralScattering] = {}
        self._kept: Kept[tuple[str, int, float], tuple[np.float32, Float16Array]] = Kept(
            lambda glow: KEPT_GLOW_BYTES // glow[1].nbytes
        )

    def on_rows(self, hits: Hits, lamp: Lamp, view: View, light: int, t_s: float) -> Float32Array:
        """Return the light from inside at a camera's rows.

        Parameters
        ----------
        hits
            The rows.
        lamp
            The light, in the frame of the mesh.
        view
            The camera; its colors count.
        light, t_s
            Number of the light and world time in s, by which it is kept.

        Returns
        -------
        ndarray of float32
            pi times radiance before the boundary, (n, 3), see `rigsim.light.lateral_scattering`.
        """
        camera = view.spectral_sensitivity
        if camera not in self._scattering:
            self._scattering[camera] = self._make(view)

        def lit() -> tuple[np.float32, Float16Array]:
            glow = self._scattering[camera].glow(lamp)
            unit = np.float32(max(float(glow.max()), 1e-30) / HALF_RANGE)
            return unit, np.asarray(glow / unit, np.float16)

        unit, kept = self._kept.get((camera, light, t_s), lit)
        uv = hits.texture_uv()
        return unit * sample(kept.astype(np.float32), uv, np.ones(len(uv), np.bool_))
