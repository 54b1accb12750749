import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from reconstruction import normal_histogram as nh
from reconstruction.normal_histogram import relief_slopes


def rough(side, rng, *, correlation_px=2.0, slope=0.3):
    height = gaussian_filter(rng.standard_normal((side, side)), correlation_px, mode="wrap")
    return height * slope / np.gradient(height)[1].std()


def numpy_histogram(height, *, pixel=1.0, bins=64, limit=1.0):
    """The plain NumPy twin."""
    dy, dx = np.gradient(height, pixel)
    normals = np.stack([-dx, dy, np.ones_like(dx)]) / np.sqrt(1.0 + dx**2 + dy**2)
    sides = np.linspace(-limit, limit, bins + 1)
    counts = np.histogram2d(normals[1].ravel(), normals[0].ravel(), bins=(sides, sides))[0]
    return counts / counts.sum()


@pytest.mark.parametrize("limit", [1.0, 0.3])
def test_histogram_is_that_of_numpy(rng, limit):
    height = rough(80, rng)
    found = nh.histogram(height, pixel=1.5, limit=limit, bins=32)
    twin = numpy_histogram(height, pixel=1.5, limit=limit, bins=32)
    assert nh.distance(found, twin) <= 2 * 2 / height.size  # a sample may lie on an edge
    assert nh.distance(found, numpy_histogram(height.T, pixel=1.5, limit=limit, bins=32)) > 0.05


def test_slope_falling_right_and_up_has_normal_there():
    rows, columns = np.mgrid[0:10, 0:12].astype(float)
    height = -0.5 * columns + 0.2 * rows  # row 0 is the top: height falls towards it
    shares = nh.histogram(height, pixel=1.0, bins=64)
    ((y, x),) = np.argwhere(shares)
    length = np.sqrt(1 + 0.5**2 + 0.2**2)
    assert (x, y) == (int(32 + 32 * 0.5 / length), int(32 + 32 * 0.2 / length))
    ((down, same),) = np.argwhere(nh.histogram(height, pixel=1.0, y_up=False))
    assert same == x
    assert down == 63 - y


def test_turned_axes_see_a_ramp_along_the_jaws(rng):
    angle = np.radians(45.0)
    y, x = np.mgrid[0:20, 0:20][0][::-1], np.mgrid[0:20, 0:20][1]
    ramp = 0.3 * (np.cos(angle) * x + np.sin(angle) * y)
    ((across, along),) = np.argwhere(nh.histogram(ramp, pixel=1.0, angle_rad=angle, bins=63))
    assert across == 31  # the middle one
    assert along < 31


def test_holes_and_nan_take_no_part(rng):
    height = rough(60, rng)
    valid = np.ones(height.shape, bool)
    valid[20:30, 15:40] = False
    spoiled = height.copy()
    spoiled[~valid] = 1e6
    seen = nh.histogram(spoiled, pixel=1.0, valid=valid)
    assert nh.distance(seen, nh.histogram(np.where(valid, height, np.nan), pixel=1.0)) == 0.0
    assert nh.distance(seen, nh.histogram(spoiled, pixel=1.0)) > 0.01


def test_normals_and_heights_give_same_histogram(rng):
    height = rough(50, rng)
    dx, dy, known = relief_slopes.slopes(height, pixel=1.0)
    normals = np.stack([-dx, -dy, np.ones_like(dx)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    assert known.all()
    by_normals = nh.from_normals(normals)
    assert nh.distance(by_normals, nh.histogram(height, pixel=1.0)) <= 4 / height.size


def test_single_precision_moves_few_samples(rng):
    height = rough(200, rng)
    single = nh.histogram(height.astype(np.float32), pixel=1.0)
    assert nh.distance(single, nh.histogram(height, pixel=1.0)) < 2e-3


def test_maps_without_slopes_are_refused():
    for height in (np.zeros((1, 9)), np.full((5, 5), np.nan), np.zeros((0, 0))):
        with pytest.raises(nh.HistogramError, match="no sample"):
            nh.histogram(height, pixel=1.0)
    with pytest.raises(nh.HistogramError, match="no sample"):
        nh.histogram(np.zeros((9, 9)), pixel=1.0, valid=np.eye(9, dtype=bool))
    with pytest.raises(relief_slopes.HistogramError, match="pixel"):
        nh.histogram(np.zeros((9, 9)), pixel=0.0)
    with pytest.raises(nh.HistogramError, match="limit"):
        nh.histogram(np.zeros((9, 9)), pixel=1.0, limit=1.5)


def test_noise_floor_is_mean_distance_of_independent_samples(rng):
    p = rng.dirichlet(np.full(300, 0.5))
    for n in (200, 5000):
        distances = [
            np.abs(a - b).sum() for a, b in (rng.multinomial(n, p, 2) / n for _ in range(400))
        ]
        stderr = np.std(distances) / 20
        assert abs(np.mean(distances) - nh.noise_floor(p, n)) < 4 * stderr + 0.005


def test_halved_distance_is_fraction_in_other_buckets():
    a, b = np.array([0.5, 0.5, 0.0]), np.array([0.5, 0.0, 0.5])
    assert nh.distance(a, b) == 1.0
    assert nh.halved_distance(a, b) == 0.5
    with pytest.raises(nh.HistogramError, match="shape"):
        nh.distance(a, b[:2])


def test_row_list_is_topography_but_stack_is_not():
    rows = [[0.0, 0.2, 0.5], [0.1, 0.2, 0.9]]
    of_list = nh.histogram(rows, pixel=1.0, bins=8)
    np.testing.assert_array_equal(of_list, nh.histogram(np.array(rows), pixel=1.0, bins=8))
    with pytest.raises(relief_slopes.HistogramError, match=r"\(1, 2, 3\), expected .*one by one"):
        nh.histogram([rows], pixel=1.0)
