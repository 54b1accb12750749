"""Partial derivative maps, masked zones and signed weights against closed forms and listing 1.1."""

import numpy as np
import pytest

from model import texture_resampling, wrinkles
from model.wrinkles.expressions import (
    JIMENEZ2011_TABLE,
    ROW_OF_STATE,
    ExpressionTable,
    WrinkleError,
    clamp_sums,
    read_table,
    zone_sums,
)

FOREHEAD = {"red": 0, "green": 1, "blue": 2, "brown": 3}


def tilted(rng, shape, steepest=0.9):
    slopes = rng.uniform(-steepest, steepest, (*shape, 2))
    n = np.concatenate([slopes, np.ones((*shape, 1))], axis=-1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def bilinear(texture, shape):
    """Read channels-last texels at pixel centres one by one, as the listing's sampler does."""
    h, w = texture.shape[:2]
    out = np.empty((*shape, *texture.shape[2:]))
    for y in range(shape[0]):
        v = (y + 0.5) / shape[0] * h - 0.5
        for x in range(shape[1]):
            u = (x + 0.5) / shape[1] * w - 0.5
            j, i = int(np.floor(v)), int(np.floor(u))
            corners = [
                (j, i, (1 - v + j) * (1 - u + i)),
                (j, i + 1, (1 - v + j) * (u - i)),
                (j + 1, i, (v - j) * (1 - u + i)),
                (j + 1, i + 1, (v - j) * (u - i)),
            ]
            out[y, x] = sum(
                part * texture[np.clip(a, 0, h - 1), np.clip(b, 0, w - 1)] for a, b, part in corners
            )
    return out


def listing_1_1(base, wrinkle, masks, sums):
    """Return normals as listing 1.1 does, zone by zone and sample by sample."""
    total = base.astype(np.float64).copy()
    sampled = bilinear(wrinkle, base.shape[:2])
    for mask, weight in zip(masks, sums, strict=True):
        total += (weight * bilinear(mask, base.shape[:2]))[..., None] * sampled
    n = np.concatenate([total, np.ones((*base.shape[:2], 1))], axis=-1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


@pytest.mark.parametrize(("dtype", "atol"), [(np.float64, 1e-15), (np.float32, 3e-7)])
def test_normal_round_trips_through_derivatives_at_rounding_level(rng, dtype, atol):
    n = tilted(rng, (3, 5, 7)).astype(dtype)
    d = wrinkles.encode(n)
    assert d.dtype == dtype
    assert d.shape == (3, 5, 7, 2)
    back = wrinkles.decode(d)
    assert back.dtype == dtype
    np.testing.assert_allclose(back, n, rtol=0, atol=atol)


def test_derivatives_are_height_slopes_of_their_normal():
    dh_dx, dh_dy = 0.3, -0.2
    d = wrinkles.encode(np.array([-dh_dx, -dh_dy, 1.0]))
    np.testing.assert_allclose(d, [-dh_dx, -dh_dy], rtol=1e-15)


def test_the_length_of_a_normal_does_not_matter(rng):
    n = tilted(rng, (20,))
    lengths = rng.uniform(0.1, 10, (20, 1))
    np.testing.assert_allclose(wrinkles.encode(n * lengths), wrinkles.encode(n), rtol=1e-14)


def test_slopes_above_45_degrees_are_clamped_and_counted():
    angles = np.radians([0.0, 44.0, 46.0, 80.0, 89.999])
    n = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1)
    report = wrinkles.encode_with_report(n)
    np.testing.assert_array_equal(report.clamped, [False, False, True, True, True])
    assert report.clamped_fraction == 0.6
    np.testing.assert_allclose(report.derivatives[2:, 0], 1.0)
    back = wrinkles.decode(report.derivatives)
    np.testing.assert_allclose(np.degrees(np.arcsin(back[2:, 0])), 45.0, rtol=1e-12)
    np.testing.assert_array_equal(report.derivatives, wrinkles.encode(n))


def test_without_a_limit_steep_normals_come_back_too():
    angles = np.radians([46.0, 80.0, 89.999, 90.0 - 1e-9])
    n = np.stack([0 * angles, np.sin(angles), np.cos(angles)], axis=-1)
    report = wrinkles.encode_with_report(n, limit=None)
    assert report.clamped_fraction == 0.0
    assert report.valid.all()
    np.testing.assert_allclose(wrinkles.decode(report.derivatives), n, atol=1e-15)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_derivatives_whose_squares_overflow_still_decode(dtype):
    large = np.finfo(dtype).max / 4
    n = wrinkles.decode(np.array([[large, -large], [large, 0]], dtype))
    np.testing.assert_allclose(n, [[0.5**0.5, -(0.5**0.5), 0], [1, 0, 0]], atol=1e-6)


@pytest.mark.parametrize("limit", [1.0, None])
def test_unrepresentable_normals_are_masked_and_never_flat(limit):
    lost = [[0, 0, 0], [0.6, 0, -0.8], [1, 0, 0], [np.nan, 0, 1], [0, np.inf, 1], [0, 0, -1]]
    bare = wrinkles.encode(np.array([*lost, [0.0, 0.6, 0.8]]), limit=limit)
    assert np.isnan(bare[:6]).all()
    np.testing.assert_allclose(bare[6], [0.0, 0.75])
    assert not wrinkles.decode(bare[:6]).any()
    report = wrinkles.encode_with_report(np.array([*lost, [0.0, 0.6, 0.8]]), limit=limit)
    np.testing.assert_array_equal(report.valid, [False] * 6 + [True])
    assert not report.derivatives[:6].any()
    assert report.clamped_fraction == 0.0
    none_left = wrinkles.encode_with_report(np.array(lost), limit=limit)
    assert none_left.clamped_fraction == 0.0


def test_smallest_outward_component_is_clamped_not_lost():
    report = wrinkles.encode_with_report(np.array([1.0, -1.0, 5e-324]))
    assert report.valid
    np.testing.assert_array_equal(report.derivatives, [1.0, -1.0])
    assert not wrinkles.encode_with_report(np.array([1.0, -1.0, 5e-324]), limit=None).valid


def test_nonfinite_derivatives_decode_to_zero_vector():
    n = wrinkles.decode(np.array([[np.nan, 0], [np.inf, 0], [0.75, 0]]))
    np.testing.assert_allclose(n, [[0, 0, 0], [0, 0, 0], [0.6, 0, 0.8]], atol=1e-15)


def test_inputs_stay_as_they_were(rng):
    n, base = tilted(rng, (6, 6)), rng.uniform(-0.5, 0.5, (6, 6, 2))
    wrinkle, masks = rng.uniform(-0.5, 0.5, (3, 3, 2)), rng.random((8, 2, 2))
    before = [a.copy() for a in (n, base, wrinkle, masks)]
    wrinkles.encode(n)
    wrinkles.combine(base, wrinkle, masks, {"joy": 1.0})
    layer = wrinkles.WrinkleLayer(wrinkle, masks)
    wrinkles.combine_layers(base, [layer, layer], {"joy": 1.0})
    for a, b in zip((n, base, wrinkle, masks), before, strict=True):
        np.testing.assert_array_equal(a, b)


def test_texture_values_encode_signed_range_in_unit_range():
    d = np.array([-1.0, 0.0, 0.5, 1.0])
    np.testing.assert_allclose(wrinkles.to_unit(d), [0, 0.5, 0.75, 1])
    np.testing.assert_allclose(wrinkles.from_unit(wrinkles.to_unit(d)), d)
    np.testing.assert_allclose(wrinkles.from_unit(wrinkles.to_unit(4 * d, limit=4), limit=4), 4 * d)
    for beyond in (1.0001, np.nan):
        with pytest.raises(WrinkleError, match=r"derivatives \(of encode\): got"):
            wrinkles.to_unit(np.array([beyond]))


def test_table_has_six_published_expressions_over_eight_zones():
    assert tuple(JIMENEZ2011_TABLE.rows) == ("joy", "surprise", "fear", "anger", "disgust", "sad")
    assert JIMENEZ2011_TABLE.zones == (
        "red",
        "green",
        "blue",
        "brown",
        "cyan",
        "magenta",
        "orange",
        "gray",
    )
    sums = {name: round(sum(row), 9) for name, row in JIMENEZ2011_TABLE.rows.items()}
    assert sums == {
        "joy": 2.4,
        "surprise": 3.2,
        "fear": 3.1,
        "anger": -0.2,
        "disgust": 3.3,
        "sad": 3.0,
    }
    assert {row for row in ROW_OF_STATE.values() if row} == set(JIMENEZ2011_TABLE.rows)


@pytest.mark.parametrize("clamp", ["unit", "signed"])
def test_surprise_and_anger_leave_fifth_in_red_green(clamp):
    sums = clamp_sums(zone_sums({"surprise": 1.0, "anger": 1.0}), clamp)
    np.testing.assert_allclose(sums[:4], [0.2, 0.2, 0.0, 0.0], atol=1e-15)


def test_anger_forehead_vanishes_under_unit_flattens_under_signed():
    sums = zone_sums({"anger": 1.0})
    np.testing.assert_array_equal(clamp_sums(sums, "unit")[:4], 0.0)
    np.testing.assert_allclose(clamp_sums(sums, "signed")[:4], [-0.6, -0.6, -0.8, -0.8])
    base, wrinkle = np.full((4, 4, 2), 0.1), np.full((2, 2, 2), 0.5)
    masks = np.ones((8, 1, 1)) * np.isin(np.arange(8), list(FOREHEAD.values()))[:, None, None]
    neutral = wrinkles.decode(base)
    unit = wrinkles.combine(base, wrinkle, masks, {"anger": 1.0})
    np.testing.assert_allclose(unit, neutral, atol=1e-15)
    signed = wrinkles.combine(base, wrinkle, masks, {"anger": 1.0}, clamp="signed")
    np.testing.assert_allclose(wrinkles.encode(signed, limit=None), 0.1 - 2.8 * 0.5)


@pytest.mark.parametrize("clamp", ["unit", "signed"])
def test_zone_sum_is_clamped_after_all_blend_shapes(clamp):
    one_by_one = clamp_sums(zone_sums({"joy": 1}), clamp) + clamp_sums(
        zone_sums({"fear": 1}), clamp
    )
    together = clamp_sums(zone_sums({"joy": 1.0, "fear": 1.0, "sad": 1.0}), clamp)
    assert one_by_one.max() > 1.0
    assert together.max() == 1.0
    base, wrinkle, masks = np.zeros((2, 2, 2)), np.full((1, 1, 2), 0.5), np.zeros((8, 1, 1))
    masks[0] = 1.0
    n = wrinkles.combine(base, wrinkle, masks, {"joy": 3.0, "surprise": 2.0}, clamp=clamp)
    np.testing.assert_allclose(wrinkles.encode(n), 0.5)


def test_user_table_sums_any_number_of_blend_shapes():
    rng = np.random.default_rng(3)
    rows = {f"shape {i}": tuple(rng.uniform(-0.01, 0.02, 8)) for i in range(300)}
    weights = {name: float(w) for name, w in zip(rows, rng.random(300), strict=True)}
    expected = sum(weights[name] * np.array(rows[name]) for name in rows)
    np.testing.assert_allclose(zone_sums(weights, rows), expected, rtol=1e-12)


def test_unknown_expression_error_suggests_nearest_name():
    with pytest.raises(WrinkleError, match="did you mean 'surprise'"):
        zone_sums({"suprise": 1.0})


def test_nonfinite_weights_are_refused():
    with pytest.raises(WrinkleError, match="finite"):
        zone_sums({"joy": float("nan")})
    with pytest.raises(WrinkleError, match="finite"):
        zone_sums(np.array([0, 0, 0, 0, 0, 0, 0, np.inf]))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "expected expression"),
        ("name,a\nx,1\n", "expected expression"),
        ("expression,a\nx,1\nx,2\n", "each once"),
        ("expression,a\nx,one\n", "not a number"),
        ("expression,a,b\nx,1\n", "2 finite weights"),
        ("expression,a,a\nx,1,1\n", "names that differ"),
    ],
)
def test_a_broken_table_is_refused(text, says):
    with pytest.raises(WrinkleError, match=says):
        read_table(text)


