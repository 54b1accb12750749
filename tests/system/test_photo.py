"""One command turns a photograph of a face into maps of its skin and a report."""

import json

import cv2
import numpy as np
import pytest
import skimage.data
from typer.testing import CliRunner

from model import store
from skinrig.cli import app, main


@pytest.fixture(scope="module")
def portrait(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photo")
    shown = skimage.data.astronaut()[:, :, ::-1]
    cv2.imwrite(str(folder / "me.jpg"), shown, [cv2.IMWRITE_JPEG_QUALITY, 95])
    arguments = ["photo", str(folder / "me.jpg"), "--out", str(folder / "out"), "--width", "100"]
    done = CliRunner().invoke(app, [*arguments, "--json"])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout), folder, arguments


@pytest.mark.long
def test_maps_hold_skin_alone(portrait):
    document, _, _ = portrait
    maps = store.read(document["appearance"]).maps
    melanin = maps["melanin"]
    height, width = melanin.mask.shape
    assert width <= 100
    assert 0.2 < melanin.mask.mean() < 0.6
    assert not melanin.mask[: height // 6].any()  # hair
    assert melanin.mask[height // 2, width // 3]
    assert np.isfinite(melanin.stderr[melanin.mask]).all()
    assert maps["image"].mask[: height // 6].any()  # the image itself is whole


@pytest.mark.long
def test_report_is_one_page(portrait):
    document, folder, _ = portrait
    page = (folder / "out" / "report.html").read_text(encoding="utf-8")
    assert str(folder / "out" / "report.html") == document["report"]
    assert "Melanosome volume fraction" in page


@pytest.mark.long
def test_second_run_changes_nothing(portrait, capsys):
    _, folder, arguments = portrait
    before = (folder / "out" / "report.html").read_bytes()
    assert main(arguments) == 3
    assert "expected a new or empty folder" in capsys.readouterr().err
    assert (folder / "out" / "report.html").read_bytes() == before


def test_gray_photograph_leaves_nothing(tmp_path, capsys):
    gray = cv2.cvtColor(skimage.data.astronaut(), cv2.COLOR_RGB2GRAY)
    cv2.imwrite(str(tmp_path / "me.png"), gray)
    assert main(["photo", str(tmp_path / "me.png"), "--out", str(tmp_path / "out")]) == 3
    assert "got a gray photograph" in capsys.readouterr().err
    assert [one.name for one in tmp_path.iterdir()] == ["me.png"]
