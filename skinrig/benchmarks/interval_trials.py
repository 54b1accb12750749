"""Simulated subjects, captured, calibrated and reconstructed, and how far their maps are off.

Each trial goes the whole way of a user, from calibration targets to maps, at the sensor's noise.
Nothing here knows the model: maps are compared with the truth that the simulator wrote.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from model import metrics, store
from model.skin import SkinAppearance, SkinMap
from reconstruction import pipeline
from skinrig import skin_bands
from skinrig.benchmarks.interval_coverage import GAUSSIAN_95, RAYLEIGH_95, Trial
from skinrig.calibrating.calibrate import calibrate
from skinrig.simulating.simulation import Simulated, simulate_session

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

ANY_BAND: Final = "any"
"""Band of quantities that do not depend on the color of the skin."""
RAYLEIGH_68: Final = float(np.sqrt(-2.0 * np.log(1.0 - 0.6827)))
"""Of an error with the same deviation in two directions, the length that 68.27 % stay below."""
BLOOD_STATES: Final = ("smile", "anger", "fear", "exercise")
FACTORS_95: Final[Mapping[str, float]] = {
    "melanin": 2.7, "hemoglobin": 2.7, "height": 2.1, "normals of the gradient sphere": 1.9,
    "normals of the dome": 1.9, "R_d, red": 2.9, "R_d, green": 2.9, "R_d, blue": 2.9,
}  # fmt: skip
"""Half width of a 95 % interval over that of the 68 % one where tails are heavier than a
Gaussian's, to 0.1, set on subjects that are not judged: 14 of the flash rig and 6 patches of seeds
0 to 13, and the one face of the dome's demonstration. Others are `GAUSSIAN_95`, of angles
`RAYLEIGH_95`."""


def _factor(quantity: str, otherwise: float = GAUSSIAN_95) -> float:
    return FACTORS_95.get(quantity, otherwise)


def _band(truth: SkinAppearance, name: str, skin: Bools) -> str:
    """Return the band of the median color of a subject's skin."""
    color = truth.maps[name].values[skin]
    return str(skin_bands.bands_of(np.median(skin_bands.typology_angle_deg(color))))


def _valid(skin_map: SkinMap) -> Bools:
    shape = skin_map.values.shape[:2]
    return np.ones(shape, bool) if skin_map.valid is None else skin_map.valid


def _of_map(
    quantity: str, estimate: SkinMap, true: NDArray[np.floating], skin: Bools, *, subject: str,
    band: str, channel: int | None = None,
) -> Trial:  # fmt: skip
    """Compare a map of numbers with the truth, where it is valid; widths are relative."""
    spread = estimate.stderr
    if spread is None:
        raise ValueError(f"{quantity}: has no standard error, expected one")
    good = skin & _valid(estimate)
    part = (good,) if channel is None else (good, channel)
    value = estimate.values[part].astype(np.float64)
    stderr = spread[part].astype(np.float64)
    truth = np.asarray(true, np.float64)[part]
    width = float(100.0 * np.median(stderr / np.abs(truth))) if value.size else float("nan")
    return Trial(
        quantity, subject, band, np.abs(value - truth) / stderr, width, "%", _factor(quantity)
    )


def _of_normals(
    quantity: str, angle_rad: Floats, stderr_rad: Floats, *, subject: str, band: str = ANY_BAND
) -> Trial:
    """Compare directions: the 68 % region is a cone about the estimate."""
    reach = RAYLEIGH_68 * stderr_rad
    width = float(np.degrees(np.median(reach))) if reach.size else float("nan")
    return Trial(
        quantity, subject, band, angle_rad / reach, width, "degrees",
        _factor(quantity, RAYLEIGH_95),
    )  # fmt: skip


