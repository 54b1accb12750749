"""Extremes of fits: relaxation of blood, Malus's law, textures, mixtures, affine maps, growth."""

import numpy as np

from capture.calibration.polarization.malus import PolarizationError, fit_malus
from model.displacement_synthesis import growth as displacement_synthesis
from model.displacement_synthesis.sources import SynthesisError
from model.texture_statistics import description as texture_statistics
from model.traits import TraitSpace
from model.traits.nonnegative_kernels import nearest_mixtures
from model.traits.vectors import TraitError
from reconstruction.facial_color.perfusion_curves import CurveError
from reconstruction.facial_color.perfusion_fit import RelaxationFit, fit_course, fit_cycle
from reconstruction.registration.affine_fit import fit_affine
from reconstruction.registration.feature_matches import FeatureError, match_features
from skinrig.extremes.expectations import ExpectationError, expect_error, expect_near, expect_within
from skinrig.extremes.inputs import InputPrecision

CYCLE_S = 10.0
PHASES_S = np.arange(20) * 0.5


def _expect_status(found: RelaxationFit, *expected: str) -> str:
    if found.known not in expected:
        raise ExpectationError(f"known: got {found.known!r}, expected {' or '.join(expected)}")
    return str(found)


def _constant_blood(real: InputPrecision) -> str:
    rng = np.random.default_rng(1)
    values = real(0.03 + 1e-4 * rng.standard_normal(20))
    return _expect_status(fit_cycle(PHASES_S, values, cycle_s=CYCLE_S), "unknown")


def _instant_blood(real: InputPrecision) -> str:
    phases = PHASES_S + 0.25  # no sample at a prompt itself
    step = np.where(phases < 5.0, 0.04, 0.03)
    noise = 1e-5 * np.random.default_rng(2).standard_normal(20)
    found = fit_cycle(phases, real(step + noise), cycle_s=CYCLE_S)
    return _expect_status(found, "only below")


def _endless_course(real: InputPrecision) -> str:
    time_s = np.linspace(0.0, 60.0, 60)
    noise = 1e-6 * np.random.default_rng(3).standard_normal(60)
    values = real(0.03 + 1e-4 * time_s / 60.0 + noise)
    return _expect_status(fit_course(time_s, values), "only above", "unknown")


def _few_samples(real: InputPrecision) -> str:
    return expect_error(
        lambda: fit_cycle(PHASES_S[:4], real(np.full(4, 0.03)), cycle_s=CYCLE_S),
        CurveError,
        "usable",
    )


ANALYZER_RAD = np.deg2rad(np.arange(0.0, 181.0, 15.0))


def _ideal_polarizer(real: InputPrecision) -> str:
    found = fit_malus(ANALYZER_RAD, real(np.cos(ANALYZER_RAD - 0.3) ** 2))
    expect_near(found.zero_rad, [0.3], absolute=1e-5)
    return "leak " + expect_within(found.leak, -1e-6, 1e-6)


def _faint_leak(real: InputPrecision) -> str:
    leak = 1e-5
    law = leak + (1.0 - leak) * np.cos(ANALYZER_RAD) ** 2
    found = fit_malus(ANALYZER_RAD, real(law))
    return "leak " + expect_near(found.leak, [leak], relative=0.05)


def _equal_angles(real: InputPrecision) -> str:
    angles = np.array([0.0, 0.5, np.pi, 0.5 + np.pi, 2.0 * np.pi])
    return expect_error(
        lambda: fit_malus(angles, real(np.ones(5))), PolarizationError, "four different"
    )


def _dark_series(real: InputPrecision) -> str:
    return expect_error(
        lambda: fit_malus(ANALYZER_RAD, real(np.zeros(len(ANALYZER_RAD)))), PolarizationError
    )


def _texture(seed: int, side: int = 32) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 0.8, (side, side))


def _own_texture(real: InputPrecision) -> str:
    image = real(_texture(0))
    found = texture_statistics.match(image, image)
    return expect_near(found.image, image, absolute=1e-5)


def _constant_texture(real: InputPrecision) -> str:
    found = texture_statistics.match(real(np.full((32, 32), 0.5)), real(_texture(1)))
    gap = float(found.after.mean() / found.before.mean())
    return "distance over that before: " + expect_within(gap, 0.0, 1.01)


def _constant_target(real: InputPrecision) -> str:
    found = texture_statistics.match(real(_texture(2)), real(np.full((32, 32), 0.4)))
    return "values " + expect_within(np.ptp(found.image), 0.0, 0.3)


def _many_matches(real: InputPrecision) -> str:
    found = texture_statistics.match(real(_texture(3)), real(_texture(4) ** 3), iterations=20)
    if not np.isfinite(found.image).all():
        raise ExpectationError("image: got NaN, expected numbers")
    return f"distance {found.after.mean():.3g} of {found.before.mean():.3g} after 20 iterations"


