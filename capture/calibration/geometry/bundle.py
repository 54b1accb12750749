"""Bundle adjustment of cameras and board poses to all corners at once.

Each camera has fifteen parameters (fx, fy, cx, cy, k1, k2, p1, p2, k3, a rotation about its own
axes, a translation), each pose of the board six. The normal equations are summed from blocks, image
by image, with analytic derivatives. Manufacturing tolerances of the lens enter as a weak prior, so
that a camera with few boards keeps a plausible lens.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from capture.arrays import Float64Array
from capture.calibration.geometry.board import Board
from capture.calibration.geometry.board_pose import (
    BoardPose,
    FlatTarget,
    corner_residuals_px,
    move_pose,
    relative_motion,
)
from capture.calibration.geometry.bundle_equations import (
    BoardPoses,
    BundleError,
    BundleProblem,
    BundleResult,
    Cameras,
    Gauge,
    LensPrior,
    Sightings,
)
from capture.calibration.geometry.intrinsics import CameraPose

__all__ = ["BundleError", "BundleResult", "adjust", "estimate_board_pose"]


MIN_SHARED_POSES = 2  # poses that a camera must share with others


def adjust(
    sightings: Sightings,
    board: Board,
    start: Cameras,
    *,
    gauge: Gauge = "board",
    prior: LensPrior | None = None,
) -> BundleResult:
    """Adjust all cameras and board poses to all corners.

    Parameters
    ----------
    sightings : mapping of (view name, pose) to Sighting
        Corners of the board in each image that shows it.
    board : Board
    start : mapping of str to CameraPose
        Nominal or earlier cameras, by view name; those without corners are named in an error.
    gauge : {"board", "cameras"}
        Gauge of the rig frame: pose 0 of the board in the jig (see `BoardPose.in_jig`), or the
        nominal cameras' centers, onto which the result is moved as a rigid body.
    prior : LensPrior, optional
        Prior of the lens parameters.

    Returns
    -------
    Bundle

    Raises
    ------
    BundleError
        If a camera shares too few poses with the others, or pose 0 is not visible.

    References
    ----------
    B. Triggs et al., "Bundle adjustment - a modern synthesis", 2000,
    doi:10.1007/3-540-44480-7_21.
    """
    _check_shared(sightings, start, gauge)
    places = {
        pose: estimate_board_pose(sightings, board, start, pose)
        for pose in sorted({pose for _, pose in sightings})
    }
    if gauge == "board":
        to_jig = relative_motion(places[0], BoardPose.to_jig_pose(board))
        places = {pose: move_pose(place, *to_jig) for pose, place in places.items()}
        cameras = {name: _moved_camera(camera, *to_jig) for name, camera in start.items()}
    else:
        cameras = dict(start)
    problem = BundleProblem(sightings, board, start, prior or LensPrior(), gauge)
    with threadpool_limits(limits=1, user_api="blas"):  # many small matrices
        cameras, places, end = problem.solve(cameras, places)
    if gauge == "cameras":
        found = np.array([cameras[name].center_mm for name in problem.names])
        wanted = np.array([start[name].center_mm for name in problem.names])
        rigid = _procrustes(found, wanted)
        cameras = {name: _moved_camera(camera, *rigid) for name, camera in cameras.items()}
        places = {pose: move_pose(place, *rigid) for pose, place in places.items()}
    return problem.solution_with_errors(cameras, places, end)


def estimate_board_pose(
    sightings: Sightings, board: FlatTarget, cameras: Cameras, pose: int
) -> BoardPose:
    """Estimate the pose of a board from all its images, for given cameras.

    Each image alone gives a start; the one that fits all images best is refined on all of them.

    Raises
    ------
    BundleError
        If no image of that pose fits.
    """
    seen = {name: s for (name, number), s in sightings.items() if number == pose}
    best: tuple[float, BoardPose] | None = None
    for name, sighting in seen.items():
        camera = cameras[name]
        points = board.points_mm[sighting.ids]
        solved, turns, shifts, _ = cv2.solvePnPGeneric(
            points, sighting.pixels, camera.matrix, camera.distortion, flags=cv2.SOLVEPNP_IPPE
        )
        for turn, shift in zip(turns, shifts, strict=True) if solved else ():
            local = Rotation.from_rotvec(np.ravel(turn)).as_matrix()
            place = BoardPose(
                camera.rotation.T @ local,
                camera.rotation.T @ (np.ravel(shift) - camera.translation_mm),
            )
            gaps = [
                corner_residuals_px(cameras[other], place, board, s) for other, s in seen.items()
            ]
            misfit = np.minimum(np.nan_to_num(np.concatenate(gaps), nan=1e3), 100.0)
            if best is None or misfit.sum() < best[0]:
                best = float(misfit.sum()), place
    if best is None:
        raise BundleError(f"pose {pose}: no image of it fits a flat board; omit it")
    images = {(name, pose): sighting for name, sighting in seen.items()}
    used = {name: cameras[name] for name in seen}
    problem = BundleProblem(images, board, used, LensPrior(), "cameras", cameras_fixed=True)
    _, places, _ = problem.solve(used, {pose: best[1]})
    return places[pose]


def _check_shared(sightings: Sightings, cameras: Cameras, gauge: Gauge) -> None:
    """Reject cameras that share no poses with the others."""
    poses = {name: {p for n, p in sightings if n == name} for name in cameras}
    unknown = sorted({name for name, _ in sightings} - set(cameras))
    if unknown:
        raise BundleError(f"cameras: got sightings of {', '.join(unknown)}, which has no start")
    count = {p: sum(p in seen for seen in poses.values()) for seen in poses.values() for p in seen}
    for name, seen in poses.items():
        shared = sum(count[p] > 1 for p in seen) if len(cameras) > 1 else len(seen)
        if shared < MIN_SHARED_POSES:
            raise BundleError(
                f"camera {name}: shares {shared} board poses with other cameras (it observed "
                f"{len(seen)}), expected at least {MIN_SHARED_POSES}; show the board where it "
                "and another camera see it, tilted between them"
            )
    if gauge == "board" and not count.get(0, 0):
        raise BundleError(
            "pose 0: no camera observed the board in the jig, expected at least one; show it, "
            "or fix the frame by the nominal cameras"
        )
    groups = [{name} for name in poses]
    for pose in count:
        tied = [g for g in groups if any(pose in poses[name] for name in g)]
        groups = [g for g in groups if g not in tied] + [set().union(*tied)]
    if len(groups) > 1:
        small = min(groups, key=len)
        raise BundleError(
            f"cameras {', '.join(sorted(small))}: share no board pose with the others, expected one"
            " rig; show the board between the two groups"
        )


def _moved_camera(camera: CameraPose, rotation: Float64Array, shift: Float64Array) -> CameraPose:
    turned = camera.rotation @ rotation.T
    return replace(camera, rotation=turned, translation_mm=camera.translation_mm - turned @ shift)


def _procrustes(points: Float64Array, wanted: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the rigid motion of points onto target points, by least squares."""
    a, b = points.mean(axis=0), wanted.mean(axis=0)
    rotation, _ = Rotation.align_vectors(wanted - b, points - a)
    R = rotation.as_matrix()
    return R, b - R @ a