def flash(
    folder: Path, subjects: Mapping[int, str], *, width_px: int, moving: bool = True
) -> Iterator[Trial]:
    """Yield trials of melanin, hemoglobin and the change of blood with a state.

    Parameters
    ----------
    folder
        For sessions and maps; those of a subject are gone when the next begins.
    subjects
        Seed of each and its preset.
    width_px
        Pixels across the camera.
    moving
        Whether each is captured in a second state, for the change of blood.
    """
    targets = {"sensor": "flat", "white": "white", "polarization": "malus"}
    _calibrated("flash", folder, targets, width_px=width_px)
    for seed, preset in subjects.items():
        state = BLOOD_STATES[seed % len(BLOOD_STATES)]
        name = f"{preset} {seed}"
        done = simulate_session(
            "flash", folder / "session-subject", subject=preset, seed=seed, width_px=width_px,
            states=("neutral", state) if moving else ("neutral",),
        )  # fmt: skip
        pipeline.reconstruct(
            done.session, want=["melanin", "hemoglobin"], out=folder / "maps",
            calibration=folder / "calibration",
        )  # fmt: skip
        found, truth = store.read(folder / "maps"), store.read(_truth(done))
        skin = truth.maps["mask"].values > 0.5
        band = _band(truth, "reflectance_blurred", skin)
        for quantity in ("melanin", "hemoglobin"):
            true = truth.maps[f"{quantity}_blurred"].values
            yield _of_map(quantity, found.maps[quantity], true, skin, subject=name, band=band)
        if moving:
            yield from _change_of_blood(done, folder, state, subject=name, band=band)
        _forget(folder, done)


def _change_of_blood(
    done: Simulated, folder: Path, state: str, *, subject: str, band: str
) -> Iterator[Trial]:
    from skinrig.evaluating import facial_color
    from skinrig.fitting.facial_color import fit_facial_color
    from skinrig.simulating.simulation import truth_folder

    fit_facial_color([done.session], out=folder / "moving", calibration=folder / "calibration")
    found = store.read(folder / "moving").maps.get(f"change_{state}")
    neutral = truth_folder(done.session)
    truths = [neutral, neutral.with_name(f"{neutral.name}-{state}")]
    rest, moved = (
        facial_color.true_blood(store.read(place)) if place.is_dir() else None for place in truths
    )
    if found is None or rest is None or moved is None:
        return
    both = _valid(rest) & _valid(moved) & (moved.values > 0)
    change = moved.values.astype(np.float64) - rest.values
    yield _of_map("change of hemoglobin", found, change, both, subject=subject, band=band)


def gradient(folder: Path, subjects: Mapping[int, str], *, width_px: int) -> Iterator[Trial]:
    """Yield trials of specular normals and heights of patches of skin, at rest.

    Parameters as of `flash`; a subject is a site of the face.
    """
    from skinrig.evaluating.microrelief import true_relief

    _calibrated("gradient", folder, {"lights": "ball", "polarization": "ball"}, width_px=None)
    for seed, site in subjects.items():
        name = f"{site} {seed}"
        done = simulate_session(
            "gradient", folder / "session-subject", site=site, seed=seed, width_px=width_px,
            angles=(0.0,), steps=(0, 0),
        )  # fmt: skip
        pipeline.reconstruct(
            done.session, want=["normals", "height"], out=folder / "maps",
            calibration=folder / "calibration",
        )  # fmt: skip
        found, truth = store.read(folder / "maps"), store.read(_truth(done))
        state = next(
            key.removeprefix("normals_")
            for key in found.maps
            if key.startswith("normals_a") and key.endswith("_n0")
        )
        normals, seen = found.maps[f"normals_{state}"], truth.maps[f"normals_seen_{state}"]
        good = _valid(normals) & _valid(seen)
        if normals.stderr is not None:
            angle = metrics.angular_error_rad(normals.values[good], seen.values[good])
            yield _of_normals(
                "normals of the gradient sphere", angle,
                normals.stderr[good][:, 0].astype(np.float64), subject=name,
            )  # fmt: skip
        height = found.maps[f"height_{state}"]
        relief = true_relief(found, truth, state)
        good = _valid(height) & _valid(truth.maps[f"height_{state}"])
        if height.stderr is not None:
            stderr = height.stderr[good].astype(np.float64)
            off = np.abs(height.values.astype(np.float64)[good] - relief[good]) / stderr
            yield Trial("height", name, ANY_BAND, off, float(np.median(stderr)), "um",
                        _factor("height"))  # fmt: skip
        _forget(folder, done)


