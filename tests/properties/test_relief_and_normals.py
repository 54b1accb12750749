"""Normals, heights and their histograms over their declared domains."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from twins.textures import points_from_texels

from model import microstructure
from model.microstructure import mesh_strain, profile_length
from reconstruction import kernel_fit, normal_histogram, photometric_stereo
from reconstruction.correspondence import landmark_field
from reconstruction.gradient_normals import patterns as gradient_patterns
from reconstruction.gradient_normals import wiener as gradient_wiener
from reconstruction.kernel_fit import neutral_relief
from reconstruction.kernel_fit import table as kernel_table
from reconstruction.normal_histogram import blocks as normal_blocks
from reconstruction.normal_histogram import relief_slopes
from reconstruction.normal_histogram import statistics as normal_statistics
from reconstruction.normal_integration import (
    height_filters,
    relief_errors,
    slope_fields,
    weighted_poisson,
)
from reconstruction.normal_integration import integration as normal_integration
from reconstruction.photometric_stereo import half_vectors as half_vector_normals
from reconstruction.photometric_stereo import light_selection
from reconstruction.registration import head_motion
from reconstruction.scan import repair as mesh_repair
from reconstruction.surface import tangent_space, texture_fill

CHEAP = settings(derandomize=True, deadline=None, max_examples=30, database=None)
FEW = settings(CHEAP, max_examples=8)

SEED = st.integers(0, 9999)
SCALE = st.sampled_from([1e-30, 1e-3, 1.0, 1e3, 1e30])
SIDES = st.tuples(st.integers(1, 12), st.integers(1, 12))
ERRORS = (ValueError,)


def masked(rng, shape, share=0.8):
    return rng.uniform(size=shape) < share


def unit_normals(rng, shape):
    n = np.concatenate([0.3 * rng.standard_normal((*shape, 2)), np.ones((*shape, 1))], axis=-1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


@CHEAP
@given(seed=SEED, sides=SIDES, scale=SCALE)
def test_slopes_are_invariant_to_unit_and_constant(seed, sides, scale):
    rng = np.random.default_rng(seed)
    height, valid = rng.standard_normal(sides), masked(rng, sides)
    kept = height.copy()
    first = relief_slopes.slopes(height, pixel=2.0, valid=valid)
    np.testing.assert_array_equal(height, kept)
    scaled = relief_slopes.slopes(scale * (height + 1.0), pixel=2.0 * scale, valid=valid)
    for a, b in zip(first, scaled, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)
    known = relief_slopes.slope_stencil(height, valid) > 0
    np.testing.assert_array_equal(first[2], known)
    assert not known[~valid].any()
    down = relief_slopes.slopes(
        height, pixel=relief_slopes.pixel_sides(2.0), valid=valid, y_up=False
    )
    np.testing.assert_allclose(down[1], -first[1], atol=1e-12)


@CHEAP
@given(
    slope=st.lists(st.tuples(*[st.floats(-1e150, 1e150)] * 2), min_size=1, max_size=20),
    bins=st.integers(1, 40),
    limit=st.floats(0.01, 1.0),
    turn=st.floats(-4.0, 4.0),
)
def test_every_normal_is_in_a_bucket_or_outside(slope, bins, limit, turn):
    x, y = np.array(slope).T
    normal_histogram.check_buckets(bins, limit)
    counts, outside = normal_histogram.count_normals(x, y, bins=bins, limit=limit)
    assert counts.sum() + outside == x.size
    a, b = relief_slopes.rotate_components(x, y, turn)
    np.testing.assert_allclose(np.hypot(a, b), np.hypot(x, y), rtol=1e-9)
    if counts.sum():
        shares = normal_histogram.from_slopes(x, y, bins=bins, limit=limit)
        np.testing.assert_array_equal(shares, normal_histogram.normalize_counts(counts))
        assert shares.sum() == pytest.approx(1.0)
        assert normal_histogram.distance(shares, shares) == 0.0
        floor = normal_histogram.noise_floor(shares, 50.0)
        assert 0.0 <= floor <= 2.0
        assert normal_histogram.noise_floor(shares, 500.0) <= floor + 1e-12
        number = normal_blocks.effective_sample_count(np.stack([counts.ravel()] * 3), 3 * x.size)
        assert 0.0 < number <= 3 * x.size


@FEW
@given(bad=st.sampled_from([np.nan, np.inf, -np.inf]))
def test_histograms_and_kernels_of_nonfinite_input_raise_error(bad):
    shares = np.full((4, 4), 1.0 / 16.0)
    wrong = shares.copy()
    wrong[1, 2] = bad
    for pair in ((shares, wrong), (wrong, shares)):
        with pytest.raises(normal_histogram.HistogramError, match="differences"):
            normal_histogram.distance(*pair)
    with pytest.raises(normal_histogram.HistogramError, match="histogram"):
        normal_histogram.noise_floor(wrong, 100.0)
    with pytest.raises(normal_histogram.HistogramError, match="samples"):
        normal_histogram.noise_floor(shares, np.nan)
    assert normal_histogram.noise_floor(shares, np.inf) == 0.0
    for pair in ((np.array([bad]), np.ones(1)), (np.ones(1), np.array([bad]))):
        for angle in (0.0, 0.3):
            with pytest.raises(relief_slopes.HistogramError, match=r"[ab]: got"):
                relief_slopes.rotate_components(*pair, angle)
    with pytest.raises(relief_slopes.HistogramError, match="angle_rad"):
        relief_slopes.rotate_components(np.ones(1), np.ones(1), bad)
    height = np.random.default_rng(0).standard_normal((12, 12))
    fit = partial(kernel_fit.fit_kernel, height, shares, stretch=1.0, axis="x", pixel_um=10.0)
    for name, wrong in (
        ("alphas", {"grid": ([-1.0, bad], [1.0])}),
        ("sigmas_um", {"grid": ([-1.0], [bad])}),
        ("target_samples", {"target_samples": np.nan}),
    ):
        with pytest.raises(neutral_relief.KernelFitError, match=name):
            fit(bins=4, **wrong)
    with pytest.raises(profile_length.SurfaceProfileError, match="height_um"):
        profile_length.convolve_profile([0.0, bad, 1.0], 0.5, 10.0, spacing_um=5.0)
    with pytest.raises(profile_length.SurfaceProfileError, match="alpha"):
        profile_length.convolve_profile([0.0, 1.0, 0.5], bad, 10.0, spacing_um=5.0)
    with pytest.raises(profile_length.SurfaceProfileError, match="spacing_um"):
        profile_length.convolve_profile([0.0, 1.0, 0.5], 0.5, 10.0, spacing_um=bad)


@CHEAP
@given(seed=SEED, bins=st.integers(2, 30), angle=st.floats(-3.2, 3.2))
def test_histograms_of_topography_and_its_normals_agree(seed, bins, angle):
    rng = np.random.default_rng(seed)
    height = 0.3 * rng.standard_normal((14, 11))
    x, y, known = relief_slopes.slopes(height, pixel=1.0)
    normals = np.stack([-x, -y, np.ones_like(x)], axis=-1)
    lengths = rng.uniform(0.1, 10.0, known.shape)[..., None]
    for ours, theirs in zip(
        relief_slopes.slopes_from_normals(lengths * normals), (x, y), strict=False
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)
    told = {"bins": bins, "angle_rad": angle}
    of_height = normal_histogram.histogram(height, pixel=1.0, **told)
    of_normals = normal_histogram.from_normals(normals, valid=known, **told)
    # at the edge of a bucket rounding decides
    assert normal_histogram.halved_distance(of_height, of_normals) <= 4.0 / known.sum()
    measured = normal_statistics.measure_normals(height, pixel=1.0, **told)
    assert measured.histogram.sum() == pytest.approx(1.0)


@CHEAP
@given(rows=st.integers(1, 40), columns=st.integers(1, 40), blocks=st.integers(1, 9))
def test_every_pixel_belongs_to_a_single_block(rows, columns, blocks):
    number, count = normal_blocks.assign_blocks(np.arange(rows * columns), (rows, columns), blocks)
    assert set(number.tolist()) == set(range(count))
    down, right = normal_blocks.block_grid_shape((rows, columns), blocks)
    assert down * right == count


@CHEAP
@given(seed=SEED, bins=st.integers(1, 20), angle=st.floats(-3.2, 3.2), sides=SIDES)
def test_counts_of_blocks_are_those_of_the_whole(seed, bins, angle, sides):
    rng = np.random.default_rng(seed)
    height, valid = rng.standard_normal(sides), masked(rng, sides)
    told = {"pixel": 1.5, "bins": bins, "limit": 0.7, "valid": valid, "angle_rad": angle}
    parts = normal_blocks.count_block_normals(height, rng.integers(0, 5, sides), 5, **told)
    assert parts.shape == (5, bins, bins)
    if parts.any():
        whole = normal_histogram.histogram(height, **told)
        np.testing.assert_allclose(parts.sum(axis=0) / parts.sum(), whole, atol=1e-12)
        residuals = normal_blocks.block_residuals(parts.reshape(5, -1).astype(np.float64))
        np.testing.assert_allclose(residuals.sum(axis=0), 0.0, atol=1e-12)
        empty = parts.sum(axis=(1, 2)) == 0
        assert not residuals[empty].any()
    none = normal_blocks.count_block_normals(height, np.full(sides, -1), 5, **told)
    assert not none.any()
    with pytest.raises(normal_histogram.HistogramError, match="block"):
        normal_blocks.count_block_normals(height, np.zeros((1, 1, 1), int), 5, **told)


@CHEAP
@given(seed=SEED, sides=SIDES)
def test_parts_are_connected_and_cover_valid_area(seed, sides):
    valid = masked(np.random.default_rng(seed), sides, 0.6)
    part = normal_integration.label_parts(valid)
    np.testing.assert_array_equal(part > 0, valid)
    right = valid[:, 1:] & valid[:, :-1]
    np.testing.assert_array_equal(part[:, 1:][right], part[:, :-1][right])
    height = normal_integration.to_height(
        np.random.default_rng(seed).standard_normal(sides), part, pixel=2.0, camera=None
    )
    for number in range(1, part.max() + 1):
        assert abs(height[part == number].mean()) < 1e-12
    assert not height[~valid].any()


@pytest.mark.long
@FEW
@given(
    tilt=st.tuples(*[st.floats(-2.0, 2.0)] * 2),
    pixel=st.sampled_from([1e-20, 1.0, 1e20]),
    seed=SEED,
    kind=st.sampled_from([np.float32, np.float64]),
)
def test_plane_is_integrated_exactly_any_mask_and_unit(tilt, pixel, seed, kind):
    valid = masked(np.random.default_rng(seed), (12, 9), 0.9)
    normals = np.broadcast_to(np.array([-tilt[0], -tilt[1], 1.0], kind), (12, 9, 3))
    found = normal_integration.integrate_map(normals, pixel=pixel, valid=valid)
    assert found.height.dtype == kind
    y, x = np.mgrid[0:12, 0:9]
    plane = pixel * (tilt[0] * x - tilt[1] * y)
    for number in range(1, found.part.max() + 1):
        here = found.part == number
        off = found.height[here] - (plane[here] - plane[here].mean())
        assert np.abs(off).max() <= 1e-3 * pixel * (1.0 + np.hypot(*tilt))
    same = normal_integration.integrate(normals, pixel=pixel, valid=valid)
    np.testing.assert_array_equal(same, found.height)


@FEW
@given(bad=st.sampled_from([np.nan, np.inf, -np.inf, 0.0]), seed=SEED)
def test_invalid_normals_are_omitted(bad, seed):
    rng = np.random.default_rng(seed)
    normals = unit_normals(rng, (8, 8))
    normals[3, 4] = bad
    found = normal_integration.integrate_map(normals)
    assert not found.valid[3, 4]
    assert np.isfinite(found.height).all()
    field = slope_fields.from_normals(normals)
    ax, ay, dx, dy = slope_fields.edges(field)
    for part in (ax, ay, dx, dy):
        assert part.shape == (10, 10)
        assert np.isfinite(part).all()
    assert np.all(ax >= 0.0)
    assert np.all(ay >= 0.0)
    hierarchy = weighted_poisson.MultigridHierarchy(ax, ay)
    x = np.zeros(dx.shape)
    told = weighted_poisson.solve_poisson(hierarchy, dx, dy, x)
    assert np.isfinite(x).all()
    assert told.residual < 1e-3
    with pytest.raises(ERRORS):
        normal_integration.integrate(np.full((3, 3, 3), bad))


@FEW
@given(seed=SEED, scale=st.sampled_from([1e-20, 1.0, 1e15]), cutoff=st.floats(3.0, 40.0))
def test_a_high_pass_takes_planes_away_and_scales(seed, scale, cutoff):
    rng = np.random.default_rng(seed)
    valid = masked(rng, (16, 14), 0.9)
    height = rng.standard_normal((16, 14))
    y, x = np.mgrid[0:16, 0:14]
    first = height_filters.high_pass(height, pixel=1.0, cutoff=cutoff, valid=valid)
    tilted = height_filters.high_pass(
        scale * (height + 0.3 * x - 2.0 * y), pixel=1.0, cutoff=cutoff, valid=valid
    )
    np.testing.assert_allclose(tilted / scale, first, atol=1e-6)
    assert not first[~valid].any()


@pytest.mark.long
@FEW
@given(seed=SEED, strength=st.floats(0.0, 4.0))
def test_smoothed_slopes_are_numbers_within_those_given(seed, strength):
    rng = np.random.default_rng(seed)
    field = slope_fields.from_normals(unit_normals(rng, (9, 8)), stderr_rad=0.1)
    found = height_filters.denoise_slopes(field, strength=strength)
    for name in ("gx", "gy"):
        before, after = getattr(field, name), getattr(found, name)
        assert np.isfinite(after).all()
        assert after.min() >= before.min() - 1e-6
        assert after.max() <= before.max() + 1e-6


@FEW
@given(sides=st.tuples(st.integers(4, 40), st.integers(4, 40)), slope=st.floats(1e-6, 0.5))
def test_expected_height_error_grows_with_noise(sides, slope):
    first = relief_errors.expected_height_rms(sides, slope)
    assert first > 0.0
    assert relief_errors.expected_height_rms(sides, 2.0 * slope) == pytest.approx(2.0 * first)
    assert relief_errors.expected_height_rms(sides, slope, pixel=3.0) == pytest.approx(3.0 * first)
    assert relief_errors.expected_height_rms(sides, slope, cutoff=6.0) <= first * (1.0 + 1e-9)


LIGHTS = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [-0.6, 0, 0.8], [0, -0.6, 0.8]])


@CHEAP
@given(seed=SEED, scale=st.sampled_from([1e-20, 1e-3, 1.0, 1e20]), robust=st.booleans())
def test_matte_normals_are_exact_and_exposure_invariant(seed, scale, robust):
    normals = unit_normals(np.random.default_rng(seed), (3, 2))
    shade = np.clip(LIGHTS @ normals.reshape(-1, 3).T, 0.0, None).reshape(5, 3, 2)
    image = scale * 0.4 * shade
    kept = image.copy()
    found = photometric_stereo.estimate_normals(image, LIGHTS, robust=robust)
    np.testing.assert_array_equal(image, kept)
    lit = found.valid & (shade > 0.0).all(axis=0)
    np.testing.assert_allclose(found.normals[lit], normals[lit], atol=1e-6)
    np.testing.assert_allclose(found.albedo[lit], 0.4 * scale, rtol=1e-6)


@CHEAP
@given(
    pixel=st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=5, max_size=5),
    robust=st.booleans(),
)
def test_normals_of_any_samples_are_numbers_or_masked(pixel, robust):
    image = np.array(pixel)[:, None]
    usable = np.isfinite(image) & (np.abs(image) < 1e100)
    found = photometric_stereo.estimate_normals(
        np.where(usable, image, 0.0), LIGHTS, valid=usable, robust=robust
    )
    for name in ("normals", "albedo", "residual", "stderr_rad"):
        assert np.isfinite(getattr(found, name)[found.valid]).all(), name


@FEW
@given(angle=st.floats(0.0, np.pi), flat=st.booleans())
def test_lights_coplanar_with_point_are_refused(angle, flat):
    turn = np.array(
        [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
    )
    lights = LIGHTS[[0, 1, 3]] if flat else LIGHTS
    turned = lights @ turn.T
    if flat:
        with pytest.raises(ERRORS):
            photometric_stereo.require_noncoplanar(turned)
    else:
        photometric_stereo.require_noncoplanar(turned)


@FEW
@given(seed=SEED, noise=st.floats(1e-6, 0.1))
def test_more_lights_never_worsen_normals(seed, noise):
    rng = np.random.default_rng(seed)
    normals = unit_normals(rng, (6,))
    found = light_selection.fisher_information(normals, LIGHTS, np.full((6, 5), noise))
    few, many = (
        light_selection.predict_errors(found, range(n), min_lights=3).tilt_rad for n in (4, 5)
    )
    assert np.all(many <= few + 1e-9)
    chosen = light_selection.select_lights(found, median_rad=10.0, valid_fraction=0.5, min_lights=3)
    assert len(set(chosen.lights)) == len(chosen.lights)
    assert light_selection.rayleigh_mixture_median([0.1, 0.1]) == pytest.approx(
        0.1 * 1.17741, rel=1e-3
    )


@CHEAP
@given(vector=st.tuples(*[st.floats(-10.0, 10.0)] * 3))
def test_rotation_keeps_lengths_and_inverse_reverts_rotation(vector):
    turn = head_motion.rotation_matrix(vector)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    np.testing.assert_allclose(head_motion.rotation_matrix(-np.array(vector)), turn.T, atol=1e-9)


@FEW
@given(seed=SEED, noise=st.floats(1e-6, 10.0))
def test_filtered_image_is_not_noisier_than_input(seed, noise):
    rng = np.random.default_rng(seed)
    image, valid = rng.standard_normal((20, 18)), masked(rng, (20, 18), 0.9)
    found, share = gradient_wiener.filter_image(image, noise, valid)
    assert np.isfinite(found).all()
    assert 0.0 <= share <= 1.0


@CHEAP
@given(names=st.sets(st.sampled_from(["full", "x", "y", "z", "-x", "-y", "-z", "dark"])))
def test_patterns_give_finite_design_or_report_missing(names):
    given_names = dict.fromkeys(sorted(names))
    if gradient_patterns.redundancy(given_names) < 0:
        with pytest.raises(gradient_patterns.MissingPatternsError):
            gradient_patterns.require_patterns(given_names, polarizer="parallel", purpose="normals")
    lit = [name for name in given_names if name != "dark"]
    if lit:
        assert np.isfinite(gradient_patterns.design_matrix(lit, dark=False)).all()


@FEW
@given(seed=SEED, stretch=st.floats(0.2, 5.0), turn=st.floats(-3.0, 3.0))
def test_stretched_mesh_reports_stretch_in_any_orientation(seed, stretch, turn):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:4, 0:4] * 10.0
    rest = np.column_stack([x.ravel(), y.ravel(), np.zeros(16)])
    corner = np.add.outer(4 * np.arange(3), np.arange(3)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 4], corner[:, None] + [1, 5, 4]])
    c, s = np.cos(turn), np.sin(turn)
    spin = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    moved = (rest * [stretch, 1.0, 1.0]) @ spin.T + rng.standard_normal(3)
    found = mesh_strain.strain(rest, moved, faces, rest[:, :2] / 40.0)
    np.testing.assert_allclose(found.r_s, max(stretch, 1.0), rtol=1e-6)
    np.testing.assert_allclose(found.r_t, min(stretch, 1.0), rtol=1e-6)
    place = mesh_strain.index_points(rest, moved)
    assert len(set(place.tolist())) == 16
    assert len(mesh_repair.boundary_edges(faces)) == 12
    again = mesh_repair.weld(mesh_repair.TriangleMesh(rest, faces))
    assert len(again.faces) == len(faces)


@CHEAP
@given(sigma=st.floats(1e-300, 200.0))
def test_weights_of_a_gaussian_add_up_and_fall(sigma):
    weights = microstructure.gaussian_weights(sigma)
    assert weights[0] + 2.0 * weights[1:].sum() == pytest.approx(1.0)
    assert np.all(np.diff(weights) <= 0.0)


@CHEAP
@given(stretch=st.floats(1e-300, 1e300), how=st.sampled_from(["hold", "formula"]))
def test_kernel_at_any_stretch_stays_within_ranges(stretch, how):
    alpha, sigma = microstructure.kernel_parameters(stretch, extrapolate=how)
    assert -2.0 <= alpha <= 1.0
    assert np.isfinite(sigma)
    assert sigma >= 0.0
    assert (alpha > 0.0) <= (stretch > 1.0)


@FEW
@given(bad=st.sampled_from([0.0, -1.0, np.nan, np.inf]))
def test_invalid_stretch_raises_error(bad):
    with pytest.raises(microstructure.KernelTableError):
        microstructure.kernel_parameters(bad)


@CHEAP
@given(
    heights=st.lists(st.floats(-1e3, 1e3), min_size=12, max_size=40),
    spacing=st.floats(0.1, 1e3),
    alpha=st.floats(-2.0, 1.0),
    sigma=st.floats(0.1, 100.0),
    stretch=st.floats(0.5, 2.0),
)
def test_a_surface_is_never_shorter_than_its_ground(heights, spacing, alpha, sigma, stretch):
    height = np.array(heights)
    ground = (height.size - 1) * spacing
    length = profile_length.surface_length(height, spacing_um=spacing)
    assert length >= ground * (1.0 - 1e-12)
    shifted = profile_length.surface_length(-(height + 3.0), spacing_um=spacing)
    assert shifted == pytest.approx(float(length), rel=1e-9)
    smooth = profile_length.convolve_profile(height, alpha, sigma, spacing_um=spacing)
    assert np.isfinite(smooth).all()
    # a kernel of sum 1 keeps the mean of a mirrored profile only roughly, and constants exactly
    flat = profile_length.convolve_profile(np.full(20, 7.0), alpha, sigma, spacing_um=spacing)
    np.testing.assert_allclose(flat, 7.0, rtol=1e-9)
    change = profile_length.length_change(
        height, spacing_um=spacing, stretch=stretch, alpha=alpha, sigma_um=sigma
    )
    assert change.unchanged_ratio > 0.0
    assert change.convolved_ratio > 0.0
    kept = profile_length.find_length_preserving_kernel(
        height, spacing_um=spacing, stretch=stretch, sigma_um=sigma
    )
    assert np.isfinite([kept.change.unchanged_ratio, kept.change.convolved_ratio]).all()


@FEW
@given(seed=SEED, shift=st.tuples(*[st.floats(-50.0, 50.0)] * 2))
def test_field_through_shifted_landmarks_is_uniform_shift(seed, shift):
    points = np.random.default_rng(seed).uniform(0.0, 100.0, (8, 2))
    field = landmark_field.fit_landmark_field(points, points + shift, stderr_px=0.5)
    found, _ = field.evaluate([[10.0, 80.0], [55.0, 5.0]])[:2]
    np.testing.assert_allclose(found, np.broadcast_to(shift, (2, 2)), atol=1e-6)


@FEW
@given(seed=SEED, share=st.floats(0.0, 1.0))
def test_filled_texels_stay_within_measured_range(seed, share):
    rng = np.random.default_rng(seed)
    values = rng.uniform(-3.0, 5.0, (13, 9, 2))
    weight = (rng.uniform(size=(13, 9)) < share).astype(float)
    kept = values.copy()
    found = texture_fill.push_pull(np.where(weight[..., None] > 0, values, np.nan), weight)
    np.testing.assert_array_equal(values, kept)
    measured = weight > 0
    np.testing.assert_allclose(found.values[measured], values[measured], rtol=1e-6)
    if measured.any():
        assert found.values.min() >= values[measured].min() - 1e-4
        assert found.values.max() <= values[measured].max() + 1e-4
    else:
        assert not found.valid.any()


@FEW
@given(seed=SEED, level=st.floats(-5.0, 5.0))
def test_uniform_value_round_trips_through_texture(seed, level):
    uv = np.array([[[0.1, 0.1], [0.9, 0.1], [0.1, 0.9]], [[0.9, 0.1], [0.9, 0.9], [0.1, 0.9]]])
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    texels = texture_fill.rasterize(uv, 16)
    weight = np.random.default_rng(seed).uniform(0.2, 1.0, 4)
    values, known = texture_fill.texels_from_points(texels, faces, np.full(4, level), weight)
    np.testing.assert_allclose(values[known > 0], level, rtol=1e-5, atol=1e-6)
    dense = texture_fill.densify(texels, faces, np.full(4, level), weight)
    back = points_from_texels(dense.values, uv, faces, 4)
    np.testing.assert_allclose(back, level, rtol=1e-5, atol=1e-6)


@FEW
@given(seed=SEED, turn=st.floats(-3.0, 3.0))
def test_texture_axes_are_orthonormal_and_rotate_with_texture(seed, turn):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:14, 0:12] * 1.0
    place = np.stack([x, -y, 0.5 * np.sin(0.4 * x + rng.uniform(0, 6))], axis=-1)
    axes, known = tangent_space.tangent_frames(place, np.ones((14, 12), bool))
    np.testing.assert_allclose(
        (axes @ np.swapaxes(axes, -1, -2))[known],
        np.broadcast_to(np.eye(3), (known.sum(), 3, 3)),
        atol=1e-6,
    )
    c, s = np.cos(turn), np.sin(turn)
    spin = np.array([[c, 0, -s], [0, 1.0, 0], [s, 0, c]])
    normals = unit_normals(rng, (14, 12))
    first = tangent_space.tangent_normals(normals, place, known)
    turned = tangent_space.tangent_normals(normals @ spin.T, place @ spin.T, known)
    np.testing.assert_allclose(first.normals, turned.normals, atol=1e-4)


@FEW
@given(seed=SEED, slope=st.floats(0.5, 3.0))
def test_table_through_collinear_points_is_the_line(seed, slope):
    rng = np.random.default_rng(seed)
    stretch = np.linspace(0.75, 1.3, 12)
    alpha = np.clip(slope * (stretch - 1.0), -2.0, 1.0)
    sigma = 10.0 + 5.0 * (stretch - 1.0) + 0.01 * rng.standard_normal(12)
    table = kernel_table.fit_table(stretch, alpha, sigma, max_segments=1)
    assert kernel_table.alpha_rms(table.table, stretch, alpha) < 0.02


@pytest.mark.long
@FEW
@given(seed=SEED, scale=st.sampled_from([1e-10, 1.0, 1e10]))
def test_highlight_half_vectors_give_normal_at_any_exposure(seed, scale):
    rng = np.random.default_rng(seed)
    light = rng.standard_normal((1, 60, 3)) * [1.0, 1.0, 0.3] + [0, 0, 1.5]
    light /= np.linalg.norm(light, axis=-1, keepdims=True)
    view = np.broadcast_to(np.array([0.0, 0.0, 1.0]), light.shape)
    half = light + view
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    values = scale * np.exp(-((1.0 - half[..., 2]) * 200.0))
    found = half_vector_normals.estimate(values, light, view, np.zeros(60, int))
    if found.valid[0]:
        assert found.normals[0, 2] > 0.95
