import numpy as np
import pytest
from scipy import stats

from model.translucency_population import weyrich_2005
from reconstruction.subsurface.probe_sites import SITE_UV, read_landmarks
from reconstruction.subsurface.translucency import (
    CORRELATION_LENGTH_MM,
    MAX_RELATIVE_ERROR,
    TEXTURE_MM,
    TranslucencyError,
    TranslucencyPrior,
    interpolate,
    population_prior,
)

ONE = TranslucencyPrior(np.array([0.2]), np.array([0.15]), np.array([0.25]))
NAMES = ("forehead", "cheek left", "cheek right", "chin")
PLACES = np.array([SITE_UV[name] for name in NAMES])
SIGMA_TR = np.array([[0.54, 0.98, 1.55], [0.5, 0.9, 1.5], [0.6, 1.05, 1.6], [0.69, 1.25, 1.92]])


def centers(shape):
    """Texture coordinates of a map's pixels, (H, W, 2)."""
    v = 1 - (np.arange(shape[0]) + 0.5) / shape[0]
    u = (np.arange(shape[1]) + 0.5) / shape[1]
    return np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=-1)


def pixel(uv, shape):
    return int((1 - uv[1]) * shape[0]), int(uv[0] * shape[1])


def textbook(prior, at_uv, log, error, to_uv):
    """Posterior mean and deviation of a Gaussian process, equations (2.23) and (2.24) of
    Rasmussen and Williams, by a Cholesky factor and pixel by pixel."""
    size = np.array(TEXTURE_MM)

    def kernel(a, b):
        squared = (((a[:, None] - b[None]) * size) ** 2).sum(axis=-1) / prior.length_mm**2
        person, place = prior.person_deviation[0], prior.place_deviation[0]
        return person**2 + place**2 * np.exp(-0.5 * squared)

    lower = np.linalg.cholesky(kernel(at_uv, at_uv) + np.diag(error**2))
    cross = np.linalg.solve(lower, kernel(at_uv, to_uv))
    mean = prior.log_mean[0] + cross.T @ np.linalg.solve(lower, log - prior.log_mean[0])
    total = prior.person_deviation[0] ** 2 + prior.place_deviation[0] ** 2
    return mean, np.sqrt(total - (cross**2).sum(axis=0))


def test_map_is_gaussian_process_posterior(rng):
    at = rng.uniform(0.1, 0.9, (6, 2))
    sigma = np.exp(-0.2 + 0.2 * rng.standard_normal(6))
    stderr = sigma * rng.uniform(0.01, 0.2, 6)
    found = interpolate(at, sigma[:, None], stderr[:, None], (40, 30), prior=ONE)
    mean, deviation = textbook(
        ONE, at, -np.log(sigma), stderr / sigma, centers((40, 30)).reshape(-1, 2)
    )
    np.testing.assert_allclose(found.values[..., 0].ravel(), np.exp(mean), rtol=1e-5)
    np.testing.assert_allclose(found.log_stderr[..., 0].ravel(), deviation, rtol=1e-4)
    half = 0.5 * np.exp(mean) * (np.exp(deviation) - np.exp(-deviation))
    np.testing.assert_allclose(found.stderr[..., 0].ravel(), half, rtol=1e-4)


def drawn_map(rng, error, stated=1.0):
    """A face drawn from the prior, mapped from four places; z of each pixel."""
    places = PLACES
    shape = (64, 64)
    at = tuple(np.concatenate([[pixel(uv, shape) for uv in places], rng.integers(0, 64, (6, 2))]).T)
    to = np.concatenate([places, centers(shape)[at]])
    size = np.array(TEXTURE_MM)
    squared = (((to[:, None] - to[None]) * size) ** 2).sum(axis=-1) / CORRELATION_LENGTH_MM**2
    covariance = 0.15**2 + 0.25**2 * np.exp(-0.5 * squared) + 1e-12 * np.eye(len(to))
    log = 0.2 + np.linalg.cholesky(covariance) @ rng.standard_normal(len(to))
    measured = np.exp(-log[:4] + error * rng.standard_normal(4))[:, None]
    found = interpolate(places, measured, stated * error * measured, shape, prior=ONE)
    return (np.log(found.values[at][:, 0]) - log[4:]) / found.log_stderr[at][:, 0]


