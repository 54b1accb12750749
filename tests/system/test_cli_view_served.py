"""`skinrig view --port`: served until interrupted; a displacement needs the server."""

from __future__ import annotations

import json
import urllib.request

import numpy as np
import pytest
from typer.testing import CliRunner

from rigsim.geometry.mesh import Mesh
from skinrig.console import Console
from skinrig.viewer import server
from skinrig.viewer.microstructure.tiles import TileError
from skinrig.viewer.scene import ViewerScene


@pytest.fixture
def plate() -> ViewerScene:
    uv = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float32)
    positions = np.concatenate([40.0 * uv, np.zeros((4, 1))], axis=1).astype(np.float32)
    normals = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    faces = np.array([[0, 1, 3], [0, 3, 2]], np.int32)
    return ViewerScene(Mesh(positions, faces, uv, normals))


def test_displacement_without_server_is_usage_error(tmp_path):
    from skinrig.cli import app

    found = CliRunner().invoke(app, ["view", "--displacement", str(tmp_path / "d.npy")])
    assert found.exit_code != 0
    assert "add --port 0" in (found.output + str(found.exception))


def test_served_page_and_tiles_exist_until_end(plate, tmp_path, capsys, monkeypatch):
    from skinrig.viewer import server

    path = tmp_path / "height.npy"
    heights = np.random.default_rng(0).normal(0.0, 9.0, (1024, 1024)).astype(np.float32)
    np.save(path, heights)
    seen = {}

    def wait(self, seconds=None):
        with urllib.request.urlopen(self.url, timeout=10) as answer:
            seen["page"] = answer.read().decode("utf-8")
        with urllib.request.urlopen(f"{self.url}tiles/1/0/0", timeout=10) as answer:
            seen["tile"] = answer.read()
        raise KeyboardInterrupt

    monkeypatch.setattr(server.PageServer, "wait", wait)
    server.serve_scene(plate, 0, [], console=Console(True), displacement=path)
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "skinrig.view-served/1"
    assert document["displacement_px"] == 1024
    assert "connect-src 'self'" in seen["page"]
    words = np.frombuffer(seen["tile"], "<u2").reshape(256, 256)
    mean = heights[:512, :512].reshape(256, 2, 256, 2).mean(axis=(1, 3))
    assert np.corrcoef(words.ravel(), mean.ravel())[0, 1] > 0.999999
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(document["url"], timeout=5)


def test_file_that_is_not_displacement_is_reported(plate, tmp_path):
    path = tmp_path / "height.npy"
    np.save(path, np.zeros((300, 300), np.float32))
    with pytest.raises(TileError, match=r"displacement: got shape \(300, 300\)"):
        server.serve_scene(plate, 0, [], console=Console(True), displacement=path)
