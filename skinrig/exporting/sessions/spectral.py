"""Spectral and polarized images in the layout of Fichet et al.: of maps, and as they were taken.

Of the gradient sphere each state and pattern is a Stokes image: it is shown with the analyser along
the light's polarization, and across it. Their sum is all light, S0; their difference is S1, along
the analyser's axis: light that the surface reflected. S2 and S3 need an analyser at 45 degrees and
a retarder, which the rig does not have. The sensor is monochrome: its one band bears the mean
wavelength of the LEDs' light behind it.

References
----------
Fichet, Pacanowski, Wilkie 2021, An OpenEXR Layout for Spectral Images, JCGT 10(3).
Ma et al. 2007, Rapid Acquisition of Specular and Diffuse Normal Maps, EGSR.
"""

import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from capture.calibration.sensor import SensorCalibration
from capture.session import Session
from model import color_table, spectra
from model.skin import SkinAppearance
from model.tissue_optics.layers import ANISOTROPY_SKIN, C_HD_MAX, C_M_MAX
from reconstruction.pipeline.gradient.images import GradientImages, StatePatterns
from reconstruction.pipeline.gradient.stages import WAVELENGTH_UM
from reconstruction.pipeline.inputs import Inputs
from reconstruction.pipeline.sensor_noise import ElectronNoise
from skinrig.arrays import BoolArray, Float32Array, Float64Array
from skinrig.errors import require_choice
from skinrig.exporting.images import write_channels
from skinrig.exporting.options import ExportError, ExportSettings
from skinrig.exporting.sealing import IMAGE_ORIENTATION, describe_provenance, write_json
from skinrig.exporting.sessions.copies import write_session_document

REFLECTANCE_FILE, STOKES_FILE, SPECTRAL_DOCUMENT = "reflectance.exr", "stokes.exr", "spectral.json"
SPECTRAL_SCHEMA: Final = "skinrig.export.spectral/1"
LAYOUT_VERSION: Final = "1.0"
"""Version of the published layout."""


def write_spectra(
    appearance: SkinAppearance, folder: Path, delivery: ExportSettings
) -> list[tuple[str, str]]:
    """Write what an appearance of the flash rig holds of spectra and polarization.

    Parameters
    ----------
    appearance
        With melanin and hemoglobin, or diffuse and specular, or all of them.
    folder
        Existing, empty.
    delivery
        Whether masks are written.

    Returns
    -------
    list of (str, str)
        What was left out, and why.

    Raises
    ------
    ExportError
        For an appearance that holds neither.
    """
    left_out: list[tuple[str, str]] = []
    files: dict[str, Any] = {}
    maps = appearance.maps
    if {"melanin", "hemoglobin"} <= set(maps):
        files[REFLECTANCE_FILE] = _reflectance(appearance, folder)
    else:
        left_out.append((REFLECTANCE_FILE, "the maps lack melanin or hemoglobin"))
    if {"diffuse", "specular"} <= set(maps):
        files[STOKES_FILE] = _stokes(appearance, folder)
    else:
        left_out.append((STOKES_FILE, "the maps lack diffuse or specular"))
    if not files:
        raise ExportError(
            f"spectral: got maps {', '.join(sorted(maps)) or 'none'}, expected melanin and "
            "hemoglobin, or diffuse and specular, as of the flash rig"
        )
    if delivery.with_errors:
        for name in ("melanin", "hemoglobin", "diffuse", "specular"):
            if name in maps and maps[name].valid is not None:
                mask = np.asarray(maps[name].valid, np.float32)
                write_channels(folder / f"{name}_valid.exr", {"Y": mask}, {"unit": "1"})
    document: dict[str, Any] = {
        "schema": SPECTRAL_SCHEMA,
        "orientation": IMAGE_ORIENTATION,
        "files": files,
    }
    document["left_out"] = [list(row) for row in left_out]
    write_json(folder / SPECTRAL_DOCUMENT, {**describe_provenance(appearance), **document})
    return left_out


def format_channel_name(kind: str, wavelength_nm: float) -> str:
    """Return a channel's name: a comma parts decimals, for dots part layers.

    Parameters
    ----------
    kind
        "T" for reflectance, "S0" to "S3" for a Stokes component.
    wavelength_nm
        Above 0.

    Examples
    --------
    >>> format_channel_name("S1", 550.5), format_channel_name("T", 400.0)
    ('S1.550,5nm', 'T.400nm')
    """
    return f"{kind}.{f'{wavelength_nm:.6g}'.replace('.', ',')}nm"


def compute_band_means_nm(camera: str, illuminant: str) -> Float64Array:
    """Return the mean wavelength of a camera's bands under a light, nm, (3,).

    Examples
    --------
    >>> compute_band_means_nm("Nikon 5100 (NPL)", "D55").round(0).tolist()
    [596.0, 529.0, 473.0]
    """
    weights = spectra.camera_sensitivity(camera) * spectra.illuminant(illuminant)[:, None]
    return np.asarray(spectra.WAVELENGTH_NM @ weights / weights.sum(axis=0))


