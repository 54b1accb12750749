import numpy as np
import pytest

from model.texture_statistics.description import statistics
from model.texture_statistics.masks import fill_smoothly, response_weights
from model.texture_statistics.space import TextureError, TextureSpace

SPREAD = np.diag([0.1, 0.03, 0.01])


def colors(side, rng, *, axes=SPREAD, mean=(0.5, 0.4, 0.3)):
    return np.asarray(mean) + rng.standard_normal((side, side, 3)) @ axes


def test_axes_are_those_of_the_population(rng):
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    images = [colors(60, rng, axes=SPREAD @ turn.T) for _ in range(3)]
    space = TextureSpace.fit(images, levels=1)
    np.testing.assert_allclose(np.abs(np.sum(space.axes * turn.T, axis=1)), 1.0, atol=1e-3)
    spread = np.concatenate([space.to_channels(i).reshape(3, -1) for i in images], axis=1)
    covariance = np.cov(spread)
    assert np.abs(covariance - np.diag(np.diag(covariance))).max() < 1e-3 * covariance[0, 0]
    assert (np.diff(np.diag(covariance)) < 0).all()


def test_every_image_counts_the_same_whatever_its_size(rng):
    small, large = np.full((4, 4, 3), 0.2), np.full((90, 90, 3), 0.6)
    np.testing.assert_allclose(TextureSpace.fit([small, large]).mean, 0.4)


def test_colors_come_back_from_their_channels(rng):
    image = colors(20, rng)
    space = TextureSpace.fit([image])
    np.testing.assert_allclose(space.to_colors(space.to_channels(image)), image, atol=1e-15)
    single = image.astype(np.float32)
    assert space.to_colors(space.to_channels(single)).dtype == np.float32
    assert np.abs(space.to_colors(space.to_channels(single)) - single).max() < 2e-7


def test_population_values_are_unclipped_and_bins_sparsely_used(rng):
    image = np.exp(rng.standard_normal((128, 128, 3)))
    space = TextureSpace.fit([image])
    found = statistics(image, space=space)
    assert found.clipped.max() == 0.0
    # half of the bins follow occurrence: none of the fine responses holds much more than 1/128
    shares = space.histograms(found.vector)[:, :6]
    assert shares.max() < 1.5 / 128
    widths = np.diff(space.edges[:, :6])
    reach = space.edges[:, :6, -1] - space.edges[:, :6, 0]
    assert (widths.max(axis=-1) < 2.1 / 256 * reach).all()


def test_huge_range_separates_both_common_and_rare_values(rng):
    image = (10.0 ** rng.uniform(-6, 6, (64, 64)))[..., None]
    space = TextureSpace.fit([image])
    found = statistics(image, space=space)
    assert np.isfinite(found.vector).all()
    # bins are not narrower than 1e-12 of the range, 1e-6 here
    assert space.histograms(found.vector)[0, 0].max() < 4.0 / 128


def test_single_color_population_has_nonzero_axes_and_bins():
    space = TextureSpace.fit([np.full((16, 16, 3), (0.4, 0.3, 0.2))])
    np.testing.assert_allclose(space.axes @ space.axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.abs(space.axes[0]), 3**-0.5, atol=1e-9)
    assert (space.edges[..., -1] - space.edges[..., 0] > 1e-5).all()
    found = statistics(np.full((16, 16, 3), (0.4, 0.3, 0.2)), space=space)
    assert found.clipped.max() == 0.0
    assert (space.histograms(found.vector).max(axis=-1) == 1.0).all()


def test_gray_images_have_space_stable_to_rounding(rng):
    gray = np.repeat(rng.uniform(0.2, 0.8, (32, 32, 1)), 3, axis=2)
    a = TextureSpace.fit([gray])
    b = TextureSpace.fit([gray + 1e-15 * rng.standard_normal(gray.shape)])
    np.testing.assert_allclose(a.axes, b.axes, atol=1e-3)
    assert np.abs(a.to_channels(gray)[1:]).max() < 1e-12


def test_a_stored_space_is_the_same(tmp_path, rng):
    space = TextureSpace.fit([colors(30, rng), colors(20, rng)])
    space.save(tmp_path / "space.npz")
    again = TextureSpace.load(tmp_path / "space.npz")
    for name in ("mean", "axes", "edges"):
        np.testing.assert_array_equal(getattr(again, name), getattr(space, name))
    assert (again.levels, again.orientations, again.images) == (7, 4, 2)


