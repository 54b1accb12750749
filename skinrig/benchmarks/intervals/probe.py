"""Trials of the fiber probe's intervals: media, two-layer skin, and anisotropy."""

import json
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from model.skin import SkinAppearance
from reconstruction.anisotropy import estimation as anisotropy
from reconstruction.pipeline.probe.stages import ANISOTROPY_FILE, CHANNEL_NAMES, SUBSURFACE_FILE
from rigsim.fiber.probe_tissue import PHANTOM_DEVIATIONS, phantom_certificate
from rigsim.population.subject_melanin import subject_melanin
from skinrig.benchmarks.intervals.coverage import IntervalTrial
from skinrig.benchmarks.intervals.trials import (
    USUAL_CAPTURE,
    CaptureVariant,
    TrialSubject,
    reconstruct_maps,
    resimulate,
)
from skinrig.calibrating.calibrate import calibrate
from skinrig.evaluating import skin_bands
from skinrig.evaluating import subsurface as evaluation
from skinrig.simulating.orders import SimulationResult
from skinrig.simulating.simulation import simulate_session

PHOTON_BUDGET: Final = "full"
"""Photon budget for phantom and media, whose coefficients are known. With fewer photons the noise
of the simulation, 2 %, would count as error of the probe. The ground truth of skin comes from the
simulated profile itself."""
BLOCK_SEED_OFFSET: Final = 90_000
"""Offset from a subject's seed to that of its phantom."""
N_DIRECTIONS: Final = 8
"""Rotations of the probe head on anisotropic tissue."""
COEFFICIENT_LABELS: Final[Mapping[str, str]] = {
    "sigma_a": "sigma_a of media",
    "sigma_s_prime": "sigma_s' of media",
}


def run_trials(
    folder: Path,
    media: Mapping[int, str],
    *,
    skin: Mapping[int, str] | None = None,
    directed: Mapping[int, str] | None = None,
    variant: CaptureVariant = USUAL_CAPTURE,
) -> Iterator[IntervalTrial]:
    """Yield trials of the fiber probe's coefficients of media and skin, and of anisotropy.

    Parameters
    ----------
    folder
        As in `flash.run_trials`.
    media
        "homogeneous:SIGMA_A,SIGMA_S_PRIME,G" by seed, for sigma_tr, sigma_a and sigma_s'.
    skin
        Preset by seed, for sigma_tr of layered skin on three sites. By definition that is the
        sigma_tr of the homogeneous medium with the nearest profile.
    directed
        "anisotropic:SIGMA_A,SIGMA_S_PRIME,STRENGTH,AXIS_DEG" by seed, for axis and ratio.
    variant
        Age of the calibration, and further options of the captures.
    """
    for seed, medium in media.items():
        done = _subject(folder, medium, seed, variant, sites=("cheek",), size=PHOTON_BUDGET)
        found, truth = reconstruct_maps(folder, done, ["subsurface"])
        subject = TrialSubject(f"{medium} {seed}")
        yield decay_trial("sigma_tr of media", found, truth, subject)
        for coefficient in COEFFICIENT_LABELS:
            yield coefficient_trial(coefficient, found, truth, subject)
    for seed, preset in (skin or {}).items():
        done = _subject(folder, preset, seed, variant)
        found, truth = reconstruct_maps(folder, done, ["subsurface"])
        subject = TrialSubject(f"{preset} {seed}", subject_melanin_band(preset, seed=seed))
        yield decay_trial("sigma_tr of skin", found, truth, subject)
    for seed, medium in (directed or {}).items():
        done = _subject(folder, medium, seed, variant, sites=("cheek",), angles=(N_DIRECTIONS,))
        found, truth = reconstruct_maps(folder, done, ["anisotropy"])
        subject = TrialSubject(f"{medium} {seed}")
        yield from direction_trials(found, truth, _farthest_deg(medium), subject)


def _subject(
    folder: Path, subject: str, seed: int, variant: CaptureVariant, **options: Any
) -> SimulationResult:
    """Simulate a subject under a probe that is calibrated with the subject's own phantom."""
    calibrate_with_own_block(folder, seed, variant)
    given = variant.subject_options(**options)
    return resimulate("probe", folder, subject=subject, seed=seed, **given)


def calibrate_with_own_block(
    folder: Path, seed: int, variant: CaptureVariant = USUAL_CAPTURE
) -> Path:
    """Calibrate the probe with a phantom of its own certificate; return FOLDER/calibration.

    Subjects with a common calibration would have its errors and the phantom's in common, and would
    count as one draw.

    Parameters
    ----------
    folder
        As in `flash.run_trials`; a previous calibration is replaced.
    seed
        Seed of the subject.
    variant
        Age of the calibration.
    """
    phantom = folder / "session-phantom"
    shutil.rmtree(phantom, ignore_errors=True)
    shutil.rmtree(folder / "truth-phantom", ignore_errors=True)
    options = variant.target_options(size=PHOTON_BUDGET)
    simulate_session("probe", phantom, target="phantom", seed=BLOCK_SEED_OFFSET + seed, **options)
    paper = folder / "block.json"
    paper.write_text(json.dumps(draw_certificate(np.random.default_rng([seed, BLOCK_SEED_OFFSET]))))
    calibrate("fiber", [phantom], folder / "calibration", phantom=paper)
    return folder / "calibration"


