"""A camera that moved since the last calibration, found by who disagrees with whom."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from capture.calibration.geometry.board import Board
from capture.calibration.geometry.board_pose import BoardPose, gaps_px
from capture.calibration.geometry.bundle import place_board
from capture.calibration.geometry.bundle_equations import BundleError, Sightings
from capture.calibration.geometry.intrinsics import CameraPose

RMS_PER_MEDIAN = 1.2011  # of distances whose coordinates are normal: (1 / ln 2) ** 0.5


@dataclass(frozen=True, slots=True)
class MovedCamera:
    """A camera that no longer stands where the previous calibration puts it.

    Attributes
    ----------
    name, serial : str
        View and camera.
    rms_px : float
        Residual of the previous calibration, by the median.
    shift_mm, turn_rad : float
        How far its centre of projection went, and how it turned.
    """

    name: str
    serial: str
    rms_px: float
    shift_mm: float
    turn_rad: float

    def __str__(self) -> str:
        """Return one line for a terminal."""
        return (
            f"camera {self.name} ({self.serial}) moved: {self.rms_px:.2f} px off, by"
            f" {self.shift_mm:.2f} mm and {np.degrees(self.turn_rad):.3f} degrees"
        )


def find_moved(
    sightings: Sightings,
    board: Board,
    previous: Mapping[str, CameraPose],
    *,
    ratio: float = 4.0,
    least_px: float = 0.3,
) -> tuple[MovedCamera, ...]:
    """Find cameras that moved since the previous calibration, by their residuals.

    For each camera the boards are placed by all others, as they were calibrated before. A camera
    that disagrees with others that agree is blamed, the worst first; then the rest is asked again
    without it, until all agree.

    Parameters
    ----------
    sightings : mapping of (view name, pose) to Sighting
        New images.
    board : Board
    previous : mapping of str to CameraPose
        The cameras as calibrated before.
    ratio : float
        How many times the residual of the remaining cameras a moved camera's is, > 1.
    least_px : float
        Smaller residuals than this do not matter, px.

    Returns
    -------
    tuple of Moved
        Worst first; empty where all agree. At most half of the cameras can be found.

    Raises
    ------
    BundleError
        If fewer than three cameras saw the boards: then nobody can say which one moved.
    """
    names = sorted({name for name, _ in sightings})
    if len(names) < 3:
        raise BundleError(
            f"cameras: got sightings of {', '.join(names) or 'none'}, expected of at least 3 to say"
            " which one moved"
        )
    moved: list[MovedCamera] = []
    left = list(names)
    while len(left) > max(2, len(names) // 2):
        trials = {name: _agreement(sightings, board, previous, left, without=name) for name in left}
        judged = {n: own / max(rest, least_px / ratio) for n, (rest, own, _) in trials.items()}
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
    sightings: Sightings,
    board: Board,
    cameras: Mapping[str, CameraPose],
    names: list[str],
    *,
    without: str,
) -> tuple[float, float, dict[int, BoardPose]]:
    """Return the residual of all cameras but one, that one's own, and the boards' places."""
    rest = {k: s for k, s in sightings.items() if k[0] in names and k[0] != without}
    count = {pose: sum(p == pose for _, p in rest) for _, pose in rest}
    places = {pose: place_board(rest, board, cameras, pose) for pose in count if count[pose] > 1}
    others, own = [np.zeros(0)], [np.zeros(0)]
    for (name, pose), sighting in sightings.items():
        if pose in places and name in names:
            gaps = gaps_px(cameras[name], places[pose], board, sighting)
            (own if name == without else others).append(gaps)
    together, alone = np.concatenate(others), np.concatenate(own)
    if not together.size:
        return np.inf, np.nan, places
    # by the median: a camera that moved moves all its corners, a bad corner is one of many
    return (
        RMS_PER_MEDIAN * float(np.median(together)),
        RMS_PER_MEDIAN * float(np.median(alone)) if alone.size else np.nan,
        places,
    )


def _resection(
    images: Sightings, board: Board, camera: CameraPose, places: Mapping[int, BoardPose]
) -> CameraPose:
    """Return a camera's new place from boards whose places are known; the lens is kept."""
    points = np.concatenate(
        [places[p].to_rig(board.points_mm[s.ids]) for (_, p), s in images.items()]
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
