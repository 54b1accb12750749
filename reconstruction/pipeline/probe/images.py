"""Read a fiber probe's session: dark frames, and one exposure series per placement."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture.calibration.fiber.darks import CameraNoise, DarkModel, measure_darks
from capture.calibration.fiber.merge import MergedSeries, merge_series
from capture.plan.suction import HeadPlacement, step_placement
from capture.session import FrameRecord, Session
from model.checks import Checks
from reconstruction.pipeline.inputs import InputsError


def measurement_name(placement: HeadPlacement) -> str:
    """Return the profile's name for one placement.

    Examples
    --------
    >>> measurement_name(HeadPlacement("cheek", 22.5, 1))
    'cheek_r1_a022.5'
    """
    return f"{placement.site}_r{placement.repeat}_a{placement.angle_deg:05.1f}"


@dataclass(frozen=True, slots=True)
class Measurement:
    """One placement of the head, with the controller's readings."""

    placement: HeadPlacement
    brackets: int
    """Exposures taken."""
    level: float
    """Level of the source."""
    suction_mbar: float
    """Mean over the exposures; NaN without readings."""
    camera_c: float
    """Mean camera temperature over the exposures, degrees Celsius; NaN without readings."""

    @property
    def name(self) -> str:
        """See `measurement_name`."""
        return measurement_name(self.placement)


class ProbeImages:
    """Reads a probe's session, one series per request.

    Parameters
    ----------
    session : Session
        Open for reading.
    noise : CameraNoise
        Noise of its camera.
    kind : str
        Kind of the steps: "fibers" on skin, "phantom".

    Attributes
    ----------
    measurements : tuple of Measurement
        In the order of capture.

    Raises
    ------
    InputsError
        When the session has no frames of that kind.
    """

    def __init__(self, session: Session, *, noise: CameraNoise, kind: str = "fibers") -> None:
        self._session = session
        self._noise = noise
        self._records: dict[HeadPlacement, list[FrameRecord]] = {}
        for record in session.frames(kind):
            placement = step_placement(record.step)
            if placement is not None:
                self._records.setdefault(placement, []).append(record)
        if not self._records:
            raise InputsError(
                f"{session.path}: has no frames of kind {kind!r}; give a session of the fiber "
                "probe [SR-REC-017]"
            )

        def measured(placement: HeadPlacement, records: list[FrameRecord]) -> Measurement:
            means = _mean(records, "suction_mbar"), _mean(records, "camera_c")
            return Measurement(placement, len(records), _level(records), *means)

        self.measurements = tuple(measured(*taken) for taken in self._records.items())
        self._darks: DarkModel | None = None

    @property
    def darks(self) -> DarkModel:
        """Bias and dark current of every pixel.

        Raises
        ------
        InputsError
            When the session has no dark frames.
        """
        if self._darks is None:
            records = self._session.frames("dark")
            if not records:
                raise InputsError(
                    f"{self._session.path}: has no frames of kind 'dark', so that the camera's "
                    "dark current is not known; capture with darks [SR-REC-018]"
                )
            temperature = _mean(records, "camera_c")
            self._darks = measure_darks(
                [self._session.read(record).cfa for record in records],
                [_exposure_s(record) for record in records],
                noise=self._noise,
                temperature_c=None if math.isnan(temperature) else temperature,
            )
        return self._darks

    def merged(self, measurement: Measurement) -> MergedSeries:
        """Merge a measurement's frames to light per second, dark frames subtracted."""
        records = self._records[measurement.placement]
        frames: list[NDArray[np.integer]] = [self._session.read(record).cfa for record in records]
        known = not math.isnan(measurement.camera_c)
        return merge_series(
            frames,
            [_exposure_s(record) for record in records],
            darks=self.darks.at(measurement.camera_c if known else None),
            noise=self._noise,
            light_s=[_light_s(record) for record in records],
        )


def _exposure_s(record: FrameRecord) -> float:
    return float(record.actual.get("exposure_s", record.settings["exposure_s"]))


def _light_s(record: FrameRecord) -> float:
    """Return how long the source was on during an exposure, s."""
    exposure_s = _exposure_s(record)
    return min(float(record.actual.get("open_s", exposure_s)), exposure_s)


def _level(records: list[FrameRecord]) -> float:
    levels = {float(record.settings.get("level", 1.0)) for record in records}
    where, got = f"step {records[0].step_id}", f"levels {sorted(levels)} in one series"
    Checks(InputsError).require(len(levels) == 1, where, got, "one; capture it again")
    return levels.pop()


def _mean(records: list[FrameRecord], name: str) -> float:
    readings = [float(record.actual[name]) for record in records if name in record.actual]
    return float(np.mean(readings)) if readings else math.nan
