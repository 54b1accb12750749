"""Extremes of the registration of a scan to views, and of merged frames of a probe's fibers."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from capture.calibration.fiber.darks import CameraNoise, DarkModel, measure_darks
from capture.calibration.fiber.merge import MergedSeries, merge_series
from capture.calibration.geometry.intrinsics import CameraPose
from capture.rig import load_rig
from reconstruction.scan.registration import RigidFit, register_scan
from reconstruction.scan.rough_normals import NormalEvidence, ScanRegistrationError
from rigsim.geometry.mesh import Mesh
from rigsim.render import Caster, g_buffer
from rigsim.subject.head import build_head
from skinrig.arrays import Float64Array
from skinrig.extremes.expectations import (
    expect_error,
    expect_near,
    expect_valid_fraction,
    expect_within,
)
from skinrig.extremes.inputs import InputPrecision

SCAN_STEP = 3
VIEW_NUMBERS = (1, 7, 13)
VIEW_WIDTH_PX = 130


@lru_cache(maxsize=1)
def _scene() -> tuple[Mesh, tuple[NormalEvidence, ...]]:
    """Return a head, and its normals in three views without noise."""
    head = build_head(np.random.default_rng(5), columns=80, rows=84)
    rig = load_rig("dome").resized(VIEW_WIDTH_PX)
    caster = Caster(head)
    views = []
    for number in VIEW_NUMBERS:
        seen = g_buffer(caster, rig.views[number])
        normals = np.where(seen.mask[..., None], seen.normal, 0.0).astype(np.float32)
        pose = CameraPose.nominal(rig.views[number])
        views.append(NormalEvidence(pose, normals, seen.mask.astype(np.float32)))
    return head, tuple(views)


def _register(
    real: InputPrecision, turn: Float64Array, shift_mm: Sequence[float], step: int = SCAN_STEP
) -> tuple[RigidFit, Float64Array]:
    """Register a moved head; return the fit and the remaining distances, mm."""
    head, views = _scene()
    points = (head.vertices_mm[::step] - np.asarray(shift_mm)) @ turn
    fit = register_scan(real(points), real(head.normals[::step] @ turn), views)
    return fit, np.linalg.norm(fit.move(points) - head.vertices_mm[::step], axis=1)


def _scan_in_place(real: InputPrecision) -> str:
    fit, gap = _register(real, np.eye(3), (0.0, 0.0, 0.0))
    return f"converged {fit.outcome.converged}, distance, mm " + expect_within(gap, 0.0, 1.5)


def _far_scan(real: InputPrecision) -> str:
    fit, gap = _register(real, np.eye(3), (10.0, -8.0, 6.0))
    return f"converged {fit.outcome.converged}, distance, mm " + expect_within(gap, 0.0, 2.0)


def _lost_scan(real: InputPrecision) -> str:
    return expect_error(
        lambda: _register(real, np.eye(3), (5000.0, 0.0, 0.0)),
        ScanRegistrationError,
        "at least 200",
    )


def _few_points(real: InputPrecision) -> str:
    return expect_error(
        lambda: _register(real, np.eye(3), (0.0, 0.0, 0.0), step=200),
        ScanRegistrationError,
        "at least 200",
    )


CAMERA_NOISE = CameraNoise(4.0, 7.0, 64.0, 4095.0, "RGGB", "nominal")
BRACKETS_S = (0.01, 0.1, 1.0)
FRAME_SHAPE = (32, 32)


def _darks() -> DarkModel:
    rng = np.random.default_rng(1)
    frames = [np.rint(64.0 + rng.normal(0.0, 1.75, FRAME_SHAPE)).astype(np.uint16) for _ in "abcd"]
    return measure_darks(frames, (0.01, 0.01, 1.0, 1.0), noise=CAMERA_NOISE)


def _merge(electrons_per_s: float, factors: Sequence[float] = (1.0, 1.0, 1.0)) -> MergedSeries:
    rng = np.random.default_rng(2)
    frames = []
    for exposure_s, factor in zip(BRACKETS_S, factors, strict=True):
        light = rng.poisson(min(electrons_per_s * exposure_s * factor, 1e6), FRAME_SHAPE)
        values = 64.0 + (light + rng.normal(0.0, 7.0, FRAME_SHAPE)) / 4.0
        frames.append(np.clip(np.rint(values), 0, 4095).astype(np.uint16))
    return merge_series(frames, BRACKETS_S, darks=_darks(), noise=CAMERA_NOISE)


def _saturated_fibers(_: InputPrecision) -> str:
    return expect_valid_fraction(_merge(1e8).valid)


def _dark_fibers(_: InputPrecision) -> str:
    found = _merge(0.0)
    pull = found.rate.mean() / np.sqrt(found.variance.mean() / found.rate.size)
    return "mean over its error " + expect_within(pull, -4.0, 4.0)


def _one_electron(_: InputPrecision) -> str:
    found = _merge(1.0)
    off = found.rate.mean() * CAMERA_NOISE.span_dn * CAMERA_NOISE.gain_e_per_dn
    return "electrons per second " + expect_near(off, 1.0, absolute=1.0)


def _flickering_source(_: InputPrecision) -> str:
    found = _merge(1e4, (1.0, 1.0, 0.8))
    ratio = found.scale[2] / found.scale[1]
    return "brightness, last over second: " + expect_near(
        ratio, 0.8, absolute=2.0 * found.scale_stderr[2]
    )
