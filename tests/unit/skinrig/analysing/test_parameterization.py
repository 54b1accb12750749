"""Distortion of texture coordinates: closed forms of a sheared plane and of a cylinder."""

import json

import numpy as np
import pytest

from skinrig.analysing.parameterization import measure_stretch
from skinrig.cli import main
from skinrig.extremes.inputs import sheet_faces


def grid(side=9):
    u, v = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side))
    return u.ravel(), v.ravel(), sheet_faces(side)


def test_stretched_plane_has_planted_singular_values():
    u, v, faces = grid()
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    flat = np.stack([30.0 * u, 12.0 * v], axis=1) @ turn.T
    found = measure_stretch(np.column_stack([flat, 0 * u]), faces, np.stack([u, v], 1))
    np.testing.assert_allclose(found[:, :2], [[30.0, 12.0]] * len(faces), rtol=1e-9)
    assert found[:, 2].sum() == pytest.approx(360.0)


def test_degenerate_texture_triangle_is_nan():
    found = measure_stretch(np.eye(3), [[0, 1, 2]], np.zeros((3, 2)))
    assert np.isnan(found).all()


def test_compressed_half_shows_in_area_percentiles(tmp_path, capsys):
    u, v, faces = grid(17)
    bent = np.where(u < 0.5, u, 0.5 + 3.0 * (u - 0.5))  # the right half covers three times as much
    mesh = tmp_path / "mesh.npz"
    points = np.column_stack([40.0 * bent, 40.0 * v, 0 * u])
    np.savez(mesh, vertices_mm=points, faces=faces, uv=np.stack([u, v], 1))
    argv = ["analyse", "parameterization", str(mesh), "--out", str(tmp_path / "p"), "--json"]
    assert main(argv) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["area_over_median"]["5"] == pytest.approx(1 / 3, rel=1e-4)
    assert found["angle_ratio"]["95"] == pytest.approx(3.0, rel=1e-4)
    assert found["log_area_sd"] == pytest.approx(np.log(3.0) * np.sqrt(0.75 * 0.25), rel=0.01)
