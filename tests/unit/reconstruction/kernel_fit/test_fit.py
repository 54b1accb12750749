import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from model.microstructure.kernel_table import gaussian_weights
from reconstruction import normal_histogram as nh
from reconstruction.kernel_fit import search as ks
from reconstruction.kernel_fit.fit import ALPHA_GRID, SIGMAS_UM, KernelSearch, fit_kernel
from reconstruction.kernel_fit.neutral_relief import KernelFitError, convolve_relief, prepare_relief
from reconstruction.normal_histogram import kernels

PIXEL_UM = 6.0
COARSE_GRID = np.round(np.arange(-2, 1.01, 0.1), 2), np.arange(2.0, 81.0, 3.0)
COARSE = {"grid": COARSE_GRID}


def skin(side, rng, *, slope=0.3):
    """Grain and furrows; slopes of the given standard deviation."""
    white = rng.standard_normal((3, side, side))
    height = gaussian_filter(white[0], 1.5, mode="wrap")
    height += 3.0 * gaussian_filter(white[1], 5.0, mode="wrap")
    wave = gaussian_filter(white[2], 8.0, mode="wrap")
    height -= 0.5 * np.exp(-((wave / wave.std() / 0.3) ** 2))
    return height * slope * PIXEL_UM / np.gradient(height)[1].std()


def convolved_histogram(height, alpha, sigma_um, *, stretch, axis):
    """Return the histogram that the search compares with its target."""
    relief = prepare_relief(height, stretch=stretch, axis=axis, pixel_um=PIXEL_UM)
    buckets = ks.TargetBuckets(np.zeros(64 * 64 + 1), 64, 1.0)
    start, change = (relief.along, relief.across), relief.slope_change(sigma_um)
    counts = buckets.count(start, change, np.array([alpha])).sum(axis=0)[0]
    shares = counts[:-1].reshape(64, 64) / relief.places.size
    return shares.T if axis == "y" else shares


def scipy_target(height, alpha, sigma_um, *, stretch, axis):
    """Eq. (7)'s histogram in plain NumPy and SciPy, in double precision."""
    blurred = gaussian_filter1d(height, sigma_um / PIXEL_UM, axis=axis)
    moved = (1 - alpha) * height + alpha * blurred
    dy, dx = np.gradient(moved, PIXEL_UM)
    dx, dy = (dx / stretch, dy) if axis == 1 else (dx, dy / stretch)
    w = 1.0 / np.sqrt(1.0 + dx**2 + dy**2)
    sides = np.linspace(-1, 1, 65)
    counts = np.histogram2d((dy * w).ravel(), (-dx * w).ravel(), bins=(sides, sides))[0]
    return counts / counts.sum()


@pytest.mark.long
@pytest.mark.parametrize(("axis", "number"), [("x", 1), ("y", 0)])
@pytest.mark.parametrize(("alpha", "sigma_um"), [(-1.3, 9.0), (0.8, 44.5), (0.5, 3.0)])
def test_search_histogram_matches_plain_numpy(rng, axis, number, alpha, sigma_um):
    height = skin(96, rng)
    ours = convolved_histogram(height, alpha, sigma_um, stretch=0.8, axis=axis)
    twin = scipy_target(height, alpha, sigma_um, stretch=0.8, axis=number)
    assert nh.distance(ours, twin) <= 2 * 4 / height.size  # samples on an edge, in single precision
    other = scipy_target(height, alpha, sigma_um, stretch=0.8, axis=1 - number)
    assert nh.distance(ours, other) > 0.02


@pytest.mark.parametrize(
    ("alpha", "sigma_um", "stretch", "axis"),
    [(-0.63, 17.5, 0.9, "x"), (0.41, 8.0, 1.2, "y"), (1.0, 24.0, 1.28, 1), (-2.0, 6.5, 0.73, 0)],
)
def test_known_kernel_returns_to_grid_point(rng, alpha, sigma_um, stretch, axis):
    height = skin(128, rng)
    target = scipy_target(
        height, alpha, sigma_um, stretch=stretch, axis=1 if axis in ("x", 1) else 0
    )
    alphas = ALPHA_GRID[(np.abs(ALPHA_GRID - alpha) < 0.25)]
    near = {"grid": (alphas, SIGMAS_UM[np.abs(SIGMAS_UM - sigma_um) < 10])}
    fit = fit_kernel(height, target, stretch=stretch, axis=axis, pixel_um=PIXEL_UM, **near)
    assert (fit.alpha, fit.sigma_um) == (alpha, sigma_um)
    assert fit.valid
    assert fit.distance < 0.002 < fit.distance_before
    assert abs(fit.alpha_refined - alpha) <= 0.01
    assert abs(fit.sigma_refined_um - sigma_um) <= 0.5
    wrong = fit_kernel(height, target, stretch=stretch * 1.1, axis=axis, pixel_um=PIXEL_UM, **near)
    assert (wrong.alpha, wrong.sigma_um) != (alpha, sigma_um)
    assert wrong.distance > 0.02


