"""A dome's colors come to linear sRGB by what is known of its camera, and else it is said."""

from __future__ import annotations

from datetime import date

import numpy as np
import pytest

from capture.calibration import store
from capture.calibration.color import matrix as color
from capture.calibration.record import Quantity
from model import color_table, spectra
from model.skin import SkinAppearance, SkinMap
from model.tissue_optics.layers import ANISOTROPY_SKIN
from rigsim.geometry.mesh import build_mesh
from skinrig.viewer.assets import facial_color
from skinrig.viewer.scene import SceneSource

CAMERA, LIGHT = "Nikon 5100 (NPL)", "LED-B3"
MATRIX = np.array([[1.5, 0.2, 0.1], [0.6, 1.2, -0.4], [0.1, -0.4, 1.9]])
WHITE = np.array([0.48, 0.77, 0.6])


def _source(folder, **more):
    values = np.full((4, 4, 3), 0.4, np.float32)
    appearance = SkinAppearance(maps={"r_d": SkinMap(values, "1")}, source="simulated", **more)
    mesh = build_mesh(10.0 * np.eye(3), [[0, 1, 2]], np.zeros((3, 2)))
    return SceneSource(
        "dome", mesh, 64, 0, None, None, {"dome": appearance}, {"dome": folder / "appearance"}
    )


def _calibration(folder):
    fit = color.ColorMatrix(
        MATRIX, np.array([1.5]), np.zeros((3, 3)), "linear", "D55", np.array([1.0])
    )
    made = color.to_calibration(
        fit,
        Quantity(WHITE, np.zeros(3)),
        serial="SD-1",
        rig="dome",
        source="simulated",
        created=date(2026, 1, 1),
        inputs={},
    )
    store.save(made, folder)
    return fit


@pytest.mark.parametrize("named", [True, False], ids=["named", "found beside by its hash"])
def test_a_color_calibration_brings_camera_colors_to_srgb(tmp_path, named):
    import dataclasses
    import hashlib

    fit = _calibration(tmp_path / "calibration")
    digest = hashlib.sha256((tmp_path / "calibration" / "color.json").read_bytes()).hexdigest()
    source = _source(tmp_path, inputs={} if named else {"calibration color": digest})
    if named:
        source = dataclasses.replace(source, calibration=tmp_path / "calibration")
    found = facial_color.find_camera_color(source)
    rgb = np.array([[0.5, 0.4, 0.3], [1.0, 1.0, 1.0]])
    np.testing.assert_allclose(found.convert(rgb), fit.to_linear_srgb(rgb * WHITE), rtol=1e-12)
    assert found.known
    assert "1.5 dE2000" in found.provenance
    assert np.abs(found.convert(rgb) - rgb).max() > 0.05


def test_calibration_of_neighboring_session_is_not_used(tmp_path):
    _calibration(tmp_path / "calibration")
    found = facial_color.find_camera_color(
        _source(tmp_path, inputs={"calibration color": "0" * 64})
    )
    assert not found.known
    rgb = np.array([0.5, 0.4, 0.3])
    np.testing.assert_array_equal(found.convert(rgb), rgb)
    assert "displayed as linear sRGB" in found.provenance


def test_tabulated_sensor_renders_skin_like_srgb(tmp_path, monkeypatch):
    """Within 0.01 of skin of another grid; without the matrix it is off by far more."""
    source = _source(tmp_path, parameters={"session": "session"})

    class Named:
        class rig:  # noqa: N801
            views = (type("View", (), {"spectral_sensitivity": CAMERA}),)
            lights = (type("Light", (), {"illuminant": LIGHT}),)

    monkeypatch.setattr("capture.session.Session.open", lambda _: Named)
    found = facial_color.find_camera_color(source)
    assert found.known
    assert "without color calibration" in found.provenance
    table = color_table.build(CAMERA, LIGHT, size=9, anisotropy=ANISOTROPY_SKIN)
    wanted = color_table.build(spectra.LINEAR_SRGB, "D65", size=9, anisotropy=ANISOTROPY_SKIN)
    assert np.abs(found.convert(table.rgb) - wanted.rgb).max() < 0.015
    assert np.abs(table.rgb - wanted.rgb).max() > 0.03
