"""Benchmark of the chromophore inversion on skins whose optics the estimator does not assume.

The skins are Monte Carlo spectra (``tools/make_independent_skins.py``), their light is known, and
intervals are those of `ChromophoreMaps.interval`. Where the environment variable SKIN_SPECTRA names
measured spectra (see ``tools/make_optics_uncertainty.py``), the fraction of their colors that
belongs to the model is measured as well, on the subjects that do not set the residuals.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib import resources
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from model import color_table, spectra
from model.fresnel import ETA_SKIN, normal_reflectance
from model.tissue_optics import SKIN_CONSTANTS
from model.tissue_optics import uncertainty as optics_uncertainty
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction import chromophores
from skinrig.arrays import BoolArray, Float64Array
from skinrig.benchmarks.measurement import measure_processor_seconds_in_turn
from skinrig.benchmarks.resampling import median_error
from skinrig.benchmarks.stage import BenchmarkStage

SKIN_TYPES: Final = ("I", "II", "III", "IV", "V", "VI")
TYPE_EDGES_DEG: Final = (55.0, 41.0, 28.0, 10.0, -30.0)
JUDGED_CAMERAS: Final = (("Nikon 5100 (NPL)", "D55"), (spectra.LINEAR_SRGB, "D65"))
MEASURED_CAMERAS: Final = (
    *JUDGED_CAMERAS,
    ("Sigma SDMerill (NPL)", "D65"),
    ("Nikon 5100 (NPL)", "A"),
    ("Sigma SDMerill (NPL)", "LED-B3"),
)
CHANNEL_NOISE: Final = 0.005
TIMED_REPEATS: Final = 7
"""Timed calls with each table, in turn."""
MELANOSOME_550_PER_MM: Final = 6.6e10 * 550.0**-3.33
"""Absorption of the simulated skins' melanosomes at 550 nm, 1/mm."""
MIN_REFLECTANCE: Final = 0.003
"""Reflectance that measured samples are raised to after the specular part is subtracted."""


@dataclass(frozen=True, slots=True, eq=False)
class IndependentSkins:
    """Spectra and truths of n skins."""

    reflectance: Float64Array
    """(n, w) diffuse reflectance."""
    wavelength_nm: Float64Array
    """(w,)"""
    depth: Float64Array
    """(n,) melanin optical depth at 550 nm."""
    blood: Float64Array
    """(n,) blood volume fraction."""
    skin_type: NDArray[np.intp]
    """(n,) index into `SKIN_TYPES`, by the individual typology angle."""


@lru_cache(maxsize=1)
def load_skins() -> IndependentSkins:
    """Return the skins of the package."""
    source = resources.files("skinrig").joinpath("data", "independent_skins.npz")
    with source.open("rb") as stream, np.load(stream) as stored:
        depth = stored["c_m"].astype(np.float64) * stored["epidermis_mm"] * MELANOSOME_550_PER_MM
        return IndependentSkins(
            stored["reflectance"].astype(np.float64),
            stored["wavelength_nm"].astype(np.float64),
            depth,
            stored["c_hd"].astype(np.float64),
            type_index(stored["typology_angle_deg"]),
        )


def type_index(angle_deg: Float64Array) -> NDArray[np.intp]:
    """Return the index into `SKIN_TYPES` of individual typology angles, degrees.

    Examples
    --------
    >>> type_index(np.array([60.0, 0.0, -60.0])).tolist()
    [0, 4, 5]
    """
    return np.searchsorted(-np.array(TYPE_EDGES_DEG), -np.asarray(angle_deg))


@dataclass(frozen=True, slots=True, eq=False)
class TypeAccuracy:
    """Results over the skins of one type."""

    skins: int
    """Number of valid skins."""
    valid: float
    """Fraction of valid skins."""
    bias: float
    """Median ratio of estimated to true melanin optical depth."""
    within_68: float
    """Coverage of 68.3 % intervals of melanin."""
    within_95: float
    """Coverage of 95 % intervals of melanin."""
    blood_within_68: float
    """Coverage of 68.3 % intervals of blood."""


def accuracy_by_type(
    table: color_table.ColorTable, skins: IndependentSkins, rgb: Float64Array
) -> tuple[dict[str, TypeAccuracy], Float64Array]:
    """Return accuracies by type, and each skin's relative error of melanin (n,), NaN if invalid."""
    found = chromophores.invert(
        rgb, table, shading="known", variance=np.square(CHANNEL_NOISE * rgb)
    )
    melanin = skins.depth / table.constants.melanin_depth_factor
    ratio = np.where(found.valid, found.melanin / melanin, np.nan)

    def inside(name: str, truth: Float64Array, probability: float) -> BoolArray:
        low, high = found.interval(name, probability)  # type: ignore[arg-type]
        return np.asarray((low <= truth) & (truth <= high))

    by_type = {}
    for index, name in enumerate(SKIN_TYPES):
        of_type = skins.skin_type == index
        good = of_type & found.valid
        if not good.any():
            continue
        by_type[name] = TypeAccuracy(
            int(good.sum()),
            float(found.valid[of_type].mean()),
            float(np.median(ratio[good])),
            float(inside("melanin", melanin, 0.683)[good].mean()),
            float(inside("melanin", melanin, 0.95)[good].mean()),
            float(inside("hemoglobin", skins.blood, 0.683)[good].mean()),
        )
    return by_type, np.abs(ratio - 1.0)


