"""A textured ball in front of four cameras, moved by known amounts, found again."""

import numpy as np
import pytest

from reconstruction.registration import head_motion
from reconstruction.registration.head_motion import HeadMotionError, rotation_matrix
from reconstruction.registration.rigid_frames import find_rigid_frames

RADIUS_MM = 80.0
WIDTH, HEIGHT, FOCAL_PX = 160, 150, 500.0
LIGHTS = np.array([[0.5, 0.6, 0.62], [-0.7, 0.3, 0.65], [0.1, -0.6, 0.79]])


class Pinhole:
    """A camera at ``center_mm`` that looks at the origin."""

    def __init__(self, center_mm):
        self.center_mm = np.asarray(center_mm, float)
        back = self.center_mm / np.linalg.norm(self.center_mm)
        right = np.cross([0.0, 1.0, 0.0], back)
        right /= np.linalg.norm(right)
        self.axes = np.stack([right, np.cross(back, right), back])

    def project(self, points_mm):
        local = (np.asarray(points_mm) - self.center_mm) @ self.axes.T
        depth = -local[:, 2]
        x = (WIDTH - 1) / 2 + FOCAL_PX * local[:, 0] / depth
        return np.stack([x, (HEIGHT - 1) / 2 - FOCAL_PX * local[:, 1] / depth], axis=-1)

    def rays(self):
        row, column = np.mgrid[0:HEIGHT, 0:WIDTH]
        local = np.stack(
            [
                (column - (WIDTH - 1) / 2) / FOCAL_PX,
                ((HEIGHT - 1) / 2 - row) / FOCAL_PX,
                np.full(row.shape, -1.0),
            ],
            axis=-1,
        )
        towards = local @ self.axes
        return towards / np.linalg.norm(towards, axis=-1, keepdims=True)


WAVES = np.random.default_rng(8).standard_normal((24, 3)) * 0.35
PHASES = np.random.default_rng(9).uniform(0, 6.28, 24)


def texture(points_mm):
    return 0.5 + 0.25 * np.tanh(np.sin(points_mm @ WAVES.T + PHASES).sum(-1) / 2.5)


def picture(camera, R, t, twitch=0.0, noise=0.003, rng=None):
    """Render the ball, moved by R and t; a twitch slides the texture of its lower part."""
    rays = camera.rays()
    from_center = camera.center_mm - t
    b = rays @ from_center
    root = b * b - (from_center @ from_center - RADIUS_MM**2)
    hit = root > 0
    depth = -b - np.sqrt(np.where(hit, root, 0.0))
    n = (camera.center_mm + depth[..., None] * rays - t) / RADIUS_MM
    own = RADIUS_MM * (n @ R)
    slide = twitch * np.exp(-((own[..., 1] + 30.0) ** 2) / 30.0**2)
    own = own + slide[..., None] * np.array([0.0, 1.0, 0.0])
    shade = np.maximum(n @ LIGHTS.T, 0.0).sum(-1)
    image = np.where(hit, texture(own) * shade, 0.0)
    return image + noise * rng.standard_normal(image.shape)


def ball_points(count=4000):
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    phi = np.pi * (1 + np.sqrt(5.0)) * k
    r = np.sqrt(1 - z * z)
    n = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)
    return RADIUS_MM * n, n


CAMERAS = [Pinhole(c) for c in ([0, 60, 640], [420, 0, 480], [-420, 300, 400])]


def capture(rng, motions, twitches=None, **options):
    twitches = twitches or [0.0] * len(motions)
    return [
        [picture(c, rotation_matrix(m[:3]), m[3:], twitch, rng=rng, **options) for c in CAMERAS]
        for m, twitch in zip(motions, twitches, strict=True)
    ]


def drift(rng, count, most_mm, most_deg):
    """Return rotation vectors and translations (count, 6) that begin at 0."""
    out = np.zeros((count, 6))
    for k in range(1, count):
        axis, way = rng.standard_normal(3), rng.standard_normal(3)
        amount = k / (count - 1)
        out[k, :3] = np.radians(most_deg) * amount * axis / np.linalg.norm(axis)
        out[k, 3:] = most_mm * amount * way / np.linalg.norm(way)
    return out


