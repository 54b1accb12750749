"""Compiled mixtures are those of the plain evaluation."""

import numpy as np
import pytest

from model.brdf import tables as brdf_tables
from reconstruction import brdf_basis
from reconstruction.brdf_basis import mixture_kernels


def directions(rng, *shape):
    way = rng.standard_normal((*shape, 3))
    return (way / np.linalg.norm(way, axis=-1, keepdims=True)).astype(np.float32)


def test_mixtures_match_plain_ones_also_below_horizon(rng):
    basis = brdf_tables.default_basis().mix_materials(
        np.eye(brdf_tables.default_basis().size)[[3, 20, 40, 55]]
    )
    weights = rng.random((30, 4))
    light, view = directions(rng, 30, 50), directions(rng, 30, 50)
    normals = directions(rng, 30).astype(np.float64)
    quick = mixture_kernels.evaluate_mixtures(basis.table, weights, light, view, normals)
    plain = brdf_basis.evaluate(
        weights[:, None], basis, light.astype(np.float64), view.astype(np.float64), normals[:, None]
    )
    below = (np.einsum("pmk,pk->pm", light, normals) <= 0) | (
        np.einsum("pmk,pk->pm", view, normals) <= 0
    )
    assert below.sum() > 500
    assert not quick[below].any()
    # nodes of azimuth are taken at the nearest: a rounding apart may choose the other one
    apart = np.abs(quick - plain) > 1e-4 * plain + 1e-6
    assert apart.mean() < 1e-3


def test_mirror_and_normal_directions_are_in_table(rng):
    basis = brdf_tables.default_basis().mix_materials(np.eye(brdf_tables.default_basis().size)[[3]])
    up = np.array([[0.0, 0.0, 1.0]])
    light = np.array([[[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [1.0, 0.0, 0.0]]], np.float32)
    view = np.array([[[0.0, 0.0, 1.0], [-0.6, 0.0, 0.8], [-1.0, 0.0, 0.0]]], np.float32)
    out = mixture_kernels.evaluate_mixtures(basis.table, np.ones((1, 1)), light, view, up)
    assert np.isfinite(out).all()
    assert out[0, 0] > 0
    assert out[0, 2] == 0


def test_table_in_any_layout_gives_equal_mixtures(rng):
    table = rng.random((32, 12, 90, 16), np.float32)
    light, view = directions(rng, 4, 5), directions(rng, 4, 5)
    normals, weights = directions(rng, 4).astype(np.float64), rng.random((4, 4))
    expected = mixture_kernels.evaluate_mixtures(table, weights, light, view, normals)
    turned = np.asfortranarray(table)
    found = mixture_kernels.evaluate_mixtures(turned, weights, light, view, normals)
    np.testing.assert_array_equal(found, expected)
    assert expected.any()


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("table", (16, 12, 90, 16)),
        ("table", (32, 12, 90, 3)),
        ("weights", (3, 4)),
        ("light_dir", (4, 5, 2)),
        ("view_dir", (4, 4, 3)),
        ("normals", (3, 3)),
    ],
)
def test_arrays_of_other_shapes_are_refused(name, shape):
    shapes = {"table": (32, 12, 90, 16), "weights": (4, 4), "light_dir": (4, 5, 3)}
    shapes |= {"view_dir": (4, 5, 3), "normals": (4, 3)} | {name: shape}
    arrays = {key: np.ones(one, np.float32) for key, one in shapes.items()}
    with pytest.raises(ValueError, match=name):
        mixture_kernels.evaluate_mixtures(**arrays)