def _equal_materials(real: InputPrecision) -> str:
    gram = np.asarray(real(np.ones((3, 3))), np.float64)
    found = nearest_mixtures(gram, np.array([[1.0, -0.25, 0.5]]))
    expect_within(found, 0.0, np.inf, label="weights") if np.isfinite(found).all() else None
    return "sum " + expect_near(found.sum(), 1.25, relative=1e-5)


def _all_negative(real: InputPrecision) -> str:
    gram = np.asarray(real(np.eye(4)), np.float64)
    return "weights " + expect_near(nearest_mixtures(gram, -np.ones((2, 4))), np.zeros((2, 4)))


def _ill_conditioned_mixtures(real: InputPrecision) -> str:
    angle = np.linspace(0.0, 1e-3, 6)
    rows = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    gram = np.asarray(real(rows @ rows.T), np.float64)
    wanted = np.array([[2.0, -1.0, 0.5, -0.5, 1.0, -1.0]])
    found = nearest_mixtures(gram, wanted)
    if not np.isfinite(found).all() or (found < 0.0).any():
        raise ExpectationError(f"weights: got {found}, expected numbers of at least 0")
    off = (found - wanted) @ rows
    return "misfit " + expect_within(np.linalg.norm(off), 0.0, 5e-3)


def _units_of_materials(real: InputPrecision) -> str:
    gram, wanted = np.array([[1.0, 0.8], [0.8, 1.0]]), np.array([[1.0, -0.5]])
    scales = (1e-18, 1e18)
    found = [nearest_mixtures(np.asarray(real(s * gram), np.float64), wanted)[0] for s in scales]
    return "weights " + expect_near(found, [[0.6, 0.0]] * 2, absolute=1e-6)


def _equal_faces(real: InputPrecision) -> str:
    same = real(np.tile([0.5, 0.5], (4, 1)))
    labels = {"oil": np.array([True, False, True, False])}
    return expect_error(lambda: TraitSpace.fit(same, labels), TraitError, "same")


def _no_label(real: InputPrecision) -> str:
    return expect_error(
        lambda: TraitSpace.fit(real(np.eye(3)), {"oil": np.zeros(3, bool)}), TraitError, "oil"
    )


GRID_PX = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2) * 20.0


def _far_points(real: InputPrecision) -> str:
    moved = np.asarray(real(GRID_PX * 1.05 + 1e5), np.float64)
    found, _ = fit_affine(GRID_PX, moved, window_px=20.0)
    return "stretch " + expect_near(found[:2], 1.05 * np.eye(2), absolute=1e-3)


def _points_on_line(real: InputPrecision) -> str:
    line = np.asarray(real(np.stack([np.arange(9.0), np.arange(9.0)], 1)), np.float64)
    return expect_error(lambda: fit_affine(line, line, window_px=5.0), ValueError, "line")


def _scaled_points(real: InputPrecision) -> str:
    moved = np.asarray(real(1e-6 * GRID_PX), np.float64)
    found, covariance = fit_affine(GRID_PX, moved, window_px=20.0)
    expect_within(np.diag(covariance), 0.0, 1e-6, label="variances")
    return "stretch " + expect_near(found[:2], 1e-6 * np.eye(2), absolute=1e-11)


def _featureless(real: InputPrecision) -> str:
    flat = np.asarray(real(np.full((64, 64), 128.0)), np.uint8)
    every = np.ones((64, 64), bool)
    return expect_error(
        lambda: match_features(flat, flat, valid=every, valid_second=every),
        FeatureError,
        "landmarks",
    )


def _flat_source(real: InputPrecision) -> str:
    patch = real(np.zeros((80, 80)))
    found = displacement_synthesis.grow([patch], 128, rng=np.random.default_rng(0))
    return "heights " + expect_near(found, np.zeros((128, 128)))


def _tall_source(real: InputPrecision) -> str:
    patch = real(1e6 * np.random.default_rng(1).standard_normal((80, 80)))
    found = displacement_synthesis.grow([patch], 128, rng=np.random.default_rng(0))
    return "RMS over that of the patch: " + expect_within(found.std() / patch.std(), 0.7, 1.3)


def _source_with_holes(real: InputPrecision) -> str:
    patch = real(np.random.default_rng(2).standard_normal((96, 96)))
    patch[::12, ::12] = np.nan
    found = displacement_synthesis.grow([patch], 128, rng=np.random.default_rng(0))
    if not np.isfinite(found).all():
        raise ExpectationError("heights: got NaN, expected filled holes")
    return "RMS " + expect_within(found.std(), 0.7, 1.3)


def _source_of_holes(real: InputPrecision) -> str:
    patch = real(np.full((80, 80), np.nan))
    return expect_error(
        lambda: displacement_synthesis.grow([patch], 128, rng=np.random.default_rng(0)),
        SynthesisError,
    )