def errors_mm(found, motions):
    """Return how far the estimate puts the ball's points from where they were, (T,)."""
    points, _ = ball_points(300)
    out = []
    for k, m in enumerate(motions):
        truth = points @ rotation_matrix(m[:3]).T + m[3:]
        ours = points @ rotation_matrix(found.rotation_rad[k]).T + found.translation_mm[k]
        out.append(np.sqrt(np.mean(np.sum((truth - ours) ** 2, axis=1))))
    return np.array(out)


@pytest.mark.parametrize("most_mm", [0.3, 3.0])
def test_drifting_head_is_tracked_within_fraction_of_pixel(most_mm, rng, caplog):
    motions = drift(rng, 5, most_mm, most_mm / 3)
    points, normals = ball_points()
    found = head_motion.estimate(capture(rng, motions), CAMERAS, points, normals, np.arange(5.0))
    # a pixel is 1.2 mm at the ball; some 250 tracks of 0.1 px
    assert found.usable.all()
    assert caplog.records == []
    assert errors_mm(found, motions).max() < 0.06
    assert np.array_equal(found.rotation_rad[0], np.zeros(3))
    moved = found.displacement_mm(points)
    assert moved[-1] == pytest.approx(errors_of_rest(motions)[-1], rel=0.25)


def errors_of_rest(motions):
    """Return how far the points moved in truth, (T,)."""

    class Rest:
        rotation_rad = np.zeros((len(motions), 3))
        translation_mm = np.zeros((len(motions), 3))

    return errors_mm(Rest, motions)


def test_standard_errors_have_the_size_of_the_errors(rng):
    motions = np.concatenate([np.zeros((1, 6)), drift(rng, 2, 1.0, 0.3)[1:].repeat(7, axis=0)])
    points, normals = ball_points()
    found = head_motion.estimate(
        capture(rng, motions, noise=0.02), CAMERAS, points, normals, np.arange(8.0)
    )
    difference = np.concatenate([found.rotation_rad, found.translation_mm], axis=1) - motions
    # the reference frame's noise is common to all and not in the errors: a factor of 1.4 at least
    ratio = np.sqrt(np.mean((difference[1:] / found.stderr[1:]) ** 2))
    assert 0.5 < ratio < 2.5


def test_twitch_is_not_head_motion_and_frame_unusable(rng, caplog):
    motions = drift(rng, 7, 1.0, 0.3)
    twitches = [0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0]
    points, normals = ball_points()
    found = head_motion.estimate(
        capture(rng, motions, twitches), CAMERAS, points, normals, np.arange(7.0)
    )
    assert found.usable.tolist() == [True, True, True, False, True, True, True]
    assert caplog.records == []  # an unusable frame's search needs no warning
    assert found.is_covered([0.5, 2.5, 3.5, 4.5, 4.0, 9.0]).tolist() == [
        True,
        False,
        False,
        True,
        True,
        False,
    ]
    turn, shift = found.interpolate([3.0])
    np.testing.assert_allclose(
        shift[0], (found.translation_mm[2] + found.translation_mm[4]) / 2, atol=1e-12
    )
    np.testing.assert_allclose(
        turn[0], (found.rotation_rad[2] + found.rotation_rad[4]) / 2, atol=1e-12
    )


def test_dark_frames_are_compared_with_dark_frames():
    rng = np.random.default_rng(1)
    motions = drift(rng, 12, 1.0, 0.3)
    dark, twitch = np.arange(12) >= 7, np.where(np.arange(12) == 9, 4.0, 0.0)
    frames = [
        capture(rng, [motion], [slide], noise=0.2 if noisy else 0.003)[0]
        for motion, slide, noisy in zip(motions, twitch, dark, strict=True)
    ]
    points, normals = ball_points()
    given = (frames, CAMERAS, points, normals, np.arange(12.0))
    found = head_motion.estimate(*given, light=np.where(dark, 1.0, 100.0))
    assert np.flatnonzero(~found.usable).tolist() == [9]
    # with one light for all, noise passes for an expression
    assert np.flatnonzero(~head_motion.estimate(*given).usable).tolist() == [7, 8, 9, 10, 11]
    with pytest.raises(HeadMotionError, match="light"):
        head_motion.estimate(*given, light=0.0)


