"""Points on which the reflectance benchmark evaluates lobes."""

import numpy as np

from skinrig.benchmarks.dome import reflectance


def test_benchmark_points_are_above_horizon_with_separate_lights(rng):
    p = reflectance.sample_face_points("III", points=6, samples=40, rng=rng)
    assert p.valid.mean() > 0.9
    assert 0.02 < p.held_out.mean() < 0.6
    np.testing.assert_allclose(np.linalg.norm(p.light, axis=-1), 1.0, atol=1e-6)
    # noise has the stated variance: 4 standard errors of the mean of squared deviates
    deviates = ((p.f - p.total) / np.sqrt(p.variance)) ** 2
    assert abs(deviates.mean() - 1.0) < 4 * np.sqrt(2.0 / deviates.size)
    assert (p.surface[p.valid] > 0).all()
    assert (p.total.min(axis=-1) > p.surface * (1 - 1e-5))[p.valid].all()