def _reflectance(appearance: SkinAppearance, folder: Path) -> dict[str, Any]:
    melanin, blood = appearance.maps["melanin"], appearance.maps["hemoglobin"]
    if melanin.values.shape != blood.values.shape:
        raise ExportError(
            f"hemoglobin: got shape {blood.values.shape}, expected {melanin.values.shape}"
        )
    valid = melanin.mask & blood.mask
    # estimates lie in the table by construction; rounding to float32 can leave it
    c_m = np.clip(melanin.values[valid].astype(np.float64), 0.0, C_M_MAX)
    c_hd = np.clip(blood.values[valid].astype(np.float64), 0.0, C_HD_MAX)
    found = color_table.spectral_reflectance(c_m, c_hd, anisotropy=ANISOTROPY_SKIN)
    channels = {}
    for band, wavelength in enumerate(spectra.WAVELENGTH_NM):
        layer = np.zeros(valid.shape, np.float32)
        layer[valid] = found[:, band]
        channels[format_channel_name("T", float(wavelength))] = layer
    what = (
        "modelled, not measured: diffuse reflectance at normal incidence without the surface's, of "
        "the two-layer skin with the estimated melanin and hemoglobin; 0 where they are not known"
    )
    header = {"spectralLayoutVersion": LAYOUT_VERSION, "comments": what}
    write_channels(folder / REFLECTANCE_FILE, channels, header)
    origin = {"what": what, "origin": "modelled", "unit": "1", "channels": list(channels)}
    return {**origin, "valid_share": float(valid.mean())}


def _stokes(appearance: SkinAppearance, folder: Path) -> dict[str, Any]:
    diffuse, specular = appearance.maps["diffuse"], appearance.maps["specular"]
    recorded = appearance.parameters.get("color_table")
    if not isinstance(recorded, dict) or not {"camera", "illuminant"} <= set(recorded):
        raise ExportError(
            "stokes: the maps have no camera and illuminant, so bands have no "
            "wavelength; make them with `skinrig reconstruct --maps diffuse,specular,melanin`"
        )
    means = compute_band_means_nm(str(recorded["camera"]), str(recorded["illuminant"]))
    valid = diffuse.mask & specular.mask
    s0 = np.where(valid[..., None], diffuse.values + specular.values, 0.0)
    s1 = np.where(valid[..., None], specular.values, 0.0)
    channels = {}
    for band, wavelength in enumerate(means):
        channels[format_channel_name("S0", float(wavelength))] = s0[..., band]
        channels[format_channel_name("S1", float(wavelength))] = s1[..., band]
    what = (
        "measured, by a parallel and a crossed picture: S0 all light, S1 what passes the analyser "
        "along the flash's polarizer less what passes across it; S2 and S3 were not measured. "
        "Bands of the camera at their mean wavelengths, not narrow lines; a white tile in the "
        "same place = 1"
    )
    write_channels(folder / STOKES_FILE, channels, build_stokes_header(what))
    return {
        "what": what,
        "origin": "measured",
        "unit": "white tile = 1",
        "channels": list(channels),
        "camera": recorded["camera"],
        "illuminant": recorded["illuminant"],
        "valid_share": float(valid.mean()),
    }


def build_stokes_header(description: str) -> dict[str, str]:
    """Return the attributes of a Stokes image in the published layout."""
    return {
        "spectralLayoutVersion": LAYOUT_VERSION,
        "emissiveUnits": "1",
        "polarisationHandedness": "right",
        "comments": description,
    }


DOCUMENT_FILE: Final = "stokes.json"
SCHEMA: Final = "skinrig.export.stokes/1"
PARALLEL, CROSSED = "parallel", "crossed"
STOKES_CHANNELS: Final = [format_channel_name(kind, 1e3 * WAVELENGTH_UM) for kind in ("S0", "S1")]


