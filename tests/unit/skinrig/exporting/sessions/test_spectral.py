"""Spectral and Stokes images: names by the published layout, values by direct computation."""

import json
import re

import numpy as np
import OpenEXR
import pytest

from model import color_table, spectra
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from model.tissue_optics import SKIN_CONSTANTS, two_layer_reflectance
from model.tissue_optics.layers import ANISOTROPY_SKIN
from skinrig.exporting.options import ExportError, ExportSettings
from skinrig.exporting.sessions import spectral as stokes

CAMERA, LIGHT = "Nikon 5100 (NPL)", "D55"


@pytest.fixture
def flash(rng):
    shape = (3, 4)
    valid = np.ones(shape, bool)
    valid[0, 0] = False
    return SkinAppearance(
        {
            "melanin": SkinMap(rng.uniform(0.01, 0.4, shape), MAP_UNITS["melanin"], valid=valid),
            "hemoglobin": SkinMap(rng.uniform(0.005, 0.2, shape), MAP_UNITS["hemoglobin"]),
            "diffuse": SkinMap(rng.uniform(0.2, 0.8, (*shape, 3)), "1"),
            "specular": SkinMap(rng.uniform(0.0, 0.3, (*shape, 3)), "1", valid=valid),
        },
        "simulated",
        {"color_table": {"camera": CAMERA, "illuminant": LIGHT}},
    )


def channels(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        header = dict(file.header())
        return header, {n: c.pixels.copy() for n, c in file.channels().items()}


def wavelengths(names, kind):
    """Read names by the pattern that another implementation of the layout publishes."""
    fichet = pytest.importorskip("colour.io.fichet2021")
    found = {}
    for name in names:
        match = re.match(rf"^{kind}\.{fichet.PATTERN_FICHET2021}$", name)
        if match is not None:
            number, _, multiplier, unit = match.groups()
            found[name] = fichet.match_groups_to_nm(number, multiplier or "", unit)
    return found


def test_reflectance_matches_two_layer_model_per_wavelength(flash, tmp_path):
    stokes.write_spectra(flash, tmp_path, ExportSettings())
    header, found = channels(tmp_path / "reflectance.exr")
    named = wavelengths(found, "T")
    assert sorted(named.values()) == spectra.WAVELENGTH_NM.tolist()
    assert header["spectralLayoutVersion"] == "1.0"
    assert header["comments"].startswith("modeled")
    picked = [400.0, 540.0, 700.0]
    for row, column in ((1, 2), (2, 3)):
        direct = two_layer_reflectance(
            picked,
            float(flash.maps["melanin"].values[row, column]),
            float(flash.maps["hemoglobin"].values[row, column]),
            constants=SKIN_CONSTANTS,
            anisotropy=ANISOTROPY_SKIN,
        )
        stored = [found[n][row, column] for w in picked for n, nm in named.items() if nm == w]
        np.testing.assert_allclose(stored, direct, rtol=2e-3)
    assert not any(layer[0, 0] for layer in found.values())  # where melanin is not known


def test_spectra_average_to_camera_table_colors(rng):
    c_m, c_hd = rng.uniform(0.005, 0.45, 40), rng.uniform(0.002, 0.3, 40)
    table = color_table.build(CAMERA, LIGHT, anisotropy=ANISOTROPY_SKIN)
    reflectance = color_table.spectral_reflectance(c_m, c_hd, anisotropy=ANISOTROPY_SKIN)
    averaged = reflectance @ np.asarray(spectra.band_weights(CAMERA, LIGHT))
    np.testing.assert_allclose(averaged, table.lookup(c_m, c_hd), rtol=1e-4)


def test_fractions_outside_the_table_have_no_spectrum():
    for c_m, c_hd in ((-0.1, 0.1), (0.1, 0.4), (np.nan, 0.1)):
        with pytest.raises(color_table.ColorTableError, match=": got"):
            color_table.spectral_reflectance(c_m, c_hd)


def test_stokes_components_give_parallel_and_crossed_images(flash, tmp_path):
    """An analyzer along (across) the polarizer passes (S0 + S1) / 2 and (S0 - S1) / 2."""
    stokes.write_spectra(flash, tmp_path, ExportSettings())
    header, found = channels(tmp_path / "stokes.exr")
    assert header["comments"].startswith("measured")
    assert header["polarisationHandedness"] == "right"
    totals, kept = wavelengths(found, "S0"), wavelengths(found, "S1")
    assert len(totals) == len(kept) == 3
    assert sorted(totals.values()) == sorted(kept.values())
    red = max(totals, key=totals.get), max(kept, key=kept.get)
    s0, s1 = (found[name][1:] for name in red)
    diffuse, specular = (flash.maps[n].values[1:, :, 0] for n in ("diffuse", "specular"))
    np.testing.assert_allclose((s0 + s1) / 2, diffuse / 2 + specular, atol=1e-6)
    np.testing.assert_allclose((s0 - s1) / 2, diffuse / 2, atol=1e-6)


def test_document_separates_measured_from_unmeasured(flash, tmp_path):
    left_out = stokes.write_spectra(
        SkinAppearance({n: flash.maps[n] for n in ("melanin", "hemoglobin")}, "simulated"),
        tmp_path,
        ExportSettings(),
    )
    assert [what for what, _ in left_out] == ["stokes.exr"]
    told = json.loads((tmp_path / "spectral.json").read_text())
    assert told["files"]["reflectance.exr"]["origin"] == "modelled"
    assert not (tmp_path / "stokes.exr").exists()


def test_bands_without_a_camera_have_no_wavelength(flash, tmp_path):
    nameless = SkinAppearance(dict(flash.maps), "simulated")
    with pytest.raises(ExportError, match="camera and illuminant"):
        stokes.write_spectra(nameless, tmp_path, ExportSettings())
    with pytest.raises(ExportError, match="expected melanin and hemoglobin"):
        stokes.write_spectra(SkinAppearance({}, "simulated"), tmp_path, ExportSettings())