@pytest.mark.parametrize(
    ("shape", "texels", "mask_texels"),
    [
        ((16, 16), (4, 4), (2, 2)),
        ((12, 9), (5, 7), (3, 2)),
        ((5, 6), (1, 1), (1, 3)),
        ((7, 7), (7, 7), (7, 7)),
    ],
)
def test_the_sum_is_listing_1_1_s(rng, shape, texels, mask_texels):
    base, wrinkle = rng.uniform(-0.5, 0.5, (*shape, 2)), rng.uniform(-0.5, 0.5, (*texels, 2))
    masks = rng.random((8, *mask_texels))
    weights = {"surprise": 0.7, "anger": 0.4, "sad": 0.9}
    expected = listing_1_1(base, wrinkle, masks, clamp_sums(zone_sums(weights)))
    got = wrinkles.combine(base, wrinkle, masks, weights)
    np.testing.assert_allclose(got, expected, atol=1e-14)
    single = wrinkles.combine(base.astype(np.float32), wrinkle, masks, weights)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, expected, atol=5e-7)


def test_masks_in_two_textures_are_same_eight_zones(rng):
    base, wrinkle = rng.uniform(-0.5, 0.5, (8, 8, 2)), rng.uniform(-0.5, 0.5, (4, 4, 2))
    masks = rng.random((8, 3, 5))
    expected = wrinkles.combine(base, wrinkle, masks, np.linspace(0, 1, 8))
    textures = wrinkles.mask_textures(masks)
    assert textures.shape == (2, 3, 5, 4)
    for given in (textures, list(textures), tuple(masks)):
        got = wrinkles.combine(base, wrinkle, given, np.linspace(0, 1, 8))
        np.testing.assert_array_equal(got, expected)


