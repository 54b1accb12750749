"""High-dynamic-range images of a dome session: one camera and one light at a time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture import hdr, raw
from capture.calibration.sensor.bracket_times import check_times
from capture.session import FrameRecord, Session
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from reconstruction.pipeline.hold_out import NO_HOLD_OUT, HoldOut
from reconstruction.pipeline.inputs import InputsError
from reconstruction.pipeline.sensor_noise import ElectronNoise

__all__ = ["DomeImage", "DomeImages", "ElectronNoise"]


@dataclass(frozen=True, slots=True)
class DomeImage:
    """Image of one camera under one light.

    Attributes
    ----------
    rgb
        (h, w, 3) float32, camera RGB, fraction of full scale per second of light at level 1;
        one pixel for each 2 x 2 cell of the sensor.
    variance
        Variance of ``rgb``.
    valid
        (h, w) bool; False where every exposure is saturated.
    """

    rgb: Float32Array
    variance: Float32Array
    valid: BoolArray

    @staticmethod
    def from_sensor_px(pixels: FloatArray) -> Float64Array:
        """Convert sensor positions, (..., 2) column and row in px, to pixels of ``rgb``.

        Examples
        --------
        >>> DomeImage.from_sensor_px(np.array([[0.5, 0.5], [2.5, 4.5]])).tolist()
        [[0.0, 0.0], [1.0, 2.0]]
        """
        return (np.asarray(pixels, np.float64) - 0.5) / 2.0


class DomeImages:
    """Reads and merges the exposures of a dome session on request, without a cache.

    Parameters
    ----------
    session
        Of the dome, open for reading.
    noise
        Calibrated gain and read noise by camera serial; for other cameras the noise profile of
        their frames is used.
    kind
        "olat" for the subject; "white", "mirror" for targets with one light at a time.
    merge
        Whether to merge the exposures of a light to one image. Not for a moving subject: its
        exposures were taken seconds apart.
    without
        Names of lights and views whose frames are excluded.

    Attributes
    ----------
    views, lights
        Names in the rig's order, of lights and views with frames in the session.
    captures
        The images of each view: light and exposure, -1 for all exposures merged.

    Raises
    ------
    InputsError
        When the session has no frames of that kind.
    """

    def __init__(
        self,
        session: Session,
        *,
        noise: dict[str, ElectronNoise] | None = None,
        kind: str = "olat",
        merge: bool = True,
        without: HoldOut = NO_HOLD_OUT,
    ) -> None:
        self._session = session
        self._noise = dict(noise or {})
        self._kind, self._without = kind, without
        self._shots: dict[tuple[str, str], list[FrameRecord]] = {}
        for record in session.frames(kind):
            view, light = record.camera, str(record.index["light"])
            if not without.is_held_out(light, view):
                self._shots.setdefault((view, light), []).append(record)
        if not self._shots:
            raise InputsError(
                f"{session.path}: has no frames of kind {kind!r}; give a session of the dome that "
                "has them [SR-REC-013]"
            )
        views = {view for view, _ in self._shots}
        lights = {light for _, light in self._shots}
        self.views = tuple(v.name for v in session.rig.views if v.name in views)
        self.lights = tuple(x.name for x in session.rig.lights if x.name in lights)
        shots = [record for records in self._shots.values() for record in records]
        exposures = sorted({int(record.index.get("exposure", 0)) for record in shots})
        kept = [-1] if merge else exposures
        self.captures = tuple((light, exposure) for exposure in kept for light in self.lights)
        self._darks: dict[str, tuple[Float32Array, Float32Array] | None] = {}

    def split_exposures(self) -> DomeImages:
        """Return the same images with each exposure separate."""
        return DomeImages(
            self._session, noise=self._noise, kind=self._kind, merge=False, without=self._without
        )

    def times_s(self, view: str, light: str, exposure: int = -1) -> tuple[float, ...]:
        """Return when the controller lit the frames of an image, s on the controller's clock.

        Frames without a controller, such as imported ones, have NaN.
        """
        times = (record.line.t_box_s for record in self._of(view, light, exposure))
        return tuple(math.nan if time is None else time for time in times)

    def image(self, view: str, light: str, exposure: int = -1) -> DomeImage:
        """Return a camera's image under a light, dark frames subtracted.

        Parameters
        ----------
        view, light
            Names.
        exposure
            Number of the exposure; -1 merges all.

        Raises
        ------
        InputsError
            Where the session lacks that image.
        """
        shots = self._of(view, light, exposure)
        frames = [self._session.read(record) for record in shots]
        levels = [float(record.settings.get("level", 1.0)) for record in shots]
        values, variance, good = self._merge(view, frames, levels)
        dark = self._dark(view)
        if dark is not None:
            values -= dark[0]
            variance += dark[1]
        linear = raw.interpolate(values, variance, good, frames[0].pattern, demosaic="centered")
        return DomeImage(linear.rgb, linear.variance, linear.valid)

    def _of(self, view: str, light: str, exposure: int) -> list[FrameRecord]:
        shots = self._shots.get((view, light), [])
        if exposure >= 0:
            shots = [record for record in shots if record.index.get("exposure", 0) == exposure]
        if not shots:
            missing = f"lacks camera {view}, light {light}"
            raise InputsError(f"{self._session.path}: {missing}; capture it again")
        return shots

    def _dark(self, view: str) -> tuple[Float32Array, Float32Array] | None:
        """Return the signal rate without any LED, and its variance."""
        if view not in self._darks:
            records = [r for r in self._session.frames("dark") if r.camera == view]
            self._darks[view] = None
            if records:
                frames = [self._session.read(record) for record in records]
                values, variance, _ = self._merge(view, frames, [1.0] * len(frames))
                self._darks[view] = values, variance
        return self._darks[view]

    def _merge(
        self, view: str, frames: Sequence[raw.RawFrame], levels: Sequence[float]
    ) -> tuple[Float32Array, Float32Array, BoolArray]:
        """Merge mosaics to fractions of full scale per second at level 1."""
        first = frames[0]
        serial = self._session.rig.view(view).serial
        noise = self._noise.get(serial) or ElectronNoise.of(first)
        times = []
        for frame, level in zip(frames, levels, strict=True):
            if frame.cfa.shape != first.cfa.shape or frame.pattern != first.pattern:
                hint = "use frames of one camera setting"
                got = f"differs in size or pattern from {first.path}"
                raise InputsError(f"{frame.path}: {got}; {hint}")
            if frame.exposure_s is None:
                raise InputsError(f"{frame.path}: lacks its exposure time; import it with one")
            times.append(frame.exposure_s * level)
        values = np.zeros(first.cfa.shape, np.float32)
        variance = np.zeros_like(values)
        good = np.zeros(values.shape, bool)
        # with one black level for all colors, the usual case, the mosaic is merged as a whole
        whole = len(set(first.black)) == 1
        for cell, black in enumerate(first.black[:1] if whole else first.black):
            part = slice(cell // 2, None, 2), slice(cell % 2, None, 2)
            part = (slice(None), slice(None)) if whole else part
            bracket = [frame.cfa[part] for frame in frames]
            sensor = {
                "gain": noise.gain,
                "read_noise": noise.read_noise,
                "black": black,
                "white": first.white,
            }
            try:
                check_times(bracket, times, **sensor)
            except hdr.BracketError as error:
                raise InputsError(f"{first.path}: {error}; correct the times") from error
            rate, spread, valid = hdr.merge(bracket, times, **sensor)
            span = np.float32(first.white - black)
            values[part] = np.where(valid, rate / span, 0.0)
            variance[part] = np.where(valid, spread / span**2, 0.0)
            good[part] = valid
        return values, variance, good