@pytest.mark.parametrize("content", [b"", b"no space", b"PK\x03\x04broken"])
def test_invalid_texture_space_file_is_reported(tmp_path, content):
    (tmp_path / "space.npz").write_bytes(content)
    with pytest.raises(TextureError, match="no texture space"):
        TextureSpace.load(tmp_path / "space.npz")


def test_parts_tile_vector_in_name_order():
    space = TextureSpace.opponent()
    assert space.size == 23808
    assert len(space.responses) == 31
    parts = [space.part(c, r) for c in range(3) for r in range(31)]
    assert np.concatenate([np.arange(23808)[p] for p in parts]).tolist() == list(range(23808))
    assert space.part(1, "level 2 orientation 3") == space.part(1, 2 + 4 * 2 + 3)
    for wrong in ("level 9", 31, -1):
        with pytest.raises(TextureError, match="part"):
            space.part(0, wrong)


def test_vectors_are_checked():
    space = TextureSpace.opponent(1)
    good = np.tile(np.full(256, 1 / 256), 31)
    assert space.check(good).shape == (1, 31, 256)
    with pytest.raises(TextureError, match="shape"):
        space.check(good[:-1])
    with pytest.raises(TextureError, match="level 0 orientation 0, expected 1"):
        space.check(np.where(np.arange(good.size) // 256 == 2, 2 * good, good))
    with pytest.raises(TextureError, match="project_to_histograms"):
        space.check(good - 0.01)


def test_a_space_that_fits_nothing_is_named(rng):
    space = TextureSpace.opponent()
    for mean, axes, edges in (
        (space.mean, 2 * space.axes, space.edges),
        (space.mean, space.axes, space.edges[:, :, ::-1]),
        (space.mean, space.axes, space.edges[:, :30]),
        (space.mean[:2], space.axes, space.edges),
    ):
        with pytest.raises(TextureError, match="TextureSpace"):
            TextureSpace(mean, axes, np.ascontiguousarray(edges), 7, 4, 1)
    for images, valid in (([], None), ([colors(4, rng)], []), ([colors(4, rng), np.eye(3)], None)):
        with pytest.raises(TextureError, match="images"):
            TextureSpace.fit(images, valid=valid)
    with pytest.raises(TextureError, match="standard"):
        TextureSpace.opponent(5)


def test_filled_area_continues_surroundings_without_detail(rng):
    side = 64
    y, x = np.mgrid[0:side, 0:side] * (2 * np.pi / side)
    image = (2.0 + np.sin(x) + np.cos(y))[..., None]
    valid = np.hypot(x - np.pi, y - np.pi) > 0.8
    holes = np.where(valid[..., None], image, np.nan)
    filled = fill_smoothly(holes, valid)
    np.testing.assert_array_equal(filled[valid], image[valid])
    assert np.abs(filled - image).max() < 0.25
    assert np.abs(np.diff(filled[..., 0], axis=0)).max() < 0.3
    np.testing.assert_allclose(fill_smoothly(np.full((5, 7, 2), 0.3), valid[:5, :7]), 0.3)


def test_a_single_valid_texel_fills_everything():
    valid = np.zeros((13, 6), bool)
    valid[7, 2] = True
    image = np.full((13, 6, 1), np.nan)
    image[7, 2] = 0.25
    np.testing.assert_allclose(fill_smoothly(image, valid), 0.25)


def test_samples_weight_cells_by_region_and_validity():
    valid = np.ones((32, 20), bool)
    region = np.zeros((32, 20))
    region[:16] = 1.0
    texels, samples = response_weights(valid, region, 3)
    assert [s.shape for s in samples] == [(32, 20), (16, 10), (8, 5), (4, 3)]
    np.testing.assert_array_equal(texels, region)
    for s in samples:
        assert s.mean() == pytest.approx(0.5, abs=0.1)
    assert samples[1][4].tolist() == [1.0] * 10
    assert samples[1][12].tolist() == [0.0] * 10
    hole = valid.copy()
    hole[:, 10:] = False
    _, samples = response_weights(hole, None, 3)
    # the first column lies beside the hole, around the end; the fifth in the middle
    assert samples[0][0, 0] == pytest.approx(11 / 16)
    assert samples[0][0, 5] == 1.0
    assert samples[0][0, 12] == 0.0
