"""What a camera of the dome meets: a face by its texture, or a target."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from capture.rig import View
from rigsim.arrays import Float32Array, Int32Array
from rigsim.geometry.atlas import sample
from rigsim.light.olat import Hits, LookUp, find_hits
from rigsim.light.olat_kernels import MATT_ROWS, METAL_ROWS, SKIN_ROWS
from rigsim.render import Caster, GBuffer
from rigsim.targets import Target


@dataclass(frozen=True, slots=True, eq=False)
class Looking:
    """How cameras look."""

    subpixels: int
    """Rays along each side of a pixel."""
    illuminant: str
    """Spectrum of the lights."""
    optics: bool
    """Whether the lens blurs."""

    def hits(
        self,
        caster: Caster,
        view: View,
        look_up: LookUp,
        distortion: ArrayLike | None,
        kind: int = SKIN_ROWS,
    ) -> Hits:
        """Return what a camera's rays meet, see `rigsim.light.olat.find_hits`."""
        return find_hits(
            caster,
            view,
            look_up,
            subpixels=self.subpixels,
            kind=kind,
            distortion=distortion,
            illuminant=self.illuminant if self.optics else None,
        )


def at_skin(
    caster: Caster, view: View, texture: Float32Array, how: Looking, distortion: ArrayLike | None
) -> Hits:
    """Look at a face.

    Parameters
    ----------
    caster
        Its mesh.
    view
        The camera, in the frame of the mesh.
    texture
        Surface and normals with relief in the last three, shape (N, N, 10) or (N, N, 14).
    how, distortion
        Rays and lens; its distortion, see `rigsim.render.camera_rays`.
    """

    def look_up(buffers: GBuffer, rows: Int32Array) -> tuple[Float32Array, Float32Array]:
        uv = buffers.uv.reshape(-1, 2)[rows]
        values = sample(texture, uv, np.ones(len(rows), np.bool_))
        return unit(values[:, -3:]), np.maximum(values[:, :-3], 0.0)

    return how.hits(caster, view, look_up, distortion)


def at_target(
    caster: Caster, view: View, target: Target, how: Looking, distortion: ArrayLike | None
) -> Hits:
    """Look at a target that reflects."""
    rgb = target.rgb(view.spectral_sensitivity, how.illuminant)

    def look_up(buffers: GBuffer, rows: Int32Array) -> tuple[Float32Array, Float32Array]:
        uv = buffers.uv.reshape(-1, 2)[rows]
        surface = np.zeros((len(rows), 7), np.float32)
        size = rgb.shape[0]
        column = np.clip((uv[:, 0] * size).astype(np.int64), 0, size - 1)
        row = np.clip(((1.0 - uv[:, 1]) * size).astype(np.int64), 0, size - 1)
        surface[:, :3] = rgb[row, column]
        surface[:, 3] = target.alpha
        return buffers.normal.reshape(-1, 3)[rows], surface

    kind = METAL_ROWS if target.kind == "metal" else MATT_ROWS
    return how.hits(caster, view, look_up, distortion, kind)


def unit(vectors: Float32Array) -> Float32Array:
    """Return vectors of length 1, shape (..., 3); those of length 0 stay."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, np.float32(1e-6)), np.float32)
