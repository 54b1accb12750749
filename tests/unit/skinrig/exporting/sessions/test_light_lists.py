"""Light lists: what is written is what `skinrig import lp` and others read back."""

import json
from datetime import UTC, date, datetime

import numpy as np
import pytest
import tifffile

from capture import raw
from capture.importers import import_light_list
from capture.importers.light_lists import find_light_list
from capture.session import ConsentError, SubjectRecord
from skinrig.exporting import export as exporting
from skinrig.exporting.options import ExportError, ExportSettings
from skinrig.exporting.sessions.light_lists import transform_to_camera_frame

NOW = datetime(2026, 1, 1, tzinfo=UTC)
SHAPE = (12, 16)


@pytest.fixture
def lights(rng):
    found = rng.standard_normal((6, 3))
    found[:, 2] = np.abs(found[:, 2]) + 0.5
    return found / np.linalg.norm(found, axis=1, keepdims=True)


@pytest.fixture
def session(lights, rng, tmp_path):
    """Six pictures of a bumpy plane that were imported with their list."""
    from capture.session import Session

    folder = tmp_path / "pictures"
    folder.mkdir()
    normals = rng.standard_normal((*SHAPE, 3)) * 0.1 + [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    rows = []
    for k, light in enumerate(lights):
        shade = np.clip(normals @ light, 0.0, None)[..., None] * [0.8, 0.6, 0.4]
        tifffile.imwrite(folder / f"p{k}.tif", np.rint(60000 * shade).astype(np.uint16))
        rows.append(f"p{k}.tif " + " ".join(f"{x:.9f}" for x in light))
    (folder / "a.lp").write_text("6\n" + "\n".join(rows) + "\n")
    made = import_light_list(
        folder,
        out=tmp_path / "session",
        encoding="linear",
        subject=SubjectRecord("P042", ("research",), date(2030, 1, 1)),
        now=lambda: NOW,
    )
    return Session.open(made.path)


def export(session, out, **more):
    told = {"use": "research", "today": date(2026, 1, 1), "now": NOW, **more}
    return exporting.export(session.path, out, "lp", **told)


def test_directions_and_images_survive_import(session, lights, tmp_path):
    export(session, tmp_path / "out")
    found = find_light_list(tmp_path / "out")
    assert found.kind == "lp"
    np.testing.assert_allclose(found.directions, lights, atol=2e-9)
    import_light_list(tmp_path / "out", out=tmp_path / "again", encoding="linear", now=lambda: NOW)
    from capture.session import Session

    again = Session.open(tmp_path / "again")
    scale = []
    for first, second in zip(session.frames("olat"), again.frames("olat"), strict=True):
        one, other = (
            raw.linear_rgb(s.read(r), demosaic="superpixel")
            for s, r in ((session, first), (again, second))
        )
        good = one.valid & other.valid & (one.rgb.min(axis=-1) > 0.05)
        assert good.mean() > 0.5
        scale.append(other.rgb[good] / one.rgb[good])
    ratio = np.concatenate([s.ravel() for s in scale])
    # one common scale: 16 bits twice, and the noise of none
    np.testing.assert_allclose(ratio, np.median(ratio), rtol=1e-3)


def test_positions_are_there_for_near_lights(session, lights, tmp_path):
    export(session, tmp_path / "out")
    rows = np.loadtxt(tmp_path / "out" / "positions_mm.txt")
    assert rows.shape == (6, 3)
    np.testing.assert_allclose(
        rows / np.linalg.norm(rows, axis=1, keepdims=True), lights, atol=1e-6
    )
    near = find_light_list(tmp_path / "out", lights=tmp_path / "out" / "positions_mm.txt")
    assert not near.has_unit_vectors
    assert json.loads((tmp_path / "out" / "lights.json").read_text())["source"] == "measured"


def test_light_at_camera_is_on_axis_above_up(rng):
    """Of a camera that looks down from above, its up towards -z."""
    down, right = np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    rotation = np.stack([right, np.cross(down, right), down])
    camera, beyond = np.array([[0.0, 600.0, 0.0]]), np.array([[0.0, 600.0, -300.0]])
    np.testing.assert_allclose(
        transform_to_camera_frame(camera, rotation), [[0, 0, 600]], atol=1e-9
    )
    np.testing.assert_allclose(
        transform_to_camera_frame(beyond, rotation), [[0, 300, 600]], atol=1e-9
    )


def test_the_same_session_gives_the_same_bytes(session, tmp_path):
    for name in ("a", "b"):
        export(session, tmp_path / name / "out")
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.*"))
    assert len(files) > 9
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_images_are_exported_only_within_consent(session, tmp_path):
    with pytest.raises(ConsentError, match="has not agreed"):
        export(session, tmp_path / "out", use="publication")
    with pytest.raises(ConsentError, match="has not agreed"):
        export(session, tmp_path / "out", today=date(2030, 1, 2))
    assert not (tmp_path / "out").exists()


def test_missing_camera_is_named_with_available_ones(session, tmp_path):
    with pytest.raises(ExportError, match="got 'C9', expected one of cam"):
        export(session, tmp_path / "out", delivery=ExportSettings(camera="C9"))
    assert not (tmp_path / "out").exists()
