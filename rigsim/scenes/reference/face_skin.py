"""Reflection of a face: light of voxels from below the surface, and Mitsuba's own facets.

Each point of the face reflects as a half-space of its own pigment. Its light into all directions
is R_d by the photon walk; the distribution over directions is that of voxels by `tissue`, which
four pigments along the face's range carry. Light transport is linear: one render of a pigment
serves all lights and cameras.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from rigsim.arrays import Float32Array, Float64Array
from rigsim.geometry.atlas import dilate_texture, sample
from rigsim.light.surface_brdf import SkinSurface
from rigsim.scenes.reference.directions import DirectionalReflectance, render_directions
from rigsim.scenes.reference.facets import SkinFacets
from rigsim.subject import SimulatedSubject
from rigsim.subject.person_skin import SiteSkin

PIGMENT_PERCENTILES: Final = (2.0, 98.0)
"""Percentiles of a face's melanin and of its blood that are rendered."""
N_PIGMENTS: Final = 4


@dataclass(frozen=True, slots=True, eq=False)
class FaceDirections:
    """Distribution of a face's light over directions, between four pigments."""

    shape: DirectionalReflectance
    """f_r over R_d of the four pigments' channels, 12: melanin, blood, then RGB."""
    log_melanin: Float64Array
    """Logarithms of the lower and of the higher rendered melanin, shape (2,)."""
    log_blood: Float64Array
    """The same of blood, shape (2,)."""

    def evaluate(
        self,
        melanin: Float32Array,
        blood: Float32Array,
        normal: ArrayLike,
        to_light: ArrayLike,
        to_camera: ArrayLike,
    ) -> Float64Array:
        """Return f_r over R_d in 1/sr, shape (n, 3).

        Parameters
        ----------
        melanin, blood
            Volume fractions, shape (n,); beyond the rendered ones, those are taken.
        normal, to_light, to_camera
            As for `DirectionalReflectance.evaluate`, shape (n, 3).
        """
        parts = self.shape.evaluate(normal, to_light, to_camera).reshape(-1, 2, 2, 3)
        up, red = (
            np.clip((np.log(np.maximum(values, 1e-6)) - low) / max(high - low, 1e-9), 0.0, 1.0)
            for values, (low, high) in ((melanin, self.log_melanin), (blood, self.log_blood))
        )
        of_melanin = (1.0 - up)[:, None, None] * parts[:, 0] + up[:, None, None] * parts[:, 1]
        found = (1.0 - red)[:, None] * of_melanin[:, 0] + red[:, None] * of_melanin[:, 1]
        return np.maximum(found, 0.0)


def render_face_directions(
    face: SimulatedSubject,
    camera: str,
    illuminant: str,
    *,
    samples: int,
    seed: int,
    progress: Callable[[str], None] | None = None,
) -> FaceDirections:
    """Render voxels of four pigments of a face under single lights in many cameras.

    Parameters
    ----------
    face
        The face at rest; its epidermis has the thickness between the regions.
    camera, illuminant
        Names of `model.spectra`.
    samples, seed
        As for `rigsim.scenes.reference.directions.render_directions`.
    progress
        Called with a line per pigment.
    """
    covered = face.atlas.covered
    log_melanin, log_blood = (
        np.percentile(np.log(values[covered].astype(np.float64)), PIGMENT_PERCENTILES)
        for values in (face.melanin, face.hemoglobin())
    )
    tissue = face.tissue.with_thickness_ratio(1.0)
    parts, misfit, noise = [], [], []
    for k in range(N_PIGMENTS):
        if progress is not None:
            progress(f"voxels: pigment {k + 1} of {N_PIGMENTS}")
        c_m, c_hd = np.exp(log_melanin[k // 2]), np.exp(log_blood[k % 2])
        skin = SiteSkin(float(c_m), float(c_hd), tissue)
        found = render_directions(
            skin, camera, illuminant, samples=samples, seed=N_PIGMENTS * seed + k
        )
        parts.append(found.coefficients / found.beam_reflectance())
        misfit.append(found.chi2)
        noise.append(found.noise)
    shape = DirectionalReflectance(
        np.concatenate(parts, axis=1), np.concatenate(misfit), np.concatenate(noise)
    )
    return FaceDirections(shape, log_melanin, log_blood)


class FaceReflection:
    """Reflection at any point of a face, see the module.

    Parameters
    ----------
    face
        The face at rest.
    surface
        Its reflection for a camera; R_d, roughness, oil and hair are used.
    directions
        Result of `render_face_directions` for the same camera.
    """

    def __init__(
        self, face: SimulatedSubject, surface: SkinSurface, directions: FaceDirections
    ) -> None:
        covered = face.atlas.covered
        self._directions = directions
        self._pigment = dilate_texture(np.stack([face.melanin, face.hemoglobin()], -1), covered)
        filled = dilate_texture(np.stack([surface.roughness, surface.oil], -1), covered)
        # texels off the face are never sampled, but facets need a roughness
        roughness = np.maximum(filled[..., 0], np.float32(0.01))
        self._facets = SkinFacets(roughness, filled[..., 1])

    def evaluate(
        self,
        uv: Float32Array,
        r_d: Float32Array,
        bare: Float32Array,
        ways: tuple[ArrayLike, ArrayLike, ArrayLike],
    ) -> tuple[Float64Array, Float64Array]:
        """Return f_r in 1/sr, shape (n, 3), and its surface part, shape (n,).

        Parameters
        ----------
        uv
            Texture coordinates, shape (n, 2).
        r_d
            Factor R_d of the points, hair included, shape (n, 3).
        bare
            Fraction not behind hair, shape (n,).
        ways
            Unit normals, and unit vectors to light and camera, shape (n, 3) or (3,) each.
        """
        pigment = sample(self._pigment, uv, np.ones(len(uv), np.bool_))
        inside = self._directions.evaluate(pigment[:, 0], pigment[:, 1], *ways)
        surface = bare * self._facets.evaluate(*ways, uv)
        return r_d * inside + surface[:, None], surface
