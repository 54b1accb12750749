"""Tiles of a large displacement, and the server that gives them to one page of this machine."""

from __future__ import annotations

import http.client
import socket

import numpy as np
import pytest

from skinrig.viewer import server
from skinrig.viewer.microstructure import tiles
from skinrig.viewer.microstructure.tiles import TILE_PX, TileError
from skinrig.viewer.scene import SceneError


@pytest.fixture(scope="module")
def displacement() -> np.ndarray:
    rng = np.random.default_rng(2)
    return rng.normal(0.0, 10.0, (1024, 1024)).astype(np.float32)


@pytest.fixture(scope="module")
def pyramid(displacement, tmp_path_factory):
    return tiles.build(displacement, tmp_path_factory.mktemp("tiles") / "levels")


def heights(pyramid, level, row, column):
    words = np.frombuffer(pyramid.tile(level, row, column), "<u2").reshape(TILE_PX, TILE_PX)
    return pyramid.low + (pyramid.high - pyramid.low) * (words / 65535.0)


def test_assembled_tiles_match_displacement_to_half_quantum(pyramid, displacement):
    found = np.block([[heights(pyramid, 0, r, c) for c in range(4)] for r in range(4)])
    assert np.abs(found - displacement).max() <= 0.51 * pyramid.step_um
    assert pyramid.step_um < 2e-3


def test_each_level_is_mean_of_finer_level(pyramid, displacement):
    assert [level.shape[0] for level in pyramid.levels] == [1024, 512]
    mean = displacement.astype(np.float64).reshape(512, 2, 512, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(pyramid.levels[1], mean, atol=1e-5)
    assert np.abs(heights(pyramid, 1, 1, 0) - mean[256:, :256]).max() <= 0.51 * pyramid.step_um


@pytest.mark.parametrize(("level", "row", "column"), [(2, 0, 0), (0, 4, 0), (1, 0, 2), (-1, 0, 0)])
def test_a_tile_that_is_not_there_is_refused(pyramid, level, row, column):
    with pytest.raises(TileError, match="got"):
        pyramid.tile(level, row, column)


@pytest.mark.parametrize("shape", [(1000, 1000), (256, 256), (1024, 512), (1536, 1536)])
def test_a_displacement_of_another_shape_is_refused(tmp_path, shape):
    with pytest.raises(TileError, match="displacement: got shape"):
        tiles.build(np.zeros(shape, np.float32), tmp_path / "levels")
    assert list(tmp_path.iterdir()) == []


def test_holes_are_refused_and_nothing_half_written_stays(tmp_path):
    holed = np.zeros((512, 512), np.float32)
    holed[300, 7] = np.nan
    with pytest.raises(TileError, match="rows 0 to 511"):
        tiles.build(holed, tmp_path / "levels")
    assert list(tmp_path.iterdir()) == []


def test_file_without_height_array_is_refused(tmp_path):
    other = tmp_path / "other.npy"
    np.save(other, np.zeros((512, 512), np.float32))
    good = other.read_bytes()
    for damaged in (b"not an array", good[:5], good[:-1], good.replace(b"'descr'", b"0/-descr")):
        other.write_bytes(damaged)
        with pytest.raises(TileError, match=r"not a \.npy file"):
            tiles.open_displacement(other, tmp_path / "levels")
    np.save(other, np.zeros((512, 512), np.int16))
    with pytest.raises(TileError, match="got int16"):
        tiles.open_displacement(other, tmp_path / "levels")


def ask(served, path, *, host=None, method="GET"):
    connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=10)
    try:
        connection.putrequest(method, path, skip_host=True)
        connection.putheader("Host", host or f"127.0.0.1:{served.port}")
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, answer.read(), dict(answer.getheaders())
    finally:
        connection.close()


@pytest.fixture(scope="module")
def served(pyramid):
    with server.serve(b"<!doctype html><title>page</title>", pyramid=pyramid) as one:
        yield one


def test_the_server_gives_the_page_and_its_tiles(served, pyramid):
    status, body, headers = ask(served, "/")
    assert status == 200
    assert body.startswith(b"<!doctype html>")
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert ask(served, "/tiles/0/1/2")[:2] == (200, pyramid.tile(0, 1, 2))
    assert ask(served, "/tiles/0/1/2", method="HEAD")[1] == b""


@pytest.mark.parametrize(
    "path",
    [
        "/tiles/0/9/0",
        "/tiles/0/../../etc/passwd",
        "/../etc/passwd",
        "/%2e%2e/etc/passwd",
        "/tiles/0/0",
        "/tiles/0/0/0/",
        "/tiles/0/-1/0",
        "/tiles/0/0/0?x=1",
        "/tiles/0/1/1.npy",
        "/index.html",
        "http://127.0.0.1/",
    ],
)
def test_no_other_path_is_answered(served, path):
    before = list(served.requests)
    assert ask(served, path)[0] == 404
    assert served.requests == before


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1", "[::1]:1"])
def test_foreign_host_name_is_refused(served, host):
    assert ask(served, "/", host=host)[0] == 403
    assert ask(served, "/", host=f"localhost:{served.port}")[0] == 200


def test_methods_that_change_something_are_refused(served):
    assert ask(served, "/", method="POST")[0] == 501


def test_only_the_loopback_address_listens(served):
    with socket.socket() as own:
        # another address of this machine, where it has one: all of 127/8 is loopback's
        own.settimeout(2.0)
        assert own.connect_ex(("127.0.0.2", served.port)) != 0


def test_a_taken_port_is_named(served):
    with pytest.raises(SceneError, match=f"port: {served.port} is not usable"):
        with server.serve(b"", port=served.port):
            pass
    with pytest.raises(SceneError, match="port: got 70000"):
        with server.serve(b"", port=70000):
            pass


def test_closed_server_answers_no_request():
    with server.serve(b"page") as one:
        assert ask(one, "/")[1] == b"page"
    with pytest.raises(ConnectionRefusedError):
        ask(one, "/")