def test_matrices_take_points_to_where_they_were():
    motion = head_motion.HeadMotion(
        times_s=np.array([0.0, 1.0]),
        rotation_rad=np.array([[0, 0, 0], [0, 0, 0.2]]),
        translation_mm=np.array([[0, 0, 0], [2.0, 0, 0]]),
        stderr=np.zeros((2, 6)),
        usable=np.ones(2, bool),
        residual_px=np.zeros(2),
        tracks=np.zeros(2, np.intp),
    )
    half = motion.matrices([0.5])[0]
    np.testing.assert_allclose(
        half @ [10.0, 0, 0, 1], [10 * np.cos(0.1) + 1, 10 * np.sin(0.1), 0, 1]
    )


def test_unfinished_search_of_usable_frame_warns_once(rng, caplog):
    points, normals = ball_points()
    frames = capture(rng, drift(rng, 3, 3.0, 1.0))
    head_motion.estimate(frames, CAMERAS, points, normals, np.arange(3.0), iterations=1)
    assert ["head motion" in record.getMessage() for record in caplog.records] == [True]


def test_black_frame_is_unusable_and_gives_no_nan(rng):
    motions = drift(rng, 4, 0.5, 0.1)
    frames = capture(rng, motions)
    frames[2] = [np.zeros((HEIGHT, WIDTH)) for _ in CAMERAS]
    points, normals = ball_points()
    found = head_motion.estimate(frames, CAMERAS, points, normals, np.arange(4.0))
    assert found.usable.tolist() == [True, True, False, True]
    assert np.isfinite(found.rotation_rad).all()
    assert not np.isnan(found.stderr).any()


def test_frames_without_motion_cues_are_refused_by_name(rng):
    points, normals = ball_points(500)
    frames = [[np.ones((HEIGHT, WIDTH)) for _ in CAMERAS]] * 2
    with pytest.raises(HeadMotionError, match="texture"):
        head_motion.estimate(frames, CAMERAS, points, normals, [0.0, 1.0])
    with pytest.raises(HeadMotionError, match="times_s"):
        head_motion.estimate(frames, CAMERAS, points, normals, [1.0, 0.0])
    with pytest.raises(HeadMotionError, match="frames"):
        head_motion.estimate(frames, CAMERAS[:2], points, normals, [0.0, 1.0])
    with pytest.raises(HeadMotionError, match="normals"):
        head_motion.estimate(frames, CAMERAS, points, normals[:5], [0.0, 1.0])
    with pytest.raises(HeadMotionError, match="reference"):
        head_motion.estimate(frames, CAMERAS, points, normals, [0.0, 1.0], reference=2)


@pytest.mark.parametrize("noise_px", [0.3, 0.5])
def test_dark_rigid_frames_keep_their_worst_part(noise_px, rng):
    points = rng.uniform(-60.0, 60.0, (600, 3)) * [1.0, 1.0, 0.1]
    dark = np.arange(12) >= 7
    scale = np.where(dark, noise_px, 0.02)
    residual = np.linalg.norm(scale[:, None, None] * rng.standard_normal((12, 600, 2)), axis=-1)
    residual[0] = 0.0
    residual[[3, 9], :60] += 6.0 * noise_px + 2.0  # expressions in a bright and a dark frame
    known, light = np.ones(12, bool), np.where(dark, 1.0, 4.0)
    found = find_rigid_frames(residual, points, known, light, 0)
    assert np.flatnonzero(~found).tolist() == [3, 9]
    one_light = find_rigid_frames(residual, points, known, np.ones(12), 0)
    assert np.flatnonzero(~one_light).tolist() != [3, 9]
