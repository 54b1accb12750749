"""Meshes of any maker become scan.ply in mm, or one clear error."""

import io

import numpy as np
import pytest
import trimesh

from capture import raw
from capture.importers.meshes import MeshImportError, import_mesh, read_mesh
from capture.plan import flash_plan
from capture.rig import load_rig
from capture.session import Session, SessionError, SubjectRecord, verify
from skinrig.cli import main

HEAD = trimesh.creation.icosphere(subdivisions=3, radius=80.0)
UV = np.linspace(0, 1, 2 * len(HEAD.vertices)).reshape(-1, 2).astype(np.float32)
CORNERS = "v 0 0 0\nv 100 0 0\nv 100 100 0\nv 0 100 0\nv 0 0 50\nv 100 0 50\nv 100 100 50\n"
RIG = load_rig("flash").resized(16)


def textured():
    visual = trimesh.visual.TextureVisuals(uv=UV)
    return trimesh.Trimesh(HEAD.vertices, HEAD.faces, visual=visual, process=False)


def with_normals():
    mesh = HEAD.copy()
    assert len(mesh.vertex_normals) == len(mesh.vertices)
    return mesh


FILES = {
    "binary.ply": lambda: HEAD.export(file_type="ply"),
    "ascii.ply": lambda: HEAD.export(file_type="ply", encoding="ascii"),
    "normals.ply": lambda: with_normals().export(file_type="ply", vertex_normal=True),
    "plain.obj": lambda: HEAD.export(file_type="obj").encode(),
    "normals.obj": lambda: trimesh.exchange.obj.export_obj(
        with_normals(), include_normals=True
    ).encode(),
    "uv.ply": lambda: textured().export(file_type="ply"),
    "uv.obj": lambda: trimesh.exchange.obj.export_obj(textured()).encode(),
}


@pytest.mark.parametrize("name", FILES)
def test_positions_triangles_and_texture_coordinates_survive_any_file(tmp_path, name):
    (tmp_path / name).write_bytes(FILES[name]())
    mesh = read_mesh(tmp_path / name)
    assert mesh.faces.shape == HEAD.faces.shape
    # the order of vertices is the file's own; the corners of the triangles are not
    want = HEAD.vertices[HEAD.faces]
    np.testing.assert_allclose(mesh.vertices_mm[mesh.faces], want, atol=1e-4)
    assert (mesh.uv is not None) == name.startswith("uv")
    if mesh.uv is not None:
        np.testing.assert_allclose(mesh.uv[mesh.faces], UV[HEAD.faces], atol=1e-6)


def test_mesh_written_as_scan_ply_is_unchanged(tmp_path):
    (tmp_path / "uv.obj").write_bytes(FILES["uv.obj"]())
    mesh = read_mesh(tmp_path / "uv.obj")
    (tmp_path / "scan.ply").write_bytes(mesh.to_ply())
    again = read_mesh(tmp_path / "scan.ply")
    for field in ("vertices_mm", "faces", "uv"):
        np.testing.assert_array_equal(getattr(again, field), getattr(mesh, field))
    assert again.to_ply() == mesh.to_ply()


def test_quads_polygons_and_missing_materials_become_triangles(tmp_path):
    text = (
        "mtllib nowhere.mtl\n" + CORNERS + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "g one\nusemtl a\nf 1/1 2/2 3/3 4/4\ng two\nusemtl b\nf 5/1 6/2 7/3\nf 1/4 2/2 6/3\n"
    )
    (tmp_path / "groups.obj").write_text(text)
    mesh = read_mesh(tmp_path / "groups.obj")
    assert (len(mesh.faces), mesh.uv.shape[1]) == (4, 2)
    assert trimesh.Trimesh(mesh.vertices_mm, mesh.faces).area == pytest.approx(
        100 * 100 + 100 * 100 / 2 + 100 * 50 / 2
    )
    (tmp_path / "five.obj").write_text(CORNERS + "f 1 2 3 4 5\n")
    assert len(read_mesh(tmp_path / "five.obj").faces) == 3


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1.0), ("cm", 10), ("m", 1e3), ("inch", 25.4)])
def test_mesh_unit_scales_to_millimeters(tmp_path, unit, factor):
    scaled = HEAD.copy().apply_scale(1 / factor)
    (tmp_path / "head.ply").write_bytes(scaled.export(file_type="ply"))
    mesh = read_mesh(tmp_path / "head.ply", unit=unit)
    np.testing.assert_allclose(np.ptp(mesh.vertices_mm, axis=0), 160.0, rtol=1e-5)


