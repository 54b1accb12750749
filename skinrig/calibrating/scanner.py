"""Calibrate a dome's scanner from stripes on a board."""

from dataclasses import replace

import numpy as np

from capture.calibration import geometry
from capture.calibration.geometry.board import Board, CornerObservation, find_board
from capture.calibration.geometry.bundle import BundleError
from capture.calibration.geometry.scanner import (
    DecodedImage,
    ScannerGeometry,
    calibrate_scanner,
    locate_corners_in_projector,
)
from capture.calibration.record import Quantity
from reconstruction.pipeline.dome.stripes import STRIPES_KIND, read_stripes
from skinrig.calibrating.outcome import CalibratingError, CalibrationResult, TargetSessions

POSES_PER_SESSION = 1000  # poses of session k are numbered from k times this, so none coincide


def calibrate_from_stripes(sessions: TargetSessions, board: Board) -> CalibrationResult:
    """Estimate cameras and projectors of a scanner.

    Parameters
    ----------
    sessions
        Sessions of the board with stripes along both axes.
    board
        The board.

    Raises
    ------
    CalibratingError
        When the sessions have no such frames, or too few of them show the board.
    """
    scanner = sessions.rig.scanner
    if scanner is None or not sessions.frames(STRIPES_KIND):
        raise CalibratingError(
            "sessions: got no frames of kind 'stripes', expected some; capture the board with the "
            "scanner first (`skinrig simulate dome --target charuco --scanner`)"
        )
    cameras: dict[tuple[str, int], CornerObservation] = {}
    projectors: dict[tuple[str, int], list[CornerObservation]] = {}
    images = 0
    for number, session in enumerate(sessions.sessions):
        poses = sorted({int(record.index["pose"]) for record in session.frames(STRIPES_KIND)})
        for pose in poses:
            place = POSES_PER_SESSION * number + pose
            for projector in scanner.projectors:
                for camera in projector.cameras:
                    images += 1
                    found = [
                        read_stripes(session, scanner, camera, projector.name, axis, pose=pose)
                        for axis in ("columns", "rows")
                    ]
                    if found[0] is None or found[1] is None:
                        continue
                    (columns, image), (rows, _) = found[0], found[1]
                    corners = find_board(image.astype(np.float32), board)
                    if corners is None:
                        continue
                    cameras[camera, place] = corners
                    decoded = DecodedImage(
                        columns.position_px, rows.position_px, columns.stderr_px, rows.stderr_px
                    )
                    there = locate_corners_in_projector(corners, decoded)
                    if there is not None:
                        projectors.setdefault((projector.name, place), []).append(there)
    pinholes = [*scanner.views, *(projector.pinhole for projector in scanner.projectors)]
    start = {pinhole.name: geometry.CameraPose.nominal(pinhole) for pinhole in pinholes}
    pairs = [(name, p.name) for p in scanner.projectors for name in p.cameras]
    try:
        fit = calibrate_scanner(cameras, projectors, board, start, pairs)
    except BundleError as error:
        raise CalibratingError(f"sessions: {error}") from error
    return _result(sessions, fit, f"{len(cameras)} of {images}")


def _result(sessions: TargetSessions, fit: ScannerGeometry, seen: str) -> CalibrationResult:
    made = geometry.to_calibration(
        fit.devices, reprojection_px=fit.rms_px, kind="scanner", **sessions.provenance()
    )
    values = {serial: dict(row) for serial, row in made.values.items()}
    summary = [("images with the board", seen), ("noise of a corner", f"{fit.sigma_px:.3f} px")]
    for (camera, projector), depth in fit.depth_stderr_mm.items():
        values[fit.devices[camera].serial]["depth_stderr_mm"] = Quantity(np.array(depth))
        summary.append((f"depth of {camera} with {projector}", f"± {depth:.3f} mm"))
    for name, device in fit.devices.items():
        center = ", ".join(f"{c:.2f}" for c in device.center_mm)
        focal, error = device.matrix[0, 0], device.matrix_stderr[0, 0]
        text = f"center {center} mm; f {focal:.1f} ± {error:.1f} px"
        summary.append((f"{name} ({device.serial})", f"{fit.rms_px[name]:.3f} px; {text}"))
    return CalibrationResult(replace(made, values=values), tuple(summary))
