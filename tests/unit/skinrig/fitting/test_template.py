"""Files of `skinrig fit template`: layout kept, properties written, inputs refused."""

import json

import numpy as np
import pytest
import trimesh

from capture.importers.meshes import ScannedMesh, read_mesh
from reconstruction.scan.face_template import load_default_template
from skinrig.benchmarks.dome.template import template_uv
from skinrig.cli import main
from skinrig.fitting import template as fitting


def write_mesh(path, points, faces, uv=None):
    mesh = ScannedMesh(points.astype(np.float32), faces.astype(np.int32), uv, {})
    path.write_bytes(mesh.to_ply())
    return path


@pytest.fixture
def scan(tmp_path):
    mesh = load_default_template().mesh
    points = mesh.vertices_mm * (1.04, 1.0, 1.0) + 0.3
    return write_mesh(tmp_path / "scan.ply", points, mesh.faces)


@pytest.fixture
def seamed(tmp_path):
    """The template's file with each triangle's vertices by themselves: a seam at every edge."""
    mesh = load_default_template().mesh
    corners = mesh.vertices_mm[mesh.faces].reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3)
    uv = mesh.corner_uv.reshape(-1, 2).astype(np.float32)
    return write_mesh(tmp_path / "own.ply", corners, faces, uv)


@pytest.mark.long
def test_written_file_has_template_layout_and_uncertainties(scan, tmp_path, capsys):
    out = tmp_path / "wrapped.ply"
    assert main(["fit", "template", str(scan), "--out", str(out), "--steps", "2", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    found = read_mesh(out)
    np.testing.assert_array_equal(found.faces, load_default_template().mesh.faces)
    np.testing.assert_allclose(found.uv, template_uv(), atol=1e-6)
    vertex = trimesh.load(out, process=False).metadata["_ply_raw"]["vertex"]["data"]
    assert float(np.mean(vertex["valid"])) == pytest.approx(figures["valid_fraction"])
    assert (vertex["across_mm"] > 0).all()
    assert figures["folded"] == 0
    assert figures["rms_mm"] < 0.3


@pytest.mark.long
def test_seams_of_own_template_stay_closed(scan, seamed, tmp_path):
    out = tmp_path / "wrapped.ply"
    fitting.fit_template(fitting.TemplateFiles(scan, seamed), out=out, steps=2)
    found, given = read_mesh(out), read_mesh(seamed)
    np.testing.assert_array_equal(found.faces, given.faces)
    np.testing.assert_allclose(found.uv, given.uv)
    _, vertex = np.unique(given.vertices_mm, axis=0, return_inverse=True)
    first = np.unique(vertex, return_index=True)[1][vertex.reshape(-1)]
    np.testing.assert_array_equal(found.vertices_mm, found.vertices_mm[first])


def test_template_without_texture_keeps_older_file(scan, tmp_path, capsys):
    out = tmp_path / "wrapped.ply"
    out.write_bytes(b"older")
    command = ["fit", "template", str(scan), "--template", str(scan), "--out", str(out)]
    assert main(command) == 3
    assert "SR-REC-026" in capsys.readouterr().err
    assert out.read_bytes() == b"older"


def test_landmarks_of_template_need_template(scan, tmp_path, capsys):
    table = tmp_path / "points.csv"
    table.write_text("name,x,y,z\nnose tip,0,-8,26\n")
    out = tmp_path / "wrapped.ply"
    command = ["fit", "template", str(scan), "--template-landmarks", str(table), "--out", str(out)]
    assert main(command) == 2
    assert "add --template" in capsys.readouterr().err


def test_landmark_table_of_image_is_refused(scan, tmp_path, capsys):
    table = tmp_path / "points.csv"
    table.write_text("name,x,y\nnose tip,10,20\n")
    out = tmp_path / "wrapped.ply"
    command = ["fit", "template", str(scan), "--landmarks", str(table), "--out", str(out)]
    assert main(command) == 3
    assert "name, x, y, z" in capsys.readouterr().err
    assert not out.exists()


def test_interrupted_run_keeps_older_file(scan, tmp_path, monkeypatch):
    def interrupted(*_args, **_options):
        raise KeyboardInterrupt

    monkeypatch.setattr(fitting, "wrap_template", interrupted)
    out = tmp_path / "wrapped.ply"
    out.write_bytes(b"older")
    with pytest.raises(KeyboardInterrupt):
        fitting.fit_template(fitting.TemplateFiles(scan), out=out)
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".part"] == []
    assert out.read_bytes() == b"older"
