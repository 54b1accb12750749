"""The dome is simulated, captured through its drivers and calibrated from the command line."""

import json

import numpy as np
import pytest

from capture.calibration import geometry, store
from capture.calibration.lights import LightTable
from capture.session import Session
from rigsim.as_built.dome import build_dome, project_points
from rigsim.light.led_light import lobe_exponent, white_intensity
from skinrig.cli import main
from skinrig.simulating.simulation import simulate_session

pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]

SEED = 3


def document(capsys):
    return json.loads(capsys.readouterr().out.strip().splitlines()[-1])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("dome")
    for target in ("charuco", "mirror", "white"):
        simulate_session(
            "dome", out / target, target=target, seed=SEED, lights=16, views=4, width_px=324
        )
    return out


def test_lights_wait_for_the_geometry(folder, capsys):
    arguments = ["calibrate", "lights", str(folder / "white"), "--out", str(folder / "empty")]
    assert main(arguments) == 3
    assert "no geometry calibration" in capsys.readouterr().err


def test_a_dome_is_calibrated_from_its_sessions(folder, capsys):
    out = folder / "calibration"
    assert (
        main(["calibrate", "geometry", str(folder / "charuco"), "--out", str(out), "--json"]) == 0
    )
    said = document(capsys)
    assert said["findings"] == []
    assert said["drift"] == []
    sessions = [str(folder / "mirror"), str(folder / "white")]
    assert main(["calibrate", "lights", *sessions, "--out", str(out), "--json"]) == 0
    findings = document(capsys)["findings"]
    assert all("never faced" in text for text in findings)

    rig = Session.open(folder / "white").rig
    dome = build_dome(rig, seed=SEED)
    cameras = geometry.cameras_from_calibration(store.load(out, "geometry"), rig)
    probes = np.random.default_rng(0).uniform(-60, 60, (200, 3))
    for view in dome.rig.views:
        truth = project_points(view, dome.distortion[view.name], probes)
        gap = np.linalg.norm(cameras[view.name].project(probes) - truth, axis=1)
        assert gap.mean() < 0.3
    table = LightTable.from_calibration(store.load(out, "lights"), rig)
    assert table.valid.sum() >= 10
    gains = np.exp(np.mean(np.log(list(dome.gain.values()))))
    truth = LightTable(
        np.array([light.position_mm for light in dome.rig.lights]),
        gains * np.array([white_intensity(light, rig.views[0]) for light in dome.rig.lights]),
        np.array([lobe_exponent(light) for light in dome.rig.lights]),
        table.names,
        dome.axis,
    )
    points = np.random.default_rng(1).uniform(-50, 50, (100, 3))
    ratio = table.irradiance(points)[1] / truth.irradiance(points)[1]
    assert np.sqrt(np.mean((ratio[table.valid] - 1) ** 2)) < 0.02

    # again: drift against the one before is printed, and nobody moved
    assert main(["calibrate", "geometry", str(folder / "charuco"), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "moved" not in text
    calibration = store.load(out, "geometry")
    assert set(calibration.serials) == {view.serial for view in rig.views}
    assert calibration.source == "simulated"
