"""Spectral and polarized images in the layout of Fichet et al.: what is measured, what is modelled.

``reflectance.exr`` is modelled: the two-layer skin whose melanin and hemoglobin were estimated,
evaluated at 31 wavelengths. ``stokes.exr`` is measured, in the three bands of the camera: all
light (S0), and what keeps the flash's polarization (S1). A band has no single wavelength:
channels bear the mean of the band, and the header says so.

References
----------
Fichet, Pacanowski, Wilkie 2021, An OpenEXR Layout for Spectral Images, JCGT 10(3).
"""

from pathlib import Path
from typing import Any, Final

import numpy as np

from model import color_table, spectra
from model.skin import SkinAppearance
from model.tissue_optics.layers import ANISOTROPY_SKIN, C_HD_MAX, C_M_MAX
from skinrig.arrays import Float64Array
from skinrig.exporting.images import write_channels
from skinrig.exporting.options import Delivery, ExportError
from skinrig.exporting.sealing import IMAGE_ORIENTATION, provenance, write_json

REFLECTANCE_FILE, STOKES_FILE, DOCUMENT_FILE = "reflectance.exr", "stokes.exr", "spectral.json"
SCHEMA: Final = "skinrig.export.spectral/1"
LAYOUT_VERSION: Final = "1.0"
"""Version of the published layout."""


def write(appearance: SkinAppearance, folder: Path, delivery: Delivery) -> list[tuple[str, str]]:
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
    told: dict[str, Any] = {"schema": SCHEMA, "orientation": IMAGE_ORIENTATION, "files": files}
    told["left_out"] = [list(row) for row in left_out]
    write_json(folder / DOCUMENT_FILE, {**provenance(appearance), **told})
    return left_out


def channel(kind: str, wavelength_nm: float) -> str:
    """Return a channel's name: a comma parts decimals, for dots part layers.

    Parameters
    ----------
    kind
        "T" for reflectance, "S0" to "S3" for a Stokes component.
    wavelength_nm
        Above 0.

    Examples
    --------
    >>> channel("S1", 550.5), channel("T", 400.0)
    ('S1.550,5nm', 'T.400nm')
    """
    return f"{kind}.{f'{wavelength_nm:.6g}'.replace('.', ',')}nm"


def band_means_nm(camera: str, illuminant: str) -> Float64Array:
    """Return the mean wavelength of a camera's bands under a light, nm, (3,).

    Examples
    --------
    >>> band_means_nm("Nikon 5100 (NPL)", "D55").round(0).tolist()
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
        channels[channel("T", float(wavelength))] = layer
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
    told = appearance.parameters.get("color_table")
    if not isinstance(told, dict) or not {"camera", "illuminant"} <= set(told):
        raise ExportError(
            "stokes: the maps do not say which camera and light they are of, so that bands have no "
            "wavelength; make them again with `skinrig reconstruct --want diffuse,specular,melanin`"
        )
    means = band_means_nm(str(told["camera"]), str(told["illuminant"]))
    valid = diffuse.mask & specular.mask
    s0 = np.where(valid[..., None], diffuse.values + specular.values, 0.0)
    s1 = np.where(valid[..., None], specular.values, 0.0)
    channels = {}
    for band, wavelength in enumerate(means):
        channels[channel("S0", float(wavelength))] = s0[..., band]
        channels[channel("S1", float(wavelength))] = s1[..., band]
    what = (
        "measured, by a parallel and a crossed picture: S0 all light, S1 what passes the analyser "
        "along the flash's polarizer less what passes across it; S2 and S3 were not measured. "
        "Bands of the camera at their mean wavelengths, not narrow lines; a white tile in the "
        "same place = 1"
    )
    write_channels(folder / STOKES_FILE, channels, stokes_header(what))
    return {
        "what": what,
        "origin": "measured",
        "unit": "white tile = 1",
        "channels": list(channels),
        "camera": told["camera"],
        "illuminant": told["illuminant"],
        "valid_share": float(valid.mean()),
    }


def stokes_header(what: str) -> dict[str, str]:
    """Return the attributes of a Stokes image in the published layout."""
    return {
        "spectralLayoutVersion": LAYOUT_VERSION,
        "emissiveUnits": "1",
        "polarisationHandedness": "right",
        "comments": what,
    }
