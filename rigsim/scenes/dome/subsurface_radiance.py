"""Light from inside a face in the dome, light after light, kept between the cameras."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from capture.rig import View
from rigsim.arrays import Float32Array
from rigsim.geometry.atlas import sample
from rigsim.light import olat
from rigsim.light.interreflection import Interreflection, interreflection_for
from rigsim.light.lateral_scattering import LateralScattering
from rigsim.light.olat import Hits, Lamp
from rigsim.light.relief_shadow import ReliefShadow
from rigsim.light.surface_brdf import SkinSurface
from rigsim.render import Caster
from rigsim.subject import SimulatedSubject

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
    subject
        The face.
    caster
        Its mesh.
    illuminant
        Spectrum of the lights, a name known to `model.spectra`.
    subsurface
        Whether light spreads sideways.
    interreflections
        Whether light goes from skin to skin.
    spectral
        Whether that light is reflected wavelength by wavelength.
    enough
        Share of the first bounce below which further ones are left out.
    relief
        What of the texture's relief hides lights; None: nothing.
    """

    def __init__(
        self,
        subject: SimulatedSubject,
        caster: Caster,
        *,
        illuminant: str,
        subsurface: bool,
        interreflections: bool,
        spectral: bool,
        enough: float,
        relief: ReliefShadow | None,
    ) -> None:
        self._subject, self._caster, self._illuminant = subject, caster, illuminant
        self._subsurface, self._interreflections = subsurface, interreflections
        self._spectral, self._enough, self._relief = spectral, enough, relief
        self._bounce: Interreflection | None = None
        self._bleeding: dict[str, LateralScattering] = {}
        self._kept: OrderedDict[tuple[str, int, float], tuple[np.float32, Float16Array]] = (
            OrderedDict()
        )

    def on_rows(
        self,
        hits: Hits,
        lamp: Lamp,
        view: View,
        surface: Callable[[View], SkinSurface],
        *,
        light: int,
        t_s: float,
    ) -> Float32Array:
        """Return what leaves the interior of a camera's rows besides their own diffuse term.

        Parameters
        ----------
        hits
            Rows of skin, n of them.
        lamp
            The light, in the frame of the mesh.
        view
            The camera.
        surface
            How the face reflects for a camera.
        light, t_s
            Which light, and the time that decides how the head stands, s: light of the same two is
            not computed again.

        Returns
        -------
        ndarray of float32
            pi times radiance before the boundary, (n, 3), see `rigsim.light.lateral_scattering`.
        """
        camera = view.spectral_sensitivity
        if camera not in self._bleeding:
            if self._interreflections and self._bounce is None:
                self._bounce = interreflection_for(self._caster)
            self._bleeding[camera] = LateralScattering(
                self._subject,
                surface(view),
                self._caster,
                camera=camera,
                light=self._illuminant,
                subsurface=self._subsurface,
                bounce=self._bounce,
                spectral=self._spectral,
                enough=self._enough,
                relief=self._relief,
            )
        key = (camera, light, t_s)
        if key not in self._kept:
            glow = self._bleeding[camera].glow(lamp)
            most = max(1, KEPT_GLOW_BYTES // (2 * glow.size))
            while len(self._kept) >= most:
                self._kept.popitem(last=False)
            unit = np.float32(max(float(glow.max()), 1e-30) / HALF_RANGE)
            self._kept[key] = unit, np.asarray(glow / unit, np.float16)
        self._kept.move_to_end(key)
        unit, kept = self._kept[key]
        uv = np.asarray(hits.uv, np.float32) / np.float32(olat.UINT16_FULL_SCALE)
        return unit * sample(kept.astype(np.float32), uv, np.ones(len(uv), np.bool_))
