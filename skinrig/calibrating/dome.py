"""Calibrate the geometry and the lights of a dome from sessions of its targets."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from capture import raw
from capture.calibration import geometry, store
from capture.calibration.geometry import bundle
from capture.calibration.geometry.board import Board, CornerObservation, find_board
from capture.calibration.lights import LightTable, light_fit, mirror_lights, mirror_sphere
from capture.calibration.lights.white_plate import PlateSamples, PlateWindow, WhitePlate
from capture.calibration.sensor.mosaic import channel_levels, neutral_mosaic
from capture.rig import Rig
from capture.session import FrameRecord, Session
from skinrig.arrays import Float64Array
from skinrig.calibrating.outcome import (
    CalibratingError,
    CalibrationResult,
    TargetSessions,
    number_findings,
)
from skinrig.calibrating.scanner import calibrate_from_stripes

DOME_CALIBRATION_KINDS = ("geometry", "lights", "scanner")
LIGHT_TOLERANCE_MM = 5.0
"""Standard deviation of light positions about nominal: a prior that matters only for lights with
few observed highlights."""
SESSION_STEP = 1000  # poses of session k are numbered from k * SESSION_STEP, so none coincide


@dataclass(frozen=True, slots=True)
class DomeTargets:
    """Sizes of the dome's targets; the defaults are those of the simulated targets."""

    board: Board = field(
        default_factory=lambda: Board.of(("charuco", 7, 5, "4X4_50"), square_mm=36.0)
    )
    sphere_radius_mm: float = 50.0
    plate: WhitePlate = field(default_factory=WhitePlate)


def dome_targets(square_mm: float, sphere_radius_mm: float) -> DomeTargets:
    """Return targets of other sizes: side of the board's squares and radius of the sphere, mm."""
    board = Board.of(("charuco", 7, 5, "4X4_50"), square_mm=square_mm)
    return DomeTargets(board, sphere_radius_mm)


def calibrate_dome(
    kind: str, sessions: TargetSessions, targets: DomeTargets | None = None
) -> CalibrationResult:
    """Estimate the calibration "geometry", "lights" or "scanner" of a dome.

    Parameters
    ----------
    kind
        One of :data:`DOME_CALIBRATION_KINDS`.
    sessions
        For "geometry", sessions of the board; for "lights", of the mirror sphere, the white plate,
        or both. "lights" needs the folder's geometry; "geometry" is compared with the folder's
        previous one, and cameras that moved are reported. For "scanner", sessions of the board
        with stripes.
    targets
        Sizes of the targets.

    Raises
    ------
    CalibratingError
        When required frames are missing, or the sessions are not of one dome.
    """
    rigs = {session.rig.name for session in sessions.sessions}
    if len(rigs) != 1:
        raise CalibratingError(
            f"sessions: got rigs {sorted(rigs)}, expected one; calibrate each rig separately"
        )
    if "dome" not in sessions.rig.boxes:
        raise CalibratingError(
            f"kind {kind!r}: got a session of rig {rigs.pop()!r}, expected one of a dome; name one"
        )
    sizes = targets or DomeTargets()
    if kind == "scanner":
        return calibrate_from_stripes(sessions, sizes.board)
    return (_geometry if kind == "geometry" else _lights)(sessions, sizes)


def _frames(
    sessions: TargetSessions, kind: str, index_name: str
) -> Iterator[tuple[int, Session, FrameRecord]]:
    """Yield the frames of all sessions with their pose number, unique over the sessions."""
    for number, session in enumerate(sessions.sessions):
        for record in session.frames(kind):
            yield SESSION_STEP * number + int(record.index[index_name]), session, record


