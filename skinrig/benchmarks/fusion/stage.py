"""Benchmark of the fusion: errors, coverages and faulty rigs on drawn people.

Rigs and covariances are left out one at a time; Gauss-Newton steps give the curve of error against
seconds.
"""

import time
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from reconstruction.fusion.consistency import MIN_PROBABILITY, check_rigs, name_faulty_rig
from reconstruction.fusion.patch_normals import check_patch
from reconstruction.fusion.person import PersonSkin
from reconstruction.fusion.texels import TEXEL_ITERATIONS, TexelSkin, melanin_depth_factor
from skinrig.benchmarks.fusion.people import RIGS, DrawnFace, RigFault, draw_face
from skinrig.benchmarks.results import ErrorEstimate, Timing
from skinrig.benchmarks.stage import BenchmarkStage

SKIN_TYPES: Final = ("I", "II", "III", "IV", "V", "VI")
"""Skin types of the people, repeated in the order of their seeds."""
N_PEOPLE: Final = 30
FIRST_SEED: Final = 900
RIG_FAULTS: Final[Mapping[str, RigFault]] = {
    "dome, red gain": RigFault("dome", (0.2, 0.0, 0.0)),
    "flash, red gain": RigFault("flash", (-0.2, 0.0, 0.0)),
    "probe, centimeters for millimeters": RigFault("probe", (-2.3, -2.3, -2.3)),
    "gradient, turned normals": RigFault("gradient", rotation_deg=30.0),
    "dome, white balance": RigFault("dome", (0.15, 0.0, -0.15)),
    "flash, white balance": RigFault("flash", (-0.15, 0.0, 0.15)),
}
"""Faults of the four rigs. The probe's is a unit of length: blood under its head, scattering of the
person and the model of its light leave a factor of 3 open."""
N_TRIALS: Final = 20
ALL_RIGS: Final = "+".join(rig.rig for rig in RIGS)


def measure_fusion(stage: BenchmarkStage) -> None:
    """Measure errors and coverage over rigs and iterations, and the trials of faulty rigs."""
    count, texels = (2, 400) if stage.toy else (N_PEOPLE, 1600)
    faces = [
        draw_face(SKIN_TYPES[k % len(SKIN_TYPES)], FIRST_SEED + k, texels=texels)
        for k in range(count)
    ]
    usual = TEXEL_ITERATIONS
    settings = [("dome", usual), ("flash", usual), ("dome+flash", usual)]
    settings += [("dome+probe", usual), ("flash+probe", usual)]
    settings += [(ALL_RIGS, n) for n in ((2, 5) if stage.toy else (1, 2, 3, 5, 8))]
    by_setting = {one: _add_point(stage, faces, *one) for one in settings}
    apart = [face.without_covariance for face in faces]
    _add_point(stage, apart, ALL_RIGS, usual, label=f"{ALL_RIGS}, without covariance")
    fused = by_setting[ALL_RIGS, usual]
    for name in ("melanin", "blood", "r_d"):
        single = [by_setting[rig, TEXEL_ITERATIONS] for rig in ("dome", "flash")]
        best = min(one[name] for one in single if name in one)
        stage.limits["gain", name] = fused[name] / best
        # a person is one draw: the target is missed if the whole interval of the mean is outside
        held, half = fused[f"{name} coverage"], fused[f"{name} half"]
        stage.limits["least", name] = held + half
        stage.limits["most", name] = held - half
    trials = 2 if stage.toy else N_TRIALS
    named, alarms = _run_trials(trials, texels=400)
    stage.limits["named"] = 20.0 * named / trials
    stage.limits["alarms"] = 20.0 * alarms / trials


def _add_point(
    stage: BenchmarkStage,
    faces: Sequence[DrawnFace],
    rigs: str,
    iterations: int,
    *,
    label: str = "",
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
        {"rigs": label or rigs, "iterations": iterations},
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
        skin_type = SKIN_TYPES[trial // 4 % len(SKIN_TYPES)]
        fault = list(RIG_FAULTS.values())[trial % len(RIG_FAULTS)]
        seed = FIRST_SEED + 100 + trial
        named += name_faulty_rigs(draw_face(skin_type, seed, texels=texels, fault=fault)) == {
            fault.rig
        }
        alarms += bool(name_faulty_rigs(draw_face(skin_type, seed, texels=texels)))
    return named, alarms


def name_faulty_rigs(face: DrawnFace) -> set[str]:
    """Return the rigs of four that contradict the others or themselves.

    Parameters
    ----------
    face
        Measurements by all rigs.
    """
    regions = face.regions(range(len(RIGS)))
    found = name_faulty_rig(check_rigs(RIGS, regions, face.errors, face.estimate_person(regions)))
    patch = check_patch(face.patch)
    named = set() if found is None else {found.rig}
    return named | ({patch.rig} if patch.probability > MIN_PROBABILITY else set())
