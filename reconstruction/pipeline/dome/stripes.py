"""Decode the stripes of a dome session's scanner, and triangulate them to one mesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from capture import raw
from capture.calibration.geometry import CameraPose
from capture.calibration.geometry.intrinsics import poses_from_calibration
from capture.rig import Projector, Scanner
from capture.session import Session
from reconstruction.arrays import Float64Array
from reconstruction.pipeline.inputs import Inputs
from reconstruction.scan.range_fusion import fuse_ranges
from reconstruction.scan.repair import TriangleMesh
from reconstruction.scan.stripe_decoding import StripeCode, StripeMap, decode_stripes
from reconstruction.scan.triangulation import RangeMap, drop_contradictions, triangulate_stripes

STRIPES_KIND: Final = "stripes"
VOXEL_PIXELS: Final = 2.5
"""Side of a voxel, in pixels of the scanner's cameras on the face."""
MIN_VOXEL_MM: Final = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class DecodedScan:
    """Mesh of the scanner, in the frame of its calibration."""

    mesh: TriangleMesh
    stderr_mm: Float64Array
    """Standard error across the surface at each vertex, mm, of noise and calibration, shape (V,).
    """
    record: Mapping[str, Any]
    """JSON values for the record of the maps."""
    calibrated: bool
    """Whether the scanner is calibrated, and with it the mesh's place in the rig frame."""


@dataclass(frozen=True, slots=True, eq=False)
class ScannerPoses:
    """Cameras and projectors of a scanner, calibrated or nominal."""

    devices: Mapping[str, CameraPose]
    """Poses by name."""
    depth_stderr_mm: float
    """Standard error of depth from the calibration, mm; 0 if nominal."""
    calibrated: bool


def has_stripes(session: Session) -> bool:
    """Return whether a session has frames of a scanner."""
    return session.rig.scanner is not None and bool(session.frames(STRIPES_KIND))


def read_stripes(
    session: Session, scanner: Scanner, camera: str, projector: str, axis: str, **index: Any
) -> tuple[StripeMap, Float64Array] | None:
    """Decode one camera's stripes along one axis of a projector.

    Returns
    -------
    (StripeMap, ndarray) or None
        With the mean of the sinusoid's frames, an image in half of the projector's full light,
        shape (H, W); None where a frame is missing.
    """
    wanted = {"projector": projector, "axis": axis, **index}
    records = [r for r in session.frames(STRIPES_KIND, **wanted) if r.camera == camera]
    lamp = scanner.projector(projector)
    code = StripeCode(lamp.length_px(axis), scanner.period_px, scanner.phase_steps)
    if len(records) != code.bits + code.steps:
        return None
    records.sort(key=lambda record: int(record.index["pattern"]))
    frames = [raw.linear_mono(session.read(record)) for record in records]
    values = np.array([frame[0] for frame in frames], np.float64)
    variance = np.array([frame[1] for frame in frames[code.bits :]], np.float64)
    usable = np.all([frame[2] for frame in frames[code.bits :]], axis=0)
    gray, phase = values[: code.bits], values[code.bits :]
    found = decode_stripes(gray, phase, code, variance=variance, usable=usable)
    return found, phase.mean(axis=0)


def decode_scan(inputs: Inputs, poses: ScannerPoses) -> DecodedScan:
    """Decode the stripes of a session to one mesh.

    Parameters
    ----------
    inputs
        A session with frames of a scanner (`has_stripes`).
    poses
        See `load_scanner`.

    Raises
    ------
    ScanMeshError
        When nothing is decoded.
    """
    session, scanner = inputs.session, _scanner(inputs)
    devices, depth_mm = poses.devices, poses.depth_stderr_mm
    pixel_mm = float(np.median([v.distance_mm / v.focal_px for v in scanner.views]))
    voxel_mm = max(VOXEL_PIXELS * pixel_mm, MIN_VOXEL_MM)

    def decode(projector: Projector) -> tuple[list[RangeMap], dict[str, float]]:
        mine: list[RangeMap] = []
        shares: dict[str, float] = {}
        for camera in projector.cameras:
            found = read_stripes(session, scanner, camera, projector.name, "columns")
            if found is None:
                shares[f"{camera} {projector.name}"] = 0.0
                continue
            lamp, eye = devices[projector.name], devices[camera]
            ranges = triangulate_stripes(eye, lamp, found[0], limits_mm=scanner.range_mm)
            mine.append(ranges)
            shares[f"{camera} {projector.name}"] = float(ranges.valid.mean())
        return drop_contradictions(mine, devices[projector.name]), shares

    maps: list[RangeMap] = []
    shares: dict[str, float] = {}
    for ranges, decoded in inputs.compute_tiles("stripes", scanner.projectors, decode):
        maps += ranges
        shares |= decoded
    mesh, noise_mm = fuse_ranges(maps, voxel_mm=voxel_mm)
    record = {
        "source": "stripes",
        "frames": len(session.frames(STRIPES_KIND)),
        "decoded": shares,
        "voxel_mm": voxel_mm,
        "vertices": len(mesh.vertices_mm),
        "noise_mm": float(np.median(noise_mm)),
        "calibration_mm": depth_mm,
    }
    return DecodedScan(mesh, np.hypot(noise_mm, depth_mm), record, poses.calibrated)


def load_scanner(inputs: Inputs) -> ScannerPoses:
    """Load the scanner's calibration; without one, assume the nominal geometry.

    Call this before `Inputs.stage_maker`, so that the calibration is part of the stages' keys.

    Raises
    ------
    CalibrationError
        When the calibration is damaged, of another rig or device, or out of date.
    """
    scanner = _scanner(inputs)
    pinholes = [*scanner.views, *(projector.pinhole for projector in scanner.projectors)]
    serials = {pinhole.name: pinhole.serial for pinhole in pinholes}
    nominal = "the scanner has the nominal geometry of the rig file"
    found = inputs.load("scanner", list(serials.values()), nominal)
    if found is None:
        poses = {pinhole.name: CameraPose.nominal(pinhole) for pinhole in pinholes}
        return ScannerPoses(poses, 0.0, False)
    depths = [float(found.quantity(view.serial, "depth_stderr_mm").value) for view in scanner.views]
    depth_mm = float(np.sqrt(np.mean(np.square(depths))))
    return ScannerPoses(poses_from_calibration(found, serials), depth_mm, True)


def _scanner(inputs: Inputs) -> Scanner:
    session = inputs.session
    if session.rig.scanner is None:
        raise ValueError(f"session {session.id}: got no scanner, expected one; see has_stripes")
    return session.rig.scanner