def _coverage_bounds(skins: int) -> tuple[float, float, float, float]:
    """Return bounds of the coverage of 68 % intervals, then of 95 % intervals.

    Coverages of 0.60 to 0.76 and of 0.90 to 0.98 are allowed, plus twice the sampling error of n
    skins.
    """
    error_68, error_95 = (2.0 * float(np.sqrt(p * (1.0 - p) / skins)) for p in (0.68, 0.95))
    return 0.60 - error_68, 0.76 + error_68, 0.90 - error_95, 0.98 + error_95


def noisy_colors(skins: IndependentSkins, camera: str, illuminant: str) -> Float64Array:
    """Return white-balanced camera RGB of the skins with noise, (n, 3)."""
    rgb = spectra.band_average(
        skins.reflectance, camera, illuminant, wavelength_nm=skins.wavelength_nm
    )
    rng = np.random.default_rng(5)
    return np.asarray(rgb * (1.0 + CHANNEL_NOISE * rng.standard_normal(rgb.shape)))


def measure_independent_skin(stage: BenchmarkStage) -> None:
    """Measure error, coverage and valid fraction by skin type over table sizes and optics."""
    skins = load_skins()
    side = 96 if stage.toy else 2048
    sizes = (16, 128) if stage.toy else (8, 16, 32, 128)
    for camera, illuminant in JUDGED_CAMERAS:
        rgb = noisy_colors(skins, camera, illuminant)
        image = rgb[np.arange(side * side) % len(rgb)].reshape(side, side, 3).astype(np.float32)
        variance = np.square(CHANNEL_NOISE * image)
        calls: dict[tuple[str, bool], Callable[[], object]] = {}
        for exact in (True, False):
            for size in sizes:
                table = color_table.build(
                    camera, illuminant, size=size, anisotropy=ANISOTROPY_SKIN, exact_optics=exact
                )
                timing, _ = stage.time(
                    lambda: chromophores.invert(image, table, shading="known", variance=variance)
                )
                by_type, off = accuracy_by_type(table, skins, rgb)
                least = min(one.valid for one in by_type.values())
                covered = {f"within 68 %, {k}": round(v.within_68, 2) for k, v in by_type.items()}
                optics = "exact" if exact else "unknown"
                stage.add(
                    {"camera": camera, "optics": optics, "type": "all", "table": size},
                    timing,
                    median_error(100.0 * off),
                    {"least valid share": round(least, 3), **covered},
                )
                for index, name in enumerate(SKIN_TYPES):
                    stage.add(
                        {"camera": camera, "optics": optics, "type": name, "table": size},
                        timing,
                        median_error(100.0 * off[skins.skin_type == index]),
                    )
                if size == sizes[-1]:
                    for shading, known in (("known", 1.0), ("free", None)):
                        calls[shading, exact] = partial(
                            chromophores.invert, image, table, shading=known, variance=variance
                        )
        # processor time, in turn: other programs do not change the ratio
        seconds = measure_processor_seconds_in_turn(calls, TIMED_REPEATS)
        for shading in ("known", "free"):
            with_optics, without = (seconds[shading, exact] for exact in (False, True))
            stage.limits["time", side, shading, camera] = with_optics / without
        for name, one in by_type.items():
            stage.limits["valid", name, camera] = one.valid
            stage.limits["bias", name, camera] = abs(one.bias - 1.0)
            bounds = _coverage_bounds(one.skins)
            stage.limits["least", name, camera] = one.within_68, bounds[0]
            stage.limits["most", name, camera] = one.within_68, bounds[1]
            stage.limits["wide", name, camera] = one.within_95, bounds[2]
            stage.limits["widest", name, camera] = one.within_95, bounds[3]
    given = os.environ.get("SKIN_SPECTRA")
    if given is None or not Path(given).is_file():
        why = "SKIN_SPECTRA names no file of measured spectra; see tools/make_optics_uncertainty.py"
        stage.omitted.append(("measured spectra", why))
        return
    for camera, illuminant in MEASURED_CAMERAS:
        for name, share in valid_measured_share(Path(given), camera, illuminant).items():
            stage.limits["measured", name, f"{camera}, {illuminant}"] = share


def valid_measured_share(path: Path, camera: str, illuminant: str) -> dict[str, float]:
    """Return the fraction of measured colors that belong to the model, by type, known light.

    Parameters
    ----------
    path
        NumPy file with ``reflectance`` (n, 43) at 360 to 780 nm, specular included, and
        ``subject`` (n,).
    camera, illuminant
        Names known to `model.spectra`.
    """
    with np.load(path) as stored:
        reflectance, subject = stored["reflectance"][:, 4:35], stored["subject"]
    judges = np.array([not sets_residuals(str(name)) for name in subject])
    reflectance = reflectance[judges & np.isfinite(reflectance).all(axis=1)]
    types = type_index(optics_uncertainty.typology_angle(reflectance))
    diffuse = np.maximum(reflectance - normal_reflectance(ETA_SKIN), MIN_REFLECTANCE)
    rgb = spectra.band_average(diffuse, camera, illuminant)
    table = color_table.build(
        camera, illuminant, anisotropy=ANISOTROPY_SKIN, constants=SKIN_CONSTANTS
    )
    found = chromophores.invert(
        rgb, table, shading="known", variance=np.square(CHANNEL_NOISE * rgb)
    )
    return {
        name: float(found.valid[types == k].mean())
        for k, name in enumerate(SKIN_TYPES)
        if (types == k).any()
    }


def sets_residuals(subject: str) -> bool:
    """Return whether a subject of the measured spectra sets the model's residuals.

    Examples
    --------
    >>> 450 < sum(sets_residuals(f"1-{k}") for k in range(1000)) < 550
    True
    """
    return int(hashlib.sha256(f"2025:{subject}".encode()).hexdigest(), 16) % 2 == 0
