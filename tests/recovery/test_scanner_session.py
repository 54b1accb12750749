"""The scanner from end to end: board and face through the wire, calibration, decoding, pipeline."""

from datetime import UTC, datetime

import numpy as np
import pytest
import trimesh

from capture.plan.dome import add_scan, dome_calibration_plan
from capture.rig import load_rig
from capture.session import Session
from model import store
from reconstruction.pipeline.dome.stripes import decode_scan, has_stripes, load_scanner
from reconstruction.pipeline.inputs import Inputs
from reconstruction.pipeline.recipes import reconstruct
from reconstruction.scan.closest_points import ScanSurface
from reconstruction.scan.repair import TriangleMesh
from rigsim.scenes.dome.stripes import scan_board
from rigsim.scenes.dome.targets import make_target_scene
from skinrig.calibrating.calibrate import calibrate
from skinrig.simulating import driving
from skinrig.simulating.dome import small_dome
from skinrig.simulating.orders import DomeOrder
from skinrig.simulating.simulation import simulate

pytestmark = pytest.mark.long
SMALL = {"width_px": 240, "lights": 20, "views": 6, "seed": 21, "scanner": True}
CREATED = datetime(2026, 11, 21, tzinfo=UTC)


def capture_board(out):
    """Capture six poses of the board with its stripes."""
    order = DomeOrder(out=out, target="charuco", created=CREATED, **SMALL)
    size = {name: SMALL[name] for name in ("lights", "views", "width_px")}
    rig = small_dome(load_rig("dome").with_scanner(), **size)
    plan = add_scan(dome_calibration_plan(rig, "charuco", poses=6), rig)
    scene = make_target_scene("charuco", rig, seed=order.seed)
    scan_board(scene, seed=order.seed, noise_seed=order.seed)
    session = driving.open_session(order, plan, rig, {}, scene)

    def prompt(world, text):
        scene.set_pose(int(text.rpartition(" ")[2]))

    driving.drive_plan(order, session, rig, scene, prompt, eyes="closed")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("scanner")
    capture_board(made / "board")
    simulate(DomeOrder(out=made / "face", subject="IV", created=CREATED, **SMALL))
    for kind in ("geometry", "scanner"):
        calibrate(kind, [made / "board"], made / "calibration")
    return made


def distances(folder, points_mm):
    """Signed distances of points from the true surface, mm; NaN at its border."""
    loaded = trimesh.load(folder / "truth-face" / "mesh.ply", process=False)
    vertices, faces = np.asarray(loaded.vertices, float), np.asarray(loaded.faces, np.int64)
    found = ScanSurface(TriangleMesh(vertices, faces)).find_closest(points_mm)
    gap = np.einsum("nk,nk->n", points_mm - found.points_mm, found.normals)
    return np.where(found.on_border, np.nan, gap)


def decoded(folder, calibration):
    inputs = Inputs.of(Session.open(folder / "face"), calibration, state="neutral")
    return decode_scan(inputs, load_scanner(inputs))


def test_calibrated_stripes_recover_surface(folder):
    session = Session.open(folder / "face")
    assert has_stripes(session)
    assert "scan.ply" not in session.attachments()
    scan = decoded(folder, folder / "calibration")
    error = distances(folder, scan.mesh.vertices_mm)
    # pixels of 1.2 mm: noise 0.03 mm, calibration 0.1 mm, curvature between voxels
    assert np.sqrt(np.nanmean(error**2)) < 0.25
    assert np.nanmean(np.abs(error) < 2.0 * scan.stderr_mm) > 0.6
    assert scan.calibrated
    assert scan.record["frames"] == 48


def test_nominal_scanner_is_far_off(folder):
    scan = decoded(folder, None)
    error = distances(folder, scan.mesh.vertices_mm)
    assert np.sqrt(np.nanmean(error**2)) > 2.0
    assert not scan.calibrated


def test_pipeline_uses_stripes_of_session(folder):
    out = folder / "appearance"
    calibration = folder / "calibration"
    reconstruct(folder / "face", want=("position",), out=out, calibration=calibration)
    made = store.read(out)
    assert made.parameters["scan"]["source"] == "stripes"
    position = made.maps["position"]
    error = distances(folder, position.values[position.valid].astype(float)[::11])
    assert np.sqrt(np.nanmean(error**2)) < 0.5
    assert np.median(position.stderr[position.valid]) < 0.5