def write_stokes(session: Session, folder: Path, delivery: ExportSettings) -> list[tuple[str, str]]:
    """Write a gradient-sphere session's images as Stokes images.

    Parameters
    ----------
    session
        Of the gradient sphere.
    folder
        Existing folder.
    delivery
        Its ``only`` names states such as "a000_n0"; with errors, standard uncertainties
        of each image are written, and the mask of each state; its calibration is of the sensor.

    Returns
    -------
    list of (str, str)
        Patterns that were not taken with both polarizations.

    Raises
    ------
    ExportError
        For a session of another rig, or a state that it lacks.
    """
    if not session.frames("gradient"):
        kinds = ", ".join(sorted({step.kind for step in session.plan.steps}))
        raise ExportError(
            f"{session.path}: shows {kinds}, expected patterns of the gradient sphere; of the "
            "flash rig take `skinrig export APPEARANCE --to spectral`"
        )
    only, with_errors = delivery.only, delivery.with_errors
    inputs = Inputs.of(session, delivery.calibration, state="neutral", on_date=None)
    camera = session.frames("gradient")[0].camera
    images = GradientImages(session, noise=_noise(inputs, camera))
    names = [state.name for state in images.states]
    for name in only:
        require_choice("--only", name, names, ExportError)
    axis = session.rig.view(camera).analyser_axis_deg
    if axis is None:
        raise ExportError(
            f"{session.path}: the rig has no axis of its analyzer; add analyser_axis_deg "
            "to the view"
        )
    what = (
        "measured, by a picture along the analyser's axis and one across: S0 all light, S1 along "
        f"the axis minus across it; the axis lies {axis:g} degrees from x right towards y up; S2 "
        "and S3 were not measured. Wavelengths are the means of the sensor's broad bands"
    )
    files: dict[str, Any] = {}
    left_out: list[tuple[str, str]] = []
    for state in images.states:
        if not only or state.name in only:
            entries, missing = _write_state(state.name, images.of(state), folder, what, with_errors)
            files |= entries
            left_out += missing
    if not files:
        raise ExportError(
            f"{session.path}: no pattern was taken both along and across the analyser's axis, "
            "expected `skinrig plan gradient` with both polarizations"
        )
    document = {
        "schema": SCHEMA,
        "what": what,
        "unit": "fraction of the sensor's full scale, darks subtracted, exposure as taken",
        "channels": STOKES_CHANNELS,
        "reference_axis_deg": axis,
        "image_frame": "against the picture's x axis S1 is "
        f"{math.cos(math.radians(2 * axis)):.9g} of what was measured along the analyser",
        "orientation": "as the camera sees it, row 0 is the top",
        "leakage": "not taken off: what crossed films let through is in S0 and lowers S1",
        "files": files,
    }
    write_session_document(folder / DOCUMENT_FILE, inputs, document, left_out)
    return left_out


def _write_state(
    state: str, patterns: StatePatterns, folder: Path, description: str, with_errors: bool
) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Write the images of one state; return what is in each file, and patterns left out."""
    files: dict[str, Any] = {}
    left_out = []
    for pattern in sorted({pattern for pattern, _ in patterns.values}):
        along, across = (pattern, PARALLEL), (pattern, CROSSED)
        if not {along, across} <= set(patterns.values):
            left_out.append((f"{state} {pattern}", "was taken with one polarization only"))
            continue
        stem = format_file_stem(state, pattern)
        one, other = patterns.values[along], patterns.values[across]
        found = one + other, one - other
        channels = dict(zip(STOKES_CHANNELS, found, strict=True))
        write_channels(folder / f"{stem}.exr", channels, build_stokes_header(description))
        stderr = np.sqrt(patterns.variance[along] + patterns.variance[across])
        figures = _figures(*found, stderr, patterns.valid)
        files[f"{stem}.exr"] = {"state": state, "pattern": pattern, **figures}
        if with_errors:
            header = {"unit": "1", "comments": "standard error of S0 and of S1, 68 %"}
            write_channels(folder / f"{stem}.stderr.exr", {"Y": stderr}, header)
    if with_errors:
        mask = patterns.valid.astype(np.float32)
        write_channels(folder / f"stokes_{state}.valid.exr", {"Y": mask}, {"unit": "1"})
    return files, left_out


def _noise(inputs: Any, camera: str) -> Any:

    serial = inputs.session.rig.view(camera).serial
    found = inputs.load("sensor", [serial], "noise as recorded by the frames")
    if found is None:
        return None
    known = SensorCalibration.from_calibration(found, serial)
    return ElectronNoise(float(known.gain_e_per_dn.value[0]), float(known.read_noise_e.value[0]))


def format_file_stem(state: str, pattern: str) -> str:
    """Return a Stokes image's name without suffix.

    Examples
    --------
    >>> format_file_stem("a000_n0", "-x")
    'stokes_a000_n0_minus_x'
    """
    return f"stokes_{state}_{pattern.replace('-', 'minus_')}"


def _figures(
    s0: Float32Array, s1: Float32Array, stderr: Float32Array, valid: BoolArray
) -> dict[str, float]:
    """Return what is worth knowing of an image before it is opened, as JSON values."""
    if not valid.any():
        return {"valid_share": 0.0}
    total, along = s0[valid].astype(np.float64), s1[valid].astype(np.float64)
    return {
        "valid_share": float(valid.mean()),
        "degree_of_polarization": float(along.sum() / total.sum()) if total.sum() > 0.0 else 0.0,
        # noise alone makes a difference exceed its sum, or fall below 0
        "beyond_s0_by_3_stderr_share": float(np.mean(np.abs(along) - total > 3.0 * stderr[valid])),
    }