RMS_PER_MEDIAN = 1.2011  # of distances whose coordinates are normal: (1 / ln 2) ** 0.5


@dataclass(frozen=True, slots=True)
class MovedCamera:
    """Camera that has moved since the previous calibration.

    Attributes
    ----------
    name, serial : str
        View and camera.
    rms_px : float
        RMS residual of the previous calibration, from the median.
    shift_mm, rotation_rad : float
        Displacement of its center of projection, and its rotation.
    """

    name: str
    serial: str
    rms_px: float
    shift_mm: float
    rotation_rad: float

    def __str__(self) -> str:
        """Return one line for a terminal."""
        return (
            f"camera {self.name} ({self.serial}) moved: {self.rms_px:.2f} px off, by"
            f" {self.shift_mm:.2f} mm and {np.degrees(self.rotation_rad):.3f} degrees"
        )


def find_moved_cameras(
    sightings: Sightings,
    board: Board,
    previous: Cameras,
    *,
    ratio: float = 4.0,
    min_residual_px: float = 0.3,
) -> tuple[MovedCamera, ...]:
    """Find cameras that moved since the previous calibration, by their residuals.

    For each camera the board poses are estimated from all others, as calibrated before. Among
    cameras that disagree with an agreeing rest, the worst is marked as moved. The test is repeated
    without it, until all agree.

    Parameters
    ----------
    sightings : mapping of (view name, pose) to Sighting
        New images.
    board : Board
    previous : mapping of str to CameraPose
        The cameras as calibrated before.
    ratio : float
        Smallest ratio of a moved camera's residual to that of the others, > 1.
    min_residual_px : float
        Smaller residuals are ignored, px.

    Returns
    -------
    tuple of Moved
        Worst first; empty when all agree. At most half of the cameras can be found.

    Raises
    ------
    BundleError
        If fewer than three cameras observed the boards: then the moved one cannot be identified.
    """
    names = sorted({name for name, _ in sightings})
    if len(names) < 3:
        raise BundleError(
            f"cameras: got sightings of {', '.join(names) or 'none'}, expected of at least 3 to "
            "find the one that moved"
        )
    moved: list[MovedCamera] = []
    left = list(names)
    while len(left) > max(2, len(names) // 2):
        trials = {name: _agreement(sightings, board, previous, left, without=name) for name in left}
        judged = {
            n: own / max(rest, min_residual_px / ratio) for n, (rest, own, _) in trials.items()
        }
        culprit = max(judged, key=lambda name: judged[name] if judged[name] > 0 else 0.0)
        _, own_px, places = trials[culprit]
        if not judged[culprit] > ratio:
            break
        images = {key: s for key, s in sightings.items() if key[0] == culprit and key[1] in places}
        now = _resection(images, board, previous[culprit], places)
        turn = Rotation.from_matrix(now.rotation @ previous[culprit].rotation.T).magnitude()
        shift = float(np.linalg.norm(now.center_mm - previous[culprit].center_mm))
        moved.append(MovedCamera(culprit, previous[culprit].serial, own_px, shift, float(turn)))
        left.remove(culprit)
    return tuple(sorted(moved, key=lambda m: -m.rms_px))


def _agreement(
    sightings: Sightings, board: Board, cameras: Cameras, names: list[str], *, without: str
) -> tuple[float, float, dict[int, BoardPose]]:
    """Return the residual of all cameras but one, that one's own, and the board poses."""
    rest = {k: s for k, s in sightings.items() if k[0] in names and k[0] != without}
    count = {pose: sum(p == pose for _, p in rest) for _, pose in rest}
    places = {
        pose: estimate_board_pose(rest, board, cameras, pose) for pose in count if count[pose] > 1
    }
    others, own = [np.zeros(0)], [np.zeros(0)]
    for (name, pose), sighting in sightings.items():
        if pose in places and name in names:
            gaps = corner_residuals_px(cameras[name], places[pose], board, sighting)
            (own if name == without else others).append(gaps)
    together, alone = np.concatenate(others), np.concatenate(own)
    if not together.size:
        return np.inf, np.nan, places
    # by the median: a moved camera shifts all its corners, whereas a bad corner is one of many
    return (
        RMS_PER_MEDIAN * float(np.median(together)),
        RMS_PER_MEDIAN * float(np.median(alone)) if alone.size else np.nan,
        places,
    )


def _resection(
    images: Sightings, board: Board, camera: CameraPose, poses: BoardPoses
) -> CameraPose:
    """Return a camera's new pose from boards of known pose; the lens is kept."""
    points = np.concatenate(
        [poses[p].to_rig(board.points_mm[s.ids]) for (_, p), s in images.items()]
    )
    pixels = np.concatenate([s.pixels for s in images.values()])
    turn = Rotation.from_matrix(camera.rotation).as_rotvec()
    _, turn, shift = cv2.solvePnP(
        points,
        pixels,
        camera.matrix,
        camera.distortion,
        turn,
        camera.translation_mm.copy(),
        useExtrinsicGuess=True,
        flags=cv2.SOLVEPNP_ITERATIVE,
    )
    rotation = Rotation.from_rotvec(np.ravel(turn)).as_matrix()
    return replace(camera, rotation=rotation, translation_mm=np.ravel(shift))