def draw_certificate(rng: np.random.Generator) -> dict[str, Any]:
    """Draw a certificate of the simulated phantom with errors of its stated uncertainty.

    Parameters
    ----------
    rng
        Generator of the two errors, of sigma_a and of sigma_s'.

    Examples
    --------
    >>> one, two = (draw_certificate(np.random.default_rng(k))["sigma_a_per_mm"] for k in (1, 2))
    >>> round(one[0] / two[0], 3) == round(one[-1] / two[-1], 3) != 1.0
    True
    """
    certificate = dict(phantom_certificate())
    for name, deviation in zip(COEFFICIENT_LABELS, PHANTOM_DEVIATIONS, strict=True):
        # certified = true / (1 + u z), where true = nominal (1 + deviation u) and z is N(0, 1)
        uncertainty = float(certificate["uncertainty"][name])
        factor = (1.0 + deviation * uncertainty) / (
            1.0 + uncertainty * float(rng.standard_normal())
        )
        certificate[f"{name}_per_mm"] = [factor * value for value in certificate[f"{name}_per_mm"]]
    return certificate


def subject_melanin_band(subject: str, *, seed: int) -> str:
    """Return the melanin band of a simulated subject: a preset, a tone, a member or a file.

    Examples
    --------
    >>> subject_melanin_band("II", seed=0), subject_melanin_band("VI", seed=0)
    ('light', 'dark')
    """
    return str(skin_bands.classify_melanin(subject_melanin(subject, seed=seed)))


def decay_trial(
    quantity: str, found: SkinAppearance, truth: SkinAppearance, subject: TrialSubject
) -> IntervalTrial:
    """Compare valid fits of sigma_tr with the ground truth, on a logarithmic scale.

    The interval of log(sigma_tr) is symmetric.

    Parameters
    ----------
    quantity, subject
        Name of the quantity, and subject of the trial.
    found, truth
        Appearance with fits, and ground truth with profiles.
    """
    fits = [
        fit
        for fit in evaluation.compare_fits(found, truth)
        if fit.method == evaluation.RECOMMENDED_METHOD and fit.valid
    ]
    half = np.array([0.5 * np.log(fit.interval[1] / fit.interval[0]) for fit in fits])
    center = np.array([0.5 * np.log(fit.interval[1] * fit.interval[0]) for fit in fits])
    true = np.log(np.array([fit.truth for fit in fits]))
    return subject.error_trial(quantity, np.abs(center - true), half)


def coefficient_trial(
    name: str, found: SkinAppearance, truth: SkinAppearance, subject: TrialSubject
) -> IntervalTrial:
    """Compare sigma_a or sigma_s' of a homogeneous medium, for fits that identify it.

    Parameters
    ----------
    name
        "sigma_a" or "sigma_s_prime".
    found, truth
        Appearance with fits, and ground truth with profiles.
    subject
        Subject of the trial.
    """
    known = evaluation.true_profiles(truth)
    fitted = evaluation.read_document(found, SUBSURFACE_FILE) or {"measurements": []}
    off, stderr = [], []
    for entry in fitted["measurements"]:
        true = known[evaluation.format_measurement_name(entry)][f"{name}_per_mm"]
        for fit in entry["fits"]:
            identified = fit["valid"] and fit["coefficients_identified"]
            if fit["method"] != evaluation.RECOMMENDED_METHOD or not identified:
                continue
            value = evaluation.parse_number(fit[f"{name}_per_mm"])
            off.append(abs(value / true[CHANNEL_NAMES.index(fit["channel"])] - 1.0))
            stderr.append(evaluation.parse_number(fit[f"{name}_stderr"]) / value)
    return subject.error_trial(COEFFICIENT_LABELS[name], np.array(off), np.array(stderr))


def direction_trials(
    found: SkinAppearance, truth: SkinAppearance, axis_deg: float, subject: TrialSubject
) -> Iterator[IntervalTrial]:
    """Yield trials of the axis and the ratio of an anisotropic medium.

    Parameters
    ----------
    found, truth
        Appearance with the anisotropy's document, and ground truth with profiles by direction.
    axis_deg
        Direction of least scattering of the medium.
    subject
        Subject of the trials.

    Notes
    -----
    The true ratio is defined as that of the ellipse fitted to the true sigma_tr by direction.
    """
    rows = [row for row in json.loads(found.files[ANISOTROPY_FILE])["sites"] if row["valid"]]
    profiles: list[dict[str, Any]] = list(evaluation.true_profiles(truth).values())  # type: ignore[arg-type]
    angle = np.radians([float(profile["angle_deg"]) for profile in profiles])
    true = anisotropy.estimate(
        angle, np.array([profile["sigma_tr_per_mm"] for profile in profiles]), outliers=False
    )
    # an axis has no sign: differences are modulo 180 degrees, from -90 to 90
    angle_deg = np.array([abs((row["axis_deg"] - axis_deg + 90.0) % 180.0 - 90.0) for row in rows])
    stderr = np.array([row["axis_stderr_deg"] for row in rows])
    yield subject.error_trial("axis of anisotropy", angle_deg, stderr, unit="degrees")
    ratio = np.array([true.ratio[CHANNEL_NAMES.index(row["channel"])] for row in rows])
    off = np.abs(np.array([row["ratio"] for row in rows]) - ratio)
    stderr = np.array([row["ratio_stderr"] for row in rows])
    yield subject.error_trial("ratio of anisotropy", off, stderr, widths=stderr / ratio)


def _farthest_deg(medium: str) -> float:
    """Return the direction in which light propagates farthest, that of least scattering."""
    strength, axis_deg = (float(number) for number in medium.split(",")[2:4])
    return axis_deg if strength < 0.0 else axis_deg + 90.0
