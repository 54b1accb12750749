"""Benchmark of the fiber probe end to end: sigma_tr of media from simulated sessions."""

import math
import tempfile
from pathlib import Path

import numpy as np

from model import store
from reconstruction.pipeline import recipes as pipeline
from reconstruction.pipeline.probe.profile_fits import METHOD_NAMES
from skinrig.benchmarks.resampling import bootstrap_median
from skinrig.benchmarks.results import ErrorEstimate, Knobs
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.calibrating.calibrate import calibrate
from skinrig.evaluating import subsurface as evaluation
from skinrig.evaluating.skin_bands import MELANIN_BANDS
from skinrig.simulating.orders import truth_folder
from skinrig.simulating.simulation import simulate_session

N_MEDIA = 8
FIRST_MEDIUM_SEED = 40
SIGMA_TR_RANGE_PER_MM = (0.3, 3.0)
SIGMA_S_PRIME_RANGE_PER_MM = (0.7, 3.0)
G_RANGE = (0.7, 0.9)
BAND_G = 0.8
"""Anisotropy g of the media that represent melanin bands."""


def measure_session(stage: BenchmarkStage) -> None:
    """Measure sigma_tr of simulated, calibrated and inverted media; seconds are the inversion's."""
    with tempfile.TemporaryDirectory(prefix="skinrig-probe-") as name:
        folder = Path(name)
        simulate_session(
            "probe", folder / "session-phantom", target="phantom", seed=FIRST_MEDIUM_SEED
        )
        calibrate("fiber", [folder / "session-phantom"], folder / "calibration")
        like_skin = {
            name: _captured(
                folder, name, (band.sigma_a_per_mm, band.sigma_s_prime_per_mm, BAND_G), seed
            )
            for seed, (name, band) in enumerate(MELANIN_BANDS.items())
        }
        of_bands = {name: _invert(folder, session) for name, session in like_skin.items()}
        rows = [row for some in of_bands.values() for row in some] if stage.toy else []
        last = like_skin["dark"]
        for seed in () if stage.toy else range(FIRST_MEDIUM_SEED, FIRST_MEDIUM_SEED + N_MEDIA):
            last = _captured(folder, f"{seed}", draw_medium(seed), seed)
            rows += _invert(folder, last)
        stage.by_band |= {name: _default_method_error(some) for name, some in of_bands.items()}
        timing, _ = stage.time(lambda: _invert(folder, last, "again"), repeats=1, memory=False)
    by_method = {row.method: row for row in evaluation.summarize_methods(rows)}
    for method in (name for name in METHOD_NAMES if name in by_method):
        valid = [row for row in rows if row.method == method and row.valid]
        for channel in ("all", *sorted({row.channel for row in valid})):
            sizes = [abs(row.relative) for row in valid if channel in ("all", row.channel)]
            knobs: Knobs = {"method": method, "channel": channel}
            knobs["media"] = len({row.name for row in rows})
            stage.add(knobs, timing, _error(sizes))
    best, dipole = by_method[METHOD_NAMES[0]], by_method["dipole"]
    stage.limits = {
        "median": 100 * best.median,
        "worst": 100 * best.worst,
        "valid": best.fits,
        "dipole": 100 * dipole.median,
    }


def draw_medium(seed: int) -> tuple[float, float, float]:
    """Draw sigma_a and sigma_s', 1/mm, and g of a medium by its seed.

    sigma_tr and sigma_s' are log-uniform, g is uniform.

    Examples
    --------
    >>> sigma_a, sigma_s_prime, g = draw_medium(3)
    >>> 0.3 <= math.sqrt(3 * sigma_a * (sigma_a + sigma_s_prime)) <= 3.0
    True
    """
    rng = np.random.default_rng(seed)
    sigma_tr, sigma_s_prime = (
        math.exp(rng.uniform(*np.log(span)))
        for span in (SIGMA_TR_RANGE_PER_MM, SIGMA_S_PRIME_RANGE_PER_MM)
    )
    g = rng.uniform(*G_RANGE)
    # the positive root of sigma_tr^2 = 3 sigma_a (sigma_a + sigma_s')
    sigma_a = 0.5 * (math.sqrt(sigma_s_prime**2 + 4.0 / 3.0 * sigma_tr**2) - sigma_s_prime)
    return sigma_a, sigma_s_prime, g


def _invert(folder: Path, session: Path, name: str = "") -> list[evaluation.FitAccuracy]:
    out = folder / f"appearance-{name or session.name}"
    pipeline.reconstruct(
        session,
        want=("profiles", "subsurface"),
        out=out,
        calibration=folder / "calibration",
        truth=truth_folder(session).name,
    )
    return evaluation.compare_fits(store.read(out), store.read(truth_folder(session)))


def _captured(folder: Path, name: str, coefficients: tuple[float, float, float], seed: int) -> Path:
    """Simulate a session of a medium of sigma_a, sigma_s' and g; return its folder."""
    sigma_a, sigma_s_prime, g = coefficients
    simulate_session(
        "probe",
        folder / f"session-{name}",
        sites=("cheek",),
        seed=seed,
        subject=f"homogeneous:{sigma_a:.6g},{sigma_s_prime:.6g},{g:.3g}",
    )
    return folder / f"session-{name}"


def _default_method_error(rows: list[evaluation.FitAccuracy]) -> ErrorEstimate:
    """Return the error of the default method over the channels of one medium, %."""
    sizes = [abs(row.relative) for row in rows if row.method == METHOD_NAMES[0] and row.valid]
    return _error(sizes)


def _error(sizes: list[float]) -> ErrorEstimate:
    """Return the median relative error in percent, with its interval."""
    percent = 100 * np.array(sizes)
    return bootstrap_median(percent, draws=400)
