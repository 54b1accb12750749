"""Benchmark of the fusion: simulated skin whose optics vary over their published ranges.

Spectra come from the simulator's photon transport. People differ in melanin, blood, oxygenation,
scattering, baseline and kind of melanin. Colors of the rigs have the errors that their covariances
state. No constant of the estimator was set on these people.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from model import spectra
from model.tissue_optics.constants import SKIN_CONSTANTS
from model.tissue_optics.uncertainty import NUISANCE_PARAMETERS
from reconstruction.chromophores.model_error import load_covariance
from reconstruction.fusion.consistency import check_rigs, name_faulty_rig
from reconstruction.fusion.person import PersonSkin, Regions, estimate_person
from reconstruction.fusion.regions import summarize_regions
from reconstruction.fusion.signals import RigBands, residual_covariance
from reconstruction.fusion.texels import (
    TEXEL_ITERATIONS,
    OffsetModel,
    RigColors,
    TexelSkin,
    estimate_texels,
    melanin_depth_factor,
)
from rigsim.subject.pigment import MELANIN_PRESETS, typical_blood
from rigsim.tissue.skin_layers import TissueProperties
from rigsim.tissue.skin_table import SkinTable
from rigsim.tissue.skin_transport import SkinTransportError
from skinrig.arrays import Float64Array
from skinrig.benchmarks.results import ErrorEstimate, Timing
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.fusing.measurements import LOCAL_SHARE

SKIN_TYPES: Final = ("I", "II", "III", "IV", "V", "VI")
"""Skin types of the people, repeated in the order of their seeds."""
N_PEOPLE: Final = 30
FIRST_SEED: Final = 900
CAMERA_NAME: Final = "Nikon 5100 (NPL)"
RIGS: Final = (RigBands("dome", CAMERA_NAME, "LED-B3"), RigBands("flash", CAMERA_NAME, "D55"))
TEXEL_ERROR: Final[Mapping[str, float]] = {"dome": 0.05, "flash": 0.01}
"""Relative standard errors of a texel's color."""
LIGHT_SD: Final = 0.6
"""Standard deviation of log light on a texel in the flash image."""
SHARED_TEXELS: Final = 8
"""Neighboring texels with one error of the dome."""
RIG_FAULTS: Final[Mapping[str, tuple[str, tuple[float, float, float]]]] = {
    "dome, red gain": ("dome", (0.2, 0.0, 0.0)),
    "dome, white balance": ("dome", (0.15, 0.0, -0.15)),
    "flash, red gain": ("flash", (-0.2, 0.0, 0.0)),
    "flash, white balance": ("flash", (-0.15, 0.0, 0.15)),
}
"""Faults: rig and log gain of its channels."""
N_TRIALS: Final = 20


@dataclass(frozen=True, slots=True, eq=False)
class DrawnFace:
    """Colors of one person by dome and flash rig, with the ground truth.

    Attributes
    ----------
    log_skin
        (N, 2): log melanin volume fraction and log blood.
    log_reflectance
        (N, 3): of the dome's channels.
    colors
        Colors by rig.
    errors
        Covariances of their errors.
    """

    log_skin: Float64Array
    log_reflectance: Float64Array
    colors: tuple[RigColors, ...]
    errors: OffsetModel

    def regions(self, rigs: Sequence[int]) -> Regions:
        """Return the face's median colors by some of the rigs."""
        labels = np.zeros(len(self.log_skin), np.intp)
        return summarize_regions([self.colors[k] for k in rigs], labels, self.errors)[0]

    def estimate_person(self, regions: Regions) -> PersonSkin:
        """Return the common properties of the skin."""
        return estimate_person(RIGS, regions, self.errors.offset_covariance)

    def estimate(self, rigs: Sequence[int], iterations: int) -> tuple[PersonSkin, TexelSkin]:
        """Return the estimates by some of the rigs."""
        person = self.estimate_person(self.regions(rigs))
        colors = [self.colors[k] for k in rigs]
        ((_, found),) = estimate_texels(person, colors, self.errors, iterations=iterations)
        return person, found


