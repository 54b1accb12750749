import numpy as np
import pytest

from model.texture_statistics.description import describe, match, statistics
from model.texture_statistics.histograms import histogram_distance, project_to_histograms
from model.texture_statistics.space import TextureError, TextureSpace


def texture(side, rng, *, angle_rad=0.0, strength=0.05, color=(0.55, 0.38, 0.28)):
    """A colored random texture with streaks at an angle, float32."""
    shape = (side, side) if np.isscalar(side) else side
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])[None, :]
    along = fx * np.cos(angle_rad) + fy * np.sin(angle_rad)
    across = fy * np.cos(angle_rad) - fx * np.sin(angle_rad)
    envelope = 1.0 / (1.0 + (along / 0.02) ** 2 + (across / 0.1) ** 2)
    layers = []
    for _ in range(3):
        noise = np.fft.ifft2(np.fft.fft2(rng.standard_normal(shape)) * envelope).real
        layers.append(noise / max(noise.std(), 1e-12))
    tint = np.array([[1.0, 1.0, 1.0], [0.1, -0.3, -0.1], [0.05, 0.05, -0.2]])
    return np.asarray(color * np.exp(strength * np.stack(layers, axis=-1) @ tint), np.float32)


def test_a_vector_is_93_histograms(rng):
    vector = describe(texture(64, rng))
    assert vector.shape == (23808,)
    assert vector.dtype == np.float64
    assert vector.min() >= 0.0
    np.testing.assert_allclose(vector.reshape(93, 256).sum(axis=1), 1.0, atol=1e-12)


def test_matching_texture_is_unchanged(rng):
    image = texture((96, 80), rng)
    space = TextureSpace.fit([image, texture(64, rng, angle_rad=1.0)])
    found = match(image, describe(image, space=space), space=space, iterations=3)
    assert np.abs(found.image - image).max() < 3e-6
    assert found.before.max() == 0.0
    assert found.after.max() < 2e-3


def test_matching_gives_an_image_the_statistics_of_another(rng):
    source, target = texture(128, rng, strength=0.03), texture(128, rng, angle_rad=1.0)
    space = TextureSpace.fit([source, target])
    found = match(source, describe(target, space=space), space=space, iterations=4)
    assert found.distances.shape == (5, 3, 31)
    assert found.after.mean() < 0.25 * found.before.mean()
    # the distances are those of the image that is returned
    again = statistics(found.image, space=space).vector
    expected = histogram_distance(
        space.histograms(again), space.histograms(describe(target, space=space)), space.edges
    )
    np.testing.assert_allclose(found.after, expected, atol=2e-3)


def test_an_empty_mask_is_named(rng):
    with pytest.raises(TextureError, match="no valid texel"):
        describe(texture(8, rng), valid=np.zeros((8, 8), bool))


def test_pixels_outside_mask_are_ignored(rng):
    image = texture((60, 50), rng)
    valid = np.ones((60, 50), bool)
    valid[20:35, 10:40] = False
    space = TextureSpace.fit([image], valid=[valid])
    vectors = []
    for outside in (np.nan, np.inf, 0.0, 1e30):
        changed = np.where(valid[..., None], image, np.float32(outside))
        vectors.append(describe(changed, space=space, valid=valid))
        matched = match(changed, vectors[0], space=space, valid=valid, iterations=1)
        np.testing.assert_array_equal(matched.image[~valid], changed[~valid])
        assert np.isfinite(matched.image[valid]).all()
    for vector in vectors[1:]:
        np.testing.assert_array_equal(vector, vectors[0])


def test_masked_texture_nearly_has_whole_texture_statistics(rng):
    """A mask filled with black instead makes edges that the texture has not."""
    image = texture(192, rng)
    y, x = np.mgrid[0:192, 0:192]
    valid = np.hypot(x - 70, y - 90) < 60
    space = TextureSpace.fit([image])
    whole = space.histograms(describe(image, space=space))
    masked = space.histograms(describe(image, space=space, valid=valid))
    black = np.where(valid[..., None], image, 0.0).astype(np.float32)
    plain = space.histograms(describe(black, space=space, region=valid))
    fine = slice(1, 14)  # the coarse levels have too few samples to tell
    off = [histogram_distance(h, whole, space.edges)[:, fine].mean() for h in (masked, plain)]
    assert off[0] < 0.06
    assert off[1] > 3.0 * off[0]


def test_region_and_rest_are_described_apart(rng):
    """A beard: strong fine texture in one half of the image, smooth skin in the other."""
    image = texture(128, rng, strength=0.01)
    beard = np.zeros((128, 128), bool)
    beard[64:] = True
    image[beard] *= rng.uniform(0.6, 1.2, (beard.sum(), 1)).astype(np.float32)
    space = TextureSpace.fit([image])
    rough, smooth = (
        space.histograms(describe(image, space=space, region=region)) for region in (beard, ~beard)
    )
    middles = 0.5 * (space.edges[0, 1, 1:] + space.edges[0, 1, :-1])
    spread = [float(np.sqrt((h[0, 1] * middles**2).sum())) for h in (rough, smooth)]
    assert spread[0] > 5.0 * spread[1]
    everything = describe(image, space=space, region=np.ones((128, 128)))
    np.testing.assert_allclose(everything, describe(image, space=space), atol=1e-6)


