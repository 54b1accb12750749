"""The head followed through tracking frames of a patterned ball whose motion is known."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.calibration.geometry.intrinsics import CameraPose
from capture.raw import RawFrame
from capture.rig import load_rig
from reconstruction.pipeline.dome.images import DomeImage
from reconstruction.pipeline.dome.motion import HalfResolutionCamera, follow_head
from reconstruction.pipeline.inputs import InputsError

RADIUS_MM = 70.0
RIG = load_rig("dome")
VIEWS = sorted(RIG.views, key=lambda view: -view.position_mm[2])[:3]
RIG = RIG.subset(views=[view.name for view in VIEWS]).resized(360)
CAMERAS = [CameraPose.nominal(view) for view in RIG.views]
PIXEL_MM = 2.0 * np.median([np.linalg.norm(c.center_mm) / c.matrix[0, 0] for c in CAMERAS])
WAVES = np.random.default_rng(5).normal(0.0, 0.3, (12, 3))
PHASES = np.random.default_rng(6).uniform(0.0, 2 * np.pi, 12)
TIMES_S = (0.0, 5.0, 10.0, 15.0, 20.0)
FAR = (1.5, 0.4)
"""Drift in mm and turn in degrees over the time of the tracking frames."""
CAPTURES_S = np.linspace(0.5, 19.5, 20)


def way(t_s, drift_mm, turn_deg):
    """Where the ball is: turned about an axis of its own and shifted, both evenly in time."""
    share = t_s / TIMES_S[-1]
    rotation = Rotation.from_rotvec(np.radians(turn_deg) * share * np.array([0.0, 0.8, 0.6]))
    return rotation.as_matrix(), drift_mm * share * np.array([0.8, 0.6, 0.0])


def photograph(view, rotation, shift_mm):
    """Return the ball's pattern in an image of one pixel for each 2 x 2 cell, 0 to 1."""
    right, up, back = (np.array(axis) for axis in view.axes)
    column, row = np.meshgrid(
        2 * np.arange(view.width_px // 2) + 0.5, 2 * np.arange(view.height_px // 2) + 0.5
    )
    x = (column - (view.width_px - 1) / 2) / view.focal_px
    y = (row - (view.height_px - 1) / 2) / view.focal_px
    ray = x[..., None] * right - y[..., None] * up - back
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    start = np.array(view.position_mm) - shift_mm
    b, c = ray @ start, start @ start - RADIUS_MM**2
    hit = b * b > c
    place = start + (-b - np.sqrt(np.where(hit, b * b - c, 0.0)))[..., None] * ray
    pattern = np.sin(place @ rotation @ WAVES.T + PHASES).mean(axis=-1)
    return np.where(hit, 0.4 + 0.5 * pattern, 0.0)


class Shots:
    """A session that holds tracking frames and nothing else."""

    id = "ball"
    path = "session-ball"

    def __init__(self, drift_mm=0.0, turn_deg=0.0, *, levels=(1.0,), times_s=TIMES_S, lacks=None):
        self._frames = {}
        self._records = []
        for k, t_s in enumerate(times_s):
            level = levels[k % len(levels)]
            for view in RIG.views:
                if lacks == (k, view.name):
                    continue
                image = photograph(view, *way(t_s, drift_mm, turn_deg))
                name = f"T{k}-{view.name}"
                cfa = np.kron(160 + 3000 * level * image, np.ones((2, 2)))
                self._frames[name] = np.rint(cfa).astype(np.uint16)
                self._records.append(
                    SimpleNamespace(
                        file=name,
                        step_id=f"T{k}",
                        camera=view.name,
                        settings={"level": level},
                        line=SimpleNamespace(t_box_s=t_s),
                    )
                )

    def frames(self, kind):
        return self._records if kind == "tracking" else []

    def read(self, record):
        return RawFrame(
            cfa=self._frames[record.file],
            pattern="RGGB",
            black=(160.0,) * 4,
            white=4095,
            noise_profile=(1e-4, 1e-7),
            exposure_s=0.1,
        )


IMAGES = SimpleNamespace(
    views=tuple(view.name for view in RIG.views),
    captures=tuple((f"L{k:03d}", 0) for k in range(len(CAPTURES_S))),
    times_s=lambda _view, light, _exposure: (CAPTURES_S[int(light[1:])],),
)
SURFACE = Rotation.random(8000, random_state=3).as_matrix()[:, :, 2]
SURFACE = SimpleNamespace(
    points_mm=(RADIUS_MM * SURFACE).astype(np.float32), normals=SURFACE.astype(np.float32)
)


def follow(session):
    return follow_head(session, IMAGES, CAMERAS, SURFACE, PIXEL_MM)


def test_half_resolution_cameras_project_to_full_image_positions():
    points = SURFACE.points_mm[:50]
    half = HalfResolutionCamera(CAMERAS[0])
    np.testing.assert_allclose(
        2.0 * half.project(points) + 0.5, CAMERAS[0].project(points), atol=1e-9
    )
    assert DomeImage.from_sensor_px(np.array([0.5, 2.5])).tolist() == [0.0, 1.0]


def test_head_at_rest_is_found_still_exposures_mergeable():
    found = follow(Shots())
    assert found.still
    assert found.usable.all()
    assert found.displacement_mm.max() < 0.02
    assert found.record()["images_left_out"] == 0


def test_poses_map_mean_head_to_its_image_positions():
    found = follow(Shots(*FAR))
    assert not found.still
    assert found.usable.all()
    true = np.tile(np.eye(4), (len(CAPTURES_S), 1, 1))
    for pose, t_s in zip(true, CAPTURES_S, strict=True):
        pose[:3, :3], pose[:3, 3] = way(t_s, *FAR)
    front = SURFACE.points_mm[SURFACE.normals[:, 2] > 0.5].astype(np.float64)
    middle = true[:, :3, :3].mean(axis=0), true[:, :3, 3].mean(axis=0)
    at_mean = front @ middle[0].T + middle[1]
    errors, moves = [], []
    for pose, truth in zip(found.poses, true, strict=True):
        seen = at_mean @ pose[:3, :3].T + pose[:3, 3]
        where = front @ truth[:3, :3].T + truth[:3, 3]
        errors.append(np.sqrt(np.mean(np.sum((seen - where) ** 2, axis=1))))
        moves.append(np.sqrt(np.mean(np.sum((at_mean - where) ** 2, axis=1))))
    assert max(errors) < 0.06 * PIXEL_MM
    assert max(errors) < 0.15 * max(moves)
    # on average the head is where the scan was laid
    mean = found.poses.mean(axis=0)
    np.testing.assert_allclose(mean[:3, 3], 0.0, atol=1e-3)
    # and what is told of the motion is its size
    np.testing.assert_allclose(found.displacement_mm.max(), max(moves), rtol=0.15)


def test_frames_of_other_light_levels_show_same_motion():
    same = follow(Shots(*FAR))
    other = follow(Shots(*FAR, levels=(1.0, 0.4)))
    points = np.array([[0.0, 0.0, RADIUS_MM], [40.0, 0.0, 57.0]])
    apart = [
        (a[:3, :3] - b[:3, :3]) @ points.T + (a[:3, 3] - b[:3, 3])[:, None]
        for a, b in zip(same.poses, other.poses, strict=True)
    ]
    assert np.abs(apart).max() < 0.03 * PIXEL_MM


@pytest.mark.parametrize(
    ("made", "why"),
    [
        ({"times_s": ()}, "no tracking frame"),
        ({"times_s": (3.0,)}, "one shows no motion"),
        ({"times_s": (0.0, 20.0), "lacks": (1, RIG.views[0].name)}, "one of two lacks a camera"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_fewer_than_two_full_frames_record_untracked_head(made, why):
    assert follow(Shots(**made)) is None, why


def test_images_outside_the_tracking_frames_are_not_used():
    found = follow(Shots(*FAR, times_s=(5.0, 10.0, 15.0)))
    inside = (CAPTURES_S >= 5.0) & (CAPTURES_S <= 15.0)
    np.testing.assert_array_equal(found.usable, inside)
    assert not found.still


def test_tracking_frames_covering_no_image_are_error():
    with pytest.raises(InputsError, match="no image between two tracking frames"):
        follow(Shots(*FAR, times_s=(30.0, 40.0)))


def test_a_frame_without_a_time_is_named():
    session = Shots(times_s=(0.0, 20.0))
    for record in session.frames("tracking"):
        record.line.t_box_s = None
    with pytest.raises(InputsError, match=r"T\d-C\d\d: lacks the time of its light"):
        follow(session)
