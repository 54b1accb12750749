"""Textures, their statistics, wrinkle maps and traits over their declared domains."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from twins import sliding_histograms

from model import (
    facial_color,
    texture_resampling,
    texture_statistics,
    traits,
    translucency_population,
    vectors,
    wrinkles,
)
from model.displacement_synthesis import regions as synthesis_regions
from model.displacement_synthesis import sources as synthesis_sources
from model.facial_color import (
    coarse_maps,
    deviation_ratio,
    disc_statistics,
    histogram_matching,
    prediction_errors,
)
from model.microstructure import convolution as displacement_convolution
from model.texture_statistics import bins as texture_bins
from model.texture_statistics import histograms as texture_histograms
from model.texture_statistics import masks as texture_masks
from model.texture_statistics import steerable_pyramid
from model.traits import feasible_sets, histogram_transport, reduced_spaces
from model.traits import vectors as trait_vectors
from model.wrinkles import block_compression
from model.wrinkles import differences as wrinkle_differences
from model.wrinkles import expressions as wrinkle_expressions
from model.wrinkles import masks as wrinkle_masks
from model.wrinkles import storage as wrinkle_storage

CHEAP = settings(derandomize=True, deadline=None, max_examples=30, database=None)
FEW = settings(CHEAP, max_examples=8)

SEED = st.integers(0, 9999)
SIDES = st.tuples(st.integers(1, 13), st.integers(1, 13))
KIND = st.sampled_from([np.float32, np.float64])
ANY = st.floats(allow_nan=True, allow_infinity=True)


@CHEAP
@given(seed=SEED, sides=SIDES, kind=KIND)
def test_blocks_hold_a_texture_to_their_precision(seed, sides, kind):
    rng = np.random.default_rng(seed)
    rows, columns = block_compression.block_grid_shape(sides)
    assert (rows, columns) == (-(-sides[0] // 4), -(-sides[1] // 4))
    codecs = {
        1: (block_compression.encode_bc4, block_compression.decode_bc4),
        2: (block_compression.encode_bc5, block_compression.decode_bc5),
        3: (block_compression.encode_bc1, block_compression.decode_bc1),
        4: (block_compression.encode_bc3, block_compression.decode_bc3),
    }
    for channels, (encode, decode) in codecs.items():
        shape = sides if channels == 1 else (*sides, channels)
        values = rng.uniform(size=shape).astype(kind)
        kept = values.copy()
        blocks = encode(values)
        np.testing.assert_array_equal(values, kept)
        assert blocks.dtype == np.uint8
        assert blocks.shape[:2] == (rows, columns)
        found = decode(blocks, sides)
        assert np.all((found >= 0.0) & (found <= 1.0))
        even = np.full(shape, kind(0.5))
        # 8 bits a level; colors have 5
        off = 0.5 / 255 + 1e-6 if channels < 3 else 0.5 / 31 + 1e-6
        assert np.abs(decode(encode(even), sides) - even).max() <= off
        if channels < 3:
            # a step of eight levels between a block's ends; the ends are chosen for the mean error
            assert np.abs(found - values).max() <= 1.0 / 7


@CHEAP
@given(bad=st.sampled_from([np.nan, -0.5, 1.5, np.inf]))
@pytest.mark.parametrize("encode", [block_compression.encode_bc4, block_compression.encode_bc5])
def test_values_missing_from_blocks_raise_error(encode, bad):
    shape = (4, 4) if encode is block_compression.encode_bc4 else (4, 4, 2)
    values = np.full(shape, 0.3)
    values[0, 0] = bad
    with pytest.raises(block_compression.BlockError):
        encode(values)


@CHEAP
@given(
    seed=SEED,
    sides=SIDES,
    radius=st.floats(0.0, 20.0),
    scale=st.sampled_from([1e-12, 1.0, 1e12]),
    hole=ANY,
)
def test_disc_statistics_scale_and_omit_missing_values(seed, sides, radius, scale, hole):
    rng = np.random.default_rng(seed)
    h, valid = rng.uniform(1.0, 2.0, sides), rng.uniform(size=sides) > 0.2
    first = disc_statistics.measure(h, radius, valid=valid)
    other = disc_statistics.measure(np.where(valid, scale * h, hole), radius, valid=valid)
    np.testing.assert_array_equal(first.count, other.count)
    some = first.count > 0
    np.testing.assert_allclose(other.mean[some], scale * first.mean[some], rtol=1e-6)
    assert np.all(first.deviation[some] >= 0.0)
    assert np.all((first.mean[some] >= 1.0 - 1e-6) & (first.mean[some] <= 2.0 + 1e-6))
    mu, sigma = facial_color.local_statistics(h, radius, valid=valid)
    np.testing.assert_array_equal(np.isnan(mu), ~some)
    np.testing.assert_array_equal(np.isnan(sigma), ~some)
    widths = disc_statistics.half_widths(radius, *sides)
    assert np.all(np.diff(widths) <= 0)


@CHEAP
@given(
    seed=SEED,
    levels=st.integers(1, 4),
    orientations=st.integers(1, 5),
    kind=KIND,
    sides=st.tuples(st.integers(1, 20), st.integers(1, 20)),
)
def test_a_pyramid_gives_its_image_back(seed, levels, orientations, kind, sides):
    image = np.random.default_rng(seed).standard_normal(sides).astype(kind)
    kept = image.copy()
    found = steerable_pyramid.analyze(image, levels=levels, orientations=orientations, workers=1)
    np.testing.assert_array_equal(image, kept)
    again = steerable_pyramid.synthesize(found, workers=1)
    assert again.dtype == kind
    tolerance = 1e-5 if kind is np.float32 else 1e-12
    assert np.abs(again - image).max() <= tolerance * max(np.abs(image).max(), 1e-30)
    sizes = steerable_pyramid.level_sizes(sides, levels)
    assert sizes[0] == sides
    assert len(sizes) == levels + 1
    assert steerable_pyramid.thread_count(1) == 1


@FEW
@given(
    seed=SEED, gain=st.floats(0.1, 10.0), offset=st.floats(-5.0, 5.0), radius=st.floats(2.0, 6.0)
)
def test_an_increasing_affine_target_is_matched_exactly(seed, gain, offset, radius):
    neutral = np.random.default_rng(seed).standard_normal((7, 6))
    target = gain * neutral + offset
    for match in (histogram_matching.match, sliding_histograms.match_sliding):
        found = match(neutral, target, radius)
        np.testing.assert_allclose(found.hemoglobin, target, atol=1e-6 * (gain + abs(offset)))


HISTOGRAM = st.lists(st.floats(0.0, 1.0), min_size=4, max_size=12)


@CHEAP
@given(counts=HISTOGRAM, shift=st.floats(-3.0, 3.0))
def test_moved_histograms_keep_sum_and_move_by_change(counts, shift):
    shares = np.array(counts)
    assume(shares.sum() > 1e-3)
    shares /= shares.sum()
    edges = np.linspace(0.0, 10.0, shares.size + 1)
    at = histogram_transport.quantile_levels()
    quantiles = histogram_transport.quantiles(shares, edges)
    assert np.all(np.diff(at) > 0.0)
    assert np.all(np.diff(quantiles) >= 0.0)
    assert quantiles[0] >= 0.0
    assert quantiles[-1] <= 10.0
    still = histogram_transport.shift_quantiles(shares, edges, np.zeros(at.size))
    np.testing.assert_allclose(still, shares, atol=1e-9)
    change = np.full(at.size, shift)
    wide = histogram_transport.widen_edges(shares, edges, change)
    moved = histogram_transport.shift_quantiles(shares, edges, change, target_edges=wide)
    assert np.all(moved >= 0.0)
    assert moved.sum() == pytest.approx(1.0)


VECTOR_256 = st.integers(0, 9999).map(lambda seed: np.random.default_rng(seed).normal(size=256))


@CHEAP
@given(vector=VECTOR_256, scale=st.sampled_from([1e-6, 1.0, 1e6]))
def test_nearest_histogram_is_a_histogram_and_idempotent(vector, scale):
    found = texture_histograms.project_to_histograms(scale * vector)
    assert np.all(found >= 0.0)
    assert found.sum() == pytest.approx(1.0)
    rows = np.stack([vector[::-1], vector])
    np.testing.assert_array_equal(vectors.project_to_simplex(scale * rows)[1], found)
    again = texture_histograms.project_to_histograms(found)
    np.testing.assert_allclose(again, found, atol=1e-9)
    cumulated = texture_histograms.cumulate_fractions(found)
    assert cumulated[0] == 0.0
    assert cumulated[-1] == 1.0
    edges = np.arange(257.0)
    other = np.roll(found, 3)
    there = texture_histograms.histogram_distance(found, other, edges)
    assert there >= 0.0
    assert texture_histograms.histogram_distance(other, found, edges) == pytest.approx(float(there))
    assert texture_histograms.histogram_distance(found, found, edges) == 0.0


@FEW
@given(bad=st.sampled_from([np.nan, np.inf, -np.inf]))
def test_histograms_of_nonfinite_textures_raise_error(bad):
    error = texture_histograms.TextureHistogramError
    even, edges = np.full(256, 1.0 / 256.0), np.arange(257.0)
    wrong, bent = even.copy(), edges.copy()
    wrong[7], bent[7] = bad, bad
    bins = texture_histograms.Bins.from_edges(edges)
    values = np.linspace(1.0, 250.0, 50)
    source = bins.count(values)
    assert np.isfinite(bins.match(values, source, even)).all()
    with pytest.raises(error, match="target"):
        bins.match(values, source, wrong)
    with pytest.raises(error, match="values"):
        bins.match(np.array([1.0, bad]), source, even)
    for pair in ((even, wrong), (wrong, even), (even, np.zeros(256))):
        with pytest.raises(error, match=r"[ab]: got"):
            texture_histograms.histogram_distance(*pair, edges)
    with pytest.raises(error, match="edges"):
        texture_histograms.histogram_distance(even, even, bent)
    with pytest.raises(error, match="fractions"):
        texture_histograms.cumulate_fractions(wrong)


@FEW
@given(far=st.floats(1e31, 1e300), bad=st.sampled_from([np.nan, np.inf]))
def test_leveled_heights_nonfinite_are_holes_extreme_raise_error(far, bad):
    height = np.zeros((6, 7))
    height[2, 3] = bad
    found = synthesis_sources.level_patch(height, pixel_um=10.0, cutoff_um=30.0)
    np.testing.assert_array_equal(np.isnan(found), ~np.isfinite(height))
    height[2, 3] = far
    with pytest.raises(synthesis_sources.SynthesisError, match="height_um"):
        synthesis_sources.level_patch(height, pixel_um=10.0, cutoff_um=30.0)
    with pytest.raises(synthesis_sources.SynthesisError, match="height_um"):
        synthesis_sources.level_patch(np.full((6, 7), bad), pixel_um=10.0)


@FEW
@given(seed=SEED, bins=st.integers(2, 30))
def test_color_histograms_of_groups_count_every_valid_texel(seed, bins):
    rng = np.random.default_rng(seed)
    images = [rng.uniform(size=(5, 4, 3)), rng.uniform(size=(3, 6, 3))]
    found = texture_histograms.rgb_histograms(images, {"all": [True, True]}, bins=bins)
    np.testing.assert_allclose(found.mean.sum(axis=-1), 1.0)


@CHEAP
@given(values=st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=50), unit=st.floats(0.01, 1e3))
def test_uneven_edges_rise_and_hold_all_values(values, unit):
    unit = max(unit, *np.abs(values))  # it is the largest value
    edges = texture_bins.make_bin_edges(np.sort(values), unit)
    assert edges.shape == (257,)
    assert np.all(np.diff(edges) > 0.0)
    assert edges[0] <= min(values)
    assert edges[-1] >= max(values)
    axes = texture_bins.principal_axes(np.cov(np.reshape(np.resize(values, 12), (3, 4))), unit)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)


@CHEAP
@given(seed=SEED, sides=SIDES, share=st.floats(0.05, 1.0), levels=st.integers(1, 4))
def test_filled_texture_keeps_valid_values_and_their_range(seed, sides, share, levels):
    rng = np.random.default_rng(seed)
    image, valid = rng.uniform(size=(*sides, 2)), rng.uniform(size=sides) < share
    valid[0, 0] = True
    broken = np.where(valid[..., None], image, np.nan)
    found = texture_masks.fill_smoothly(broken, valid)
    np.testing.assert_array_equal(found[valid], image[valid])
    assert found.min() >= image[valid].min() - 1e-9
    assert found.max() <= image[valid].max() + 1e-9
    texels, samples = texture_masks.response_weights(valid, None, levels)
    np.testing.assert_array_equal(texels > 0, valid)
    assert all(np.all((s >= 0.0) & (s <= 1.0 + 1e-6)) for s in samples)


@CHEAP
@given(sides=SIDES, onto=SIDES, level=st.floats(-1e6, 1e6))
def test_an_even_texture_is_even_at_every_resolution(sides, onto, level):
    found = texture_resampling.resample(np.full(sides, level), onto)
    assert found.shape == onto
    np.testing.assert_allclose(found, level, rtol=1e-9)
    for make in (texture_resampling.reading_matrix, texture_resampling.averaging_matrix):
        rows = make(max(sides[0], onto[0]), min(sides[0], onto[0]))
        np.testing.assert_allclose(np.asarray(rows.sum(axis=1)).ravel(), 1.0)
    first, part = texture_resampling.bilinear_taps(sides[0], onto[0])
    assert np.all((first >= 0) & (first < sides[0]))
    assert np.all((part >= 0.0) & (part < 1.0))


@FEW
@given(seed=SEED)
def test_texture_already_matching_statistics_is_returned(seed):
    image = np.random.default_rng(seed).uniform(0.2, 0.8, (16, 16))
    vector = texture_statistics.describe(image, space=None, workers=1)
    told = texture_statistics.statistics(image, workers=1)
    np.testing.assert_array_equal(told.vector, vector)
    found = texture_statistics.match(image, image, iterations=1, workers=1)
    np.testing.assert_allclose(found.image, image, atol=1e-4)


@CHEAP
@given(
    seed=SEED,
    sides=SIDES,
    alpha=st.floats(-2.0, 1.0),
    sigma=st.floats(0.0, 6.0),
    level=st.floats(-100.0, 100.0),
    turn=st.floats(-3.0, 3.0),
)
def test_kernel_keeps_uniform_height_and_scales_others(seed, sides, alpha, sigma, level, turn):
    axis = (np.cos(turn), np.sin(turn))
    across = (-np.sin(turn), np.cos(turn))
    kernel = (axis, across, alpha, sigma, 0.0, 1.0)
    even = displacement_convolution.convolve(np.full(sides, level), *kernel)
    np.testing.assert_allclose(even, level, rtol=1e-4, atol=1e-4)
    height = np.random.default_rng(seed).standard_normal(sides)
    kept = height.copy()
    first = displacement_convolution.convolve(height, *kernel)
    np.testing.assert_array_equal(height, kept)
    twice = displacement_convolution.convolve(-2.0 * height, *kernel)
    np.testing.assert_allclose(twice, -2.0 * first, atol=1e-4)
    tiles = displacement_convolution.list_tiles(sides, 5)
    assert sum(np.prod(tile.shape) for tile in tiles) == np.prod(sides)
    lines = displacement_convolution.LineKernels.of(axis, alpha, sigma, sides)
    assert displacement_convolution.kernel_reach(lines, sides) >= 0
    target = np.zeros(sides, np.float32)
    nothing = displacement_convolution.LineKernels.of(across, 0.0, 1.0, sides)
    displacement_convolution.convolve_tiled(
        height, target, lambda window: (lines.part(window), nothing.part(window)), tile=5
    )
    single = displacement_convolution.convolve(height.astype(np.float32), *kernel)
    np.testing.assert_array_equal(target, single)
    np.testing.assert_allclose(single, first, atol=1e-4)


@CHEAP
@given(pair=st.tuples(*[st.floats(-1e9, 1e9)] * 2), kind=KIND)
def test_derivatives_of_normals_come_back(pair, kind):
    derivatives = np.array([[pair]], kind)
    normals = wrinkles.decode(derivatives)
    assert np.linalg.norm(normals[0, 0].astype(float)) == pytest.approx(1.0, abs=1e-5)
    if max(map(abs, pair)) < 1e3:
        again = wrinkles.encode(normals, limit=None)
        assert again.dtype == kind
        scale = 1.0 + np.square(pair).sum()
        np.testing.assert_allclose(
            again, derivatives, atol=scale * (1e-5 if kind == np.float32 else 1e-12)
        )


@CHEAP
@given(normal=st.tuples(ANY, ANY, ANY), limit=st.floats(0.1, 10.0))
def test_normal_is_encoded_within_limit_or_masked(normal, limit):
    report = wrinkles.encode_with_report([normal], limit=limit)
    assert np.isfinite(report.derivatives).all()
    assert np.abs(report.derivatives).max() <= limit
    shown = np.where(report.valid[..., None], report.derivatives, np.nan)
    np.testing.assert_array_equal(wrinkles.encode([normal], limit=limit), shown)
    assert not report.derivatives[~report.valid].any()
    stored = wrinkles.to_unit(report.derivatives, limit=limit)
    assert np.all((stored >= 0.0) & (stored <= 1.0))
    np.testing.assert_allclose(
        wrinkles.from_unit(stored, limit=limit), report.derivatives, atol=1e-6 * limit
    )


@CHEAP
@given(
    seed=SEED,
    weights=st.lists(st.floats(-3.0, 3.0), min_size=8, max_size=8),
    clamp=st.sampled_from(["unit", "signed"]),
)
def test_wrinkle_weights_give_unit_normals_none_at_rest(seed, weights, clamp):
    rng = np.random.default_rng(seed)
    base, wrinkle = rng.normal(size=(6, 5, 2)), rng.uniform(-1.0, 1.0, (3, 4, 2))
    masks = rng.uniform(size=(8, 2, 3))
    found = wrinkles.combine(base, wrinkle, masks, weights, clamp=clamp)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1.0, atol=1e-9)
    still = wrinkles.combine(base, wrinkle, masks, np.zeros(8), clamp=clamp)
    np.testing.assert_allclose(still, wrinkles.decode(base), atol=1e-9)
    layer = wrinkles.WrinkleLayer(wrinkle, masks)
    layered = wrinkles.combine_layers(base, [layer], weights, clamp=clamp)
    np.testing.assert_allclose(layered, found, atol=1e-9)
    sums = wrinkle_expressions.clamp_sums(wrinkle_expressions.zone_sums(weights), clamp)
    assert np.all((sums >= (0.0 if clamp == "unit" else -1.0)) & (sums <= 1.0))
    strength = wrinkle_masks.zone_strength(wrinkle_masks.mask_stack(masks), sums)
    assert np.abs(strength).max() <= 8.0


@CHEAP
@given(seed=SEED, zones=st.integers(1, 9), dtype=st.sampled_from(["f2", "f4", "f8", "u1", "?"]))
def test_masks_are_equal_as_planes_and_textures(seed, zones, dtype):
    planes = np.random.default_rng(seed).uniform(0, 2, (zones, 2, 3)).astype(dtype)
    stack = wrinkle_masks.mask_stack(planes)
    np.testing.assert_array_equal(stack, planes)
    assert stack.dtype == (np.float32 if dtype in ("f2", "f4") else np.float64)
    assert stack.dtype == wrinkle_masks.real_array(planes).dtype
    textures = wrinkle_masks.mask_textures(planes)
    assert textures.shape == (-(-zones // 4), 2, 3, 4)
    again = wrinkle_masks.mask_stack(textures)
    np.testing.assert_array_equal(again[:zones], planes)
    assert not again[zones:].any()


@pytest.mark.long
@CHEAP
@given(seed=SEED, strength=st.floats(0.0, 1.0))
def test_normal_difference_at_full_strength_is_other_map(seed, strength):
    rng = np.random.default_rng(seed)
    base, other = (wrinkles.decode(0.5 * rng.standard_normal((4, 3, 2))) for _ in range(2))
    difference = wrinkle_differences.difference_map(base, other)
    assert np.all((difference.values >= 0.0) & (difference.values <= 1.0))
    weights = np.zeros(8)
    masks = np.ones((8, 1, 1))
    still = wrinkle_differences.combine(base, difference, masks, weights)
    np.testing.assert_allclose(still, base, atol=1e-6)
    weights[0] = 1.0
    whole = wrinkle_differences.combine(base, difference, masks, weights)
    held = np.abs(other - base).max(axis=-1) <= 1.0
    assert difference.clamped_fraction == pytest.approx(1.0 - held.mean())
    np.testing.assert_allclose(whole[held], other[held], atol=1e-5)
    weights[0] = strength
    some = wrinkle_differences.combine(base, difference, masks, weights)
    np.testing.assert_allclose(np.linalg.norm(some, axis=-1), 1.0, atol=1e-5)


@CHEAP
@given(sides=st.tuples(*[st.integers(1, 4096)] * 2), texel=st.integers(1, 16), blocks=st.booleans())
def test_stored_map_takes_at_least_its_texels(sides, texel, blocks):
    one = wrinkle_storage.texture_bytes(sides, texel, in_blocks=blocks)
    assert one >= sides[0] * sides[1] * texel


@FEW
@given(seed=SEED, encoding=st.sampled_from(["float32", "float16", "unit8", "bc5"]))
def test_stored_derivatives_come_back_to_their_encoding(seed, encoding):
    values = np.random.default_rng(seed).uniform(-1.0, 1.0, (8, 8, 2)).astype(np.float32)
    found = wrinkle_storage.round_trip_map(values, encoding)
    worst = {"float32": 0.0, "float16": 1e-3, "unit8": 1.0 / 255 + 1e-6, "bc5": 0.16}[encoding]
    assert np.abs(found - values).max() <= worst


@CHEAP
@given(seed=SEED, d=st.integers(1, 6), scale=st.floats(1e-6, 1e6))
def test_lengths_under_metric_match_those_in_frame(seed, d, scale):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((d, d)) + 2.0 * np.eye(d)
    metric = reduced_spaces.check_metric(scale * root @ root.T, d)
    samples = rng.standard_normal((4, d))
    lengths = reduced_spaces.metric_lengths(samples, metric)
    np.testing.assert_allclose(
        np.linalg.norm(reduced_spaces.to_euclidean_frame(samples, metric), axis=1),
        lengths,
        rtol=1e-6,
    )
    product = reduced_spaces.times_metric(samples, metric)
    np.testing.assert_allclose(np.sum(product * samples, axis=1), lengths**2, rtol=1e-9)
    value = traits.cosine(samples[0], samples[1], metric)
    assert -1.0 - 1e-9 <= value <= 1.0 + 1e-9
    assert traits.cosine(samples[0], 3.0 * samples[0], metric) == pytest.approx(1.0)


@CHEAP
@given(seed=SEED, count=st.integers(3, 12))
def test_contrasts_of_traits_add_up_to_nothing(seed, count):
    rng = np.random.default_rng(seed)
    labels = rng.uniform(size=count) > 0.5
    assume(0 < labels.sum() < count)
    age = rng.uniform(20.0, 60.0, count)
    found = trait_vectors.parse_traits({"beard": labels}, {"age": age}, count)
    for trait in found:
        assert abs(trait.contrast.sum()) < 1e-9
    table = trait_vectors.correlations(found)
    np.testing.assert_allclose(np.diag(table), 1.0)
    assert np.all(np.abs(table) <= 1.0 + 1e-9)
    left = trait_vectors.residuals(found[0], rng.standard_normal((count, 3)))
    assert left.shape == (count, 4)
    assert np.isfinite(left).all()
    weight = trait_vectors.error_weights(found[0], left[:, -1], 2)
    assert np.all(weight >= 0.0)


@CHEAP
@given(seed=SEED, n=st.integers(1, 5))
def test_the_smallest_set_of_samples_holds_them(seed, n):
    rng = np.random.default_rng(seed)
    for samples in (
        rng.normal(size=(n, 7)),
        rng.uniform(size=(n, 7)),
        rng.dirichlet(np.ones(256), n),
    ):
        found = feasible_sets.smallest_feasible_set(samples)
        assert np.all(found.contains(samples))
        np.testing.assert_allclose(found.project(samples), samples, atol=1e-9)
        assert type(feasible_sets.from_document(found.document())) is type(found)


@CHEAP
@given(seed=SEED, people=st.integers(1, 6))
def test_people_table_stays_within_their_range(seed, people):
    values = np.random.default_rng(seed).uniform(0.2, 3.0, (people, 3, 3))
    found = translucency_population.table(values)
    assert np.all(found.count == people)
    assert np.all(found.mean_per_mm >= values.min(axis=0) - 1e-12)
    assert np.all(found.mean_per_mm <= values.max(axis=0) + 1e-12)


@CHEAP
@given(seed=SEED, gain=st.floats(0.1, 5.0), scale=st.sampled_from([1e-6, 1.0, 1e6]))
def test_map_ratio_is_found_in_any_unit(seed, gain, scale):
    seen = np.random.default_rng(seed).uniform(1.0, 2.0, 50)
    assert deviation_ratio.global_ratio(gain * scale * seen, scale * seen) == pytest.approx(gain)
    found = deviation_ratio.estimate_ratio(
        gain * scale * seen, scale * seen, np.full(50, (1e-6 * scale) ** 2), seen > 0
    )
    np.testing.assert_allclose(found.value, gain, rtol=1e-3)
    assert deviation_ratio.global_ratio(np.zeros(3), np.zeros(3)) == 1.0


@CHEAP
@given(seed=SEED, scale=st.sampled_from([1e-6, 1.0, 1e6]), gain=st.floats(0.2, 5.0))
def test_blood_errors_scale_and_vanish_for_truth(seed, scale, gain):
    rng = np.random.default_rng(seed)
    neutral, truth, predicted = scale * rng.uniform(0.1, 1.0, (3, 6, 5))
    found = prediction_errors.compare_prediction(predicted, truth, neutral)
    twice = prediction_errors.compare_prediction(2.0 * predicted, 2.0 * truth, 2.0 * neutral)
    assert twice.predicted == pytest.approx(2.0 * found.predicted)
    assert prediction_errors.compare_prediction(truth, truth, neutral).predicted == 0.0
    assert prediction_errors.compare_prediction(
        truth, gain * neutral, neutral
    ).gain == pytest.approx(gain)


@CHEAP
@given(shape=st.tuples(*[st.integers(1, 4000)] * 2), size=st.one_of(st.none(), st.integers(1, 512)))
def test_map_cells_are_not_finer_than_map(shape, size):
    cells = coarse_maps.coarse_grid(shape, size)
    assert all(1 <= kept <= own for kept, own in zip(cells.stored, shape, strict=True))


@FEW
@given(seed=SEED, transition=st.floats(2.0, 10.0))
def test_weights_of_regions_add_up_everywhere(seed, transition):
    regions = np.random.default_rng(seed).integers(0, 3, (6, 5))
    weights = synthesis_regions.coarse_weights(regions, 3, (24, 20), transition_px=transition)
    np.testing.assert_allclose(weights.sum(axis=0), 1.0)
    assert weights.min() >= 0.0
    total = sum(
        synthesis_regions.interpolate_weights(each, (24, 20), (3, 19), (0, 20), wrap=(False, False))
        for each in weights
    )
    np.testing.assert_allclose(total, 1.0, atol=1e-6)


@FEW
@given(seed=SEED, level=st.floats(-1e3, 1e3))
def test_leveled_patch_is_constant_invariant_and_fills_holes(seed, level):
    rng = np.random.default_rng(seed)
    height, valid = rng.standard_normal((12, 11)), rng.uniform(size=(12, 11)) > 0.1
    first = synthesis_sources.level_patch(height, pixel_um=10.0, valid=valid, cutoff_um=60.0)
    other = synthesis_sources.level_patch(
        height + level, pixel_um=10.0, valid=valid, cutoff_um=60.0
    )
    np.testing.assert_array_equal(np.isnan(first), ~valid)
    np.testing.assert_allclose(other[valid], first[valid], atol=1e-3)
    whole = synthesis_sources.fill_holes(first, valid)
    assert np.isfinite(whole).all()
    assert whole.max() <= first[valid].max() + 1e-6


@CHEAP
@given(bad=st.sampled_from([np.nan, np.inf, -np.inf, None]), size=st.integers(1, 9))
def test_texture_without_fill_source_raises_error(bad, size):
    image = np.full((size, 5, 3), 0.5)
    valid = np.zeros((size, 5), bool)
    if bad is not None:
        valid[0, 0], image[0, 0] = True, bad
    with pytest.raises(
        ValueError, match="valid: got no texel" if bad is None else "image: got NaN"
    ):
        texture_masks.fill_smoothly(image, valid)


@CHEAP
@given(radius=st.floats(12.0, 1.79e308))
def test_disc_larger_than_map_contains_whole_map(radius):
    found = disc_statistics.measure(np.arange(48.0).reshape(6, 8), radius)
    np.testing.assert_allclose(found.mean, 23.5, rtol=1e-9)


@CHEAP
@given(bad=st.sampled_from([np.nan, np.inf, -np.inf]), count=st.integers(0, 3))
def test_bins_and_axes_from_empty_or_nonfinite_refused(bad, count):
    with pytest.raises(ValueError, match="quantiles"):
        texture_bins.make_bin_edges([], 1.0)
    with pytest.raises(ValueError, match="quantiles"):
        texture_bins.make_bin_edges([1.0] * count + [bad], 1.0)
    with pytest.raises(ValueError, match="unit"):
        texture_bins.make_bin_edges([1.0], bad)
    with pytest.raises(ValueError, match="covariance"):
        texture_bins.principal_axes(np.full((count, count), bad), 1.0)
    with pytest.raises(ValueError, match="covariance"):
        texture_bins.principal_axes(np.ones((count, count + 1)), 1.0)


@CHEAP
@given(
    seed=st.integers(0, 99),
    sides=st.tuples(*[st.integers(1, 9)] * 2),
    onto=st.tuples(*[st.integers(1, 9)] * 2),
)
def test_halves_are_resampled_as_singles_are(seed, sides, onto):
    texture = np.random.default_rng(seed).uniform(-1.0, 1.0, (2, *sides)).astype(np.float16)
    found = texture_resampling.resample(texture, onto)
    expected = texture_resampling.resample(texture.astype(np.float32), onto)
    assert found.dtype == np.float16
    np.testing.assert_array_equal(found, expected.astype(np.float16))


@CHEAP
@given(kind=st.sampled_from([np.int64, np.bool_, np.complex64, object]))
def test_textures_of_invalid_numbers_or_size_are_refused(kind):
    with pytest.raises(ValueError, match="texture"):
        texture_resampling.resample(np.ones((2, 4, 4)).astype(kind), (2, 2))
    for shape in ((4,), (2, 0, 4), (2, 4, 0)):
        with pytest.raises(ValueError, match="texture"):
            texture_resampling.resample(np.ones(shape), (2, 2))
    with pytest.raises(ValueError, match="shape"):
        texture_resampling.resample(np.ones((2, 4, 4)), (0, 2))
    with pytest.raises(ValueError, match="pixels"):
        texture_resampling.averaging_matrix(0, 2)