def _geometry(sessions: TargetSessions, targets: DomeTargets) -> CalibrationResult:
    rig = sessions.rig
    sightings: dict[tuple[str, int], CornerObservation] = {}
    without = 0
    for pose, session, record in _frames(sessions, "charuco", "pose"):
        image = raw.linear_rgb(session.read(record), demosaic="bilinear").rgb
        sighting = find_board(image, targets.board)
        if sighting is None:
            without += 1
        else:
            sightings[record.camera, pose] = sighting
    if not sightings:
        raise CalibratingError(
            f"sessions: the board was found in none of {without} frames of kind 'charuco'; capture"
            " it (`skinrig simulate dome --target charuco`), or give the side of its squares"
        )
    start = geometry.nominal_cameras(rig)
    findings = _describe_movement(sightings, targets.board, sessions.folder, rig)
    in_jig = any(pose == 0 for _, pose in sightings)
    found = bundle.adjust(sightings, targets.board, start, gauge="board" if in_jig else "cameras")
    summary = [
        ("frames with the board", f"{len(sightings)} of {len(sightings) + without}"),
        ("rig frame", "the board in its jig" if in_jig else "the nominal cameras"),
        ("noise of a corner", f"{found.sigma_px:.3f} px"),
    ]
    for name, camera in found.cameras.items():
        center, error = camera.center_mm, np.sqrt(np.diag(found.center_covariance_mm2[name]))
        position = ", ".join(f"{c:.2f} ± {e:.2f}" for c, e in zip(center, error, strict=True))
        focal, focal_error = camera.matrix[0, 0], camera.matrix_stderr[0, 0]
        text = f"center {position} mm; f {focal:.1f} ± {focal_error:.1f} px"
        summary.append((f"{name} ({camera.serial})", f"{found.rms_px[name]:.3f} px; {text}"))
    calibration = geometry.to_calibration(
        found.cameras, reprojection_px=found.rms_px, **sessions.provenance()
    )
    return CalibrationResult(calibration, tuple(summary), findings)


def _describe_movement(
    sightings: Mapping[tuple[str, int], CornerObservation], board: Board, folder: Path, rig: Rig
) -> tuple[str, ...]:
    """Describe the cameras that moved since the geometry in a folder; empty without one."""
    try:
        previous = geometry.cameras_from_calibration(store.load(folder, "geometry"), rig)
        return tuple(str(moved) for moved in bundle.find_moved_cameras(sightings, board, previous))
    except (store.CalibrationMissing, store.CalibrationMismatch, bundle.BundleError):
        return ()


def _lights(sessions: TargetSessions, targets: DomeTargets) -> CalibrationResult:
    rig = sessions.rig
    cameras = geometry.cameras_from_calibration(store.load(sessions.folder, "geometry"), rig)
    table = LightTable.nominal(rig)
    findings: list[str] = []
    summary: list[tuple[str, str]] = []
    notes = {}
    kinds = {record.kind for session in sessions.sessions for record in session.frames()}
    if not kinds & {"mirror", "white"}:
        raise CalibratingError(
            "sessions: got no frames of kind 'mirror' or 'white'; capture a target (`skinrig"
            " simulate dome --target mirror`, `--target white`)"
        )
    if "mirror" in kinds:
        positions = _mirror(sessions, cameras, targets)
        # lights are mounted facing the rig's origin, so the axis is minus the position
        table = replace(
            table,
            position_mm=positions.position_mm,
            position_stderr_mm=positions.stderr_mm,
            axis=-positions.position_mm,
            valid=positions.valid,
        )
        error = np.linalg.norm(positions.stderr_mm[positions.valid], axis=1)
        summary += [
            ("lights placed", f"{int(positions.valid.sum())} of {len(rig.lights)}"),
            (
                "standard error of a place",
                f"median {np.median(error):.2f} mm, worst {error.max():.2f} mm",
            ),
            ("noise of a highlight", f"{positions.sigma_px:.3f} px"),
        ]
        few = [n for n, ok in zip(positions.names, positions.valid, strict=True) if not ok]
        if few:
            findings.append(f"observed by too few cameras to locate, omitted: {', '.join(few)}")
        findings += [
            f"light {a} shone at the position of {b}" for a, b in positions.swapped.items()
        ]
        findings += [f"light {name} was not observed in a sphere" for name in positions.unobserved]
    else:
        notes["positions"] = "nominal: no session of the mirror sphere was given"
    if "white" in kinds:
        samples = _white(sessions, cameras, targets)
        fit = light_fit.fit_lights(samples, table, cameras, plate=targets.plate)
        table = fit.table
        lit = table.intensity[table.valid]
        relative = table.intensity_stderr[table.valid] / np.where(lit > 0, lit, 1.0)
        count = int((table.intensity > 0).all(axis=1).sum())
        shared = f"{100 * targets.plate.reflectance_stderr:.1f} % common to all: plate reflectance"
        summary += [
            ("lights measured", f"{count} of {len(rig.lights)}, in {fit.frames} frames"),
            ("standard error of an intensity", f"{100 * np.median(relative):.2f} % (and {shared})"),
            ("residual of the plate's parts", f"{100 * fit.residual:.2f} %"),
        ]
        for serial, response in table.cameras.items():
            gain = ", ".join(f"{g:.4f}" for g in response.gain)
            corner = 1 + float(response.vignetting.sum())
            summary.append((f"{serial} gain R, G, B", f"{gain}; corner {100 * corner:.0f} %"))
        findings += [f"light {name} is dead" for name in fit.dead]
        findings += [f"light order: {a} shows the shading of {b}" for a, b in fit.swapped.items()]
        if fit.unobserved:
            findings.append(f"the plate never faced {', '.join(fit.unobserved)}: omitted")
    else:
        notes["intensities"] = "nominal and relative: no session of the white plate was given"
    calibration = table.to_calibration(
        notes={**notes, **number_findings(findings)}, **sessions.provenance()
    )
    return CalibrationResult(calibration, tuple(summary), tuple(findings))


