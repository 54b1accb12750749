"""From a simulated subject's maps to trials of their intervals; what all rigs' trials share.

Each trial goes the whole way of a user, from calibration targets to maps, at the sensor's noise:
`interval_trials_flash` and its like of the other rigs. Nothing there knows the model: maps are
compared with the truth that the simulator wrote.
"""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from model.skin import SkinAppearance, SkinMap
from model.store import read
from reconstruction.pipeline.recipes import reconstruct
from skinrig.arrays import BoolArray, Float64Array, FloatArray
from skinrig.benchmarks.intervals.coverage import GAUSSIAN_95, RAYLEIGH_95, Trial
from skinrig.calibrating.calibrate import calibrate
from skinrig.evaluating import skin_bands
from skinrig.evaluating.surface import RAYLEIGH_68
from skinrig.simulating.orders import Simulated
from skinrig.simulating.simulation import simulate_session

ANY_BAND: Final = "any"
"""Band of quantities that do not depend on the color of the skin."""


def band_of(truth: SkinAppearance, name: str, skin: BoolArray) -> str:
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
    return str(skin_bands.bands_of(np.median(skin_bands.typology_angle_deg(color))))


def valid_of(skin_map: SkinMap) -> BoolArray:
    """Return where a map means something, (H, W)."""
    shape = skin_map.values.shape[:2]
    return np.ones(shape, bool) if skin_map.valid is None else skin_map.valid


def of_errors(
    quantity: str,
    off: FloatArray,
    half: FloatArray,
    *,
    subject: str,
    band: str = ANY_BAND,
    unit: str = "%",
    widths: FloatArray | None = None,
    factor_95: float = GAUSSIAN_95,
) -> Trial:
    """Compare errors with the half widths of their 68 % intervals.

    Parameters
    ----------
    quantity, subject, band, unit, factor_95
        Of the trial; widths in "%" are taken for fractions.
    off, half
        (n,): sizes of errors, and half widths.
    widths
        Half widths as the trial shows them; None: `half`.
    """
    shown = half if widths is None else widths
    to_unit = 100.0 if unit == "%" else 1.0
    width = float(to_unit * np.median(shown)) if shown.size else float("nan")
    return Trial(quantity, subject, band, np.asarray(off / half), width, unit, factor_95)


def of_map(
    quantity: str,
    estimate: SkinMap,
    true: FloatArray,
    skin: BoolArray,
    *,
    subject: str,
    band: str,
    channel: int | None = None,
    factor_95: float = GAUSSIAN_95,
    over: FloatArray | None = None,
) -> Trial:
    """Compare a map of numbers with the truth, where it is valid; widths are relative.

    Parameters
    ----------
    quantity, subject, band, factor_95
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
        Of the map's shape: what widths are relative to, such as what a change is one of. None: the
        truth.

    Raises
    ------
    ValueError
        When the map has no standard error.
    """
    spread = estimate.stderr
    if spread is None:
        raise ValueError(f"{quantity}: has no standard error, expected one")
    good = skin & valid_of(estimate)
    part = (good,) if channel is None else (good, channel)
    value = estimate.values[part].astype(np.float64)
    stderr = spread[part].astype(np.float64)
    truth = np.asarray(true, np.float64)[part]
    whole = truth if over is None else np.asarray(over, np.float64)[part]
    with np.errstate(divide="ignore"):  # what is nothing has a width of infinity
        relative = np.asarray(stderr / np.abs(whole))
    return of_errors(
        quantity,
        np.abs(value - truth),
        stderr,
        subject=subject,
        band=band,
        widths=relative,
        factor_95=factor_95,
    )


def of_normals(
    quantity: str,
    angle_rad: Float64Array,
    stderr_rad: Float64Array,
    *,
    subject: str,
    band: str = ANY_BAND,
    factor_95: float = RAYLEIGH_95,
) -> Trial:
    """Compare directions: the 68 % region is a cone about the estimate.

    Parameters
    ----------
    quantity, subject, band, factor_95
        Of the trial.
    angle_rad
        (n,): between estimates and truths.
    stderr_rad
        (n,): standard error of each of two directions across.
    """
    reach = np.degrees(RAYLEIGH_68 * stderr_rad)
    return of_errors(
        quantity,
        np.degrees(angle_rad),
        reach,
        subject=subject,
        band=band,
        unit="degrees",
        factor_95=factor_95,
    )


def calibrated(rig: str, folder: Path, targets: Mapping[str, str], *, width_px: int | None) -> None:
    """Calibrate a simulated rig into a folder's `calibration`.

    Parameters
    ----------
    rig
        Its name.
    folder
        For sessions and the calibration.
    targets
        Kind of each calibration and the target it takes.
    width_px
        Pixels across the camera; None: the rig's small size.
    """
    for kind, target in targets.items():
        session = folder / f"session-{target}"
        if not session.exists():
            simulate_session(rig, session, target=target, seed=900, width_px=width_px)
        calibrate(kind, [session], folder / "calibration")


def truth_of(done: Simulated) -> Path:
    """Return the folder of a simulated session's truth.

    Raises
    ------
    ValueError
        When it has none.
    """
    if done.truth is None:
        raise ValueError("simulated session: has no truth, expected one")
    return done.truth


def maps_of(
    folder: Path, done: Simulated, want: Sequence[str]
) -> tuple[SkinAppearance, SkinAppearance]:
    """Reconstruct a subject's maps into a folder's `maps`; return them and the truth."""
    reconstruct(done.session, want=want, out=folder / "maps", calibration=folder / "calibration")
    return read(folder / "maps"), read(truth_of(done))


def delete_trial_outputs(folder: Path, done: Simulated, *others: Path) -> None:
    """Take a subject's folders away, and others: the next one's have their names."""
    for place in (done.session, folder / "maps", folder / "moving", *others):
        shutil.rmtree(place, ignore_errors=True)
    for place in folder.glob("truth-subject*"):
        shutil.rmtree(place)