def unlike(height, rng):
    """A strained relief that no convolution makes: furrows deepen more than ridges rise."""
    z = height / height.std()
    deeper = height * rng.uniform(0.8, 1.3) - rng.uniform(0.0, 2.0) * z**2 * (z < 0)
    blurred = gaussian_filter1d(deeper, rng.uniform(0.2, 2.0), axis=int(rng.integers(2)))
    return blurred + rng.uniform(0.05, 0.3) * rng.standard_normal(height.shape)


def compared(rng, side, first_sample, grid=(ALPHA_GRID, SIGMAS_UM)):
    """Return the results of both searches for one random case."""
    height = skin(side, rng, slope=rng.uniform(0.1, 0.4))
    stretch, axis = rng.uniform(0.73, 1.28), ("x", "y")[int(rng.integers(2))]
    pixel = (PIXEL_UM, PIXEL_UM * stretch) if axis == "x" else (PIXEL_UM * stretch, PIXEL_UM)
    if rng.random() < 0.5:
        target = nh.histogram(unlike(height, rng), pixel=pixel)
    else:
        target = scipy_target(
            height, rng.uniform(-2, 1), rng.uniform(3, 80), stretch=stretch, axis=int(axis == "x")
        )
    relief = prepare_relief(height, stretch=stretch, axis=axis, pixel_um=PIXEL_UM)
    flat = (target.T if axis == "y" else target).reshape(-1)
    buckets = ks.TargetBuckets(np.append(flat, 0.0), 64, 1.0)
    kernels_tried = ks.KernelGrid(relief, buckets, *grid)
    full = ks.search_exhaustively(kernels_tried)
    part = ks.search_hierarchically(kernels_tried, first_sample=first_sample, rng=rng)
    return full, part


@pytest.mark.long
def test_hierarchical_search_matches_exhaustive_search(rng):
    for _ in range(4):
        full, part = compared(rng, 144, 2048, **COARSE)
        assert part.best == full.best
        np.testing.assert_array_equal(part.distance[part.exact], full.distance[part.exact])
        assert not part.exact.all()  # it did drop kernels
        near = full.distance <= full.distance.min() + 0.01
        np.testing.assert_allclose(part.distance[near], full.distance[near], atol=0.02)


@pytest.mark.long
@pytest.mark.timeout(600)
def test_five_random_cases_agree_with_the_exhaustive_search():
    """Each on every fourth alpha and sigma of the full grid, from a random first one.

    The bounds do not see the grid's spacing but its size, and five searches may miss with a
    chance of 5e-6 in all; the full grid itself is searched once.
    """
    rng = np.random.default_rng(7)
    for case in range(6):
        i, j, step = (*rng.integers(4, size=2), 4) if case else (0, 0, 1)
        grid = ALPHA_GRID[i::step], SIGMAS_UM[j::step]
        full, part = compared(rng, 200, 4096, grid)
        assert part.best == full.best
        assert not part.exact.all()


def test_kernel_lower_bounds_never_exceed_true_distances(rng):
    """The proof's inequality itself: over a whole grid, lower bounds lie below the distances."""
    height = skin(160, rng)
    target = nh.histogram(unlike(height, rng), pixel=PIXEL_UM)
    relief = prepare_relief(height, stretch=1.0, axis="x", pixel_um=PIXEL_UM)
    buckets = ks.TargetBuckets(np.append(target.reshape(-1), 0.0), 64, 1.0)
    grid = ks.KernelGrid(relief, buckets, *COARSE_GRID)
    full = ks.search_exhaustively(grid)
    race = ks._Race(grid)
    race.run([2048, 8192], rng)
    assert (race.low <= full.distance + 1e-12).all()
    assert race.low.max() > 0.05  # and they say something


def test_results_are_independent_of_thread_count(rng, monkeypatch):
    height = skin(100, rng)
    target = nh.histogram(unlike(height, rng), pixel=PIXEL_UM)
    found = []
    for parts in (1, 2, 7):
        monkeypatch.setattr(kernels, "thread_count", lambda parts=parts: parts)
        fit = fit_kernel(
            height,
            target,
            stretch=0.9,
            axis="x",
            pixel_um=PIXEL_UM,
            search=KernelSearch(first_sample=1024),
            **COARSE,
        )
        found.append((fit.alpha, fit.sigma_um, fit.distance, fit.alpha_stderr, fit.passes))
    assert found[0] == found[1] == found[2]


