"""Write spectral and polarized images of maps and sessions in the layout of Fichet et al.

Each strain step and pattern of the gradient sphere is a Stokes image. It is captured with the
analyzer parallel and perpendicular to the light's polarization. Their sum is S0, the total light.
Their difference is S1 along the analyzer's axis, the specular reflection. S2 and S3 require an
analyzer at 45 degrees and a retarder, which the rig lacks. The sensor is monochrome; its band is
labeled by the mean wavelength of the LEDs' light weighted by its response.

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
from skinrig.exporting.sealing import (
    IMAGE_ORIENTATION,
    PROVENANCE_KEY,
    describe_provenance,
    format_provenance,
    write_json,
)
from skinrig.exporting.sessions.copies import write_session_document

REFLECTANCE_FILE, STOKES_FILE, SPECTRAL_DOCUMENT = "reflectance.exr", "stokes.exr", "spectral.json"
SPECTRAL_SCHEMA: Final = "skinrig.export.spectral/1"
LAYOUT_VERSION: Final = "1.0"
"""Version of the published layout."""


def write_spectra(
    appearance: SkinAppearance, folder: Path, delivery: ExportSettings
) -> list[tuple[str, str]]:
    """Write the spectral reflectance and Stokes images of a flash appearance.

    Parameters
    ----------
    appearance
        Appearance with melanin and hemoglobin, or diffuse and specular, or all of them.
    folder
        Existing, empty folder.
    delivery
        With or without masks.

    Returns
    -------
    list of (str, str)
        Omissions with reasons.

    Raises
    ------
    ExportError
        If the appearance has neither.
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
                header = {"unit": "1", PROVENANCE_KEY: format_provenance(appearance)}
                write_channels(folder / f"{name}_valid.exr", {"Y": mask}, header)
    document: dict[str, Any] = {
        "schema": SPECTRAL_SCHEMA,
        "orientation": IMAGE_ORIENTATION,
        "files": files,
    }
    document["left_out"] = [list(row) for row in left_out]
    write_json(folder / SPECTRAL_DOCUMENT, {**describe_provenance(appearance), **document})
    return left_out


def format_channel_name(kind: str, wavelength_nm: float) -> str:
    """Format a channel's name; the decimal separator is a comma, as dots separate layers.

    Parameters
    ----------
    kind
        "T" for reflectance, "S0" to "S3" for a Stokes component.
    wavelength_nm
        Wavelength, nm, above 0.

    Examples
    --------
    >>> format_channel_name("S1", 550.5), format_channel_name("T", 400.0)
    ('S1.550,5nm', 'T.400nm')
    """
    return f"{kind}.{f'{wavelength_nm:.6g}'.replace('.', ',')}nm"