def test_region_of_few_texels_is_described_and_matched(rng):
    image, target = texture(48, rng), texture(48, rng, color=(0.3, 0.25, 0.2))
    few = np.zeros((48, 48), bool)
    few[10, 7:10] = True
    space = TextureSpace.fit([image, target])
    found = statistics(image, space=space, region=few)
    assert found.n_effective[0, 0] == pytest.approx(3.0)
    assert (found.n_effective >= 1.0 - 1e-6).all()
    matched = match(image, describe(target, space=space), space=space, region=few)
    np.testing.assert_array_equal(matched.image[~few], image[~few])
    assert np.isfinite(matched.image).all()
    assert np.abs(matched.image[few] - image[few]).max() > 0.01


def test_a_soft_region_blends(rng):
    image, target = texture(32, rng), texture(32, rng, color=(0.3, 0.25, 0.2))
    ramp = np.tile(np.linspace(0.0, 1.0, 32), (32, 1))
    found = match(image, target, region=ramp, iterations=1).image
    np.testing.assert_array_equal(found[:, 0], image[:, 0])
    change = np.abs(found - image).mean(axis=(0, 2))
    assert change[4] < change[16] < change[31]


def test_coarsest_cell_shift_is_invariant_others_nearly(rng):
    image = texture(128, rng).astype(np.float64)
    space = TextureSpace.fit([image])
    vector = describe(image, space=space)
    same = describe(np.roll(image, (64, 128), (0, 1)), space=space)
    assert np.abs(same - vector).max() <= 2 / 16  # a value that rounding takes to the next bin
    assert np.count_nonzero(same != vector) < 40
    shifted = space.histograms(describe(np.roll(image, (3, 11), (0, 1)), space=space))
    mirrored = space.histograms(describe(image.transpose(1, 0, 2), space=space))
    moved, turned = (
        histogram_distance(h, space.histograms(vector), space.edges)[:, :14].mean()
        for h in (shifted, mirrored)
    )
    assert moved < 0.02
    assert turned > 5.0 * moved


def test_noise_matches_texture_as_nearly_as_image(rng):
    target = texture(128, rng, angle_rad=0.6, strength=0.08)
    other = texture(128, rng, strength=0.04)
    space = TextureSpace.fit([target, other])
    vector = describe(target, space=space)
    from_image = match(other, vector, space=space, iterations=8)
    from_noise = match(other, vector, space=space, iterations=8, start="noise", rng=rng)
    fine = slice(0, 18)
    assert from_noise.before[:, fine].mean() > 10.0 * from_noise.after[:, fine].mean()
    assert from_noise.after[:, fine].mean() < 1.5 * from_image.after[:, fine].mean() + 0.01
    # independent of the source image
    blank = match(
        np.zeros_like(other),
        vector,
        space=space,
        iterations=8,
        start="noise",
        rng=np.random.default_rng(5),
    )
    again = match(
        other, vector, space=space, iterations=8, start="noise", rng=np.random.default_rng(5)
    )
    np.testing.assert_allclose(blank.image, again.image, atol=1e-5)


def test_distances_fall_with_every_iteration(rng):
    """Streaks turned by 70 degrees, sizes that differ: the slow case."""
    source, target = texture(64, rng, strength=0.02), texture((56, 80), rng, angle_rad=1.2)
    found = match(source, target, iterations=5, noise=0.1, rng=rng)
    fine = found.distances[:, :, :14].mean(axis=(1, 2))
    assert (np.diff(fine) < 0.0).all()
    assert fine[-1] < 0.3 * fine[0]


def test_single_color_is_fixed_point_or_recolored(rng):
    one, other = np.full((24, 24, 3), (0.5, 0.3, 0.2)), np.full((24, 24, 3), (0.2, 0.3, 0.4))
    space = TextureSpace.fit([one])
    found = match(one, describe(one, space=space), space=space, noise=0.3, rng=rng)
    np.testing.assert_allclose(found.image, one, atol=1e-12)
    np.testing.assert_allclose(match(one, other).image, other, atol=2e-3)
    textured = match(texture(24, rng).astype(np.float64), one)
    assert textured.image.std(axis=(0, 1)).max() < 0.1 * texture(24, rng).std(axis=(0, 1)).min()


def test_a_channel_without_variance_stays_so(rng):
    image = texture(40, rng)
    image[..., 2] = 0.25
    target = texture(40, rng, angle_rad=1.0)
    target[..., 2] = 0.25
    found = match(image, target).image
    np.testing.assert_allclose(found[..., 2], 0.25, atol=1e-4)
    assert np.abs(found[..., 0] - image[..., 0]).max() > 0.01


