"""Compare maps of simulated subjects with ground truth, as trials of the maps' stated intervals.

A trial runs the whole pipeline, from calibration targets to maps, at the sensor's noise (see
`flash` and the other rigs' modules). The comparison uses only the maps and the ground truth that
the simulator wrote.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from model.skin import SkinAppearance, SkinMap
from model.store import read
from reconstruction.pipeline.inputs import DomeOptions
from reconstruction.pipeline.recipes import reconstruct
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import BoolArray, Float64Array, FloatArray
from skinrig.benchmarks.intervals.coverage import GAUSSIAN_95, IntervalTrial
from skinrig.evaluating import skin_bands
from skinrig.evaluating.surface import RAYLEIGH_68
from skinrig.simulating.orders import SimulationResult
from skinrig.simulating.simulation import simulate_session

ANY_BAND: Final = "any"
"""Band of quantities that do not depend on skin color."""


def skin_color_band(truth: SkinAppearance, name: str, skin: BoolArray) -> str:
    """Return the band of the median color of a subject's skin.

    Parameters
    ----------
    truth
        Ground truth of the subject.
    name
        Name of its map of linear color.
    skin
        (H, W): mask of skin.
    """
    color = truth.maps[name].values[skin]
    return str(skin_bands.classify_typology(np.median(skin_bands.typology_angle_deg(color))))


@dataclass(frozen=True, slots=True)
class CaptureVariant:
    """Departures of trials from a new calibration and a rig's usual capture."""

    calibration_age_days: int = 0
    """Days between the calibration and the subject's session."""
    size: Mapping[str, float] = field(default_factory=dict)
    """Further fields of the orders of targets and subjects, such as lights, views and ISO."""
    subject: Mapping[str, Any] = field(default_factory=dict)
    """Further fields of the orders of subjects alone."""

    def target_options(self, **options: Any) -> dict[str, Any]:
        """Return the fields of the orders of calibration targets."""
        return {**options, **self.size, "days_ago": self.calibration_age_days}

    def subject_options(self, **options: Any) -> dict[str, Any]:
        """Return the fields of the order of a subject."""
        return {**options, **self.size, **self.subject}


USUAL_CAPTURE: Final = CaptureVariant()


@dataclass(frozen=True, slots=True)
class TrialSubject:
    """Subject of trials, which builds them from errors and stated half widths."""

    name: str
    """Preset, site or medium, and seed."""
    band: str = ANY_BAND

    def error_trial(
        self,
        quantity: str,
        errors: FloatArray,
        half: FloatArray,
        *,
        unit: str = "%",
        widths: FloatArray | None = None,
        factor_95: float = GAUSSIAN_95,
    ) -> IntervalTrial:
        """Compare errors with the half widths of their 68 % intervals.

        Parameters
        ----------
        quantity, unit, factor_95
            Fields of the trial; for the unit "%", widths are given as fractions.
        errors, half
            (n,): absolute errors, and half widths.
        widths
            Half widths for the trial's median width; None: `half`.
        """
        shown = half if widths is None else widths
        to_unit = 100.0 if unit == "%" else 1.0
        width = float(to_unit * np.median(shown)) if shown.size else float("nan")
        error = float(to_unit * np.median(errors * (shown / half))) if shown.size else float("nan")
        deviation = np.asarray(errors / half, np.float64)
        return IntervalTrial(
            quantity, self.name, self.band, deviation, width, unit, factor_95, error
        )

    def map_trial(
        self,
        quantity: str,
        estimate: SkinMap,
        true: FloatArray,
        skin: BoolArray,
        *,
        channel: int | None = None,
        over: FloatArray | None = None,
        factor_95: float = GAUSSIAN_95,
    ) -> IntervalTrial:
        """Compare a scalar map with the ground truth in valid pixels; widths are relative.

        Parameters
        ----------
        quantity, factor_95
            Fields of the trial.
        estimate
            Map with its standard error.
        true
            Ground truth, in the map's shape.
        skin
            (H, W): pixels with ground truth.
        channel
            Channel of a map with several.
        over
            Denominator of relative widths, in the map's shape, e.g. the value that changes. None:
            the ground truth.

        Raises
        ------
        ValueError
            When the map has no standard error.
        """
        if estimate.stderr is None:
            raise ValueError(
                f"{quantity}: got a map without a standard error, expected one with it; "
                "reconstruct it again"
            )
        good = skin & intersect_valid(estimate)
        part = (good,) if channel is None else (good, channel)
        value, stderr, truth, whole = (
            np.asarray(values, np.float64)[part]
            for values in (estimate.values, estimate.stderr, true, true if over is None else over)
        )
        with np.errstate(divide="ignore"):  # a value of 0 has an infinite relative width
            relative = np.asarray(stderr / np.abs(whole))
        off = np.abs(value - truth)
        return self.error_trial(quantity, off, stderr, widths=relative, factor_95=factor_95)

    def normal_trial(
        self, quantity: str, angle_rad: Float64Array, stderr_rad: FloatArray, *, factor_95: float
    ) -> IntervalTrial:
        """Compare directions; the 68 % region is a cone about the estimate.

        Parameters
        ----------
        quantity, factor_95
            Fields of the trial.
        angle_rad
            (n,): angle between estimate and ground truth.
        stderr_rad
            (n, 3): standard error of each of two tangential components, repeated in all channels.
        """
        # two equal Gaussian components make the angle Rayleigh distributed: its 68 % quantile is
        # sqrt(-2 ln(1 - 0.6827)) standard errors
        reach = np.degrees(RAYLEIGH_68 * stderr_rad[:, 0].astype(np.float64))
        off = np.degrees(angle_rad)
        return self.error_trial(quantity, off, reach, unit="degrees", factor_95=factor_95)


def resimulate(rig: str, folder: Path, **options: Any) -> SimulationResult:
    """Simulate a subject into a folder, after deleting the previous subject and its maps."""
    old = (folder / name for name in ("session-subject", "maps", "moving"))
    for path in (*old, *folder.glob("truth-subject*")):
        shutil.rmtree(path, ignore_errors=True)
    return simulate_session(rig, folder / "session-subject", **options)


def truth_folder(done: SimulationResult) -> Path:
    """Return the folder of a simulated session's ground truth.

    Raises
    ------
    ValueError
        When the session has none.
    """
    if done.truth is None:
        raise ValueError(
            "simulated session: got no ground truth, expected its folder; simulate a subject"
        )
    return done.truth


def reconstruct_maps(
    folder: Path, done: SimulationResult, want: Sequence[str], *, dome: DomeOptions | None = None
) -> tuple[SkinAppearance, SkinAppearance]:
    """Reconstruct a subject's maps into FOLDER/maps; return them and the ground truth."""
    maps, calibration = folder / "maps", folder / "calibration"
    reconstruct(done.session, want=want, out=maps, calibration=calibration, dome=dome)
    return read(folder / "maps"), read(truth_folder(done))