def draw_face(
    skin_type: str, seed: int, *, texels: int, log_gain: Mapping[str, Sequence[float]] | None = None
) -> DrawnFace:
    """Draw a person and the colors of the rigs.

    Parameters
    ----------
    skin_type
        One of `rigsim.subject.pigment.MELANIN_PRESETS`.
    seed
        Seed of the person and of all errors.
    texels
        Number of texels, a multiple of `SHARED_TEXELS`.
    log_gain
        Fault of a rig: log gain of its channels.
    """
    rng = np.random.default_rng([seed, 0x6675])
    table = _draw_table(rng)
    middle = MELANIN_PRESETS[skin_type] * float(np.exp(0.1 * rng.standard_normal()))
    mean = np.log([middle, float(typical_blood(middle))])
    fractions = np.exp(mean + rng.standard_normal((texels, 2)) * [0.15, 0.25])
    fractions = np.clip(fractions, 6e-4, [0.45, 0.25])
    spectrum = table.spectra(*fractions.T.astype(np.float32)).astype(np.float64)
    depth = SKIN_CONSTANTS.melanin_depth_factor
    unexplained = residual_covariance(RIGS, mean + np.array([np.log(depth), 0.0]))
    calibration = np.zeros((6, 6))
    calibration[:3, :3] = 0.02**2 + 0.005**2 * np.eye(3)
    calibration[3:, 3:] = 0.1**2 + 0.003**2 * np.eye(3)
    simulated = np.kron(np.eye(2), load_covariance())
    errors = OffsetModel(unexplained, calibration, LOCAL_SHARE * unexplained + simulated)

    def draw(covariance: Float64Array, *count: int) -> Float64Array:
        return np.asarray(rng.standard_normal((*count, 6)) @ np.linalg.cholesky(covariance).T)

    weights = [spectra.band_weights(rig.camera, rig.illuminant) for rig in RIGS]
    log_color = np.concatenate([np.log(spectrum @ w) for w in weights], axis=-1)
    log_color += draw(unexplained) + draw(LOCAL_SHARE * unexplained, texels)
    offset = draw(calibration)
    every = np.ones(texels, bool)
    colors = []
    for k, rig in enumerate(RIGS):
        at, sd = slice(3 * k, 3 * k + 3), TEXEL_ERROR[rig.rig]
        covariance = np.tile(0.25 * sd**2 * np.eye(3), (texels, 1, 1))
        noise = 0.5 * sd * rng.standard_normal((texels, 3))
        light = np.zeros((texels, 1))
        if rig.rig == "dome":
            covariance += 0.75 * sd**2
            few = rng.standard_normal((texels // SHARED_TEXELS, 1))
            noise += np.sqrt(0.75) * sd * np.repeat(few, SHARED_TEXELS, axis=0)
        else:
            light = LIGHT_SD * rng.standard_normal((texels, 1))
        seen = log_color[:, at] + offset[at] + noise + light
        seen = seen + np.array((log_gain or {}).get(rig.rig, (0.0, 0.0, 0.0)))
        free = LIGHT_SD**2 if rig.rig == "flash" else 0.0
        colors.append(RigColors(k, seen, covariance, every, free))
    return DrawnFace(np.log(fractions), log_color[:, :3], tuple(colors), errors)


def _draw_table(rng: np.random.Generator) -> SkinTable:
    """Return spectra of a person; properties outside the table of photons are drawn again."""
    while True:
        drawn = {}
        for one in NUISANCE_PARAMETERS:
            if one.name == "epidermis_mm":
                continue  # all maps of melanin presume the thickness
            usual = float(getattr(SKIN_CONSTANTS, one.name))
            off = one.sd * float(np.clip(rng.standard_normal(), -2.0, 2.0))
            name = "baseline_amplitude" if one.name == "baseline_factor" else one.name
            drawn[name] = usual * float(np.exp(off)) if one.is_log else usual + off
        for name in ("oxygenation", "eumelanin_fraction"):
            drawn[name] = min(drawn[name], 1.0)
        try:
            return SkinTable.load(TissueProperties(**drawn))
        except SkinTransportError:
            continue


def measure_fusion(stage: BenchmarkStage) -> None:
    """Measure errors and coverage over rigs and iterations, and the trials of faulty rigs."""
    count, texels = (2, 800) if stage.toy else (N_PEOPLE, 1600)
    faces = [
        draw_face(SKIN_TYPES[k % len(SKIN_TYPES)], FIRST_SEED + k, texels=texels)
        for k in range(count)
    ]
    settings = [("dome", TEXEL_ITERATIONS), ("flash", TEXEL_ITERATIONS)]
    settings += [("dome+flash", n) for n in ((2, 5) if stage.toy else (1, 2, 3, 5, 8))]
    by_setting = {one: _add_point(stage, faces, *one) for one in settings}
    fused = by_setting["dome+flash", TEXEL_ITERATIONS]
    for name in ("melanin", "blood", "r_d"):
        single = [by_setting[rig, TEXEL_ITERATIONS] for rig in ("dome", "flash")]
        best = min(one[name] for one in single if name in one)
        stage.limits["gain", name] = fused[name] / best
        # a person is one draw: the target is missed if the whole interval of the mean is outside
        held, half = fused[f"{name} coverage"], fused[f"{name} half"]
        stage.limits["least", name] = held + half
        stage.limits["most", name] = held - half
    trials = 4 if stage.toy else N_TRIALS
    named, alarms = _run_trials(trials, texels=400)
    stage.limits["named"] = 20.0 * named / trials
    stage.limits["alarms"] = 20.0 * alarms / trials


def _add_point(
    stage: BenchmarkStage, faces: Sequence[DrawnFace], rigs: str, iterations: int
) -> dict[str, float]:
    """Add the point of a setting, and return the means of its figures over people."""
    chosen = [k for k, rig in enumerate(RIGS) if rig.rig in rigs.split("+")]
    rows, seconds = [], []
    for face in faces:
        began = time.process_time()
        person, found = face.estimate(chosen, iterations)
        seconds.append(time.process_time() - began)
        rows.append(_figures(face, person, found, "dome" in rigs))
    mean = {name: float(np.nanmean([row[name] for row in rows])) for name in rows[0]}
    for name in [name for name in rows[0] if name.endswith("coverage")]:
        spread = float(np.std([row[name] for row in rows]))
        mean[name.replace("coverage", "half")] = spread / float(np.sqrt(len(rows)))
    errors = np.array([row["melanin"] for row in rows])
    half = float(errors.std() / np.sqrt(len(errors)))
    stage.add(
        {"rigs": rigs, "iterations": iterations},
        Timing(
            float(np.median(seconds)),
            (min(seconds), max(seconds)),
            seconds[0],
            None,
            no_memory_reason="processor time of single calls",
        ),
        ErrorEstimate.symmetric(float(errors.mean()), half),
        {name: round(value, 3) for name, value in mean.items() if name != "melanin"},
    )
    return mean


def _figures(
    face: DrawnFace, person: PersonSkin, found: TexelSkin, has_dome: bool
) -> dict[str, float]:
    """Return median errors in %, and coverages, over the valid texels of a face."""
    good = found.valid
    if not good.any():
        good = np.ones(len(good), bool)
    melanin = found.log_skin[:, 0] - np.log(melanin_depth_factor(person.properties_sd))
    blood_sd = np.sqrt((found.covariance + found.common)[:, 1, 1])
    parts = {
        "melanin": (melanin - face.log_skin[:, 0], np.sqrt(found.log_melanin_variance)),
        "blood": (found.log_skin[:, 1] - face.log_skin[:, 1], blood_sd),
    }
    if has_dome:
        sd = np.sqrt(found.signal_variance + found.signal_common)[:, :3]
        parts["r_d"] = (found.log_signals[:, :3] - face.log_reflectance, sd)
    figures = {name: 100.0 * float(np.median(np.abs(e[good]))) for name, (e, _) in parts.items()}
    figures |= {
        f"{name} coverage": float((np.abs(e) < sd)[good].mean()) for name, (e, sd) in parts.items()
    }
    return figures


def _run_trials(count: int, *, texels: int) -> tuple[int, int]:
    """Return how many faulty rigs were named, and how many people without a fault alarmed."""
    named = alarms = 0
    for trial in range(count):
        skin_type = SKIN_TYPES[trial % len(SKIN_TYPES)]
        rig, gain = list(RIG_FAULTS.values())[trial % len(RIG_FAULTS)]
        for faults in ({}, {rig: gain}):
            seed = FIRST_SEED + 100 + trial
            face = draw_face(skin_type, seed, texels=texels, log_gain=faults)
            regions = face.regions((0, 1))
            person = face.estimate_person(regions)
            found = name_faulty_rig(check_rigs(RIGS, regions, face.errors, person))
            if faults:
                named += found is not None and found.rig == rig
            else:
                alarms += found is not None
    return named, alarms
