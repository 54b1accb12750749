"""Calibrated or nominal dome, with its images."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture.calibration import geometry
from capture.calibration.geometry import CameraPose
from capture.calibration.lights import LightTable
from reconstruction.arrays import Float32Array, Float64Array
from reconstruction.pipeline.dome.images import DomeImage, DomeImages
from reconstruction.pipeline.graph import select_attributes
from reconstruction.pipeline.inputs import Inputs


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedDome:
    """Calibrated or nominal dome, with its images."""

    images: DomeImages
    cameras: tuple[CameraPose, ...]
    table: LightTable
    """The lights, one row for each of ``images.lights``."""
    lights: LightTable
    """One row for each of ``images.captures``."""
    response: tuple[Float32Array, ...]
    """Response of each camera at the pixels of its images, (h, w, 3)."""
    absolute: bool
    """Whether the lights' intensities are calibrated, so that the albedo has a scale."""
    compute_tiles: Callable[..., Iterator[Any]]
    """See `reconstruction.pipeline.inputs.Inputs.compute_tiles`."""

    @property
    def pixel_mm(self) -> float:
        """Size of an image's pixel on the subject, mm."""
        sizes = [
            2.0 * float(np.linalg.norm(camera.center_mm)) / float(camera.matrix[0, 0])
            for camera in self.cameras
        ]
        return float(np.median(sizes))

    def image(self, view: int, capture: int) -> DomeImage:
        """Return a camera's image for one of ``images.captures``, over the camera's response."""
        light, exposure = self.images.captures[capture]
        image = self.images.image(self.images.views[view], light, exposure)
        response = self.response[view]
        return DomeImage(image.rgb / response, image.variance / response**2, image.valid)


def transform_dome(
    dome: CalibratedDome, rotation: Float64Array, shift_mm: Float64Array
) -> CalibratedDome:
    """Transform the dome to a mesh's frame, whose points are at ``rotation @ p + shift_mm``.

    Parameters
    ----------
    dome
        In the rig frame.
    rotation
        (3, 3), from the mesh's frame to the rig's.
    shift_mm
        (3,).
    """

    def table(lights: LightTable) -> LightTable:
        place = (lights.position_mm - shift_mm) @ rotation
        return dataclasses.replace(lights, position_mm=place, axis=lights.axis @ rotation)

    def turned(camera: CameraPose) -> CameraPose:
        shift = camera.translation_mm + camera.rotation @ shift_mm
        rotated = camera.rotation @ rotation
        return dataclasses.replace(camera, rotation=rotated, translation_mm=shift)

    cameras, lights = tuple(map(turned, dome.cameras)), table(dome.lights)
    return dataclasses.replace(dome, cameras=cameras, table=table(dome.table), lights=lights)


def load_dome(inputs: Inputs, images: DomeImages) -> CalibratedDome:
    """Load the dome of a session's images; uncalibrated quantities take nominal values.

    Parameters
    ----------
    inputs
        Session and calibrations; it records assumptions and dead lights.
    images
        Images of the session to use.

    Raises
    ------
    CalibrationError
        When a calibration is damaged, of another rig or device, or out of date.
    """
    rig = inputs.session.rig
    views = [rig.view(name) for name in images.views]
    serials = [view.serial for view in views]
    found = inputs.load("geometry", serials, "the cameras have the nominal poses of the rig file")
    if found is None:
        cameras = tuple(CameraPose.nominal(view) for view in views)
    else:
        poses = geometry.cameras_from_calibration(found, rig.subset(views=images.views))
        cameras = tuple(poses[view.name] for view in views)
    drawn = "the lights have the nominal positions and intensities of the rig file"
    lit = inputs.load("lights", images.lights, f"{drawn}; the albedo has no absolute scale")
    lights_rig = rig.subset(lights=images.lights)
    lights = LightTable.nominal(lights_rig)
    # spheres alone calibrate positions without intensities, the white plate intensities only
    nominal: dict[str, str] = {}
    if lit is not None:
        lights = LightTable.from_calibration(lit, lights_rig)
        nominal = {k: lit.notes[k] for k in ("positions", "intensities") if k in lit.notes}
        inputs.assumed += [f"the lights' {what} are {why}" for what, why in nominal.items()]
    dead = [name for name, good in zip(lights.names, lights.valid, strict=True) if not good]
    if dead:
        inputs.noted["lights_left_out"] = dead
    response = tuple(_response(lights, camera) for camera in cameras)
    absolute = lit is not None and "intensities" not in nominal
    return CalibratedDome(images, cameras, lights, lights, response, absolute, inputs.compute_tiles)


def split_exposures(dome: CalibratedDome) -> CalibratedDome:
    """Return the dome with each exposure as a separate image, as a moving head requires."""
    images = dome.images.split_exposures()
    order = [images.lights.index(light) for light, _ in images.captures]
    names = [f"{name} {exposure}" for name, exposure in images.captures]
    return dataclasses.replace(dome, images=images, lights=reorder_lights(dome.table, order, names))


def reorder_lights(lights: LightTable, order: list[int], names: list[str]) -> LightTable:
    """Return a table's rows in the given order; rows may repeat."""
    per_light = (
        "position_mm intensity exponent axis valid position_stderr_mm intensity_stderr "
        "exponent_stderr"
    )
    kept = {field: values[order] for field, values in select_attributes(lights, per_light).items()}
    return dataclasses.replace(lights, names=tuple(names), **kept)


def _response(lights: LightTable, camera: CameraPose) -> Float32Array:
    width, height = camera.image_size
    row, column = np.mgrid[0 : height // 2, 0 : width // 2]
    pixels = 2.0 * np.stack([column, row], axis=-1) + 0.5
    return lights.response(camera.serial, pixels, camera.image_size).astype(np.float32)
