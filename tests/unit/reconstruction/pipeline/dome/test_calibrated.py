"""The dome as seen from a head that sits elsewhere."""

import numpy as np

from capture.calibration.geometry.intrinsics import CameraPose
from capture.calibration.lights.light_list import LightTable
from capture.rig import load_rig
from reconstruction.pipeline.dome.calibrated import CalibratedDome, transform_dome

RIG = load_rig("dome").subset(lights=["L000", "L017", "L023"], views=["C00", "C07"]).resized(64)


def turn(axis, angle):
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def test_moved_head_projections_match_rig_frame(rng):
    cameras = tuple(CameraPose.nominal(view) for view in RIG.views)
    lights = LightTable.nominal(RIG)
    dome = CalibratedDome(None, cameras, lights, lights, (), True, lambda *_: None)
    rotation, shift = turn((1, 2, -0.5), 0.2), np.array([12.0, -5.0, 3.0])
    points = rng.uniform(-60, 60, (20, 3))
    in_rig = points @ rotation.T + shift
    moved = transform_dome(dome, rotation, shift)
    for before, after in zip(dome.cameras, moved.cameras, strict=True):
        np.testing.assert_allclose(after.project(points), before.project(in_rig), atol=1e-6)
        assert np.abs(before.project(points) - before.project(in_rig)).max() > 0.5
    way, white = dome.lights.irradiance(in_rig)
    way_seen, white_seen = moved.lights.irradiance(points)
    np.testing.assert_allclose(way_seen @ rotation.T, way, atol=1e-9)
    np.testing.assert_allclose(white_seen, white, rtol=1e-9)