def test_samples_are_changed_as_whole_maps_are(rng):
    height = skin(90, rng)
    valid = np.ones(height.shape, bool)
    valid[30:40, 20:50] = False
    relief = prepare_relief(height, stretch=1.1, axis="y", pixel_um=PIXEL_UM, valid=valid)
    chosen = rng.permutation(relief.places.size)[:1500]
    for sigma in (1.0, 7.0, 99.0):
        whole = relief.slope_change(sigma)
        part = ks._SampledChange(relief, chosen, 100.0).at(sigma)
        for a, b in zip(whole, part, strict=True):
            np.testing.assert_allclose(b, a[chosen], atol=2e-6)


def test_border_is_mirrored_and_holes_filled_along_axis(rng):
    height = skin(40, rng)
    for axis, number in (("x", 1), ("y", 0)):
        ours = convolve_relief(height, 0.7, 90.0, axis=axis, pixel_um=PIXEL_UM)
        theirs = 0.3 * height + 0.7 * gaussian_filter1d(height, 15.0, axis=number)
        np.testing.assert_allclose(ours, theirs, atol=1e-4)
    ramp = np.tile(np.arange(30.0), (8, 1))
    valid = np.ones(ramp.shape, bool)
    valid[:, 12:15] = False
    spoiled = np.where(valid, ramp, 99.0)
    ours = convolve_relief(spoiled, 1.0, 6.0, axis="x", pixel_um=PIXEL_UM, valid=valid)
    np.testing.assert_allclose(
        ours[:, 8:20][valid[:, 8:20]], ramp[:, 8:20][valid[:, 8:20]], atol=1e-4
    )
    assert (ours[~valid] == 99.0).all()


def test_a_mask_hides_damage_from_the_fit(rng):
    height = skin(128, rng)
    target = scipy_target(height, -0.6, 14.0, stretch=0.9, axis=1)
    spoiled = height.copy()
    spoiled[40:60, 30:70] += 200.0 * rng.standard_normal((20, 40))
    valid = np.ones(height.shape, bool)
    valid[40:60, 30:70] = False
    given = {"stretch": 0.9, "axis": "x", "pixel_um": PIXEL_UM, **COARSE}
    seen = fit_kernel(spoiled, target, **given)
    hidden = fit_kernel(spoiled, target, valid=valid, **given)
    nan = fit_kernel(np.where(valid, height, np.nan), target, **given)
    assert (hidden.alpha, hidden.sigma_um) == (nan.alpha, nan.sigma_um) == (-0.6, 14.0)
    assert hidden.distance < seen.distance - 0.05


def test_a_flat_patch_has_no_kernel():
    fit = fit_kernel(
        np.zeros((40, 40)),
        nh.histogram(np.zeros((40, 40)), pixel=1.0),
        stretch=0.9,
        axis="x",
        pixel_um=PIXEL_UM,
        **COARSE,
    )
    assert not fit.valid
    assert "flat" in fit.reason
    assert fit.alpha == 0.0
    assert fit.distance == 0.0
    assert np.isinf([fit.alpha_stderr, fit.sigma_stderr_um]).all()
    assert len(fit.near_best) == COARSE_GRID[0].size * COARSE_GRID[1].size


def test_single_occupied_bucket_gives_invalid_fit(rng):
    height = 1e-3 * skin(60, rng)
    target = nh.histogram(height, pixel=PIXEL_UM, bins=63)  # odd: 0 is within a bucket
    assert np.count_nonzero(target) == 1
    fit = fit_kernel(height, target, stretch=1.0, axis="y", pixel_um=PIXEL_UM, bins=63, **COARSE)
    assert not fit.valid
    assert fit.reason
    assert np.isinf(fit.alpha_stderr)


@pytest.mark.parametrize("stretch", [0.5, 2.0])
def test_extreme_strains_are_fitted_as_any_other(rng, stretch):
    height = skin(128, rng)
    target = scipy_target(height, -0.5, 20.0, stretch=stretch, axis=1)
    fit = fit_kernel(height, target, stretch=stretch, axis="x", pixel_um=PIXEL_UM, **COARSE)
    assert (fit.alpha, fit.sigma_um) == (-0.5, 20.0)


def test_subpixel_sigma_tie_takes_gentlest_kernel(rng):
    height = skin(100, rng)
    target = convolved_histogram(height, 0.0, 1.0, stretch=1.0, axis="x")
    assert gaussian_weights(0.4 / PIXEL_UM).size == 1
    fit = fit_kernel(
        height,
        target,
        stretch=1.0,
        axis="x",
        pixel_um=PIXEL_UM,
        grid=([-2.0, -0.5, 0.3, 1.0], [0.2, 0.4, 30.0]),
    )
    assert (fit.alpha, fit.sigma_um, fit.distance) == (0.3, 0.2, 0.0)
    ties = fit.near_best[fit.near_best[:, 2] == 0.0]
    assert len(ties) == 8
    assert fit.valid  # the wide kernels are worse