def compute_band_means_nm(camera: str, illuminant: str) -> Float64Array:
    """Compute the mean wavelength of a camera's bands under an illuminant, nm, (3,).

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
            f"hemoglobin: got shape {blood.values.shape}, expected {melanin.values.shape} as of "
            "melanin; reconstruct both together"
        )
    valid = melanin.mask & blood.mask
    # estimates are within the table by construction, but rounding to float32 can exceed it
    c_m = np.clip(melanin.values[valid].astype(np.float64), 0.0, C_M_MAX)
    c_hd = np.clip(blood.values[valid].astype(np.float64), 0.0, C_HD_MAX)
    found = color_table.spectral_reflectance(c_m, c_hd, anisotropy=ANISOTROPY_SKIN)
    channels = {}
    for band, wavelength in enumerate(spectra.WAVELENGTH_NM):
        layer = np.zeros(valid.shape, np.float32)
        layer[valid] = found[:, band]
        channels[format_channel_name("T", float(wavelength))] = layer
    what = (
        "modeled, not measured: diffuse reflectance at normal incidence, without specular "
        "reflection, of two-layer skin with the estimated melanin and hemoglobin; 0 where these "
        "are unknown"
    )
    header = {"spectralLayoutVersion": LAYOUT_VERSION, "comments": what}
    header[PROVENANCE_KEY] = format_provenance(appearance)
    write_channels(folder / REFLECTANCE_FILE, channels, header)
    origin = {"what": what, "origin": "modelled", "unit": "1", "channels": list(channels)}
    return {**origin, "valid_share": float(valid.mean())}


def _stokes(appearance: SkinAppearance, folder: Path) -> dict[str, Any]:
    diffuse, specular = appearance.maps["diffuse"], appearance.maps["specular"]
    recorded = appearance.parameters.get("color_table")
    if not isinstance(recorded, dict) or not {"camera", "illuminant"} <= set(recorded):
        raise ExportError(
            "stokes: camera and illuminant of the maps are unknown, expected them for the bands' "
            "wavelengths; reconstruct with `--maps diffuse,specular,melanin`"
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
        "measured, from a parallel and a cross-polarized image: S0 total light, S1 light through "
        "the analyzer parallel minus perpendicular to the flash's polarizer; S2 and S3 were not "
        "measured. Bands of the camera at their mean wavelengths, not narrow lines; a white "
        "reference in the same position = 1"
    )
    header = build_stokes_header(what) | {PROVENANCE_KEY: format_provenance(appearance)}
    write_channels(folder / STOKES_FILE, channels, header)
    return {
        "what": what,
        "origin": "measured",
        "unit": "white reference = 1",
        "channels": list(channels),
        "camera": recorded["camera"],
        "illuminant": recorded["illuminant"],
        "valid_share": float(valid.mean()),
    }


def build_stokes_header(description: str) -> dict[str, str]:
    """Build the header attributes of a Stokes image in the published layout."""
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
        Session of the gradient sphere.
    folder
        Existing folder.
    delivery
        ``only`` selects strain steps such as "a000_n0". With errors, the standard uncertainties of
        each image and the mask of each strain step are written. The calibration is of the sensor.

    Returns
    -------
    list of (str, str)
        Omitted patterns: those without both polarizations.

    Raises
    ------
    ExportError
        If the session is of another rig, or lacks a strain step.
    """
    if not session.frames("gradient"):
        kinds = ", ".join(sorted({step.kind for step in session.plan.steps}))
        raise ExportError(
            f"{session.path}: got {kinds}, expected patterns of the gradient sphere; for the flash "
            "rig use `skinrig export APPEARANCE --to spectral`"
        )
    only, with_errors = delivery.only, delivery.with_errors
    inputs = Inputs.of(session, delivery.calibration, state="neutral", on_date=None)
    camera = session.frames("gradient")[0].camera
    images = GradientImages(session, noise=_noise(inputs, camera))
    names = [state.name for state in images.states]
    for name in only:
        require_choice("--only", name, names, ExportError)
    axis = session.rig.view(camera).analyzer_axis_deg
    if axis is None:
        raise ExportError(
            f"{session.path}: axis of the rig's analyzer is missing; add analyzer_axis_deg "
            "to the view"
        )
    what = (
        "measured, from images parallel and perpendicular to the analyzer's axis: S0 total light, "
        f"S1 parallel minus perpendicular; the axis is {axis:g} degrees from x right towards y "
        "up; S2 and S3 were not measured. Wavelengths are the means of the sensor's broad bands"
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
            f"{session.path}: got no pattern with both polarizations, expected at least one; "
            "capture with a plan of `skinrig plan gradient`"
        )
    document = {
        "schema": SCHEMA,
        "what": what,
        "unit": "fraction of the sensor's full scale, dark frames subtracted, exposure as captured",
        "channels": STOKES_CHANNELS,
        "reference_axis_deg": axis,
        "image_frame": "relative to the image's x axis, S1 is "
        f"{math.cos(math.radians(2 * axis)):.9g} of that along the analyzer",
        "orientation": "camera image, row 0 is the top",
        "leakage": "not subtracted: leakage of crossed polarizers is in S0 and reduces S1",
        "files": files,
    }
    write_session_document(folder / DOCUMENT_FILE, inputs, document, left_out)
    return left_out


def _write_state(
    state: str, patterns: StatePatterns, folder: Path, description: str, with_errors: bool
) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Write the images of one strain step; return a record per file, and omitted patterns."""
    files: dict[str, Any] = {}
    left_out = []
    for pattern in sorted({pattern for pattern, _ in patterns.values}):
        along, across = (pattern, PARALLEL), (pattern, CROSSED)
        if not {along, across} <= set(patterns.values):
            left_out.append((f"{state} {pattern}", "captured with one polarization only"))
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
            header = {"unit": "1", "comments": "standard uncertainty of S0 and of S1, 68 %"}
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
    """Format a Stokes image's name without suffix.

    Examples
    --------
    >>> format_file_stem("a000_n0", "-x")
    'stokes_a000_n0_minus_x'
    """
    return f"stokes_{state}_{pattern.replace('-', 'minus_')}"


def _figures(
    s0: Float32Array, s1: Float32Array, stderr: Float32Array, valid: BoolArray
) -> dict[str, float]:
    """Return summary figures of an image as JSON values."""
    if not valid.any():
        return {"valid_share": 0.0}
    total, along = s0[valid].astype(np.float64), s1[valid].astype(np.float64)
    return {
        "valid_share": float(valid.mean()),
        "degree_of_polarization": float(along.sum() / total.sum()) if total.sum() > 0.0 else 0.0,
        # by noise alone, a difference may exceed its sum, and a sum may be below 0
        "beyond_s0_by_3_stderr_share": float(np.mean(np.abs(along) - total > 3.0 * stderr[valid])),
    }