def test_interval_coverage_matches_nominal(rng):
    z = np.array([drawn_map(rng, 0.05) for _ in range(400)])
    inside = (np.abs(z) < 1).mean(axis=1)  # pixels of a face belong together, faces do not
    expected = 2 * stats.norm.cdf(1) - 1
    assert abs(inside.mean() - expected) < 4.9 * inside.std() / np.sqrt(400)  # once in a million
    # errors stated three times too small fail
    wrong = np.array([drawn_map(rng, 0.15, 1 / 3)[:4] for _ in range(400)])
    low = (np.abs(wrong) < 1).mean(axis=1)
    assert abs(low.mean() - expected) > 4.9 * low.std() / np.sqrt(400)


def test_map_interpolates_measured_positions_uncertain_away():
    places = PLACES
    found = interpolate(places, SIGMA_TR, 0.001 * SIGMA_TR, (256, 256))
    prior = population_prior()
    total = np.hypot(prior.person_deviation, prior.place_deviation)
    for uv, sigma in zip(places, SIGMA_TR, strict=True):
        at = pixel(uv, (256, 256))
        np.testing.assert_allclose(found.values[at], 1 / sigma, rtol=0.01)
        assert (found.log_stderr[at] < 0.02).all()
    corner = found.log_stderr[0, 0]
    assert (corner > 5 * found.log_stderr[pixel(places[0], (256, 256))]).all()
    assert (found.log_stderr <= total * (1 + 1e-6)).all()
    # from a cheek outward and up, away from all places, uncertainty never falls
    row, column = pixel(places[1], (256, 256))
    outward = found.log_stderr[row, column::-1, 0]
    assert (np.diff(outward) > -1e-6).all()


def test_map_rows_run_down_from_forehead_columns_right():
    sigma = np.array([[0.4], [0.6], [0.9], [0.5]])
    found = interpolate(PLACES, sigma, 0.01 * sigma, (64, 64), prior=ONE)
    assert found.values[pixel(SITE_UV["forehead"], (64, 64))][0] > 2.2
    assert found.values[int(0.18 * 64), 32, 0] > found.values[int(0.8 * 64), 32, 0]
    left, right = found.values[int(0.472 * 64), [16, 47], 0]
    assert left > right


def test_single_position_gives_value_there_population_far_away():
    uv, sigma = np.array([[0.2, 0.3]]), np.array([[0.5]])
    prior = TranslucencyPrior(np.array([0.2]), np.array([0.15]), np.array([0.25]), length_mm=10.0)
    found = interpolate(uv, sigma, 0.1 * sigma, (301, 301), prior=prior)
    total, noise = 0.15**2 + 0.25**2, 0.1**2
    off = np.log(1 / 0.5) - 0.2
    at, far = pixel(uv[0], (301, 301)), (0, 300)
    assert np.log(found.values[at][0]) == pytest.approx(
        0.2 + total / (total + noise) * off, abs=1e-3
    )
    assert np.log(found.values[far][0]) == pytest.approx(
        0.2 + 0.15**2 / (total + noise) * off, abs=1e-5
    )
    expected = np.sqrt(total - 0.15**4 / (total + noise))
    assert found.log_stderr[far][0] == pytest.approx(expected, rel=1e-5)


def test_worse_measured_position_has_less_weight():
    uv = np.array([[0.3, 0.5], [0.7, 0.5]])
    sigma = np.array([[0.5], [1.0]])
    even = interpolate(uv, sigma, 0.05 * sigma, (3, 3), prior=ONE)
    uneven = interpolate(uv, sigma, np.array([[0.025], [0.4]]), (3, 3), prior=ONE)
    assert uneven.values[1, 1, 0] > even.values[1, 1, 0] * 1.05


def test_position_repeats_count_as_better_single_measurement():
    uv = np.array([[0.5, 0.5], [0.2, 0.8]])
    sigma, error = np.array([[0.5], [0.8]]), np.array([[0.04], [0.04]])
    single = interpolate(uv, sigma, error / [[2.0], [1.0]], (32, 32), prior=ONE)
    four = np.array([0, 0, 0, 0, 1])
    repeated = interpolate(uv[four], sigma[four], error[four], (32, 32), prior=ONE)
    np.testing.assert_allclose(repeated.values, single.values, rtol=1e-5)
    np.testing.assert_allclose(repeated.stderr, single.stderr, rtol=1e-4)
    assert repeated.conflicts == ()


