"""Scanner calibrations from boards projected in closed form."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.calibration.geometry import CameraPose
from capture.calibration.geometry.board import Board, CornerObservation
from capture.calibration.geometry.board_pose import BoardPose
from capture.calibration.geometry.bundle import BundleError
from capture.calibration.geometry.scanner import (
    DecodedImage,
    calibrate_scanner,
    locate_corners_in_projector,
)
from capture.rig import load_rig
from rigsim.as_built.scanner import build_scanner

BOARD = Board.of(("charuco", 7, 5, "4X4_50"), square_mm=36.0)
TURNS = ((0, 0, 0), (30, 5, 10), (-30, 5, -10), (5, 30, 80), (-20, -25, 95), (20, 20, -85))


@pytest.fixture(scope="module")
def scanner():
    return load_rig("dome").scanner.resized(320)


@pytest.fixture(scope="module")
def actual(scanner):
    built = build_scanner(scanner, seed=4)
    return {
        name: dataclasses.replace(CameraPose.nominal(view), distortion=built.distortion[name])
        for name, view in (built.views | built.projectors).items()
    }


def board_poses():
    jig = BoardPose.to_jig_pose(BOARD)
    for azimuth, elevation, turn in TURNS:
        move = Rotation.from_euler("yxz", [azimuth, -elevation, turn], degrees=True).as_matrix()
        yield BoardPose(move @ jig.rotation, move @ jig.translation_mm)


def sightings(scanner, actual, rng, noise_px):
    cameras, projectors = {}, {}
    for pose, place in enumerate(board_poses()):
        points = place.to_rig(BOARD.points_mm)
        for projector in scanner.projectors:
            for camera in projector.cameras:
                spread = noise_px * rng.standard_normal((len(points), 2))
                pixels = actual[camera].project(points) + spread
                ids = np.arange(len(points))
                cameras[camera, pose] = CornerObservation(ids, pixels)
                scale = actual[projector.name].matrix[0, 0] / actual[camera].matrix[0, 0]
                seen = actual[projector.name].project(points)
                seen = seen + scale * noise_px * rng.standard_normal(seen.shape)
                found = projectors.setdefault((projector.name, pose), [])
                found.append(CornerObservation(ids, seen))
    return cameras, projectors


def calibrated(scanner, actual, rng, noise_px=0.03):
    cameras, projectors = sightings(scanner, actual, rng, noise_px)
    start = {view.name: CameraPose.nominal(view) for view in scanner.views}
    start |= {p.name: CameraPose.nominal(p.pinhole) for p in scanner.projectors}
    pairs = [(name, p.name) for p in scanner.projectors for name in p.cameras]
    return calibrate_scanner(cameras, projectors, BOARD, start, pairs), pairs


def test_projectors_calibrate_as_inverse_cameras(scanner, actual, rng):
    found, pairs = calibrated(scanner, actual, rng)
    points = np.concatenate([pose.to_rig(BOARD.points_mm) for pose in board_poses()])
    assert set(found.depth_stderr_mm) == set(pairs)
    for camera, projector in pairs:
        # the point that both devices see moves by the error of their calibration
        pixels, column = (actual[name].project(points) for name in (camera, projector))
        device, lamp = found.devices[camera], found.devices[projector]
        rays = device.rays(pixels)
        length = np.linalg.norm(points - device.center_mm, axis=1)
        for _ in range(4):
            there = device.center_mm + length[:, None] * rays
            ahead = lamp.project(there + 0.01 * rays)[:, 0] - lamp.project(there)[:, 0]
            length += (column[:, 0] - lamp.project(there)[:, 0]) / (ahead / 0.01)
        miss = device.center_mm + length[:, None] * rays - points
        error = np.sqrt(np.mean(np.einsum("nk,nk->n", miss, rays) ** 2))
        assert error < 0.15  # 0.03 px: 0.03 mm in an image, 3 to 4 times that in depth
        assert 0.3 < error / found.depth_stderr_mm[camera, projector] < 2.5
        assert found.devices[projector].image_size == (800, 1280)
        nominal = next(p for p in scanner.projectors if p.name == projector).pinhole
        assert np.linalg.norm(lamp.center_mm - nominal.position_mm) > 0.5  # as built


def test_depth_error_grows_with_noise(scanner, actual, rng):
    low, pairs = calibrated(scanner, actual, rng, 0.02)
    high, _ = calibrated(scanner, actual, rng, 0.08)
    for pair in pairs:
        ratio = high.depth_stderr_mm[pair] / low.depth_stderr_mm[pair]
        assert ratio == pytest.approx(4.0, rel=0.35)


def test_corner_is_found_between_decoded_pixels(rng):
    row, column = np.mgrid[0:80, 0:100].astype(float)
    columns = 100.0 + 2.9 * column + 0.4 * row + 1e-3 * column**2
    rows = 50.0 - 0.3 * column + 3.1 * row
    noise = np.full(row.shape, 0.05)
    corners = CornerObservation(np.array([3, 8]), np.array([[30.4, 40.7], [70.2, 41.1]]))
    decoded = DecodedImage(columns + 0.05 * rng.standard_normal(row.shape), rows, noise, noise)
    found = locate_corners_in_projector(corners, decoded)
    assert found.ids.tolist() == [3, 8]
    u, v = corners.pixels.T
    wanted = np.stack([100 + 2.9 * u + 0.4 * v + 1e-3 * u**2, 50 - 0.3 * u + 3.1 * v], axis=-1)
    np.testing.assert_allclose(found.pixels, wanted, atol=0.02)  # 0.05 px over about 1000 pixels
    dark = dataclasses.replace(decoded, columns=np.where(column < 50, np.nan, columns))
    assert locate_corners_in_projector(corners, dark).ids.tolist() == [8]


def test_projector_without_corners_is_refused(scanner, actual, rng):
    cameras, _ = sightings(scanner, actual, rng, 0.03)
    start = {view.name: CameraPose.nominal(view) for view in scanner.views}
    start |= {p.name: CameraPose.nominal(p.pinhole) for p in scanner.projectors}
    with pytest.raises(BundleError, match="P0: shares 0 board poses"):
        calibrate_scanner(cameras, {}, BOARD, start, [])
