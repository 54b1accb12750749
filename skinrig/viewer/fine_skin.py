"""The few maps of a simulated person that the page shows at its full size, and nothing else.

A whole person of 2048 texels takes several times as long: normals, gloss, hair and blood of every
state are drawn from a coarser one.
"""

from typing import Final

import numpy as np

from rigsim.geometry.atlas import unwrap
from rigsim.subject import SimulatedSubject, face_regions, pigment, relief
from rigsim.subject.perfusion import draw_perfusion
from skinrig.arrays import Float32Array, Float64Array
from skinrig.viewer.map_filling import fill_holes

PERSON_PX: Final = 512
"""Most texels a side of the person that everything else comes from: half a millimeter of a face."""


class FineSkin:
    """Skin of a simulated person in a texture of another size, the same as the person's own.

    Texels without skin hold what surrounds them.

    Parameters
    ----------
    person : rigsim.subject.SimulatedSubject
        At rest.
    size : int
        Texels a side, at least the person's.
    """

    def __init__(self, person: SimulatedSubject, size: int) -> None:
        """Lay out the surface."""
        self._person = person
        self._atlas = person.atlas if size == person.size else unwrap(person.mesh, size)
        self.covered = self._atlas.covered
        """Texels with skin, (N, N)."""
        # noise is drawn point by point: those beside the face are left out
        surface = self._atlas.position_mm[self.covered]
        self._points = np.asarray(face_regions.to_mean_head(surface, person.mesh), np.float32)
        self._regions = face_regions.region_masks(self._points)

    def melanin(self) -> Float64Array:
        """Return the volume fraction of melanosomes in the epidermis, (N, N)."""
        base = pigment.MELANIN_PRESETS[self._person.preset]
        return self._on_texture(
            pigment.draw_melanin_map(self._points, self._regions, base, seed=self._person.seed)
        )

    def hemoglobin(self) -> Float64Array:
        """Return the volume fraction of blood in the dermis of the neutral state, (N, N)."""
        found = draw_perfusion(self._points, self._regions, seed=self._person.seed)
        return self._on_texture(found.blood("neutral"))

    def height_um(self) -> Float64Array:
        """Return pores and lines over the mesh, um, (N, N)."""
        along_u, along_v = self._atlas.texel_mm()
        texel_mm = float(np.median(np.maximum(along_u, along_v)[self.covered]))
        return self._on_texture(
            relief.height_um(self._points, self._regions, texel_mm=texel_mm, seed=self._person.seed)
        )

    def _on_texture(self, values: Float32Array) -> Float64Array:
        whole = np.zeros(self.covered.shape, np.float32)
        whole[self.covered] = values
        return fill_holes(whole, self.covered)
