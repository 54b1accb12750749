"""Extremes of template wrapping: incomplete, coarse and displaced scans, and scans of no face."""

from collections.abc import Callable

import numpy as np

from reconstruction.scan.face_template import load_default_template
from reconstruction.scan.repair import ScanMeshError, TriangleMesh
from reconstruction.scan.template_wrapping import wrap_template
from skinrig.arrays import Float64Array
from skinrig.benchmarks.dome.template import simulate_scan
from skinrig.extremes.expectations import (
    expect_error,
    expect_near,
    expect_valid_fraction,
    expect_within,
)
from skinrig.extremes.inputs import InputPrecision

PERSON_SEED = 300
STIFFNESS_STEPS = 4
QUARTER_TURN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""By 90 degrees about the vertical axis."""


def _wrapped(
    real: InputPrecision,
    limits: tuple[float, float, float],
    *,
    triangles: int = 20_000,
    keep: Callable[[Float64Array], Float64Array] | None = None,
    rotation: Float64Array | None = None,
    shift_mm: float = 0.0,
) -> str:
    """Check RMS error of the valid vertices, mm, and the range of the valid fraction."""
    face = simulate_scan(PERSON_SEED, "neutral", triangles=triangles)
    scan, turn = face.scan, np.eye(3) if rotation is None else rotation
    if keep is not None:
        scan = scan.select_faces(keep(scan.vertices_mm[scan.faces].mean(axis=1)) > 0.0)
    moved = np.asarray(real(scan.vertices_mm @ turn.T + shift_mm), np.float64)
    found = wrap_template(
        load_default_template(), TriangleMesh(moved, scan.faces), steps=STIFFNESS_STEPS
    )
    gap = found.mesh.vertices_mm - (face.true_vertices_mm @ turn.T + shift_mm)
    expect_near(found.folded, 0)
    expect_valid_fraction(found.valid, fraction_range=limits[1:])
    rms = np.sqrt(np.mean(np.sum(gap[found.valid] ** 2, axis=1)))
    return expect_within(rms, 0.0, limits[0], label="RMS error, mm")


def _half(real: InputPrecision) -> str:
    return _wrapped(real, (2.0, 0.3, 0.7), keep=lambda centers: centers[:, 0])


def _coarse(real: InputPrecision) -> str:
    return expect_error(
        lambda: _wrapped(real, (2.0, 0.2, 1.0), triangles=500), ScanMeshError, "expected a face"
    )


def _turned(real: InputPrecision) -> str:
    return _wrapped(real, (2.0, 0.8, 1.0), rotation=QUARTER_TURN)


def _far(real: InputPrecision) -> str:
    return _wrapped(real, (2.0, 0.8, 1.0), shift_mm=1e5)


def _ball(real: InputPrecision) -> str:
    angle, height = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 61), np.linspace(-0.99, 0.99, 41))
    ring = np.sqrt(1.0 - height**2)
    points = 95.0 * np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=-1)
    at = np.arange(points.size // 3).reshape(points.shape[:2])
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
    faces = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)])
    mesh = TriangleMesh(np.asarray(real(points.reshape(-1, 3)), np.float64), faces)
    return expect_error(
        lambda: wrap_template(load_default_template(), mesh), ScanMeshError, "expected a face"
    )


def _empty(real: InputPrecision) -> str:
    nothing = TriangleMesh(np.asarray(real(np.zeros((0, 3))), np.float64), np.zeros((0, 3), int))
    return expect_error(
        lambda: wrap_template(load_default_template(), nothing), ScanMeshError, "triangle"
    )
