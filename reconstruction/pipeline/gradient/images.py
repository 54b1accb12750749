"""Read the images of a gradient-sphere session, one state of the skin at a time."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture import raw
from capture.plan.gradient import state_name
from capture.session import FrameRecord, Session
from reconstruction.arrays import BoolArray, Float32Array
from reconstruction.pipeline.inputs import InputsError
from reconstruction.pipeline.sensor_noise import ElectronNoise

Key = tuple[str, str]


@dataclass(frozen=True, slots=True)
class SkinState:
    """Setting of the caliper during one series of patterns."""

    name: str
    angle_deg: float
    """Of the jaws' axis, from +x towards +y."""
    step: int
    """Step of the caliper; 0 neutral, below 0 compressed."""
    reading_mm: float
    """Distance of the jaws that the controller reports; NaN without a reading."""
    force_n: float
    """Force on the jaws that the controller reports, N; NaN without a reading."""

    @property
    def angle_rad(self) -> float:
        """The angle in radians."""
        return math.radians(self.angle_deg)


@dataclass(frozen=True, slots=True)
class StatePatterns:
    """Images of one state.

    Attributes
    ----------
    values, variance
        By pattern and polarizer, (H, W) float32, fraction of full scale; dark frames subtracted.
    valid
        (H, W) bool; False where an image is saturated.
    """

    values: Mapping[Key, Float32Array]
    variance: Mapping[Key, Float32Array]
    valid: BoolArray

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the images."""
        return self.valid.shape[0], self.valid.shape[1]

    def crossed(self) -> Float32Array:
        """Return the subsurface-scattered light, the sum of all crossed images.

        Raises
        ------
        InputsError
            Without a lit crossed image.
        """
        crossed = {key[0]: image for key, image in self.values.items() if key[1] == "crossed"}
        lit = [image for pattern, image in crossed.items() if pattern != "dark"]
        if not lit:
            got = "got no lit image with crossed polarizers, expected at least one"
            raise InputsError(f"state: {got}; capture the state again")
        return np.mean(lit, axis=0, dtype=np.float32)


class GradientImages:
    """Reads the states of a gradient-sphere session, one per request.

    Parameters
    ----------
    session
        Open for reading.
    noise
        Calibrated gain and read noise; None: the noise profile of each frame.

    Attributes
    ----------
    states : tuple of SkinState
        In the order of capture; the first is a neutral one.

    Raises
    ------
    InputsError
        When the session has no frames of that kind, or no neutral state as a reference.
    """

    def __init__(self, session: Session, *, noise: ElectronNoise | None = None) -> None:
        self._session = session
        self._noise = noise
        self._records: dict[str, dict[Key, list[FrameRecord]]] = {}
        found: dict[str, SkinState] = {}
        for record in session.frames("gradient"):
            index = record.index
            angle, step = float(index["angle"]), int(index["caliper"])
            name = state_name(angle, step)
            aperture_mm, force_n = (
                float(record.actual.get(key, math.nan)) for key in ("aperture_mm", "force_n")
            )
            found.setdefault(name, SkinState(name, angle, step, aperture_mm, force_n))
            key = str(index["pattern"]), str(index["polarizer"])
            self._records.setdefault(name, {}).setdefault(key, []).append(record)
        if not found:
            raise InputsError(
                f"{session.path}: has no frames of kind 'gradient'; give a session of the gradient "
                "sphere [SR-REC-014]"
            )
        states = list(found.values())
        first = next((state for state in states if state.step == 0), None)
        if first is None:
            raise InputsError(
                f"{session.path}: has no neutral state, caliper step 0, as the reference; "
                "capture it [SR-REC-015]"
            )
        self.states = (first, *(state for state in states if state is not first))
        self._dark: Float32Array | None = None
        self._dark_variance = 0.0

    @property
    def neutral(self) -> SkinState:
        """The first neutral state, the reference of all strains."""
        return self.states[0]

    def of(self, state: SkinState) -> StatePatterns:
        """Return the images of a state.

        Frames of one pattern are averaged.

        Raises
        ------
        InputsError
            When frames differ in size.
        """
        values: dict[Key, Float32Array] = {}
        variance: dict[Key, Float32Array] = {}
        valid: BoolArray | None = None
        dark = self._darkness()
        for key, records in self._records[state.name].items():
            if key[0] == "dark":
                continue
            mean, spread, good = self._mean(records)
            sizes = {one.shape for one in (mean, dark, valid) if one is not None}
            if len(sizes) > 1:
                hint = f"got {sorted(sizes)}, expected one size; capture the state again"
                raise InputsError(f"state {state.name}: its frames differ in size; {hint}")
            values[key] = mean if dark is None else mean - dark
            variance[key] = spread + np.float32(self._dark_variance)
            valid = good if valid is None else valid & good
        if valid is None:
            got = "got no lit image, expected at least one"
            raise InputsError(f"state {state.name}: {got}; capture the state again")
        return StatePatterns(values, variance, valid)

    def _mean(self, records: Sequence[FrameRecord]) -> tuple[Float32Array, Float32Array, BoolArray]:
        if not records:
            raise InputsError("a pattern has no frame; capture the state again")
        noise = {} if self._noise is None else dataclasses.asdict(self._noise)
        frames = (raw.linear_mono(self._session.read(record), **noise) for record in records)
        total, variance, valid = next(frames)
        for value, spread, good in frames:
            if value.shape != total.shape:
                got = f"got repeats of {total.shape} and {value.shape} pixels"
                raise InputsError(f"a pattern: {got}, expected one size; capture the state again")
            total, variance, valid = total + value, variance + spread, valid & good
        count = np.float32(len(records))
        return total / count, variance / count**2, valid

    def _darkness(self) -> Float32Array | None:
        """Return the mean of all dark frames, with the fixed pattern of the sensor."""
        if self._dark is None:
            taken = [item for by_key in self._records.values() for item in by_key.items()]
            records = [
                record for (pattern, _), some in taken if pattern == "dark" for record in some
            ]
            records += self._session.frames("dark")
            if not records:
                return None
            self._dark, spread, _ = self._mean(records)
            self._dark_variance = float(np.mean(spread))
        return self._dark
