"""Write images under one light at a time with their light list, for photometric stereo programs.

Images of one camera are linear 16-bit TIFF on a common scale. ``lights.lp`` has a count, then a
file name and a unit vector towards the light per line; x right, y up, z towards the camera.
"""

from pathlib import Path
from typing import Any, Final

import numpy as np

from capture import raw
from capture.session import Session
from reconstruction.pipeline.dome.calibrated import load_dome
from reconstruction.pipeline.dome.images import DomeImages
from reconstruction.pipeline.inputs import Inputs
from skinrig.arrays import BoolArray, Float32Array, Float64Array, FloatArray, UInt16Array
from skinrig.errors import require_choice
from skinrig.exporting.options import ExportError, ExportSettings
from skinrig.exporting.sessions.copies import write_session_document

LIST_FILE, POSITIONS_FILE, DOCUMENT_FILE = "lights.lp", "positions_mm.txt", "lights.json"
SCHEMA: Final = "skinrig.export.lights/1"
SATURATED_CODE: Final = 65535
"""Code of saturated pixels; unsaturated ones stay below."""
MAX_BRIGHT_FRACTION: Final = 1e-4
"""Fraction of an image's values above the scale, so that single highlights do not determine it."""
_CAMERA_TO_LIST_SIGNS = np.array([1.0, -1.0, -1.0])  # from camera axes, x right, y down, z forward


def write(session: Session, folder: Path, delivery: ExportSettings) -> list[tuple[str, str]]:
    """Write one camera's images of a session with their light list.

    Parameters
    ----------
    session
        Session of a dome, or of images imported with a light list.
    folder
        Existing folder.
    delivery
        Camera and calibration.

    Returns
    -------
    list of (str, str)
        Omitted lights: defective ones, and those of unknown position.

    Raises
    ------
    ExportError
        If the session has no images of single lights, or lacks the camera.
    ValueError
        If the calibration is of another rig.
    """
    import tifffile

    if not any(step.kind == "olat" for step in session.plan.steps):
        kinds = ", ".join(sorted({step.kind for step in session.plan.steps}))
        raise ExportError(
            f"{session.path}: got {kinds}, expected images of one light each; give a session of "
            "the dome or of `skinrig import olat`"
        )
    inputs = Inputs.of(session, delivery.calibration, state="neutral", on_date=None)
    images = DomeImages(session)
    dome = load_dome(inputs, images)
    view = _view(images.views, dome.cameras, delivery.camera)
    pose = dome.cameras[view]
    good = [k for k in range(len(images.lights)) if dome.table.valid[k]]
    left_out = [
        (name, "the light is defective, or its position is unknown")
        for k, name in enumerate(images.lights)
        if k not in good
    ]
    if len(good) < 3:
        raise ExportError(
            f"{session.path}: has {len(good)} usable lights, expected at least 3; capture more "
            "lights"
        )
    places = transform_to_camera_frame(dome.table.position_mm[good], pose.rotation)
    toward = places / np.linalg.norm(places, axis=1, keepdims=True)
    names = [f"{images.lights[k]}.tif" for k in good]

    def picture(light: int) -> tuple[Float32Array, BoolArray]:
        if "light_list" in session.manifest.extra:
            return _imported(session, images.views[view], images.lights[light])
        found = dome.image(view, images.captures.index((images.lights[light], -1)))
        return found.rgb, found.valid

    # the images are read twice, for scale and output, instead of keeping them in memory
    top = max(_full_scale(*picture(k)) for k in good)
    scale = (SATURATED_CODE - 1) / top if top > 0.0 else 1.0
    clipped: dict[str, float] = {}
    for k, name in zip(good, names, strict=True):
        codes, clipped[name] = _coded(*picture(k), scale)
        photometric = "minisblack" if codes.ndim == 2 else "rgb"
        plain = {"compression": None, "metadata": None, "software": False}
        tifffile.imwrite(folder / name, codes, photometric=photometric, **plain)
    rows = [f"{n} {x:.9f} {y:.9f} {z:.9f}" for n, (x, y, z) in zip(names, toward, strict=True)]
    (folder / LIST_FILE).write_text(f"{len(rows)}\n" + "\n".join(rows) + "\n", encoding="ascii")
    near = "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in places)
    (folder / POSITIONS_FILE).write_text(near, encoding="ascii")
    document = {
        "schema": SCHEMA,
        "frame": "x right, y up, z towards the camera; directions from the rig's origin",
        "encoding": f"linear camera values: fraction of full scale, per second of exposure if "
        f"known, = code / {scale:.9g}; {SATURATED_CODE} is saturated",
        "code_per_rate": scale,
        "clipped_share": clipped,
        "camera": images.views[view],
        "mm_per_px": dome.pixel_mm,
        "near_lights": f"{POSITIONS_FILE}: mm around the rig's origin; `skinrig import olat DIR "
        f"--lights DIR/{POSITIONS_FILE} --mm-per-px {dome.pixel_mm:.6g}`",
    }
    write_session_document(folder / DOCUMENT_FILE, inputs, document, left_out)
    return left_out


def transform_to_camera_frame(position_mm: FloatArray, rotation: FloatArray) -> Float64Array:
    """Transform positions to the frame of light lists: x right, y up, z towards the camera.

    Parameters
    ----------
    position_mm
        (N, 3), rig frame.
    rotation
        (3, 3), rows are the camera's axes: right, down, forward.

    Examples
    --------
    >>> ahead = np.array([[0.0, -10.0, 700.0]])
    >>> transform_to_camera_frame(ahead, np.diag([1.0, -1.0, -1.0])).tolist()
    [[0.0, -10.0, 700.0]]
    """
    return np.asarray((position_mm @ np.asarray(rotation).T) * _CAMERA_TO_LIST_SIGNS)


def _view(names: tuple[str, ...], cameras: Any, requested: str | None) -> int:
    if requested is None:
        return int(np.argmin([camera.rotation[2, 2] for camera in cameras]))
    return names.index(require_choice("--camera", requested, names, ExportError))


def _imported(session: Session, view: str, light: str) -> tuple[Float32Array, BoolArray]:
    """Return an image imported with a light list, whose exposure may be unknown."""
    record = next(one for one in session.frames("olat", light=light) if one.camera == view)
    frame = session.read(record)
    time = float(record.settings.get("exposure_s", 0.0)) * float(record.settings.get("iso", 100.0))
    per_time = np.float32(1.0 / time if time > 0.0 else 1.0)
    if frame.pattern == "MONO":
        (black,) = frame.black
        values = (frame.cfa.astype(np.float32) - black) / np.float32(frame.white - black)
        return values * per_time, frame.cfa < frame.white
    image = raw.linear_rgb(frame, demosaic="superpixel")
    return image.rgb * per_time, image.valid


def _full_scale(values: Float32Array, valid: BoolArray) -> float:
    shown = values[valid]
    return float(np.quantile(shown, 1.0 - MAX_BRIGHT_FRACTION)) if shown.size else 0.0


def _coded(values: Float32Array, valid: BoolArray, scale: float) -> tuple[UInt16Array, float]:
    codes = np.rint(np.nan_to_num(values.astype(np.float64)) * scale)
    beyond = codes > SATURATED_CODE - 1
    beyond = (beyond if codes.ndim == 2 else beyond.any(axis=-1)) | ~valid
    codes[beyond] = SATURATED_CODE
    return np.clip(codes, 0, SATURATED_CODE).astype(np.uint16), float(beyond.mean())