def test_layer_finer_than_base_is_averaged_without_aliasing():
    base = np.zeros((4, 4, 2))
    ripple = np.zeros((64, 64, 2))
    ripple[:, ::2] = 0.5  # a period of two texels: its mean is all that a coarse base can show
    n = wrinkles.combine(base, ripple, np.ones((1, 1, 1)), np.ones(1))
    np.testing.assert_allclose(wrinkles.encode(n), 0.25, atol=1e-12)


def test_wrinkle_maps_add_and_lemon_pose_flattens_neutral(rng):
    base = rng.uniform(-0.4, 0.4, (8, 8, 2))
    first = wrinkles.WrinkleLayer(rng.uniform(-0.4, 0.4, (4, 4, 2)), rng.random((8, 2, 2)))
    rows = dict.fromkeys(JIMENEZ2011_TABLE.rows, (0.0,)) | {"lemon": (1.0,)}
    lemon = wrinkles.WrinkleLayer(-base, np.ones((1, 1, 1)), ExpressionTable(("all",), rows))
    both = {"lemon": 1.0, "joy": 0.5}
    with pytest.raises(WrinkleError, match="'lemon'"):
        wrinkles.combine_layers(base, [first, lemon], both)
    first = wrinkles.WrinkleLayer(
        first.wrinkle, first.masks, {**JIMENEZ2011_TABLE.rows, "lemon": (0.0,) * 8}
    )
    flat = wrinkles.combine_layers(base, [first, lemon], {"lemon": 1.0})
    np.testing.assert_allclose(flat, np.broadcast_to([0, 0, 1.0], flat.shape), atol=1e-15)
    got = wrinkles.combine_layers(base, [first, lemon], both)
    alone = wrinkles.combine(np.zeros_like(base), first.wrinkle, first.masks, {"joy": 0.5})
    np.testing.assert_allclose(got, alone, atol=1e-14)


