"""Errors that are estimated from images, over all images."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruction.chromophores import model_error


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    shape=st.tuples(st.integers(1, 12), st.integers(1, 12)),
    gain=st.floats(1e-3, 1e3),
    spread=st.floats(0.0, 2.0),
)
def test_fine_structure_is_finite_nonnegative_and_light_invariant(seed, shape, gain, spread):
    rng = np.random.default_rng(seed)
    rgb = np.exp(spread * rng.standard_normal((*shape, 3)))
    rgb[rng.random(shape) < 0.1] = np.nan
    valid = rng.random(shape) < 0.8
    good = model_error.usable_pixels(rgb, valid)
    assert not (good & ~valid).any()
    variance = np.where(np.isfinite(rgb), 1e-4 * rgb**2, 0.0)
    found = model_error.fine_structure(rgb, variance, good)
    brighter = model_error.fine_structure(gain * rgb, gain**2 * variance, good)
    assert np.isfinite(found).all()
    assert (found >= 0.0).all()
    np.testing.assert_allclose(brighter, found, rtol=1e-6, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31), factor=st.floats(0.1, 10.0), spread=st.floats(0.0, 1.0))
def test_image_errors_are_covariances_scaling_with_terms(seed, factor, spread):
    rng = np.random.default_rng(seed)
    rgb = 0.3 * np.exp(spread * rng.standard_normal((9, 8, 3)))
    valid = rng.random((9, 8)) < 0.9
    terms = model_error.load_error_terms()
    wider = model_error.ColorErrors(
        factor**2 * terms.transport, factor**2 * terms.fine, factor * terms.interreflection
    )
    one, two = (
        model_error.image_covariance(rgb, 0.0 * rgb, valid, errors=e) for e in (terms, wider)
    )
    np.testing.assert_allclose(two, factor**2 * one, rtol=1e-9, atol=1e-15)
    assert np.linalg.eigvalsh(one).min() > -1e-9 * np.abs(one).max()
