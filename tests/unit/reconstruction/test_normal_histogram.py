import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from reconstruction import normal_histogram as nh


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


def test_a_slope_that_falls_to_the_right_and_to_the_top_has_its_normal_there():
    rows, columns = np.mgrid[0:10, 0:12].astype(float)
    height = -0.5 * columns + 0.2 * rows  # row 0 is the top: height falls towards it
    shares = nh.histogram(height, pixel=1.0, bins=64)
    ((y, x),) = np.argwhere(shares)
    length = np.sqrt(1 + 0.5**2 + 0.2**2)
    assert (x, y) == (int(32 + 32 * 0.5 / length), int(32 + 32 * 0.2 / length))
    ((down, same),) = np.argwhere(nh.histogram(height, pixel=1.0, y_up=False))
    assert same == x
    assert down == 63 - y


def test_a_wide_pixel_halves_the_slope_along_its_rows():
    height = np.tile(0.4 * np.arange(9.0), (9, 1))
    wide, _, _ = nh.slopes(height, pixel=(1.0, 2.0))
    np.testing.assert_allclose(wide, 0.2, atol=1e-12)


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


def test_normals_and_heights_give_one_histogram(rng):
    height = rough(50, rng)
    dx, dy, known = nh.slopes(height, pixel=1.0)
    normals = np.stack([-dx, -dy, np.ones_like(dx)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    assert known.all()
    by_normals = nh.from_normals(normals)
    assert nh.distance(by_normals, nh.histogram(height, pixel=1.0)) <= 4 / height.size
    measured = nh.measure_normals(normals)
    assert measured.variance_x == pytest.approx(np.var(normals[..., 0]), rel=1e-9)


def test_single_precision_moves_few_samples(rng):
    height = rough(200, rng)
    single = nh.histogram(height.astype(np.float32), pixel=1.0)
    assert nh.distance(single, nh.histogram(height, pixel=1.0)) < 2e-3


def test_flat_patch_lies_in_one_bucket_and_is_not_called_aliased():
    flat = nh.measure(np.zeros((20, 20)), pixel=1.0)
    assert flat.occupied == 1
    assert flat.variance_x == flat.variance_y == flat.stderr_x == 0.0
    assert not flat.aliased
    assert flat.histogram.sum() == 1.0


def test_few_samples_for_many_buckets_are_called_aliased(rng):
    height = rough(32, rng)
    assert nh.measure(height, pixel=1.0).aliased
    assert not nh.measure(height, pixel=1.0, bins=4).aliased


def test_maps_without_slopes_are_refused():
    for height in (np.zeros((1, 9)), np.full((5, 5), np.nan), np.zeros((0, 0))):
        with pytest.raises(nh.HistogramError, match="no sample"):
            nh.histogram(height, pixel=1.0)
    with pytest.raises(nh.HistogramError, match="no sample"):
        nh.histogram(np.zeros((9, 9)), pixel=1.0, valid=np.eye(9, dtype=bool))
    with pytest.raises(nh.HistogramError, match="pixel"):
        nh.histogram(np.zeros((9, 9)), pixel=0.0)
    with pytest.raises(nh.HistogramError, match="limit"):
        nh.histogram(np.zeros((9, 9)), pixel=1.0, limit=1.5)


def test_normals_beyond_the_limit_are_counted_apart():
    height = np.tile(np.arange(8.0), (8, 1))
    height[:, 4:] = height[:, 4:5]  # steep on the left, flat on the right
    found = nh.measure(height, pixel=1.0, limit=0.6)
    assert found.outside == 4 * 8  # columns 0...3 rise by 1 a pixel: n_x = -0.71
    assert found.samples == height.size - found.outside
    assert found.histogram.sum() == pytest.approx(1.0)


def test_standard_error_of_variances_is_their_scatter(rng):
    """Rationale: blocks are far larger than the correlation length of 3 px.

    The ratio of a standard deviation of 60 values to its mean estimate lies within 0.72...1.28
    in 99.7 %; blocks cut neighbours apart, which adds a little.
    """
    found = []
    for _ in range(60):
        white = rng.standard_normal((160, 160))
        found.append(nh.measure(13.0 * gaussian_filter(white, 3.0, mode="wrap"), pixel=1.0))
    scatter = np.std([m.variance_y for m in found], ddof=1)
    assert 0.7 < scatter / np.mean([m.stderr_y for m in found]) < 1.35
    plain = np.mean([np.sqrt(2 / m.samples) * m.variance_y for m in found])
    assert scatter > 2.0 * plain  # as if pixels were independent: too small


def test_noise_floor_is_the_mean_distance_of_independent_samples(rng):
    p = rng.dirichlet(np.full(300, 0.5))
    for n in (200, 5000):
        distances = [
            np.abs(a - b).sum() for a, b in (rng.multinomial(n, p, 2) / n for _ in range(400))
        ]
        stderr = np.std(distances) / 20
        assert abs(np.mean(distances) - nh.noise_floor(p, n)) < 4 * stderr + 0.005


def test_effective_number_of_correlated_normals_tells_the_distance_of_two_patches(rng):
    pairs = [[nh.measure(rough(192, rng, correlation_px=5.0), pixel=1.0, bins=16)
              for _ in range(2)] for _ in range(12)]  # fmt: skip
    real = np.mean([nh.distance(a.histogram, b.histogram) for a, b in pairs])
    effective = [m.effective_samples for pair in pairs for m in pair]
    told = nh.noise_floor(pairs[0][0].histogram, float(np.mean(effective)))
    naive = nh.noise_floor(pairs[0][0].histogram, pairs[0][0].samples)
    assert 0.7 < real / told < 1.4
    assert real / naive > 2.0


def test_halved_distance_is_the_share_in_other_buckets():
    a, b = np.array([0.5, 0.5, 0.0]), np.array([0.5, 0.0, 0.5])
    assert nh.distance(a, b) == 1.0
    assert nh.halved_distance(a, b) == 0.5
    with pytest.raises(nh.HistogramError, match="shape"):
        nh.distance(a, b[:2])
