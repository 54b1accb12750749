"""Videos are imported as folders of their frames, with what compression loses."""

import hashlib
import json
import shutil
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from capture.importers import PhotoError, photos, read_photo, video_frames
from capture.importers.image_stacks import encode_srgb
from capture.importers.light_lists import to_gray
from capture.importers.video_frames import open_source
from capture.session import Session
from skinrig.cli import main

SIDE, COUNT = 64, 12


@pytest.fixture(scope="module")
def lights():
    k = np.arange(COUNT) + 0.5
    z = 1.0 - 0.45 * k / COUNT
    phi, r = 2.4 * k, np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)


@pytest.fixture(scope="module")
def images(lights):
    """Display values of a matte ball, (N, H, W)."""
    y, x = np.mgrid[0:SIDE, 0:SIDE]
    u, v = (x - (SIDE - 1) / 2) / (0.45 * SIDE), ((SIDE - 1) / 2 - y) / (0.45 * SIDE)
    n = np.stack([u, v, np.sqrt(np.maximum(1.0 - u * u - v * v, 0.0))], axis=-1)
    light = 0.8 * np.maximum(np.einsum("hwk,nk->nhw", n, lights), 0.0) * (u * u + v * v < 0.95)
    return np.rint(255 * np.asarray(encode_srgb(light))).astype(np.uint8)


def write_video(path, images, codec="MJPG"):
    stream = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 10, (SIDE, SIDE))
    assert stream.isOpened()
    for image in images:
        stream.write(np.repeat(image[..., None], 3, axis=-1))
    stream.release()
    return path


@pytest.mark.parametrize(
    ("name", "codec"), [("a.avi", "MJPG"), ("a.mp4", "mp4v"), ("a.mov", "mp4v"), ("a.avi", "FFV1")]
)
def test_frames_of_video_are_read_in_order(name, codec, images, tmp_path):
    video = write_video(tmp_path / name, images, codec)
    with open_source(video) as source:
        files = sorted(source.path.iterdir())
        frames = np.array([cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files])
        gray = to_gray(read_photo(files[0]).frame)
    assert not source.path.exists()
    assert [file.name for file in files] == [f"{k:05d}.png" for k in range(1, COUNT + 1)]
    worst = np.abs(frames.astype(int) - images).mean(axis=(1, 2)).max()
    assert worst < (0.5 if codec == "FFV1" else 6.0)
    assert gray.shape == (SIDE, SIDE)
    compressed = any("bits per pixel" in text for text in source.assumed)
    assert compressed == (codec != "FFV1")
    assert any("transfer curve" in text for text in source.assumed)


def test_video_under_listed_lights_is_imported_and_diagnosed(images, lights, tmp_path, capsys):
    video = write_video(tmp_path / "a.avi", images)
    rows = "\n".join(" ".join(map(str, row)) for row in lights)
    (tmp_path / "lights.txt").write_text(rows)
    session = tmp_path / "s"
    argv = ["import", "olat", str(video), "--out", str(session)]
    assert main(argv) == 3
    assert "got none, expected a file, or estimate" in capsys.readouterr().err
    assert main([*argv, "--lights", str(tmp_path / "lights.txt")]) == 0
    printed = capsys.readouterr().out
    assert "assumed: the frames were compressed (MJPG" in printed
    assert len(Session.open(session).frames()) == COUNT
    assert Session.open(session).manifest.extra["video"] == describe(video, COUNT)
    assert main(["diagnose", str(session), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["findings"] == []
    assert any("compressed (MJPG" in text for text in found["assumed"])
    assert any("transfer curve" in text for text in found["assumed"])


def test_frames_of_video_become_photographs(images, tmp_path, capsys):
    video = write_video(tmp_path / "a.avi", images[:2])
    argv = ["import", "photos", str(video), "--subject", "none", "--out", str(tmp_path / "s")]
    assert main(argv) == 0
    assert "compressed (MJPG" in capsys.readouterr().out
    session = Session.open(tmp_path / "s")
    assert [record.index["state"] for record in session.frames()] == ["00001", "00002"]
    assert "compressed (MJPG" in session.manifest.extra["assumed"][0]
    assert session.manifest.extra["video"] == describe(video, 2)


def describe(video, count):
    digest = hashlib.sha256(video.read_bytes()).hexdigest()
    about = {"name": "a.avi", "sha256": f"sha256:{digest}", "codec": "MJPG"}
    return about | {"stated_frames": count, "decoded_frames": count}


def test_errors_of_frames_name_the_video(images, lights, tmp_path, capsys, monkeypatch):
    video = write_video(tmp_path / "a.avi", images[:3])

    def read_all_but_second(file, **options):
        if file.name == "00002.png":
            raise PhotoError("is black", where=str(file))
        return read_photo(file, **options)

    monkeypatch.setattr(photos, "read_photo", read_all_but_second)
    assert main(["import", "photos", str(video), "--out", str(tmp_path / "s")]) == 3
    printed = capsys.readouterr().err
    assert f"{video}: 1 of 3 files cannot be imported" in printed
    assert "frame 2: got one that is black" in printed
    assert "Cut these frames out; nothing was written." in printed
    assert ".png" not in printed
    rows = "\n".join(" ".join(map(str, row)) for row in lights[:2])
    (tmp_path / "lights.txt").write_text(rows)
    argv = ["import", "olat", str(video), "--lights", str(tmp_path / "lights.txt")]
    assert main([*argv, "--out", str(tmp_path / "t")]) == 3
    assert "skinrig-" not in capsys.readouterr().err


@pytest.mark.parametrize("make", [lambda text: PhotoError("is bad", where=text), ValueError])
def test_paths_of_frames_become_numbers(make, images, tmp_path):
    video = write_video(tmp_path / "a.avi", images[:2])
    with (
        pytest.raises(ValueError, match=r"a\.avi, frame 2") as caught,
        open_source(video) as source,
    ):
        raise make(f"{source.path / '00002.png'}")
    assert "skinrig-" not in str(caught.value)
    assert ".png" not in str(caught.value)


def test_video_without_space_is_refused(images, tmp_path, capsys, monkeypatch):
    video = write_video(tmp_path / "a.avi", images)
    free = shutil.disk_usage(tmp_path)._replace(free=2000)
    monkeypatch.setattr(video_frames, "shutil", SimpleNamespace(disk_usage=lambda _: free))
    written = []
    write = cv2.imwrite
    monkeypatch.setattr(cv2, "imwrite", lambda *args: written.append(1) or write(*args))
    assert main(["import", "photos", str(video), "--out", str(tmp_path / "s")]) == 3
    printed = capsys.readouterr().err
    assert "too little space" in printed
    assert f"for {COUNT} frames" in printed
    assert "TMPDIR" in printed
    assert len(written) == 1


def test_unreadable_or_long_video_is_refused(images, tmp_path, capsys, monkeypatch):
    video = write_video(tmp_path / "a.mp4", images, "mp4v")
    (tmp_path / "cut.mp4").write_bytes(video.read_bytes()[:500])
    argv = ["import", "photos", str(tmp_path / "cut.mp4"), "--out", str(tmp_path / "s")]
    assert main(argv) == 3
    printed = capsys.readouterr().err
    assert "cut.mp4: cannot be decoded" in printed
    assert "ffmpeg -i VIDEO" in printed
    monkeypatch.setattr(video_frames, "MAX_FRAMES", 5)
    argv[2] = str(video)
    assert main(argv) == 3
    assert "at most 5" in capsys.readouterr().err
    assert not (tmp_path / "s").exists()
