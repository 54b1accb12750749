"""Trials of the dome's intervals on simulated faces, whose light from below is Lambertian."""

import numpy as np

from model.skin import SkinMap
from reconstruction.surface.errors import interior_error
from skinrig.benchmarks.intervals import dome


def test_trials_of_albedo_omit_interior_error():
    """Expected: the other errors alone; an error below the term becomes 0, not NaN."""
    values = np.random.default_rng(0).uniform(0.05, 0.6, (4, 5, 3)).astype(np.float32)
    other = 0.01 * values
    stated = np.hypot(other, interior_error(values)).astype(np.float32)
    found = dome._without_interior_error(SkinMap(values, "1", stated))
    np.testing.assert_allclose(found.stderr, other, rtol=1e-4)
    narrow = dome._without_interior_error(SkinMap(values, "1", 0.5 * interior_error(values)))
    assert not narrow.stderr.any()
    truth = SkinMap(values, "1")
    assert dome._without_interior_error(truth) is truth