def test_contradicting_repeats_are_reported_and_widen_error():
    uv = np.full((2, 2), 0.5)
    near = interpolate(uv, np.array([[0.50], [0.505]]), np.full((2, 1), 0.01), (9, 9), prior=ONE)
    far = interpolate(uv, np.array([[0.40], [0.60]]), np.full((2, 1), 0.01), (9, 9), prior=ONE)
    assert near.conflicts == ()
    assert far.conflicts[0][0] == "0, channel 0"
    assert "2 repeats differ by" in far.conflicts[0][1]
    assert far.log_stderr[4, 4, 0] > 5 * near.log_stderr[4, 4, 0]
    assert far.log_stderr[4, 4, 0] == pytest.approx(
        np.sqrt(1 / (1 / 0.085 + 1 / np.log(1.5) ** 2 * 4)), rel=0.1
    )


def test_exact_and_coincident_positions_keep_map_finite():
    uv = np.array([[0.5, 0.5], [0.5, 0.5], [0.5, 0.5 + 2.1 / 330], [0.1, 0.1]])
    sigma = np.full((4, 1), 0.7)
    found = interpolate(uv, sigma, np.zeros((4, 1)), (128, 128), prior=ONE)
    assert np.isfinite(found.values).all()
    assert (found.values > 0).all()
    assert (found.stderr > 0).all()
    assert found.values[64, 64, 0] == pytest.approx(1 / 0.7, rel=1e-3)


def test_hundred_crowded_positions_keep_map_finite(rng):
    uv = rng.uniform(0.45, 0.55, (100, 2))
    sigma = np.full((100, 1), 0.7) * np.exp(0.02 * rng.standard_normal((100, 1)))
    found = interpolate(uv, sigma, 0.02 * sigma, (64, 64), prior=ONE)
    assert found.values[32, 32, 0] == pytest.approx(1 / 0.7, rel=0.02)
    assert (found.log_stderr[..., 0] > 0).all()
    assert found.log_stderr.max() <= np.hypot(0.15, 0.25) * (1 + 1e-6)


def test_uncounted_positions_are_omitted_with_reasons():
    sigma, stderr = SIGMA_TR.copy(), 0.03 * SIGMA_TR
    sigma[0, 0] = np.nan
    sigma[1, 1], stderr[1, 1] = 1e-9, 1.0
    stderr[2, 2] = np.inf
    good = np.ones((4, 3), bool)
    good[3, 0] = False
    found = interpolate(PLACES, sigma, stderr, (16, 16), valid=good, names=NAMES)
    assert found.used.sum() == 8
    reasons = dict(found.omitted)
    assert reasons["forehead, channel 0"] == "sigma_tr or its standard error is not finite"
    assert reasons["cheek left, channel 1"] == "sigma_tr 1e-09 ± 1 per mm does not differ from 0"
    assert "not finite" in reasons["cheek right, channel 2"]
    assert reasons["chin, channel 0"] == "not valid"
    assert found.valid.all()
    # the same as if they had never been there
    kept = interpolate(PLACES[[0, 2, 3]], SIGMA_TR[[0, 2, 3]], 0.03 * SIGMA_TR[[0, 2, 3]], (16, 16))
    np.testing.assert_allclose(found.values[..., 1], kept.values[..., 1], rtol=1e-6)


def test_channel_without_position_is_masked_all_without_error():
    places = PLACES
    good = np.ones((4, 3), bool)
    good[:, 2] = False
    found = interpolate(places, SIGMA_TR, 0.03 * SIGMA_TR, (8, 8), valid=good)
    assert found.valid[0, 0].tolist() == [True, True, False]
    assert (found.values[..., 2] == 0).all()
    assert found.p_value[2] == 1
    with pytest.raises(TranslucencyError, match=r"no usable.*forehead, channel 0: not valid"):
        interpolate(places, SIGMA_TR, SIGMA_TR, (8, 8), valid=np.zeros(4, bool), names=NAMES)
    with pytest.raises(TranslucencyError, match="does not differ from 0"):
        interpolate(places, SIGMA_TR, SIGMA_TR * MAX_RELATIVE_ERROR * 1.01, (8, 8))


def test_map_is_invalid_outside_skin():
    skin = np.zeros((8, 8), bool)
    skin[2:5] = True
    found = interpolate(PLACES, SIGMA_TR, 0.03 * SIGMA_TR, (8, 8), mask=skin)
    assert (found.valid == skin[..., None]).all()
    assert (found.values[~skin] == 0).all()
    assert (found.stderr[skin] > 0).all()


