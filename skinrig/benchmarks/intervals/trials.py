"""From a simulated subject's maps to trials of their intervals; what all rigs' trials share.

Each trial goes the whole way of a user, from calibration targets to maps, at the sensor's noise:
`flash` and its like of the other rigs. Nothing there knows the model: maps are
compared with the truth that the simulator wrote.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from model.skin import SkinAppearance, SkinMap
from model.store import read
from reconstruction.pipeline.recipes import reconstruct
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import BoolArray, Float64Array, FloatArray
from skinrig.benchmarks.intervals.coverage import GAUSSIAN_95, IntervalTrial
from skinrig.evaluating import skin_bands
from skinrig.evaluating.surface import RAYLEIGH_68
from skinrig.simulating.orders import SimulationResult
from skinrig.simulating.simulation import simulate_session

ANY_BAND: Final = "any"
"""Band of quantities that do not depend on the color of the skin."""


def skin_color_band(truth: SkinAppearance, name: str, skin: BoolArray) -> str:
    """Return the band of the median color of a subject's skin.

    Parameters
    ----------
    truth
        Of the subject.
    name
        Of its map of linear color.
    skin
        (H, W): pixels of skin.
    """
    color = truth.maps[name].values[skin]
    return str(skin_bands.classify_typology(np.median(skin_bands.typology_angle_deg(color))))


@dataclass(frozen=True, slots=True)
class TrialSubject:
    """Whose intervals are tried."""

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
            Of the trial; widths in "%" are taken for fractions.
        off, half
            (n,): sizes of errors, and half widths.
        widths
            Half widths as the trial shows them; None: `half`.
        """
        shown = half if widths is None else widths
        to_unit = 100.0 if unit == "%" else 1.0
        width = float(to_unit * np.median(shown)) if shown.size else float("nan")
        deviation = np.asarray(errors / half, np.float64)
        return IntervalTrial(quantity, self.name, self.band, deviation, width, unit, factor_95)

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
        """Compare a map of numbers with the truth, where it is valid; widths are relative.

        Parameters
        ----------
        quantity, factor_95
            Of the trial.
        estimate
            With its standard error.
        true
            Of the map's shape.
        skin
            (H, W): where there is a truth.
        channel
            Of a map of several.
        over
            Of the map's shape: what widths are relative to, such as what a change is one of. None:
            the truth.

        Raises
        ------
        ValueError
            When the map has no standard error.
        """
        if estimate.stderr is None:
            raise ValueError(f"{quantity}: has no standard error, expected one")
        good = skin & intersect_valid(estimate)
        part = (good,) if channel is None else (good, channel)
        value, stderr, truth, whole = (
            np.asarray(values, np.float64)[part]
            for values in (estimate.values, estimate.stderr, true, true if over is None else over)
        )
        with np.errstate(divide="ignore"):  # what is nothing has a width of infinity
            relative = np.asarray(stderr / np.abs(whole))
        off = np.abs(value - truth)
        return self.error_trial(quantity, off, stderr, widths=relative, factor_95=factor_95)

    def normal_trial(
        self, quantity: str, angle_rad: Float64Array, stderr_rad: FloatArray, *, factor_95: float
    ) -> IntervalTrial:
        """Compare directions: the 68 % region is a cone about the estimate.

        Parameters
        ----------
        quantity, factor_95
            Of the trial.
        angle_rad
            (n,): between estimates and truths.
        stderr_rad
            (n, 3): standard error of each of two directions across, the same in all channels.
        """
        reach = np.degrees(RAYLEIGH_68 * stderr_rad[:, 0].astype(np.float64))
        off = np.degrees(angle_rad)
        return self.error_trial(quantity, off, reach, unit="degrees", factor_95=factor_95)


def resimulate(rig: str, folder: Path, **options: Any) -> SimulationResult:
    """Simulate a subject into a folder, where the one before it and its maps are taken away."""
    old = (folder / name for name in ("session-subject", "maps", "moving"))
    for place in (*old, *folder.glob("truth-subject*")):
        shutil.rmtree(place, ignore_errors=True)
    return simulate_session(rig, folder / "session-subject", **options)


def truth_folder(done: SimulationResult) -> Path:
    """Return the folder of a simulated session's truth.

    Raises
    ------
    ValueError
        When it has none.
    """
    if done.truth is None:
        raise ValueError("simulated session: has no truth, expected one")
    return done.truth


def reconstruct_maps(
    folder: Path, done: SimulationResult, want: Sequence[str]
) -> tuple[SkinAppearance, SkinAppearance]:
    """Reconstruct a subject's maps into a folder's `maps`; return them and the truth."""
    reconstruct(done.session, want=want, out=folder / "maps", calibration=folder / "calibration")
    return read(folder / "maps"), read(truth_folder(done))
