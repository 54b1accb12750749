"""Colors of a dome's camera brought to linear sRGB, by what is known of that camera.

A color calibration comes first. Without one, a session beside the folder names the sensor and the
light: both are tabulated, and skin of any melanin and hemoglobin has a color in either space.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from capture.calibration import store
from capture.calibration.color import matrix as color
from capture.session import Session, SessionError
from model import color_table, spectra
from model.skin import SkinAppearance
from model.tissue_optics.layers import ANISOTROPY_SKIN
from skinrig.arrays import Float64Array
from skinrig.viewer.scene import SceneSource

COLOR_KIND: Final = "color"
CALIBRATION_INPUT_PREFIX: Final = "calibration "
"""Inputs of an appearance that are files of a calibration begin like this."""
TABLE_NODES: Final = 24
"""Nodes a side of the table of skin colors that a matrix is fitted to."""


@dataclass(frozen=True, slots=True)
class CameraColor:
    """How camera RGB over that of a white becomes linear sRGB.

    Attributes
    ----------
    convert
        From (..., 3) to (..., 3).
    provenance
        Where it comes from, for people.
    known
        False: nothing is known, and camera RGB is taken for linear sRGB.
    """

    convert: Callable[[Float64Array], Float64Array]
    provenance: str
    known: bool = True


def of(source: SceneSource) -> CameraColor:
    """Return the color of the camera that measured a scene's albedo.

    Raises
    ------
    capture.calibration.record.CalibrationError
        A color calibration that is damaged, or missing in a folder that was named.
    """
    kind = next(name for name in ("model", "dome") if name in source.appearances)
    appearance, path = source.appearances[kind], source.paths.get(kind)
    folder = source.calibration or (None if path is None else _beside(appearance, path))
    if folder is not None:
        return _calibrated(folder)
    found = None if path is None else _tabulated(appearance, path)
    shown = (
        "its camera RGB is shown as if it were linear sRGB; --calibration names a folder with a "
        "color calibration"
    )
    return found or CameraColor(lambda rgb: rgb, shown, known=False)


def _beside(appearance: SkinAppearance, path: Path) -> Path | None:
    """Return the calibration that an appearance was made with, if it lies beside and has color."""
    digests = {
        name.removeprefix(CALIBRATION_INPUT_PREFIX): digest
        for name, digest in appearance.inputs.items()
        if name.startswith(CALIBRATION_INPUT_PREFIX)
    }
    for folder in sorted(path.resolve().parent.iterdir()):
        if not (folder / f"{COLOR_KIND}.json").is_file():
            continue
        for kind, digest in digests.items():
            file = folder / f"{kind}.json"
            if file.is_file() and hashlib.sha256(file.read_bytes()).hexdigest() == digest:
                return folder
    return None


def _calibrated(folder: Path) -> CameraColor:

    found = store.load(folder, COLOR_KIND)
    cameras = [
        (color.from_calibration(found, serial), found.quantity(serial, "white_rgb").value)
        for serial in found.serials
    ]
    error = float(np.mean([one.mean_delta_e for one, _ in cameras]))

    def convert(rgb: Float64Array) -> Float64Array:
        # maps merge all cameras: so are their colors
        seen = [one.to_linear_srgb(rgb * white) for one, white in cameras]
        return np.asarray(np.mean(seen, axis=0))

    several = f" of {len(cameras)} cameras" if len(cameras) > 1 else ""
    quality = f"{error:.1f} dE2000 on held-out patches"
    return CameraColor(convert, f"{folder.name}/{COLOR_KIND}.json{several}, {quality}")


def _tabulated(appearance: SkinAppearance, path: Path) -> CameraColor | None:
    """Return a matrix between colors of skin, where a session beside names sensor and light."""
    name: Any = appearance.parameters.get("session")
    if not isinstance(name, str):
        return None
    folder = path.resolve().parent / Path(name).name
    try:
        rig = Session.open(folder).rig
    except (SessionError, OSError):
        return None
    camera, light = rig.views[0].spectral_sensitivity, rig.lights[0].illuminant
    if camera not in spectra.camera_names() or light not in spectra.illuminant_names():
        return None
    measured, shown = (
        color_table.build(*pair, size=TABLE_NODES, anisotropy=ANISOTROPY_SKIN).rgb.reshape(-1, 3)
        for pair in ((camera, light), (spectra.LINEAR_SRGB, "D65"))
    )
    matrix = np.linalg.lstsq(measured, shown, rcond=None)[0]
    error = float(np.sqrt(np.mean((measured @ matrix - shown) ** 2)))
    return CameraColor(
        lambda rgb: np.asarray(rgb @ matrix),
        f"a matrix between the colors of skin that the tabulated sensor {camera} and {light} and "
        f"linear sRGB see, {error:.4f} RMS; no color calibration was found",
    )