def test_face_unlike_population_is_reported(rng):
    prior = population_prior()
    places = PLACES
    usual = interpolate(places, SIGMA_TR, 0.03 * SIGMA_TR, (4, 4))
    other = interpolate(places, 4 * SIGMA_TR, 0.12 * SIGMA_TR, (4, 4), prior=prior)
    assert (usual.p_value > 0.01).all()
    assert (other.p_value < 1e-4).all()


def test_the_prior_has_the_variance_of_the_population(rng):
    prior, population = population_prior(), weyrich_2005()
    logs = -np.log(population.sample(20_000, rng=rng))
    np.testing.assert_allclose(logs.mean(axis=(0, 1)), prior.log_mean, atol=0.01)
    total = prior.person_deviation**2 + prior.place_deviation**2
    one_face = logs.var(axis=1, ddof=1).mean(axis=0)
    np.testing.assert_allclose(one_face, prior.place_deviation**2, rtol=0.03)
    # over people and places, of places as drawn from more than these three
    between = logs.mean(axis=0).var(axis=0, ddof=1)
    np.testing.assert_allclose(logs.var(axis=0).mean(axis=0) + between, total, rtol=0.03)


def test_mismatched_shapes_and_ranges_are_refused():
    uv, sigma = np.array([[0.5, 0.5]]), np.array([[0.5]])

    def call(*, uv=uv, sigma=sigma, stderr=0.1 * sigma, shape=(4, 4), **more):
        return interpolate(uv, sigma, stderr, shape, prior=ONE, **more)

    for match, wrong in (
        ("sites_uv: got shape", {"uv": np.zeros((0, 2))}),
        ("sites_uv: got .* numbers in", {"uv": np.array([[0.5, 1.5]])}),
        ("sites_uv: got .* numbers in", {"uv": np.array([[0.5, np.nan]])}),
        ("sigma_tr_per_mm: got shape", {"sigma": np.ones((1, 3))}),
        ("stderr_per_mm: got shape", {"stderr": np.ones(1)}),
        ("stderr_per_mm: got -1.0", {"stderr": -np.ones((1, 1))}),
        ("shape: got", {"shape": (0, 4)}),
        ("mask: got shape", {"mask": np.ones((2, 2), bool)}),
        ("texture_mm", {"texture_mm": (0.0, 1.0)}),
        ("names: got 2", {"names": ("a", "b")}),
    ):
        with pytest.raises(TranslucencyError, match=match):
            call(**wrong)
    with pytest.raises(TranslucencyError, match="place_deviation"):
        TranslucencyPrior(np.zeros(1), np.ones(1), np.zeros(1))
    with pytest.raises(TranslucencyError, match="length_mm"):
        TranslucencyPrior(np.zeros(1), np.ones(1), np.ones(1), length_mm=0.0)


def test_default_positions_are_on_simulated_heads():
    from rigsim.subject.head import LANDMARKS_MM, build_head

    head = build_head(np.random.default_rng(3))
    vertices = np.asarray(head.vertices_mm, np.float64)
    for name in ("forehead", "cheek left", "cheek right", "chin"):
        there = vertices[np.argmin(((head.uv - SITE_UV[name]) ** 2).sum(axis=1))]
        if name != "chin":
            assert np.linalg.norm(there - LANDMARKS_MM[name]) < 9.0
    # below the chin, where the skin faces down
    assert -25.0 < there[1] - LANDMARKS_MM["chin"][1] < -5.0
    faces = head.normals[np.argmin(((head.uv - SITE_UV["chin"]) ** 2).sum(axis=1))]
    assert faces[1] < -0.5


def test_landmarks_name_pixels_of_a_texture(tmp_path):
    path = tmp_path / "landmarks.csv"
    path.write_text("# made by hand\nname, x, y\nforehead,31.5,9.5\nscar,0,99\n")
    found = read_landmarks(path, texture_px=(100, 64))
    assert found == {"forehead": (0.5, 0.9), "scar": (0.5 / 64, pytest.approx(0.005))}
    for text, match in (
        ("label,x,y\na,1,1\n", "expected name, x, y"),
        ("name,x,y\na,1,one\n", "line 2, column y: got 'one'"),
        ("name,x,y\na,1\n", "line 2: got 2 cells"),
        ("name,x,y\na,1,nan\n", "expected a finite number"),
        ("name,x,y\na,1,100\n", "expected within"),
        ("name,x,y\na,1,1\na,2,2\n", "twice"),
    ):
        path.write_text(text)
        with pytest.raises(TranslucencyError, match=match):
            read_landmarks(path, texture_px=(100, 64))
