"""Compare kernels with simulated skin in equilibrium, in close-ups at the strain of a face.

No photograph of strained skin at 10 um is public. Its counterpart is a patch of simulated skin
whose layer is in mechanical equilibrium on stretched tissue (`rigsim.skin_patch.stretch`), which
shares no code with the kernels. Strain is uniform over the patch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy import ndimage

from model.microstructure import KernelTable
from model.microstructure.mesh_strain import strain
from model.microstructure.strain_fields import TextureStrain
from rigsim.skin_patch.microrelief import MicroSkin
from rigsim.skin_patch.stretch import stretch_skin
from skinrig.applying.face_photograph import FlashCamera, Photograph, photograph
from skinrig.applying.microstructure import convolve_by_strain
from skinrig.arrays import Float32Array, Float64Array

TEXEL_DIVISIONS: Final = 2
SLOPE_BINS: Final = 40
MAX_SLOPE: Final = 1.2


@dataclass(frozen=True, slots=True)
class PlaneStrain:
    """A uniform strain of the plane: one principal stretch, and the other one from its power.

    Attributes
    ----------
    stretch
        Stretch ratio of larger logarithm.
    compensation
        p, 0 to 1: the ratio across is ``stretch ** -p``.
    angle_rad
        Direction of the axis from +x towards +y.
    """

    stretch: float
    compensation: float
    angle_rad: float

    @classmethod
    def of(cls, field: TextureStrain) -> PlaneStrain:
        """Return the strain at the middle of a map; two ratios on one side of 1 lose the milder."""
        middle = (field.stretch.shape[0] // 2, field.stretch.shape[1] // 2)
        logs = np.log(np.asarray(field.stretch[middle], np.float64))
        main = int(np.argmax(np.abs(logs)))
        x, y = field.axes[middle][main]
        power = -float(logs[1 - main]) / float(logs[main]) if logs[main] != 0.0 else 0.0
        return cls(math.exp(logs[main]), min(max(power, 0.0), 1.0), math.atan2(-float(y), float(x)))

    @property
    def across(self) -> float:
        """Return the stretch ratio across the axis."""
        return self.stretch**-self.compensation

    @property
    def gradient(self) -> Float64Array:
        """Return the deformation gradient, (2, 2), symmetric."""
        c, d = math.cos(self.angle_rad), math.sin(self.angle_rad)
        turn = np.array([[c, -d], [d, c]])
        return turn @ np.diag([self.stretch, self.across]) @ turn.T


@dataclass(frozen=True, slots=True, eq=False)
class CloseUp:
    """Photographs of a patch: "neutral", "static", "dynamic" and "equilibrium".

    Attributes
    ----------
    images
        Photographs by name.
    figures
        JSON values: strain; variances of slopes along s and t; half the total variation between
        the slopes' histograms and that in equilibrium.
    """

    images: Mapping[str, Photograph]
    figures: dict[str, Any]


def photograph_closeup(
    skin: MicroSkin, by: PlaneStrain, *, table: KernelTable, camera: FlashCamera
) -> CloseUp:
    """Strain a patch by kernels and in equilibrium, and photograph both.

    Parameters
    ----------
    skin
        Neutral patch.
    by
        Its strain.
    table
        Kernels over stretch.
    camera
        Camera and light, aimed at the middle of the patch.
    """
    count = TEXEL_DIVISIONS * len(skin.height_um)
    at = ((np.arange(count) + 0.5) / count - 0.5) * skin.size_mm
    x, y = np.meshgrid(at, -at)
    rest = np.stack([x, y], axis=-1)
    surfaces = {
        name: np.concatenate([plane, np.zeros((count, count, 1))], axis=-1)
        for name, plane in (("rest", rest), ("strained", rest @ by.gradient.T))
    }
    corners = 0.5 * skin.size_mm * np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
    flat, moved = (
        np.concatenate([corners @ one.T, np.zeros((4, 1))], axis=1)
        for one in (np.eye(2), by.gradient)
    )
    faces, uv = np.array([[0, 1, 3], [0, 3, 2]]), (corners / skin.size_mm + 0.5)
    dynamic, _ = convolve_by_strain(
        skin.height_um, strain(flat, moved, faces, uv), faces, uv, table
    )
    found = stretch_skin(
        skin, stretch=by.stretch, angle_deg=math.degrees(by.angle_rad), compensation=by.compensation
    )
    shown = {
        "neutral": ("rest", skin.height_um),
        "static": ("strained", skin.height_um),
        "dynamic": ("strained", dynamic),
        "equilibrium": ("strained", found.height_um),
    }
    axes = np.linalg.eigh(by.gradient)[1][:, ::-1]
    gradients = {"rest": np.eye(2), "strained": by.gradient}
    slopes = {
        name: _slopes(height, skin.texel_um, gradients[plane], axes)
        for name, (plane, height) in shown.items()
    }
    truth = _histogram(slopes["equilibrium"])
    return CloseUp(
        {
            name: photograph(surfaces[plane], _refine(height), camera)
            for name, (plane, height) in shown.items()
        },
        {
            "stretch": [by.stretch, by.across],
            "angle_deg": math.degrees(by.angle_rad),
            "slope_variances": {
                name: [float(v) for v in one.reshape(-1, 2).var(axis=0)]
                for name, one in slopes.items()
            },
            "histogram_distance": {
                name: float(0.5 * np.abs(_histogram(slopes[name]) - truth).sum())
                for name in ("static", "dynamic")
            },
        },
    )


def _refine(height_um: Float32Array) -> Float32Array:
    """Return a map on texels `TEXEL_DIVISIONS` times as fine, so that each pixel has several."""
    rows, columns = (
        (np.arange(TEXEL_DIVISIONS * n) + 0.5) / TEXEL_DIVISIONS - 0.5 for n in height_um.shape
    )
    at = np.meshgrid(rows, columns, indexing="ij")
    return ndimage.map_coordinates(height_um, at, order=3, mode="nearest", output=np.float32)


def _slopes(
    height_um: Float32Array, texel_um: float, gradient: Float64Array, axes: Float64Array
) -> Float64Array:
    """Return slopes over the plane strained by a gradient, along axes s and t, (N, N, 2)."""
    down, right = (np.asarray(part, np.float64) / texel_um for part in np.gradient(height_um))
    return np.asarray(np.stack([right, -down], axis=-1) @ np.linalg.inv(gradient) @ axes)


def _histogram(slopes: Float64Array) -> Float64Array:
    """Return the distribution of slopes over both axes; steep ones count in the last bins."""
    edges = np.linspace(-MAX_SLOPE, MAX_SLOPE, SLOPE_BINS + 1)
    held = np.clip(slopes.reshape(-1, 2), -0.999 * MAX_SLOPE, 0.999 * MAX_SLOPE)
    counts = np.histogram2d(held[:, 0], held[:, 1], bins=(edges, edges))[0]
    return np.asarray(counts / counts.sum())