@pytest.mark.parametrize("shape", [(1, 1), (8, 5), (4096, 1), (1, 9), (2, 2)])
def test_the_smallest_and_thinnest_images_have_full_vectors(shape, rng):
    image = rng.uniform(0.2, 0.8, (*shape, 3)).astype(np.float32)
    target = rng.uniform(0.3, 0.5, (*shape, 3)).astype(np.float32)
    space = TextureSpace.fit([image, target])
    vector = describe(target, space=space)
    assert vector.shape == (23808,)
    space.check(vector)
    found = match(image, vector, space=space)
    assert found.image.shape == image.shape
    assert np.isfinite(found.image).all()
    assert np.isfinite(found.distances).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_huge_range_stays_finite_and_a_fixpoint(dtype, rng):
    image = (10.0 ** rng.uniform(-6, 6, (64, 48))).astype(dtype)
    space = TextureSpace.fit([image])
    found = match(image, describe(image, space=space), space=space, iterations=2)
    # rounding is relative to the largest value
    bound = 4e-6 if dtype == np.float32 else 1e-13
    assert np.abs(found.image - image).max() < bound * image.max()
    other = match(image, 1.0 / image, iterations=2)
    assert np.isfinite(other.image).all()


def test_a_target_with_empty_bins_is_met(rng):
    image = texture(64, rng)
    space = TextureSpace.fit([image])
    h = space.histograms(describe(image, space=space)).copy()
    h[:, :, ::2] = 0.0
    h[0, 0] = 0.0
    h[0, 0, 17] = 1.0
    vector = project_to_histograms(h.reshape(-1))
    found = match(image, vector, space=space, iterations=2)
    assert np.isfinite(found.image).all()
    again = space.to_channels(found.image)[0]
    low, high = space.edges[0, 0, 17:19]
    assert low - 1e-6 <= again.min() <= again.max() <= high + 1e-6


def test_clipped_samples_are_counted_and_reported(rng):
    image = texture(32, rng)
    space = TextureSpace.fit([image])
    bright = statistics(3.0 * image, space=space)
    assert bright.clipped[0, 0] > 0.9
    space.check(bright.vector)
    assert statistics(image, space=space).clipped.max() == 0.0


def test_the_least_standard_error_is_that_of_counting(rng):
    """White noise has independent texels: vectors of many images scatter as said."""
    space = TextureSpace.fit([rng.standard_normal((64, 64)) for _ in range(4)])
    found = [statistics(rng.standard_normal((64, 64)), space=space) for _ in range(60)]
    part = space.part(0, "image")
    scatter = np.std([one.vector[part] for one in found], axis=0, ddof=1)
    said = np.sqrt(np.mean([one.stderr()[part] ** 2 for one in found], axis=0))
    used = said > 0.0
    # chi-square of 59 degrees of freedom, mean over about 250 bins: 1 +- 0.012 a sigma
    assert np.mean(scatter[used] ** 2 / said[used] ** 2) == pytest.approx(1.0, abs=0.06)


def test_gray_image_has_single_channel_vector(rng):
    image = rng.uniform(0.2, 0.8, (32, 48))
    assert describe(image).shape == (7936,)
    assert match(image, describe(0.5 * image)).image.shape == (32, 48)


def test_inputs_stay_as_they_are(rng):
    image, target = texture(32, rng), texture(32, rng)
    before = image.copy(), target.copy()
    match(image, target, noise=0.1, rng=rng)
    np.testing.assert_array_equal(image, before[0])
    np.testing.assert_array_equal(target, before[1])


def test_mismatched_description_input_is_refused_by_name(rng):
    image = texture(8, rng)
    vector = describe(image)
    broken = image.copy()
    broken[2, 3] = np.nan
    some = np.ones((8, 8), bool)
    cases = [
        (r"image \(mark others in valid\): got", lambda: describe(broken)),
        ("shape", lambda: describe(np.zeros(5))),
        ("channels", lambda: describe(np.zeros((4, 4, 2)))),
        ("valid", lambda: describe(image, valid=some[:3])),
        ("region", lambda: describe(image, region=some[:3])),
        ("region", lambda: describe(image, region=2.0 * some)),
        ("no valid texel", lambda: describe(image, region=~some)),
        ("iterations", lambda: match(image, vector, iterations=-1)),
        ("rng", lambda: match(image, vector, noise=0.1)),
        ("rng", lambda: match(image, vector, start="noise")),
        ("start", lambda: match(image, vector, start="elsewhere")),
        ("vector", lambda: match(image, vector[:-1])),
        ("project_to_histograms", lambda: match(image, vector - 1e-3)),
        ("channels", lambda: match(image[..., 0], vector, space=TextureSpace.opponent(3))),
    ]
    for message, call in cases:
        with pytest.raises(TextureError, match=message):
            call()