BINARY = HEAD.export(file_type="ply")
ASCII = HEAD.export(file_type="ply", encoding="ascii")
POINTS = BINARY[: BINARY.index(b"element face")] + b"end_header\n" + bytes(12 * len(HEAD.vertices))
BROKEN = {
    "empty.obj": (b"", "an empty one"),
    "blank.ply": (b" \n\n", "an empty one"),
    "noise.ply": (bytes(range(256)) * 8, "a whole PLY file"),
    "noise.obj": (bytes(range(256)) * 8, "at least one triangle|a whole OBJ file"),
    "cut.ply": (BINARY[:-100], "a whole PLY file|truncated"),
    "header.ply": (BINARY[:60], "a whole PLY file|truncated|triangle"),
    "cut-ascii.ply": (ASCII[:-200], "a whole PLY file|truncated"),
    "middle-ascii.ply": (ASCII[:2000], "a whole PLY file|truncated"),
    "cut.obj": (HEAD.export(file_type="obj").encode()[:900], "whole OBJ|triangle"),
    "points.ply": (POINTS, "points only"),
    "points.obj": (CORNERS.encode(), "at least one triangle"),
    "nan.obj": ((CORNERS.replace("100 0 50", "nan 0 50") + "f 1 2 6\n").encode(), "not finite"),
    "index.obj": ((CORNERS + "f 1 2 99\n").encode(), "whole OBJ|0 to"),
    "meters.obj": (
        (CORNERS.replace("100", "0.2").replace("50", "0.1") + "f 1 2 3\n").encode(),
        "--unit m",
    ),
    "giant.obj": (
        (CORNERS.replace("100", "1e9") + "f 1 2 3\n").encode(),
        "implausible in size for a face",
    ),
    "point.obj": (b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "implausible in size for a face"),
    "head.stl": (b"solid", "suffix '.stl'"),
}


def test_obj_names_of_any_encoding_are_read(tmp_path):
    text = CORNERS + "f 1 2 3\n"
    for number, name in enumerate((b"\xe4", "\u00e4".encode(), b"\xff\xfe\x00")):
        path = tmp_path / f"{number}.obj"
        path.write_bytes(b"o " + name + b"\n" + text.encode())
        assert len(read_mesh(path).faces) == 1
    path.write_text(text, encoding="utf-16")
    assert len(read_mesh(path).faces) == 1


@pytest.mark.parametrize("name", BROKEN)
def test_unusable_mesh_gives_single_clear_error(tmp_path, name):
    content, says = BROKEN[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(MeshImportError, match=says) as caught:
        read_mesh(tmp_path / name)
    assert name in str(caught.value)


def test_missing_file_and_unknown_unit_are_reported(tmp_path):
    with pytest.raises(MeshImportError, match="No such file"):
        read_mesh(tmp_path / "none.ply")
    with pytest.raises(MeshImportError, match="unit: got 'yard'"):
        read_mesh(tmp_path / "none.ply", unit="yard")


@pytest.mark.parametrize("cut", np.random.default_rng(3).integers(0, len(BINARY), 20).tolist())
def test_no_cut_file_is_taken_for_whole(tmp_path, cut):
    (tmp_path / "cut.ply").write_bytes(BINARY[:cut])
    with pytest.raises(MeshImportError):
        read_mesh(tmp_path / "cut.ply")


# --- into a session -------------------------------------------------------------------------------


@pytest.fixture
def session(tmp_path):
    made = Session.create(
        tmp_path / "s",
        plan=flash_plan(RIG, darks=1),
        rig=RIG,
        devices={},
        subject=SubjectRecord("P1", ("research",)),
        source="measured",
    )
    values = np.full((10, 16), 600, np.uint16)
    step, camera = made.pending_frames()[0]
    blob = raw.encode_dng(
        values, pattern="RGGB", black=512, white=16383, step_id=step.id, session_id=made.id
    )
    made.commit(step.id, camera, blob, settings={}, actual={}, t_host_s=0.0)
    made.release()
    return tmp_path / "s"


@pytest.fixture
def scan(tmp_path):
    (tmp_path / "ada lovelace.obj").write_bytes(FILES["plain.obj"]())
    return tmp_path / "ada lovelace.obj"


def test_open_session_accepts_mesh_stays_open_without_names(session, scan):
    assert main(["import", "mesh", str(scan), "--session", str(session)]) == 0
    opened = Session.open(session)
    assert not opened.closed
    loaded = trimesh.load(io.BytesIO(opened.attachment("scan.ply")), file_type="ply", process=False)
    np.testing.assert_allclose(loaded.vertices[loaded.faces], HEAD.triangles, atol=1e-4)
    about = opened.attachment_line("scan.ply").about
    assert (about["unit"], about["format"], about["origin"]) == ("mm", "obj", "imported")
    assert b"lovelace" not in (session / "journal.jsonl").read_bytes()
    with pytest.raises(SessionError, match="contains a scan already"):
        import_mesh(scan, session=session)


def test_closed_session_is_unchanged_and_copy_gets_mesh(session, scan, tmp_path):
    with Session.resume(session) as made:
        made.close(missing_reason="the subject left")
    before = {file: file.read_bytes() for file in session.rglob("*") if file.is_file()}
    with pytest.raises(SessionError, match="--out COPY"):
        import_mesh(scan, session=session)
    arguments = ["import", "mesh", str(scan), "--session", str(session), "--out"]
    assert main([*arguments, str(tmp_path / "copy")]) == 0
    assert {file: file.read_bytes() for file in session.rglob("*") if file.is_file()} == before
    copy = Session.open(tmp_path / "copy")
    assert (copy.closed, copy.attachments(), len(copy.frames())) == (True, ("scan.ply",), 1)
    assert verify(tmp_path / "copy").ok
