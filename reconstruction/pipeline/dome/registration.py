"""Register a mesh of the face to the dome's one-light-at-a-time images."""

from typing import Final

import numpy as np

from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float32Array, Float64Array
from reconstruction.pipeline.dome.calibrated import CalibratedDome, reorder_lights
from reconstruction.pipeline.inputs import InputsError
from reconstruction.scan import registration as scan_registration
from reconstruction.scan.registration import RigidFit
from reconstruction.scan.repair import TriangleMesh
from reconstruction.scan.rough_normals import ScanRegistrationError

N_REGISTRATION_LIGHTS: Final = 40
"""Lights whose images the mesh is registered to."""
MIN_SIGNAL_TO_NOISE: Final = 5.0
"""Signal-to-noise ratio from which on a pixel counts as lit."""


def register_mesh(dome: CalibratedDome, mesh: TriangleMesh) -> RigidFit:
    """Register a mesh to the images of a dome; see `reconstruction.scan.registration.align_scan`.

    Parameters
    ----------
    dome
        Calibrated, with its images.
    mesh
        Clean, within about 10 mm and 5 degrees of the face.

    Raises
    ------
    InputsError
        When all usable lights are behind the face, or the mesh is not found in the images.
    """
    chosen = farthest_point_sample(
        dome.lights.position_mm, dome.lights.valid, N_REGISTRATION_LIGHTS
    )
    shares = []

    def stacks(view: int) -> Float32Array:
        layers = []
        for capture in chosen:
            image = dome.image(view, capture)
            gray = image.rgb.mean(axis=-1)
            noise = np.sqrt(image.variance.sum(axis=-1)) / 3.0
            seen = image.valid & (gray > MIN_SIGNAL_TO_NOISE * noise)
            shares.append((np.mean(~image.valid), np.mean(seen)))
            layers.append(np.where(image.valid, gray, np.nan))
        return np.asarray(layers, np.float32)

    try:
        return scan_registration.align_scan(
            mesh,
            cameras=dome.cameras,
            lights=reorder_lights(dome.lights, chosen, [dome.lights.names[k] for k in chosen]),
            stacks=stacks,
            binning=2,
            rng=np.random.default_rng(0),
        )
    except ScanRegistrationError as exc:
        lost, seen = 100.0 * np.mean(shares, axis=0)
        raise InputsError(
            f"surface: the scan was not found in the images: {exc}; {lost:.1f} % of their pixels "
            f"are saturated in every exposure, {seen:.1f} % are brighter than their noise; "
            "check that the scan is of this subject, or capture again [SR-REC-009]"
        ) from exc


def farthest_point_sample(position_mm: Float64Array, usable: BoolArray, count: int) -> list[int]:
    """Choose lights in front of the face, each the farthest from those chosen before."""
    way = unit_vectors(position_mm)
    front = np.flatnonzero(usable & (way[:, 2] > -0.1))
    if not len(front):
        got = "got no usable light in front of the face, expected at least one"
        raise InputsError(f"lights: {got}; check the light calibration")
    chosen = [int(front[np.argmax(way[front, 2])])]
    nearest = way[front] @ way[chosen[0]]
    while len(chosen) < min(count, len(front)):
        best = int(front[np.argmin(nearest)])
        if best in chosen:
            break
        chosen.append(best)
        nearest = np.maximum(nearest, way[front] @ way[best])
    return chosen
