"""Bundle adjustment: cameras and board places that explain all corners at once.

Each camera has fifteen numbers (fx, fy, cx, cy, k1, k2, p1, p2, k3, a turn about its own axes, a
shift), each place of the board six. The normal equations are summed from blocks, image by image,
with analytic derivatives; what the workshop guarantees of a lens enters as a weak prior, so that a
camera that saw few boards keeps a sensible lens.
"""

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from capture.arrays import Float64Array
from capture.calibration.geometry.board import Board
from capture.calibration.geometry.board_pose import (
    BoardPose,
    Target,
    gaps_px,
    motion_between,
    move_pose,
)
from capture.calibration.geometry.bundle_equations import (
    Bundle,
    BundleError,
    BundleProblem,
    Gauge,
    LensPrior,
    Sightings,
)
from capture.calibration.geometry.intrinsics import CameraPose

__all__ = ["Bundle", "BundleError", "adjust", "place_board"]


MIN_SHARED_POSES = 2  # places that a camera must share with others


def adjust(
    sightings: Sightings,
    board: Board,
    start: Mapping[str, CameraPose],
    *,
    gauge: Gauge = "board",
    prior: LensPrior | None = None,
) -> Bundle:
    """Adjust all cameras and board places to all corners.

    Parameters
    ----------
    sightings : mapping of (view name, pose) to Sighting
        Corners of the board in each image that shows it.
    board : Board
    start : mapping of str to CameraPose
        Nominal or earlier cameras, by view name; those without sightings are named in an error.
    gauge : {"board", "cameras"}
        What fixes the rig frame: pose 0 of the board in the jig (see `BoardPose.in_jig`), or the
        nominal cameras' centres, which the result is moved onto as a rigid body.
    prior : LensPrior, optional
        What is known of the lenses.

    Returns
    -------
    Bundle

    Raises
    ------
    BundleError
        If a camera shares too few places with the others, or pose 0 is not seen.

    References
    ----------
    B. Triggs et al., "Bundle adjustment - a modern synthesis", 2000,
    doi:10.1007/3-540-44480-7_21.
    """
    _check_shared(sightings, start, gauge)
    places = {
        pose: place_board(sightings, board, start, pose)
        for pose in sorted({pose for _, pose in sightings})
    }
    if gauge == "board":
        to_jig = motion_between(places[0], BoardPose.in_jig(board))
        places = {pose: move_pose(place, *to_jig) for pose, place in places.items()}
        cameras = {name: _moved_camera(camera, *to_jig) for name, camera in start.items()}
    else:
        cameras = dict(start)
    problem = BundleProblem(sightings, board, start, prior or LensPrior(), gauge)
    with threadpool_limits(limits=1, user_api="blas"):  # many small matrices
        cameras, places = problem.solve(cameras, places)
    if gauge == "cameras":
        found = np.array([cameras[name].center_mm for name in problem.names])
        wanted = np.array([start[name].center_mm for name in problem.names])
        rigid = _procrustes(found, wanted)
        cameras = {name: _moved_camera(camera, *rigid) for name, camera in cameras.items()}
        places = {pose: move_pose(place, *rigid) for pose, place in places.items()}
    return problem.judged(cameras, places)


def place_board(
    sightings: Sightings, board: Target, cameras: Mapping[str, CameraPose], pose: int
) -> BoardPose:
    """Return where the board stood, from all its images, with the cameras as given.

    Each image alone gives a guess; the one that suits all images best is refined on all of them.

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
            misfit = np.concatenate(
                [
                    np.minimum(
                        np.nan_to_num(gaps_px(cameras[other], place, board, s), nan=1e3), 100.0
                    )
                    for other, s in seen.items()
                ]
            )
            if best is None or misfit.sum() < best[0]:
                best = float(misfit.sum()), place
    if best is None:
        raise BundleError(f"pose {pose}: no image of it fits a flat board; leave it out")
    images = {(name, pose): sighting for name, sighting in seen.items()}
    used = {name: cameras[name] for name in seen}
    problem = BundleProblem(images, board, used, LensPrior(), "cameras", cameras_fixed=True)
    _, places = problem.solve(used, {pose: best[1]})
    return places[pose]


def _check_shared(sightings: Sightings, cameras: Mapping[str, CameraPose], gauge: Gauge) -> None:
    """Refuse cameras that nothing ties to the others."""
    poses = {name: {p for n, p in sightings if n == name} for name in cameras}
    unknown = sorted({name for name, _ in sightings} - set(cameras))
    if unknown:
        raise BundleError(f"cameras: got sightings of {', '.join(unknown)}, which has no start")
    count = {p: sum(p in seen for seen in poses.values()) for seen in poses.values() for p in seen}
    for name, seen in poses.items():
        shared = sum(count[p] > 1 for p in seen) if len(cameras) > 1 else len(seen)
        if shared < MIN_SHARED_POSES:
            raise BundleError(
                f"camera {name}: shares {shared} board poses with other cameras (it saw"
                f" {len(seen)}), expected at least {MIN_SHARED_POSES}; show the board where it and"
                " another camera see it, tilted between them"
            )
    if gauge == "board" and not count.get(0, 0):
        raise BundleError(
            "pose 0: no camera saw the board in the jig, expected at least one; show it, or fix the"
            " frame by the nominal cameras"
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
    """Return the rigid motion that takes points onto wanted ones, least squares."""
    a, b = points.mean(axis=0), wanted.mean(axis=0)
    rotation, _ = Rotation.align_vectors(wanted - b, points - a)
    R = rotation.as_matrix()
    return R, b - R @ a
