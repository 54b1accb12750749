"""Each command that skinrig prints as the next one runs."""

import re
import shlex

import cv2
import numpy as np
import pytest
import skimage.data
import tifffile
from fixtures.faulty_stacks import dome, render

from skinrig.cli import main
from skinrig.next_steps import CALIBRATION_BY_TARGET

pytestmark = pytest.mark.long
NEXT_COMMAND = re.compile(r"^next: skinrig (.*?)(?:  \(.*\))?$", re.MULTILINE)


@pytest.fixture
def follow(tmp_path, monkeypatch, capsys):
    """Return a function that runs a command and all that it leads to, and returns the last text."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        waiting, ran = [list(words)], []
        while waiting:
            words = waiting.pop()
            code = main(words)
            out, err = capsys.readouterr()
            assert code == 0, f"after {ran}: {words}: {err}"
            ran.append(words)
            waiting += [found for line in NEXT_COMMAND.findall(out) if (found := shlex.split(line))]
            assert len(ran) < 10, ran
        return [" ".join(words[:2]) for words in ran], out

    return run


@pytest.mark.render
@pytest.mark.parametrize(
    ("rig", "targets"), [*CALIBRATION_BY_TARGET.items(), ("dome", {"mirror": "lights"})]
)
def test_simulated_targets_lead_to_calibrations(rig, targets, follow, tmp_path):
    for target in targets:
        out = f"session-{target}"
        if not (tmp_path / out).exists():  # else a target before has led to it
            ran, _ = follow("simulate", rig, "--target", target, "--out", out)
            assert ran[-1].startswith("calibrate")
    assert {path.stem for path in tmp_path.glob("calibration/*.json")} >= {*targets.values()}


def test_photographs_lead_to_reports(follow, tmp_path):
    image = skimage.data.astronaut()[:200, 130:330, ::-1]
    cv2.imwrite(str(tmp_path / "me.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
    ran, _ = follow("import", "photos", ".", "--out", "session", "--width", "60")
    assert [words.split()[0] for words in ran] == ["import", "reconstruct", "report"]
    _, out = follow("photo", "me.jpg", "--out", "portrait", "--width", "60")
    page = re.search(r"^next: \S+ (.*)$", out, re.MULTILINE)[1]
    assert (tmp_path / page).is_file()


def test_exports_lead_back_to_data(follow, tmp_path):
    xarray = pytest.importorskip("xarray")
    rng = np.random.default_rng(1)
    lights = dome(12, rng, 60)
    images, _ = render("ball", lights, rng, side=48, gloss=0.2, noise=0.005)
    (tmp_path / "images").mkdir()
    rows = [str(len(lights))]
    for number, (image, light) in enumerate(zip(images, lights, strict=True)):
        tifffile.imwrite(tmp_path / "images" / f"{number:02d}.tif", image.astype(np.float32))
        rows.append(f"{number:02d}.tif {' '.join(map(str, light))}")
    (tmp_path / "images" / "lights.lp").write_text("\n".join(rows), encoding="utf-8")
    use = ("--use", "research")
    follow("import", "olat", "images", "--consent", "research", "--out", "session")
    for source, to in (("session", "zarr"), ("appearance", "ome-zarr")):
        _, out = follow("export", source, "--to", to, *use, "--out", f"my {to}")
        call = re.search(r"^next: in Python: (.*)$", out, re.MULTILINE)[1]
        assert eval(call, {"xarray": xarray}).data_vars
    ran, _ = follow("export", "session", "--to", "lp", *use, "--out", "my list")
    assert ran[1] == "import olat"
