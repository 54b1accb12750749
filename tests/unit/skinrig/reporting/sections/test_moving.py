"""The report's sections on faces that move and on sequences in time."""

import json
import re
from html import unescape

import numpy as np
import pytest

from model import store
from model.facial_color import document as facial_color_document
from model.facial_color.rig import HemoglobinRig
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from model.wrinkles.evaluation import WRINKLE_FILE as WRINKLE_FILE
from model.wrinkles.evaluation import WrinkleModel
from model.wrinkles.partial_derivatives import WrinkleLayer
from skinrig.appearances import dynamic
from skinrig.reporting import report

SIDE = 40


def moving(folder, truths):
    rng = np.random.default_rng(3)
    neutral = np.clip(0.02 + 0.004 * rng.standard_normal((SIDE, SIDE)), 0.005, 0.05)
    rig = HemoglobinRig.from_maps(neutral, {"smile": 1.5 * neutral}, radius_px=6.0)
    maps, document = facial_color_document.to_maps(rig)
    stderr = np.full((SIDE, SIDE), 1e-3, np.float32)
    maps["melanin"] = SkinMap(np.full((SIDE, SIDE), 0.03, np.float32), MAP_UNITS["melanin"])
    maps["hemoglobin_smile"] = SkinMap(1.5 * neutral, MAP_UNITS["hemoglobin"], stderr)
    maps["change_smile"] = SkinMap(0.5 * neutral, MAP_UNITS["hemoglobin"], stderr)
    parameters = {
        "alignment": [{"state": "smile", "median_error_px": 0.3, "by": "landmarks"}],
        "storage_error": {"smile": [0.0, 0.0]},
        "repeatability": None,
        "truth": truths,
    }
    dynamic.add(
        folder,
        dynamic.FACIAL_COLOR,
        SkinAppearance(
            maps, "simulated", parameters, {}, files={facial_color_document.RIG_DOCUMENT: document}
        ),
    )
    layer = WrinkleLayer(np.full((8, 8, 2), 0.3), np.ones((8, 4, 4)) / 8.0)
    maps, document = WrinkleModel(np.zeros((16, 16, 2)), (layer,)).to_maps()
    dynamic.add(
        folder,
        dynamic.WRINKLES,
        SkinAppearance(
            maps,
            "simulated",
            {"expressions": ["surprise"], "explained": 0.9},
            {},
            files={WRINKLE_FILE: document},
        ),
    )
    return neutral


def write_truth(folder, state, name, values):
    maps = {name: SkinMap(np.asarray(values, np.float32), MAP_UNITS["hemoglobin"])}
    store.write(
        folder,
        SkinAppearance(maps, "simulated", parameters={"kind": "truth", "state": state}, seed=0),
    )


def test_rig_with_true_blood_passes_limit_other_misses(tmp_path):
    neutral = moving(tmp_path / "moving", {"neutral": "truth", "smile": "truth-smile"})
    write_truth(tmp_path / "truth", "neutral", "hemoglobin", neutral)
    write_truth(tmp_path / "truth-smile", "smile", "hemoglobin_at_rest", 1.5 * neutral)
    page = report.build([tmp_path])
    assert "Moving face: skin color by expression <small>moving</small>" in page
    assert "The only check kept its limit." in page
    assert "blood volume fraction of smile, by the rig" in page
    change = "change of the blood volume fraction from neutral to smile"
    medians = {
        label: re.search(rf"{change}, {label}: median ([0-9.e-]+)", page)[1]
        for label in ("ground truth", "estimate")
    }
    assert medians["ground truth"] == medians["estimate"]
    assert float(medians["estimate"]) == pytest.approx(0.5 * np.median(neutral), rel=0.02)
    assert "smile, change × 4" in page
    write_truth(tmp_path / "truth-smile", "smile", "hemoglobin_at_rest", 2.5 * neutral)
    assert "1 of 1 checks missed its limit." in report.build([tmp_path])


def test_face_without_truth_is_shown_with_own_errors(tmp_path):
    moving(tmp_path / "moving", {})
    page = report.build([tmp_path / "moving"])
    assert "No limit was checked" in page
    assert "Hemoglobin rig" in page
    assert "error by method" not in page
    # surprise and anger in the forehead: the table's 0.8 - 0.6 and 0.8 - 0.8
    assert "sums over zones" in unescape(page)


def test_sequence_shows_positions_and_bounded_quantities(tmp_path):
    places = {"cheek": 0.03, "chin": 0.02}
    told = {
        "schema": "skinrig.perfusion-curves/1",
        "state": "smile",
        "shot_period_s": 5.5,
        "cycle_s": 10.0,
        "phases": {"captures": 22, "distinct": 20, "interval_s": 0.5},
        "frames": [{"time_s": 5.5 * k, "phase_s": 5.5 * k % 10} for k in range(22)],
        "curves": {
            name: {"hemoglobin": [level] * 22, "stderr": [1e-3] * 21 + [None]}
            for name, level in places.items()
        },
        "fits": {
            name: {"start": level, "end": level, "text": "below 0.157 s"}
            for name, level in places.items()
        },
        "transition": {
            "cheek": {"seen": False, "decided": True, "power": 0.8},
            "chin": {"seen": False, "decided": False},
        },
        "reproducibility": {"cheek": {"sd": 1e-4}},
        "fit_of_all": {"text": "below 0.137 s"},
    }
    store.write(
        tmp_path / "curves",
        SkinAppearance(
            {},
            "simulated",
            parameters={"kind": "appearance"},
            files={"perfusion_curves.json": json.dumps(told).encode()},
        ),
    )
    page = report.build([tmp_path])
    assert "sample 20 phases" in page
    assert "below 0.137 s" in page
    assert "no (power of the test: 80 %)" in page
    assert "undetermined" in page
