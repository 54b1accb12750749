"""Simulate only those maps of a person that the page displays at full resolution.

A complete person of 2048 texels takes several times as long. Normals, specular reflection, hair and
blood of expressions are those of a coarser person.
"""

from typing import Final

import numpy as np

from rigsim.geometry.atlas import unwrap
from rigsim.subject import SimulatedSubject, face_regions, pigment, relief
from rigsim.subject.perfusion import draw_perfusion
from skinrig.arrays import Float32Array, Float64Array
from skinrig.viewer.map_filling import fill_holes

PERSON_PX: Final = 512
"""Maximum side of the person of all other maps: texels of 0.5 mm on a face."""


class FineSkin:
    """Skin of a simulated person in a texture of another size, consistent with the person's own.

    Texels without skin are filled from their surroundings.

    Parameters
    ----------
    person : rigsim.subject.SimulatedSubject
        Neutral person.
    size : int
        Side of the texture, texels, at least the person's.
    """

    def __init__(self, person: SimulatedSubject, size: int) -> None:
        """Compute the texture atlas."""
        self._person = person
        self._atlas = person.atlas if size == person.size else unwrap(person.mesh, size)
        self.covered = self._atlas.covered
        """Texels with skin, (N, N)."""
        # noise is evaluated per point, only on the face
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
        found = draw_perfusion(
            self._points,
            self._regions,
            pigment.typical_blood(pigment.MELANIN_PRESETS[self._person.preset]),
            seed=self._person.seed,
        )
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
