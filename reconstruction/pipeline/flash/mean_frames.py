"""Average the frames of one polarizer state of the flash rig."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture import raw
from capture.calibration.sensor import SensorCalibration
from capture.calibration.sensor.noise_model import QUANTIZATION_DN2
from capture.session import FrameRecord, Session
from model.checks import Checks
from reconstruction.arrays import BoolArray, Float32Array
from reconstruction.pipeline.inputs import InputsError


@dataclass(frozen=True, slots=True)
class FlashImage:
    """Linear light on superpixels: rgb and variance (H, W, 3), valid (H, W).

    `neutral` is the first frame's camera RGB of white; None: not recorded.
    """

    rgb: Float32Array
    variance: Float32Array
    valid: BoolArray
    neutral: tuple[float, ...] | None = None


def make_image_reader(
    session: Session, sensor: SensorCalibration | None
) -> Callable[[Sequence[FrameRecord]], FlashImage]:
    """Return a function that averages frames of one polarizer state and subtracts dark frames."""
    demosaic: raw.Demosaic = "superpixel" if session.manifest.has_developed_images else "centered"
    gain, read_noise = _noise(sensor)
    known: dict[str, Any] = {"demosaic": demosaic, "gain": gain, "read_noise": read_noise}

    def linear_light(
        records: Sequence[FrameRecord],
    ) -> tuple[list[raw.LinearImage], tuple[float, ...] | None]:
        images, neutrals = [], []
        for record in records:
            frame = session.read(record)
            images.append(raw.linear_rgb(frame, **known))
            neutrals.append(frame.neutral)
        return images, next(iter(neutrals), None)

    def total(images: list[raw.LinearImage], name: str) -> NDArray[Any]:
        parts = [getattr(image, name) for image in images]
        return np.asarray(np.sum(parts, axis=0, dtype=np.float64))

    darks, _ = linear_light(session.frames("dark"))
    count = max(len(darks), 1)
    dark = total(darks, "rgb") / count
    dark_variance = total(darks, "variance") / count / count

    def mean_image(records: Sequence[FrameRecord]) -> FlashImage:
        linear, neutral = linear_light(records)
        sizes = {image.rgb.shape for image in linear}
        name = records[0].index.get("polarizer") or records[0].index["light"]
        expected = "one camera setting; choose frames of one"
        Checks(InputsError).require(len(sizes) == 1, f"{name} frames", f"sizes {sizes}", expected)
        power = sum(relative_light(record.settings) for record in records)
        rgb = total(linear, "rgb") - len(linear) * dark
        variance = total(linear, "variance") + len(linear) ** 2 * dark_variance
        return FlashImage(
            (rgb / power).astype(np.float32),
            (variance / power**2).astype(np.float32),
            np.logical_and.reduce([image.valid for image in linear]),
            neutral,
        )

    return mean_image


def relative_light(settings: Mapping[str, Any]) -> float:
    """Return the power of the flash, or the exposure of a photograph over its partner's.

    Examples
    --------
    >>> relative_light({"power": 0.5}), relative_light({"relative_exposure": 2.0})
    (0.5, 2.0)
    """
    return float(settings.get("power", 1.0)) * float(settings.get("relative_exposure", 1.0))


def _noise(sensor: SensorCalibration | None) -> tuple[float, float] | tuple[None, None]:
    """Return a calibration's gain (electrons per DN) and read noise with rounding, or None."""
    if sensor is None:
        return None, None
    gain = float(sensor.mean_gain_e_per_dn().value)
    read = float(sensor.mean_read_noise_e().value)
    return gain, float(np.hypot(read, gain * np.sqrt(QUANTIZATION_DN2)))
