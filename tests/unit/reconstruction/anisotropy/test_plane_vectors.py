import numpy as np
import pytest

from reconstruction.anisotropy import plane_vectors


@pytest.mark.parametrize("length", [0.0, 0.3, 1.0, 2.5, 8.0])
def test_axis_error_is_circular_scatter_of_sampled_vectors(length, rng):
    """Rationale: drawn directions' mean resultant length, by definition.

    Expected: sqrt(-2 log R) / 2. Tolerance: R of 400,000 draws has a standard error of at most
    0.0012; at length 0, R would be 0 and the logarithm is held by the axis's greatest error.
    """
    drawn = rng.standard_normal((400_000, 2)) + np.array([length, 0.0])
    resultant = np.cos(np.arctan2(drawn[:, 1], drawn[:, 0])).mean()
    told = plane_vectors.axis_stderr(np.array([3.0 * length]), np.array([3.0]))[0]
    if length == 0.0:
        assert abs(resultant) < 0.005
        assert told == plane_vectors.UNKNOWN_AXIS_RAD
    else:
        least = np.sqrt(-2 * np.log(resultant + 0.005)) / 2 if resultant < 0.995 else 0.0
        most = np.sqrt(-2 * np.log(resultant - 0.005)) / 2
        assert min(least, plane_vectors.UNKNOWN_AXIS_RAD) <= told <= most
    if length > 2.0:
        assert told == pytest.approx(0.5 / length, rel=0.15)


def test_lengths_scatter_by_their_standard_errors(rng):
    """Tolerance: a standard deviation of 100,000 draws is known to 0.22 %, asked within 5 sigma."""
    covariance = np.array([[0.04, 0.018], [0.018, 0.02]]) * 1e-4
    mean = np.array([0.6, -0.8])
    drawn = mean + rng.standard_normal((100_000, 2)) @ np.linalg.cholesky(covariance).T
    length, along, across = plane_vectors.estimate_length(mean[None], covariance[None])
    assert length[0] == pytest.approx(1.0)
    assert np.hypot(*drawn.T).std() == pytest.approx(along[0], rel=0.012)
    assert np.arctan2(drawn[:, 1], drawn[:, 0]).std() == pytest.approx(across[0], rel=0.012)
