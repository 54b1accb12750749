"""Raw files of the rigs look right in programs that develop them.

Rationale: LibRaw develops a frame of known skin by the matrix and neutral in the file alone.
Expected: the skin under D50, up to exposure. Tolerance: Delta E 2000 of 4, as a matrix from RGB to
XYZ is not exact. Without the entries, the frame comes out green.
"""

import io
from dataclasses import replace

import numpy as np
import pytest
import rawpy

from capture import raw
from capture.calibration.color.colorimetry import delta_e_2000, lab_from_xyz, white_point
from capture.rig import load_rig
from model import color_table, spectra
from model.tissue_optics.layers import ANISOTROPY_SKIN
from skinrig.capturing.camera_colors import nominal_camera_colors

TILE_PX = 32
BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


@pytest.fixture(scope="module")
def skin():
    c_m, c_hd = np.array([0.008, 0.02, 0.05, 0.12, 0.25])[:, None], np.array([0.004, 0.012, 0.03])
    return color_table.spectral_reflectance(c_m, c_hd, anisotropy=ANISOTROPY_SKIN).reshape(-1, 31)


def mosaic(skin, view, light):
    """Tiles of skin, one below the other, as the sensor reads them out."""
    lit = skin * spectra.illuminant(light)
    rgb = lit @ spectra.camera_sensitivity(view.spectral_sensitivity)
    values = view.black_level + 0.6 * (view.white_level - view.black_level) * rgb / rgb.max()
    cell = np.round(values).astype(np.uint16)[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    return np.tile(cell[:, None, :, None, :], (1, TILE_PX // 2, 1, TILE_PX, 1)).reshape(
        len(skin) * TILE_PX, 2 * TILE_PX
    )


def developed_xyz(cfa, view, color):
    """XYZ under D50 of each tile, by LibRaw."""
    blob = raw.encode_frame(
        raw.RawFrame(
            cfa=cfa,
            pattern=view.cfa,
            black=(float(view.black_level),) * 4,
            white=view.white_level,
            camera_model=view.camera_model,
            color_matrix=None if color is None else color.matrix,
            neutral=None if color is None else color.neutral,
        )
    )
    with rawpy.imread(io.BytesIO(blob)) as file:
        image = file.postprocess(
            use_camera_wb=True,
            no_auto_bright=True,
            gamma=(1, 1),
            output_bps=16,
            output_color=rawpy.ColorSpace.sRGB,
        )
    crop = (len(cfa) - len(image)) // 2
    middle = np.arange(TILE_PX // 2, len(cfa), TILE_PX) - crop
    rgb = np.stack([image[m - 4 : m + 4, 20:28].mean(axis=(0, 1)) for m in middle]) / 65_535.0
    d50, d65 = white_point("D50"), white_point("D65")
    adapt = np.linalg.solve(BRADFORD, np.diag((BRADFORD @ d50) / (BRADFORD @ d65)) @ BRADFORD)
    return rgb @ np.linalg.inv(spectra.XYZ_TO_LINEAR_SRGB).T @ adapt.T


def color_error(xyz, skin):
    light = spectra.illuminant("D50")
    curves = spectra.color_matching_functions()
    truth = skin * light @ curves / (light @ curves[:, 1])
    scaled = xyz * np.median(truth[:, 1] / xyz[:, 1])  # up to exposure
    white = white_point("D50")
    return delta_e_2000(lab_from_xyz(scaled, white), lab_from_xyz(truth, white))


@pytest.mark.parametrize("name", ["flash", "dome", "probe"])
def test_developed_skin_has_its_color(skin, name):
    rig = load_rig(name)
    view = rig.views[0]
    cfa = mosaic(skin, view, rig.lights[0].illuminant)
    color = nominal_camera_colors(rig)[view.name]
    assert color_error(developed_xyz(cfa, view, color), skin).max() < 4.0
    assert np.median(color_error(developed_xyz(cfa, view, None), skin)) > 8.0


def test_camera_colors_of_every_view_are_finite():
    rig = load_rig("dome")
    colors = nominal_camera_colors(rig)
    assert set(colors) == {view.name for view in rig.views}
    one = colors[rig.views[0].name]
    assert max(one.neutral) == 1.0
    np.testing.assert_allclose(one.matrix @ white_point("D65"), one.neutral, rtol=5e-3)


def test_camera_colors_omit_unknown_sensitivities_and_mono():
    rig = load_rig("flash")
    own = replace(rig.views[0], spectral_sensitivity="my camera")
    mono = replace(rig.views[0], cfa="MONO")
    assert nominal_camera_colors(replace(rig, views=(own,))) == {}
    assert nominal_camera_colors(replace(rig, views=(mono,))) == {}
    other_light = replace(rig.lights[0], illuminant="my lamp")
    assert nominal_camera_colors(replace(rig, lights=(other_light, rig.lights[1]))) == {}