def _mirror(
    sessions: TargetSessions, cameras: Mapping[str, geometry.CameraPose], targets: DomeTargets
) -> mirror_lights.LightPositions:
    """Locate the lights from their highlights in the frames of mirror spheres."""
    lights = sessions.rig.lights
    outlines: dict[int, dict[str, Float64Array]] = {}
    colors: dict[str, Float64Array] = {}
    for sphere, session, record in _frames(sessions, "mirror", "sphere"):
        if record.index.get("light") != "outline":
            continue
        frame = session.read(record)
        colors[record.camera] = channel_levels(frame)
        image = neutral_mosaic(frame, colors[record.camera])
        edges = mirror_sphere.find_outline(image, cameras[record.camera], targets.sphere_radius_mm)
        if edges is not None:
            outlines.setdefault(sphere, {})[record.camera] = edges
    if not outlines:
        raise CalibratingError(
            "sessions: no outline of a mirror sphere was found; capture it with the lit dome (index"
            " light = 'outline'), darker than the background"
        )
    spheres = {
        number: mirror_sphere.locate_sphere(edges, cameras, targets.sphere_radius_mm)
        for number, edges in outlines.items()
    }
    windows: dict[tuple[str, int], mirror_lights.SphereWindow] = {}
    highlights = []
    for sphere, session, record in _frames(sessions, "mirror", "sphere"):
        lit_dome = record.index.get("light") == "outline"
        if lit_dome or sphere not in spheres or record.camera not in colors:
            continue
        key = (record.camera, sphere)
        if key not in windows:
            windows[key] = mirror_lights.SphereWindow.of(cameras[record.camera], spheres[sphere])
        image = neutral_mosaic(session.read(record), colors[record.camera])
        pixels = mirror_lights.find_highlights(image, windows[key])
        lit = _lit_lights(record)
        highlights.append(mirror_lights.Highlights(record.camera, sphere, lit, pixels))
    return mirror_lights.locate_lights(
        highlights,
        cameras,
        spheres,
        {light.name: np.array(light.position_mm) for light in lights},
        light_radius_mm=lights[0].radius_mm,
        nominal_stderr_mm=LIGHT_TOLERANCE_MM,
    )


def _lit_lights(record: FrameRecord) -> tuple[str, ...]:
    """Return the names of the lights that were on in a frame."""
    joined = str(record.settings.get("leds", ""))
    return tuple(joined.split("+")) if joined else (str(record.settings["light"]),)


def _white(
    sessions: TargetSessions, cameras: Mapping[str, geometry.CameraPose], targets: DomeTargets
) -> list[PlateSamples]:
    """Return the samples of the white plate in all one-light-at-a-time frames."""
    markers: dict[tuple[str, int], CornerObservation] = {}
    for pose, session, record in _frames(sessions, "white", "pose"):
        if record.index.get("light") == "several":
            image = raw.linear_rgb(session.read(record), demosaic="bilinear").rgb
            sighting = targets.plate.find(image)
            if sighting is not None:
                markers[record.camera, pose] = sighting
    if not markers:
        raise CalibratingError(
            "sessions: the white plate's markers were not found in any frame lit by several lights"
            " (index light = 'several'); capture the plate with its markers in view"
        )
    poses = {
        pose: bundle.estimate_board_pose(markers, targets.plate, cameras, pose)
        for pose in {pose for _, pose in markers}
    }
    windows: dict[tuple[str, int], PlateWindow | None] = {}
    samples = []
    for pose, session, record in _frames(sessions, "white", "pose"):
        if record.index.get("light") == "several" or pose not in poses:
            continue
        key = (record.camera, pose)
        if key not in windows:
            windows[key] = PlateWindow.of(cameras[record.camera], poses[pose], targets.plate)
        window = windows[key]
        if window is None:
            continue
        shot = raw.linear_rgb(session.read(record), demosaic="centered")
        # exposure at full level that gives the same light: exposure time times level
        on_s = float(record.settings["exposure_s"]) * float(record.settings["level"])
        light, pixels = str(record.settings["light"]), (shot.rgb, shot.variance, shot.valid)
        samples.append(window.sample(*pixels, view=record.camera, light=light, on_s=on_s))
    return samples
