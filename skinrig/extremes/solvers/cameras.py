"""Extremes of the bundle adjustment of a dome's cameras, and of Gaussians that fit a dipole."""

from collections.abc import Mapping

import cv2
import numpy as np

from capture.calibration import geometry
from capture.calibration.geometry import bundle
from capture.calibration.geometry.board import Board, CornerObservation
from capture.calibration.geometry.board_pose import BoardPose
from capture.calibration.geometry.intrinsics import CameraPose
from capture.rig import load_rig
from skinrig.arrays import Float64Array
from skinrig.extremes.expectations import expect_error, expect_within
from skinrig.extremes.inputs import InputPrecision
from skinrig.viewer.assets import gaussian_profiles
from skinrig.viewer.scene import SceneError

CHARUCO_BOARD = Board.of(("charuco", 7, 5, "4X4_50"), square_mm=36.0)
N_CORNERS = 24
N_POSES = 5

Corners = dict[tuple[str, int], CornerObservation]


def _cameras(*names: str) -> dict[str, CameraPose]:
    return geometry.nominal_cameras(load_rig("dome").subset(views=list(names)))


def _corners(real: InputPrecision, cameras: Mapping[str, CameraPose], noise_px: float) -> Corners:
    """Return corners of a board in random poses near the origin, the first in the jig."""
    rng = np.random.default_rng(0)
    places = [BoardPose.to_jig_pose(CHARUCO_BOARD)]
    middle = np.array([*np.array(CHARUCO_BOARD.size_mm) / 2, 0.0])
    for _ in range(1, N_POSES):
        rotation = cv2.Rodrigues(rng.uniform(-0.7, 0.7, 3))[0] @ places[0].rotation
        places.append(BoardPose(rotation, rng.uniform(-15, 15, 3) - rotation @ middle))
    found: Corners = {}
    for name, camera in cameras.items():
        for pose, place in enumerate(places):
            pixels = camera.project(place.to_rig(CHARUCO_BOARD.points_mm))
            pixels = pixels + noise_px * rng.standard_normal(pixels.shape)
            observed: Float64Array = np.asarray(real(pixels), np.float64)
            found[name, pose] = CornerObservation(np.arange(N_CORNERS), observed)
    return found


def _largest_shift(found: bundle.BundleResult, true: Mapping[str, CameraPose]) -> float:
    gaps = [found.cameras[name].center_mm - camera.center_mm for name, camera in true.items()]
    return float(np.linalg.norm(gaps, axis=1).max())


def _describe(found: bundle.BundleResult, text: str) -> str:
    end = found.end
    return (
        f"{text}; {end.stop} after {end.steps} steps, residual {end.residual:.1e}, condition "
        f"{end.condition:.1e}"
    )


def _exact_corners(real: InputPrecision) -> str:
    cameras = _cameras("C06", "C07", "C08")
    found = bundle.adjust(_corners(real, cameras, 0.0), CHARUCO_BOARD, cameras)
    return _describe(
        found, expect_within(_largest_shift(found, cameras), 0.0, 0.05, label="shift, mm")
    )


def _distant_start(real: InputPrecision) -> str:
    cameras = _cameras("C06", "C07", "C08")
    start = {
        name: CameraPose(
            **{
                **{key: getattr(camera, key) for key in camera.__dataclass_fields__},
                "translation_mm": camera.translation_mm + np.array([20.0, -20.0, 30.0]),
            }
        )
        for name, camera in cameras.items()
    }
    found = bundle.adjust(_corners(real, cameras, 0.05), CHARUCO_BOARD, start)
    return _describe(found, expect_within(max(found.rms_px.values()), 0.0, 0.1, label="RMS, px"))


def _wrong_corners(real: InputPrecision) -> str:
    cameras = _cameras("C06", "C07", "C08")
    seen = _corners(real, cameras, 0.05)
    for observation in seen.values():
        observation.pixels[3] += 500.0
    found = bundle.adjust(seen, CHARUCO_BOARD, cameras)
    expect_within(_largest_shift(found, cameras), 0.0, 1.5, label="shift, mm")
    return _describe(found, f"{sum(found.outliers.values())} of {len(seen)} wrong corners left out")


def _no_common_board(real: InputPrecision) -> str:
    cameras = _cameras("C05", "C06", "C07", "C10")
    seen = _corners(real, cameras, 0.05)
    apart = {k: one for k, one in seen.items() if (k[0] in ("C05", "C06")) == (k[1] < 2)}
    return expect_error(
        lambda: bundle.adjust(apart, CHARUCO_BOARD, cameras),
        bundle.BundleError,
        "share no board pose",
    )


def _fit(real: InputPrecision, r_d: float, sigma_tr_per_mm: float) -> str:
    found = gaussian_profiles.fit_gaussians(real([r_d] * 3), real([sigma_tr_per_mm] * 3))
    return "error of the edge " + expect_within(found.edge_error, 0.0, 0.02)


def _opaque_skin(real: InputPrecision) -> str:
    return _fit(real, 1e-3, 100.0)


def _bright_skin(real: InputPrecision) -> str:
    return _fit(real, 0.999, 1.0)


def _translucent_skin(real: InputPrecision) -> str:
    return _fit(real, 0.4, 1e-3)


def _lossless_skin(real: InputPrecision) -> str:
    return expect_error(lambda: _fit(real, 1.0, 1.0), SceneError)
