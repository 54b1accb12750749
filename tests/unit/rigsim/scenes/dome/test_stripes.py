"""Light of the scanner's projectors on a board, against closed forms."""

import dataclasses

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.as_built.dome import DomeTolerances
from rigsim.as_built.scanner import build_scanner
from rigsim.boxes.scanner import ProjectorLight
from rigsim.scenes.dome.stripes import StripedBoard, StripeScene, projector_intensity
from rigsim.scenes.exposing import SceneError
from rigsim.targets.printed_plate import Plate

EXACT = DomeTolerances(**{f.name: 0.0 for f in dataclasses.fields(DomeTolerances)})
WHITE = Plate(np.full((100, 100), 0.8), np.zeros((0, 4)))  # 450 mm wide


def front_pose():
    """Return a plate at z = -40 mm that faces +z."""
    rotation = np.diag([1.0, -1.0, -1.0])
    return rotation, np.array([-225.0, 225.0, -40.0])


@pytest.fixture(scope="module")
def scene():
    scanner = load_rig("dome").resized(128).scanner
    board = StripedBoard(WHITE, front_pose)
    return StripeScene(build_scanner(scanner, seed=1, tolerances=EXACT), board, seed=1)


def light(axis="columns", pattern=0, projector="P0"):
    return ProjectorLight(projector, axis, pattern, 1.0, 0.0, 0.02)


def test_white_light_is_lambertian(scene):
    image = scene.radiance("S1", light(axis=""))
    projector = scene.scanner.nominal.projectors[0]
    view = scene.scanner.nominal.views[1]
    cosine = np.cos(np.radians(38.0))
    wanted = 0.8 * projector_intensity(projector, view) * cosine / 900.0**2
    middle = image[70:90, 54:74].mean()  # optical axes meet at the target
    assert middle == pytest.approx(wanted, rel=0.01)


def test_phase_frames_sum_to_half_white(scene):
    white = scene.radiance("S1", light(axis=""))
    steps = [scene.radiance("S1", light(pattern=6 + n)) for n in range(6)]
    lit = white > 0.5 * white.max()
    share = np.mean(steps, axis=0)[lit] / white[lit]
    gamma = scene.scanner.gamma["P0"]
    place = np.linspace(0.0, 2 * np.pi, 1000, endpoint=False)
    wanted = np.mean((0.5 + 0.5 * np.cos(place)) ** gamma)
    assert np.median(share) == pytest.approx(wanted, abs=3e-3)


def test_exposure_has_ambient_light_without_projector(scene):
    dark = scene.exposure("S0", pops=[], exposure_s=0.02, seed=3).astype(float)
    view = scene.scanner.nominal.views[0]
    over = (dark[60:100, 40:90].mean() - view.black_level) / (view.white_level - view.black_level)
    assert over == pytest.approx(0.02 * 0.5 * 0.8, rel=0.05)
    again = scene.exposure("S0", pops=[], exposure_s=0.02, seed=3)
    assert np.array_equal(dark, again)


def test_other_camera_is_refused(scene):
    with pytest.raises(SceneError, match="view: got 'C00'"):
        scene.exposure("C00", pops=[], exposure_s=0.02, seed=0)


def test_tolerances_move_each_part_alone():
    scanner = load_rig("dome").scanner
    small = build_scanner(scanner.resized(128), seed=2)
    large = build_scanner(scanner, seed=2)
    other = build_scanner(scanner, seed=3)
    for name, view in large.views.items():
        assert view.position_mm == small.views[name].position_mm
        assert view.position_mm != other.views[name].position_mm
    assert large.gamma == small.gamma != other.gamma
