"""Pictures of expressions are laid over neutral ones, and say how far off they may be."""

import cv2
import numpy as np
import pytest
from twins.alignments import place_stderr

from model.skin import SkinMap
from reconstruction.correspondence import expression_alignment as alignment
from reconstruction.correspondence import landmark_field, landmark_table

SIDE = 96


def skin(rng, side=SIDE):
    """A texture of spots, positive."""
    noise = rng.standard_normal((side, side)).astype(np.float32)
    fine, coarse = cv2.GaussianBlur(noise, (0, 0), 1.5), cv2.GaussianBlur(noise, (0, 0), 6.0)
    return np.exp(0.1 * fine / fine.std() + 0.2 * coarse / coarse.std()).astype(np.float64)


def marks(shift=(0.0, 0.0), side=SIDE, step=24):
    at = np.arange(step // 2, side, step, dtype=float)
    return {f"{x:g} {y:g}": (x + shift[0], y + shift[1]) for x in at for y in at}


def identity(shape=(SIDE, SIDE)):
    x, y = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    return np.stack([x, y], axis=-1).astype(np.float32)


def alignment_of(source, valid=None, error=0.0, moving_shape=None):
    shape = source.shape[:2]
    return alignment.Alignment(
        source_px=source.astype(np.float32),
        valid=np.ones(shape, bool) if valid is None else valid,
        error_px=np.full(shape, error, np.float32),
        residual_px=np.zeros(shape, np.float32),
        followed=np.ones(shape, bool),
        landmark_rms_px=0.0,
        leave_one_out_px={},
        folded_fraction=0.0,
        by="landmarks",
        moving_shape=shape if moving_shape is None else moving_shape,
    )


def test_image_shifted_right_is_found_shifted_right(rng):
    picture = skin(rng)
    found = alignment.align(
        np.roll(picture, (2, 5), (0, 1)),
        picture,
        landmarks_moving=marks((5.0, 2.0)),
        landmarks_neutral=marks(),
    )
    inner = (slice(12, -12),) * 2
    gap = (found.source_px - identity())[inner]
    assert np.sqrt(((gap - [5.0, 2.0]) ** 2).sum(-1).mean()) < 0.1
    assert found.valid[inner].all()
    assert found.by == "landmarks"


def test_landmarks_few_pixels_off_are_corrected_by_flow(rng):
    picture = skin(rng)
    off = {name: (x + 2.0, y - 1.5) for name, (x, y) in marks((4.0, 0.0)).items()}
    found = alignment.align(
        np.roll(picture, 4, 1),
        picture,
        landmarks_moving=off,
        landmarks_neutral=marks(),
        landmark_stderr_px=2.0,
    )
    gap = (found.source_px - identity())[16:-16, 16:-16] - [4.0, 0.0]
    assert np.sqrt((gap**2).sum(-1).mean()) < 0.2
    # what the landmarks alone would have left
    assert found.landmark_rms_px > 2.0


def test_light_that_changes_over_the_face_moves_nothing(rng):
    picture = skin(rng)
    light = np.exp(np.linspace(-0.5, 0.5, SIDE))[None, :]
    found = alignment.align(
        picture * light, picture, landmarks_moving=marks(), landmarks_neutral=marks()
    )
    gap = np.linalg.norm(found.source_px - identity(), axis=-1)[10:-10, 10:-10]
    assert np.percentile(gap, 95) < 0.15


def test_missing_landmarks_use_feature_matches_and_report_this(rng):
    picture = skin(rng, 160)
    found = alignment.align(np.roll(picture, (3, 6), (0, 1)), picture)
    assert found.by == "features"
    gap = (found.source_px - identity((160, 160)))[20:-20, 20:-20] - [6.0, 3.0]
    assert np.percentile(np.linalg.norm(gap, axis=-1), 95) < 0.1


def test_images_of_different_skin_have_no_common_features(rng):
    with pytest.raises(alignment.AlignmentError, match="give landmarks"):
        alignment.align(skin(rng), skin(rng))


def test_crossing_landmarks_fold_the_map_and_invalidate(rng):
    picture = np.ones((SIDE, SIDE)) + 1e-6 * rng.standard_normal((SIDE, SIDE))
    neutral = marks()
    crossed = dict(neutral)
    left, right = "36 60", "60 60"
    crossed[left], crossed[right] = neutral[right], neutral[left]
    found = alignment.align(
        picture,
        picture,
        landmarks_moving=crossed,
        landmarks_neutral=neutral,
        landmark_stderr_px=0.05,
        max_error_px=100.0,
    )
    assert found.folded_fraction > 0.01
    assert not found.valid[60, 44:52].any()
    straight = alignment.align(
        picture,
        picture,
        landmarks_moving=neutral,
        landmarks_neutral=neutral,
        landmark_stderr_px=0.05,
        max_error_px=100.0,
    )
    assert straight.folded_fraction == 0.0


def test_skin_hidden_in_moving_image_is_invalid(rng):
    picture = skin(rng)
    hidden = np.ones((SIDE, SIDE), bool)
    hidden[40:60, 40:60] = False
    found = alignment.align(
        picture, picture, landmarks_moving=marks(), landmarks_neutral=marks(), valid_moving=hidden
    )
    assert not found.valid[42:58, 42:58].any()
    assert found.valid[15:35, 15:80].all()


def test_positions_beyond_moving_image_are_invalid(rng):
    picture = skin(rng)
    found = alignment.align(
        picture[:, :70],
        picture,
        landmarks_moving={k: v for k, v in marks().items() if v[0] < 65},
        landmarks_neutral=marks(),
    )
    assert not found.valid[:, 71:].any()
    assert found.valid[12:-12, 12:58].all()


def test_map_is_warped_from_source_with_its_mask():
    values = np.arange(30, dtype=np.float32).reshape(5, 6)
    valid = np.ones((5, 6), bool)
    valid[2, 4] = False
    source = identity((5, 6)) + np.array([1.0, 0.0], np.float32)
    inside = source[..., 0] <= 5
    moved, seen = alignment_of(source, inside).warp(np.where(valid, values, np.nan), valid)
    assert moved.dtype == np.float32
    np.testing.assert_array_equal(seen[:, :5], valid[:, 1:])
    np.testing.assert_allclose(moved[:, :5][seen[:, :5]], values[:, 1:][valid[:, 1:]], atol=1e-5)
    assert not moved[~seen].any()


def test_pixel_between_valid_and_masked_is_masked():
    valid = np.ones((8, 8), bool)
    valid[4, 4] = False
    source = identity((8, 8)) + np.array([0.5, 0.0], np.float32)
    _, seen = alignment_of(source).warp(np.ones((8, 8)), valid)
    assert not seen[4, 3]
    assert not seen[4, 4]
    assert seen[4, 2]


def test_half_pixel_shift_preserves_contrast_better_than_averaging(rng):
    texture = cv2.GaussianBlur(rng.standard_normal((64, 64)), (0, 0), 1.2)
    source = identity((64, 64)) + np.float32(0.5)
    warped, _ = alignment_of(source).warp(texture)
    inner = (slice(8, -8),) * 2
    averaged = cv2.blur(texture, (2, 2))
    kept, lost = warped[inner].std() / texture[inner].std(), averaged.std() / texture.std()
    assert kept > 0.95
    assert kept > lost + 0.05


def test_color_maps_and_single_maps_are_warped_alike(rng):
    values = rng.random((20, 20, 3)).astype(np.float32)
    source = identity((20, 20)) + np.float32(0.3)
    found = alignment_of(source)
    together, seen = found.warp(values)
    assert together.shape == (20, 20, 3)
    for k in range(3):
        alone, seen_alone = found.warp(values[..., k])
        np.testing.assert_array_equal(alone, together[..., k])
        np.testing.assert_array_equal(seen, seen_alone)


def test_warped_map_error_grows_with_slope_and_misplacement():
    ramp = np.broadcast_to(0.5 * np.arange(40.0), (40, 40))
    noise = np.full((40, 40), 0.3)
    still = alignment_of(identity((40, 40))).warp_stderr(ramp, noise)
    moved = alignment_of(identity((40, 40)), error=2.0).warp_stderr(ramp, noise)
    inner = (slice(10, -10),) * 2
    np.testing.assert_allclose(still[inner], 0.3, rtol=1e-5)
    # 2 px are the distance: sqrt(2) along the slope of 0.5 a px
    np.testing.assert_allclose(moved[inner], np.hypot(0.3, 0.5 * np.sqrt(2.0)), rtol=1e-3)


def test_position_error_is_that_of_neutral_image_slope():
    ramp = np.broadcast_to(0.5 * np.arange(40.0), (40, 40))
    found = alignment_of(identity((40, 40)), error=2.0)
    stderr = place_stderr(found, ramp)
    np.testing.assert_allclose(stderr[10:-10, 10:-10], 0.5 * np.sqrt(2.0), rtol=1e-3)
    masked = place_stderr(found, np.where(np.eye(40) > 0, np.nan, ramp))
    assert np.isfinite(masked).all()
    assert not masked[np.eye(40) > 0].any()
    noise = np.full((40, 40), 0.3)
    own = found.warp_map(SkinMap(ramp, "1", noise))
    np.testing.assert_allclose(own.stderr, 0.3, rtol=1e-5)
    whole = found.warp_stderr(ramp, noise)[10:-10, 10:-10]
    np.testing.assert_allclose(whole**2, 0.09 + stderr[10:-10, 10:-10] ** 2, rtol=1e-3)


def test_skin_map_keeps_unit_and_gets_mask():
    mapped = SkinMap(np.ones((8, 8)), "mm", np.full((8, 8), 0.1), np.eye(8) < 1)
    warped = alignment_of(identity((8, 8))).warp_map(mapped)
    assert warped.unit == "mm"
    np.testing.assert_array_equal(warped.valid, mapped.valid)
    np.testing.assert_allclose(warped.stderr[mapped.valid], 0.1, rtol=1e-6)


def test_inputs_stay_as_they_were(rng):
    picture = skin(rng)
    before = picture.copy()
    alignment.align(picture, picture, landmarks_moving=marks(), landmarks_neutral=marks())
    np.testing.assert_array_equal(picture, before)


def test_arguments_that_do_not_fit_are_named(rng):
    picture = skin(rng, 40)
    cases = (
        ({"landmarks_moving": marks(side=40)}, "landmarks_neutral: got None"),
        (
            {"landmarks_moving": {"a": (1.0, 2.0)}, "landmarks_neutral": {"a": (1.0, 2.0)}},
            "1 names in both images, expected at least 4",
        ),
        ({"valid_moving": np.ones((3, 3), bool)}, "valid_moving: got shape"),
        ({"valid_neutral": np.zeros((40, 40), bool)}, "neutral: got no valid pixel"),
    )
    for given, message in cases:
        with pytest.raises(alignment.AlignmentError, match=message):
            alignment.align(picture, picture, **given)
    with pytest.raises(alignment.AlignmentError, match="moving: got shape"):
        alignment.align(picture[:8, :8], picture)
    with pytest.raises(alignment.AlignmentError, match="values: got shape"):
        alignment_of(identity()).warp(np.ones((3, 3)))


def test_collinear_or_nonfinite_landmarks_are_refused():
    line = np.stack([np.arange(6.0), 2 * np.arange(6.0)], axis=1)
    with pytest.raises(landmark_field.LandmarkFieldError, match="on one line"):
        landmark_field.fit_landmark_field(line, line, stderr_px=1.0)
    with pytest.raises(landmark_field.LandmarkFieldError, match="on one line"):
        landmark_field.fit_landmark_field(np.ones((6, 2)), np.ones((6, 2)), stderr_px=1.0)
    square = np.array([[0, 0], [0, 9], [9, 0], [9, 9.0]])
    with pytest.raises(landmark_field.LandmarkFieldError, match="landmarks: got"):
        landmark_field.fit_landmark_field(
            square, np.where(square > 5, np.nan, square), stderr_px=1.0
        )
    with pytest.raises(landmark_field.LandmarkFieldError, match="stderr_px"):
        landmark_field.fit_landmark_field(square, square, stderr_px=0.0)


def test_affine_motion_is_exact_and_smoothed_under_noise(rng):
    points = rng.uniform(0, 200, (30, 2))
    turn = np.array([[1.02, 0.05], [-0.04, 0.97]])
    noisy = points @ turn + 3.0 + rng.normal(0.0, 1.0, points.shape)
    exact = landmark_field.fit_landmark_field(points, points @ turn + 3.0, stderr_px=1.0)
    to = rng.uniform(0, 200, (50, 2))
    np.testing.assert_allclose(exact.evaluate(to)[0], to @ turn + 3.0 - to, atol=1e-3)
    found, error = landmark_field.fit_landmark_field(points, noisy, stderr_px=1.0).evaluate(to)
    gap = found - (to @ turn + 3.0 - to)
    # through the points it would be off by the landmarks' own noise and more
    assert np.sqrt((gap**2).mean()) < 0.8
    assert np.sqrt(((gap / error[:, None]) ** 2).mean()) < 2.0


def test_misplaced_landmark_is_identified_by_others(rng):
    points = rng.uniform(0, 200, (25, 2))
    moved = points + 4.0
    moved[7] += [15.0, 0.0]
    found = landmark_field.fit_landmark_field(points, moved, stderr_px=1.0)
    assert int(np.argmax(found.leave_one_out_px)) == 7


def test_grid_field_equals_field_at_points(rng):
    points = rng.uniform(0, 60, (12, 2))
    field = landmark_field.fit_landmark_field(
        points, points + rng.normal(0, 3, points.shape), stderr_px=0.5
    )
    moved, error = field.evaluate_grid((61, 57))
    at, stderr = field.evaluate([[20.0, 33.0]])
    np.testing.assert_allclose(moved[33, 20], at[0], atol=0.1)
    np.testing.assert_allclose(error[33, 20], stderr[0], rtol=0.1)


def test_landmark_table_faults_name_line_and_column(tmp_path):
    path = tmp_path / "landmarks.csv"
    path.write_text('# somebody\nname,x,y\n\nnose tip, 10.5 ,20\n"chin, low",1,-2\n')
    assert landmark_table.read_landmark_table(path) == {
        "nose tip": (10.5, 20.0),
        "chin, low": (1.0, -2.0),
    }
    cases = (
        ("", "is empty"),
        ("label,x,y\n", "line 1: got columns"),
        ("name,x,y\na,1,2\nb,one,2\n", "line 3, column x: got 'one'"),
        ("name,x,y\na,1,inf\n", "line 2, column y: got 'inf'"),
        ("name,x,y\na,1,2\n# b\na,3,4\n", "line 4, column name: got 'a' twice, .* line 2"),
        ("name,x,y\na,1,2,3\n", "line 2: got 4 cells"),
        ("name,x,y\n,1,2\n", "line 2, column name"),
    )
    for text, message in cases:
        path.write_text(text)
        with pytest.raises(landmark_table.LandmarkError, match=message):
            landmark_table.read_landmark_table(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(landmark_table.LandmarkError, match="UTF-8"):
        landmark_table.read_landmark_table(path)
