"""Unit vectors."""

import numpy as np

from model.vectors import unit_vectors


def test_unit_vectors_keep_type_and_unit_length():
    found = unit_vectors(np.array([[3.0, 0.0, 4.0], [0.0, 0.0, 1e-3]], np.float32))
    assert found.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1.0, rtol=1e-6)


def test_vectors_below_the_minimum_stay_short():
    found = unit_vectors(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.5]]), min_length=1.0)
    np.testing.assert_array_equal(found, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.5]])
