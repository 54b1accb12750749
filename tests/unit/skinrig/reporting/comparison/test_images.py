"""Two folders of pictures beside each other: light in proportion, codes, sizes, records."""

import json

import numpy as np
import pytest

from model import store
from skinrig.drawing import png
from skinrig.reporting import report
from skinrig.reporting.comparison import images as image_comparison
from skinrig.reporting.comparison import runs as run_comparison


def folder(path, radiance, *, shown=None, **told):
    """Write a rendering: linear light, its picture, and the record."""
    path.mkdir(parents=True)
    store.write_exr(path / "radiance.exr", radiance.astype(np.float32))
    codes = np.rint(255 * np.clip(radiance if shown is None else shown, 0, 1)).astype(np.uint8)
    (path / "radiance.png").write_bytes(png.encode(codes))
    document = {"schema": "skinrig.render/1", "view": {"name": "C03"}, "seconds": 1.0, **told}
    (path / "render.json").write_text(json.dumps(document))
    return path


@pytest.fixture
def light(rng):
    return rng.uniform(0.1, 0.5, (24, 32, 3))


def test_brighter_light_is_reported_by_factor_despite_similarity(light, tmp_path):
    """A picture may be shown at a brightness of its own: codes would say that nothing differs."""
    a = folder(tmp_path / "a", light, shown=light)
    b = folder(tmp_path / "b", 1.25 * light, shown=light)
    (one,), refused = image_comparison.compare_folders(a, b)
    assert (one.kind, refused) == ("linear", [])
    assert one.mean_ratio == pytest.approx(1.25, rel=1e-6)
    assert one.relative_rms == pytest.approx(0.25, rel=1e-6)
    (a / "radiance.exr").unlink()
    (codes,), _ = image_comparison.compare_folders(a, b)
    assert (codes.kind, codes.equal) == ("8-bit codes", True)


def test_brightening_spot_is_located_with_its_channel(light, tmp_path):
    other = light.copy()
    other[5:8, 20:24, 0] += 0.3
    (one,), _ = image_comparison.compare_folders(
        folder(tmp_path / "a", light), folder(tmp_path / "b", other)
    )
    spot = np.zeros(light.shape[:2], bool)
    spot[5:8, 20:24] = True
    np.testing.assert_allclose(one.difference[spot], 0.1, atol=1e-6)
    assert np.abs(one.difference[~spot]).max() == 0.0
    assert one.largest == pytest.approx(0.3, abs=1e-6)


def test_colors_of_png_files_keep_their_order(light, tmp_path):
    a, b = folder(tmp_path / "a", light), folder(tmp_path / "b", light)
    for one in (a, b):
        (one / "radiance.exr").unlink()
    (found,), _ = image_comparison.compare_folders(a, b)
    np.testing.assert_allclose(found.a, light, atol=0.51 / 255)


def test_images_of_other_size_or_unpaired_are_named(light, tmp_path):
    a, b = folder(tmp_path / "a", light), folder(tmp_path / "b", light[:12])
    (b / "shadow.png").write_bytes(png.encode(np.zeros((4, 4), np.uint8)))
    found, refused = image_comparison.compare_folders(a, b)
    assert found == []
    assert dict(refused) == {"radiance": "sizes 24 x 32 x 3 and 12 x 32 x 3", "shadow": "only in B"}


def test_report_on_two_image_folders_compares_images(light, tmp_path):
    a = folder(tmp_path / "monday", light, samples=4)
    b = folder(tmp_path / "tuesday", 1.1 * light, samples=16, seconds=9.0)
    done = report.build_any([a, b])
    assert done.compared == ("A: monday", "B: tuesday")
    assert "1 of 1 images differ" in done.html
    assert "monday and tuesday" in done.html
    assert ">samples<" in done.html
    assert ">seconds<" not in done.html
    assert done.html == report.build_any([a, b]).html
    assert report.build_any([a, b], compare=False).compared is None


def test_images_in_two_runs_pair_by_folder_name(light, tmp_path):
    for run, gain in (("x", 1.0), ("y", 1.0)):
        folder(tmp_path / run / "pictures-front", gain * light)
    folder(tmp_path / "x" / "pictures-side", light)
    paths = [tmp_path / "x", tmp_path / "y"]
    both = run_comparison.split_sides(paths)
    assert both is not None
    found = run_comparison.pair_by_name(*(run.pictures for run in both))
    assert [name for name, _, _ in found] == ["pictures-front"]
    assert run_comparison.list_unpaired(*both) == [("pictures-side", "A: x")]
    html = report.build_any(paths).html
    assert "0 of 1 images differ" in html
    assert "Settings and records are equal" in html


def test_photograph_check_failing_once_is_reported_as_changed(light, tmp_path):
    row = {
        "pairs": 2,
        "median": 0.03,
        "p68": 0.05,
        "p95": 0.1,
        "bias": 0.0,
        "total_error": 0.04,
        "ssim": 0.9,
        "delta_e": 1.0,
        "noise": 0.01,
    }
    for name, median in (("a", 0.03), ("b", 0.08)):
        told = {
            "full model": {**row, "median": median},
            "limit": 0.05,
            "by_kind": {},
            "ablation": {},
            "by_band": {},
        }
        folder(tmp_path / name, light, **told)
    html = report.build_any([tmp_path / "a", tmp_path / "b"]).html
    assert "1 of 1 checks changed their verdict, 1 from kept to missed" in html


def test_damaged_image_is_named_and_rest_compared(light, tmp_path):
    a, b = folder(tmp_path / "a", light), folder(tmp_path / "b", light)
    for one in (a, b):
        (one / "broken.png").write_bytes(b"no picture")
    found, refused = image_comparison.compare_folders(a, b)
    assert [one.name for one in found] == ["radiance"]
    assert refused == [("broken", "cannot be read: not an image")]