def test_neutral_skin_has_neutral_kernel_and_wide_valley(rng):
    height = skin(100, rng)
    target = nh.histogram(height, pixel=PIXEL_UM)
    fit = fit_kernel(height, target, stretch=1.0, axis="x", pixel_um=PIXEL_UM, **COARSE)
    assert fit.alpha == 0.0
    assert fit.distance == fit.distance_before
    assert fit.sigma_interval_um == (2.0, 80.0)  # alpha = 0: sigma is not told


def test_tiny_maps_are_fitted_but_called_aliased(rng):
    fit = fit_kernel(
        skin(16, rng)[:3, :3],
        nh.histogram(skin(64, rng), pixel=PIXEL_UM),
        stretch=0.9,
        axis="y",
        pixel_um=PIXEL_UM,
        **COARSE,
    )
    assert fit.samples == 9
    assert fit.aliased
    assert not fit.valid
    with pytest.raises(KernelFitError, match="slope"):
        fit_kernel(
            np.zeros((1, 5)), np.full((64, 64), 1 / 4096), stretch=1.0, axis="x", pixel_um=PIXEL_UM
        )


def test_a_finer_minimum_than_the_grid_is_refined(rng):
    height = skin(128, rng)
    target = scipy_target(height, -0.843, 18.2, stretch=0.9, axis=1)
    near = {"grid": (ALPHA_GRID[100:140], SIGMAS_UM[28:42])}
    fit = fit_kernel(height, target, stretch=0.9, axis="x", pixel_um=PIXEL_UM, **near)
    assert fit.distance_refined < fit.distance
    assert abs(fit.alpha_refined + 0.843) <= 0.006
    assert abs(fit.sigma_refined_um - 18.2) <= 0.15


@pytest.mark.long
def test_standard_errors_predict_deviation_of_other_patch(rng):
    """Target of one patch, kernel of another of the same statistics.

    Rationale: 10 errors over their standard errors; their mean square is about 1, and lies in
    0.2...2.6 in 99.7 % when the standard errors are right; the factor of 2 beyond it is for
    their own scatter.
    """
    grid = {"grid": (np.round(np.arange(-1.6, 0.01, 0.05), 2), np.arange(8.0, 41, 2))}
    pulls = []
    for _ in range(10):
        other = convolve_relief(skin(128, rng), -0.8, 20.0, axis="x", pixel_um=PIXEL_UM)
        fit = fit_kernel(
            skin(128, rng),
            nh.histogram(other, pixel=PIXEL_UM),
            stretch=1.0,
            axis="x",
            pixel_um=PIXEL_UM,
            **grid,
        )
        pulls.append((fit.alpha + 0.8) / fit.alpha_stderr)
    assert 0.1 < np.mean(np.square(pulls)) < 5.2


def test_settings_that_do_not_fit_are_refused(rng):
    height, target = np.zeros((8, 8)), np.full((64, 64), 1 / 4096)
    good = {"stretch": 1.0, "axis": "x", "pixel_um": PIXEL_UM}
    for change, word in (
        ({"stretch": 0.0}, "stretch"),
        ({"stretch": np.nan}, "stretch"),
        ({"axis": "z"}, "axis"),
        ({"search": KernelSearch("fast")}, "search"),
        ({"bins": 32}, "target_histogram"),
        ({"grid": ([0.5, 0.2], [2.0])}, "alphas"),
        ({"grid": ([0.5], [0.0, 2.0])}, "sigmas_um"),
    ):
        with pytest.raises(KernelFitError, match=word):
            fit_kernel(height, target, **{**good, **change})
    with pytest.raises(KernelFitError, match="target_histogram"):
        fit_kernel(height, target * np.nan, **good)
    for wrong, change, word in (
        (np.zeros((2, 8, 8)), {}, "height: got .*one by one"),
        ([[0.0, 1.0], [0.0]], {}, "height: got no array"),
        (height, {"valid": np.ones((8, 7), bool)}, "valid: got"),
        (height, {"pixel_um": 0.0}, "pixel: got"),
    ):
        with pytest.raises(KernelFitError, match=f"neutral relief: {word}"):
            fit_kernel(wrong, target, **{**good, **change})


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (3, 0), (3, 2)])
def test_empty_or_misshapen_grid_is_reported(shape):
    alphas, sigmas_um = np.linspace(0.0, 1.0, min(shape[1], 3)), np.arange(1.0, 1.0 + shape[0])
    distance = np.zeros(shape if shape != (3, 2) else (2, 3))
    with pytest.raises(ks.KernelFitError, match=r"distance: got shape"):
        ks.find_best(distance, alphas, sigmas_um)