def dome(folder: Path, subjects: Mapping[int, str], *, width_px: int) -> Iterator[Trial]:
    """Yield trials of normals and diffuse albedo of faces; parameters as of `flash`."""
    from skinrig.evaluating import surface as surface_evaluation

    for target in ("charuco", "mirror", "white"):
        simulate_session(
            "dome",
            folder / f"session-{target}",
            target=target,
            seed=900,
            width_px=width_px,
        )
    calibrate("geometry", [folder / "session-charuco"], folder / "calibration")
    calibrate(
        "lights", [folder / "session-mirror", folder / "session-white"], folder / "calibration"
    )
    for seed, preset in subjects.items():
        name = f"{preset} {seed}"
        done = simulate_session(
            "dome",
            folder / "session-subject",
            subject=preset,
            seed=seed,
            width_px=width_px,
        )
        pipeline.reconstruct(
            done.session, want=["normals", "r_d"], out=folder / "maps",
            calibration=folder / "calibration",
        )  # fmt: skip
        found, truth = store.read(folder / "maps"), store.read(_truth(done))
        pairs = surface_evaluation.match(found, truth)
        true_normals, true_albedo = (
            truth.maps[key].values.reshape(-1, 3).astype(np.float64)[pairs.truth]
            for key in ("normals", "r_d")
        )
        band = str(skin_bands.bands_of(np.median(skin_bands.typology_angle_deg(true_albedo))))
        normals, albedo = found.maps["normals"], found.maps["r_d"]
        good = _valid(normals)[pairs.rows, pairs.columns]
        if normals.stderr is not None:
            at = (pairs.rows[good], pairs.columns[good])
            yield _of_normals(
                "normals of the dome",
                metrics.angular_error_rad(normals.values[at], true_normals[good]),
                normals.stderr[at][:, 0].astype(np.float64), subject=name, band=band,
            )  # fmt: skip
        shape = _valid(albedo).shape
        true = np.zeros((*shape, 3))
        true[pairs.rows, pairs.columns] = true_albedo
        told = np.zeros(shape, bool)
        told[pairs.rows, pairs.columns] = True
        for channel, color in enumerate(("red", "green", "blue")):
            yield _of_map(f"R_d, {color}", albedo, true, told, subject=name, band=band,
                          channel=channel)  # fmt: skip
        _forget(folder, done)


def probe(folder: Path, media: Mapping[int, str]) -> Iterator[Trial]:
    """Yield trials of sigma_tr of homogeneous media under the fibre probe.

    Parameters
    ----------
    folder
        As of `flash`.
    media
        Seed of each and "homogeneous:SIGMA_A,SIGMA_S_PRIME,G"; layers have a sigma_tr by
        definition only.
    """
    from skinrig.evaluating import subsurface as evaluation

    _calibrated("probe", folder, {"fibre": "phantom"}, width_px=None)
    for seed, medium in media.items():
        done = simulate_session(
            "probe", folder / "session-subject", subject=medium, sites=("cheek",), seed=seed
        )
        pipeline.reconstruct(
            done.session, want=["subsurface"], out=folder / "maps",
            calibration=folder / "calibration",
        )  # fmt: skip
        fits = [
            fit
            for fit in evaluation.compare_fits(
                store.read(folder / "maps"), store.read(_truth(done))
            )
            if fit.method == evaluation.RECOMMENDED and fit.valid
        ]
        # an interval of the logarithm, its two halves alike
        half = np.array([0.5 * np.log(fit.interval[1] / fit.interval[0]) for fit in fits])
        center = np.array([0.5 * np.log(fit.interval[1] * fit.interval[0]) for fit in fits])
        truth = np.log(np.array([fit.truth for fit in fits]))
        width = float(100.0 * np.median(half)) if fits else float("nan")
        yield Trial("sigma_tr", f"{medium} {seed}", ANY_BAND, np.abs(center - truth) / half, width,
                    "%", _factor("sigma_tr"))  # fmt: skip
        _forget(folder, done)


def _calibrated(
    rig: str, folder: Path, targets: Mapping[str, str], *, width_px: int | None
) -> None:
    for kind, target in targets.items():
        session = folder / f"session-{target}"
        if not session.exists():
            simulate_session(rig, session, target=target, seed=900, width_px=width_px)
        calibrate(kind, [session], folder / "calibration")


def _truth(done: Simulated) -> Path:
    if done.truth is None:
        raise ValueError("simulated session: has no truth, expected one")
    return done.truth


def _forget(folder: Path, done: Simulated) -> None:
    """Take a subject's folders away: the next one's have their names."""
    for place in (done.session, folder / "maps", folder / "moving"):
        shutil.rmtree(place, ignore_errors=True)
    for place in folder.glob("truth-subject*"):
        shutil.rmtree(place)
