"""Public data sets, with limits from their authors' figures.

`tools/fetch_real_sets.py` fetches them; SKINRIG_REAL_SETS names their folder. Each test shows that
it can fail: wrong normals, wrong lists or another model miss the same limits.
"""

import importlib.util
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from reconstruction.normal_integration import integrate_map
from reconstruction.photometric_stereo import estimate_normals

ROOT = Path(__file__).parents[2]
SPEC = importlib.util.spec_from_file_location("judge_real_sets", ROOT / "tools/judge_real_sets.py")
TOOL = importlib.util.module_from_spec(SPEC)
sys.modules["judge_real_sets"] = TOOL  # dataclasses look their module up
SPEC.loader.exec_module(TOOL)
FACE = sys.modules["judge_photographs"]

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]


def find_sets(name):
    """Return the folder of the fetched sets, or skip and name the set that is not in it."""
    folder = Path(os.environ.get("SKINRIG_REAL_SETS", "") or "/nowhere")
    if not (folder / name).is_dir():
        pytest.skip(f"real set not found: {name}; fetch it and set SKINRIG_REAL_SETS")
    return folder


def require_limits(figures):
    rows = list(figures)
    assert rows
    assert [one.row() for one in rows if not one.passes] == []
    return {one.figure: one for one in rows}


@pytest.mark.parametrize("name", TOOL.DEPTH_ERRORS_MM)
def test_depth_from_normals_meets_authors_errors(name):
    real_sets = find_sets("diligent-normals")
    require_limits(TOOL.judge_normal_maps(real_sets, [name]))
    folder = real_sets / "diligent-normals/data/Fig7_diligent" / name
    normals, mask, camera, truth = TOOL.load_normal_map(folder)
    hollow = integrate_map(normals * (-1.0, -1.0, 1.0), valid=mask, camera=camera)
    error = TOOL.depth_error_mm(hollow.height, hollow.valid, camera, truth)
    assert error > TOOL.PLAIN_FACTOR * TOOL.DEPTH_ERRORS_MM[name][0]


@pytest.mark.parametrize("name", TOOL.BUNNY_ERRORS_DEG)
def test_rendered_bunny_meets_authors_errors(tmp_path, name):
    real_sets = find_sets("rendered-bunny")
    require_limits(TOOL.judge_bunny(real_sets, tmp_path, [name]))
    (tmp_path / "again").mkdir()
    stack, truth = TOOL.load_bunny(real_sets, name, tmp_path / "again")
    wrong = estimate_normals(stack.gray, stack.directions[::-1], valid=stack.inside)
    seen = wrong.valid & stack.inside
    error = TOOL.angle_deg(wrong.normals, truth)[seen].mean()
    assert error > max(TOOL.BUNNY_ERRORS_DEG[name].values())


@pytest.mark.parametrize("name", TOOL.PHOTOGRAPHED)
def test_wrong_lists_of_photographs_are_found(tmp_path, name):
    real_sets = find_sets("twelve-lights")
    shown = require_limits(TOOL.judge_twelve_lights(real_sets, tmp_path, [name]))
    assert shown["lights without a list: refused"].passes
    (tmp_path / "again").mkdir()
    stack = TOOL.load_photographs(real_sets, name, tmp_path / "again")
    right = {"nothing spoiled": (lambda rows: rows, frozenset({"axes of the list"}))}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TOOL, "CORRUPTIONS", right)
        *_, missed = TOOL.judge_lists(name, stack)
    assert (missed.ours, missed.passes) == (1, False)
    if name == "gray":
        truth, inner = TOOL.ball_normals(stack.inside)
        turned = np.roll(stack.directions, 1, axis=0)
        maps = estimate_normals(stack.gray, turned, valid=stack.inside)
        error = TOOL.angle_deg(maps.normals, truth)[maps.valid & inner].mean()
        assert error > 2.0 * TOOL.GRAY_BALL_LIMIT_DEG


def test_near_lights_explain_face_better():
    real_sets = find_sets("near-face")
    shown = require_limits(FACE.judge_face(real_sets))
    distant = shown["pixels without a normal to the camera, distant lights"]
    assert distant.ours > FACE.MAX_FACE_UNFIT
    limit = shown["median residual over albedo, near lights"].limit
    gray, mask, positions, *view = FACE.load_face(real_sets)
    points = FACE.face_points_mm(mask, *view)
    for order in (np.roll(positions, 1, axis=0), positions[::-1]):
        residual, unfit = FACE.fit_face(gray, mask, points, order)
        assert residual[1] > limit
        assert unfit[1] > FACE.MAX_FACE_UNFIT


def test_metal_height_follows_from_normals():
    real_sets = find_sets("metal-without-list")
    shown = require_limits(TOOL.judge_metal(real_sets))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            TOOL, "integrate_map", lambda n, valid: integrate_map(n, valid=valid, y_up=False)
        )
        wrong = next(TOOL.judge_metal(real_sets))
    assert not wrong.passes
    assert wrong.ours > 5.0 * shown[wrong.figure].ours


@pytest.mark.parametrize("name", ["", "no-such-set"])
def test_unknown_folder_is_an_error(tmp_path, name, capsys):
    with pytest.raises(SystemExit) if name else pytest.MonkeyPatch.context():
        assert TOOL.main(["--sets", str(tmp_path), *([name] if name else [])]) == 1
    assert ("not a set" if name else "run tools/fetch_real_sets.py") in capsys.readouterr().err
