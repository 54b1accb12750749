"""Folders of renderings and analyses in the report."""

import json

import numpy as np
import pytest

from skinrig.drawing import png
from skinrig.reporting import page
from skinrig.reporting.report import ReportError, build
from skinrig.reporting.sections import images as pictures


def a_row(median):
    return {
        "pairs": 2,
        "median": median,
        "p68": 0.05,
        "p95": 0.2,
        "bias": -0.01,
        "total_error": 0.04,
        "ssim": 0.98,
        "delta_e": 1.0,
        "noise": 0.01,
    }


def a_folder(path, **document):
    path.mkdir()
    (path / "render.json").write_text(json.dumps({"schema": "skinrig.render/1", **document}))
    (path / "radiance.png").write_bytes(png.encode(np.zeros((4, 6, 3), np.uint8)))
    return path


def test_comparison_adds_limit_and_names_omissions(tmp_path):
    folder = a_folder(
        tmp_path / "pictures",
        **{
            "full model": a_row(0.06),
            "by_kind": {"light": a_row(0.06)},
            "limit": 0.05,
            "ablation": {"no surface": a_row(0.11)},
            "assumed": ["lights as drawn"],
            "by_band": {"light": {"pixels": 10, "median": 0.06}},
        },
    )
    checks: list[page.Check] = []
    body = page.render_fragment(pictures.section(folder, checks))
    assert [check.passed for check in checks] == [False]
    assert "no surface" in body
    assert "light held out" in body
    assert "lights as drawn" in body
    assert body.count("data:image/webp") == 1


def test_report_finds_images_below_its_folder(tmp_path):
    a_folder(tmp_path / "pictures", view={"name": "C03"}, lights={"L017": 1}, lobes=4)
    html = build([tmp_path])
    assert "Rendering <small>pictures</small>" in html
    assert "L017" in html


def test_large_images_stay_in_their_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "MAX_IMAGE_BYTES", 10)
    folder = a_folder(tmp_path / "pictures", view={"name": "C03"}, lights={})
    body = page.render_fragment(pictures.section(folder, []))
    assert "Too large for this report: radiance.png" in body
    assert "data:image" not in body


def test_other_documents_are_not_images(tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    (folder / "analysis.json").write_text(json.dumps({"schema": "somebody.else/1"}))
    assert not list(pictures.section(folder, []))
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(ReportError, match="holds no"):
        build([empty])