def test_no_layer_leaves_the_base(rng):
    base = rng.uniform(-0.5, 0.5, (3, 4, 2))
    np.testing.assert_array_equal(wrinkles.combine_layers(base, [], {}), wrinkles.decode(base))


def test_base_hole_is_zero_normal_and_spares_neighbors(rng):
    base = rng.uniform(-0.5, 0.5, (4, 4, 2))
    base[1, 2] = np.nan
    n = wrinkles.combine(base, np.full((2, 2, 2), 0.1), np.ones((8, 2, 2)), {"joy": 1.0})
    lengths = np.linalg.norm(n, axis=2)
    assert lengths[1, 2] == 0.0
    lengths[1, 2] = 1.0
    np.testing.assert_allclose(lengths, 1.0, rtol=1e-14)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"base": np.zeros((4, 4, 4))}, r"base: got shape \(4, 4, 4\), expected \(..., H, W, 2\)"),
        ({"base": np.zeros((4, 2))}, "base: got shape"),
        ({"base": np.zeros((3, 4, 4, 2)), "wrinkle": np.zeros((2, 2, 2, 2))}, "leading axes"),
        ({"wrinkle": -np.ones((2, 2, 3))}, "wrinkle: got NaN.*n_z > 0"),
        ({"wrinkle": np.full((2, 2, 2), np.nan)}, "wrinkle: got NaN"),
        ({"masks": np.full((8, 2, 2), np.nan)}, "masks: got nan"),
        ({"masks": np.ones((7, 2, 2))}, r"masks: got shape \(7, 2, 2\), expected \(8, h, w\)"),
        ({"masks": np.ones((9, 7, 8))}, r"\(9, 7, 8\), expected \(8, h, w\).*zones come first"),
        ({"masks": np.ones((2, 2))}, "masks: got shape"),
        ({"weights": np.ones(7)}, "of the 7 zones"),
        ({"weights": np.ones((8, 2))}, r"weights \(blend shapes by name, or by zone\): got"),
        ({"clamp": "tight"}, "clamp: got 'tight'"),
    ],
)
def test_mismatched_wrinkle_input_is_refused(change, says):
    given = {
        "base": np.zeros((4, 4, 2)),
        "wrinkle": np.zeros((2, 2, 2)),
        "masks": np.ones((8, 2, 2)),
        "weights": {"joy": 1.0},
    }
    with pytest.raises(WrinkleError, match=says):
        wrinkles.combine(**(given | change))


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_normals_combine_as_their_derivatives(rng, kind):
    base, fold = tilted(rng, (6, 5)).astype(kind), tilted(rng, (4, 4)).astype(kind)
    base[1, 2] = (0.0, 0.0, -1.0)
    masks, weights = rng.random((8, 3, 3)), {"joy": 0.4, "anger": 0.9}
    wanted = wrinkles.combine(
        wrinkles.encode(base, limit=None), wrinkles.encode(fold, limit=None), masks, weights
    )
    found = wrinkles.combine(base, fold, masks, weights)
    assert found.dtype == kind
    np.testing.assert_array_equal(found, wanted)
    lengths = np.linalg.norm(found, axis=-1)
    assert lengths[1, 2] == 0.0
    lengths[1, 2] = 1.0
    np.testing.assert_allclose(lengths, 1.0, rtol=1e-6)


def test_leading_axes_of_base_and_wrinkle_broadcast(rng):
    base, fold = rng.uniform(-0.5, 0.5, (2, 1, 6, 5, 2)), rng.uniform(-0.5, 0.5, (3, 4, 4, 2))
    masks, weights = rng.random((8, 3, 3)), {"joy": 0.4, "anger": 0.9}
    found = wrinkles.combine(base, fold, masks, weights)
    assert found.shape == (2, 3, 6, 5, 3)
    for i, j in np.ndindex(2, 3):
        one = wrinkles.combine(base[i, 0], fold[j], masks, weights)
        np.testing.assert_array_equal(found[i, j], one)
    assert wrinkles.combine(base[:0], fold, masks, weights).shape == (0, 3, 6, 5, 3)


def test_averaging_and_reading_keep_texture_mean(rng):
    texture = rng.random((9, 14))
    for shape in ((3, 7), (4, 5), (1, 1)):
        small = texture_resampling.resample(texture, shape)
        assert small.mean() == pytest.approx(texture.mean(), rel=1e-12)
    flat = np.full((3, 4), 0.7)
    np.testing.assert_allclose(texture_resampling.resample(flat, (11, 2)), 0.7)
