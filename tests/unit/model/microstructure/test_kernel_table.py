import dataclasses
import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from model.microstructure.kernel_table import (
    FOREHEAD,
    KernelTable,
    KernelTableError,
    gaussian_weights,
    kernel_parameters,
)


def test_forehead_is_eqs_8_and_9():
    r = np.linspace(0.73, 1.28, 300)
    alpha, sigma_um = kernel_parameters(r)
    eq8 = np.maximum(np.minimum(np.minimum(1.0, 15.4 * r - 13.8), 3.09 * (r - 1.0)), -2.0)
    eq9 = np.where(r >= 1.0, 38.2 * r - 26.5, 70.5 * r - 46.9)
    np.testing.assert_allclose(alpha, eq8, atol=1e-12)
    np.testing.assert_allclose(sigma_um, eq9, atol=1e-12)


def test_neutral_skin_keeps_topography_while_sigma_jumps():
    alpha, sigma_um = kernel_parameters([np.nextafter(1.0, 0.0), 1.0])
    np.testing.assert_allclose(alpha, 0.0, atol=1e-12)
    np.testing.assert_allclose(sigma_um, [23.6, 11.7])


def test_beyond_range_table_clamps_extrapolates_or_refuses():
    held = kernel_parameters([0.5, 2.0])
    np.testing.assert_array_equal(held, kernel_parameters([0.73, 1.28]))
    alpha, sigma_um = kernel_parameters([0.5, 0.665, 2.0], extrapolate="formula")
    np.testing.assert_array_equal(alpha, [-2.0, -2.0, 1.0])
    np.testing.assert_allclose(sigma_um, [0.0, 0.0, 49.9], atol=0.02)  # eq. (9) ends at r = 0.665
    with pytest.raises(KernelTableError, match=r"0\.73\.\.\.1\.28"):
        kernel_parameters(0.665, extrapolate="refuse")
    with pytest.raises(ValueError, match="extrapolate"):
        kernel_parameters(1.0, extrapolate="clamp")
    np.testing.assert_array_equal(FOREHEAD.inside([0.5, 0.73, 1.0, 1.28, 2.0]), [0, 1, 1, 1, 0])
    for bad in (np.nan, 0.0, -1.0, np.inf):
        with pytest.raises(KernelTableError):
            kernel_parameters(bad)


def test_neutral_kernel_is_identity_in_every_table():
    m = 1.0 / 3.0
    rounded = dataclasses.replace(
        FOREHEAD, alpha_breaks=(), alpha_lines=((m, -np.nextafter(m, 1.0)),)
    )
    assert rounded.unlimited_alpha(np.ones(1))[0] != 0.0
    for table in (FOREHEAD, rounded):
        assert kernel_parameters(1.0, table)[0] == 0.0


def test_kernels_keep_to_their_ranges_for_any_stretch():
    r = np.geomspace(1e-3, 1e3, 4001)
    for extrapolate in ("hold", "formula"):
        alpha, sigma_um = kernel_parameters(r, extrapolate=extrapolate)
        assert alpha.min() == -2.0
        assert alpha.max() <= 1.0
        assert sigma_um.min() >= 0.0


def test_table_round_trips_through_json_damage_is_reported():
    text = FOREHEAD.to_json()
    assert KernelTable.from_json(text) == FOREHEAD
    given = json.loads(text)
    for damage, word in (
        ({"schema": "skinrig.kernel-table/9"}, "schema"),
        ({"colour": 1}, "colour"),
        ({"alpha_lines": [[1.0, 0.0]]}, "alpha_lines"),
        ({"sigma_stretch_um": "wide"}, "table"),
    ):
        with pytest.raises(KernelTableError, match=word):
            KernelTable.from_json(json.dumps({**given, **damage}))
    with pytest.raises(KernelTableError, match="JSON"):
        KernelTable.from_json(text[:-5])


def test_tables_that_contradict_themselves_are_refused():
    for change, word in (
        ({"alpha_lines": ((15.4, -13.8), (3.0, -2.0))}, "meet"),
        ({"alpha_lines": ((15.4, -13.7), (3.09, -3.09 + 0.1))}, "neutral"),
        ({"stretch_range": (0.6, 1.28)}, "sigma <= 0"),
        ({"sigma_compression_um": None}, "covered"),
        ({"alpha_breaks": ()}, "one more"),
    ):
        with pytest.raises(KernelTableError, match=word):
            dataclasses.replace(FOREHEAD, **change)


@pytest.mark.parametrize("sigma_px", [0.05, 0.4, 1.0, 3.3])
def test_the_discrete_gaussian_is_that_of_scipy(sigma_px):
    w = gaussian_weights(sigma_px)
    spike = np.zeros(2 * w.size + 1)
    spike[w.size] = 1.0
    theirs = gaussian_filter1d(spike, sigma_px)
    np.testing.assert_allclose(w, theirs[w.size : 2 * w.size], atol=1e-14)
