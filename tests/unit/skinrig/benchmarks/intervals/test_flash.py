"""Trials of the flash rig: subjects' distances from the white reference match the stated errors."""

import numpy as np
import pytest
from scipy import stats

from reconstruction.chromophores import shading_prior
from skinrig.benchmarks.intervals import flash as trials


def test_subject_distance_from_tile_matches_stated_light_error():
    """Light falls with the square of the distance; chi-square of 400 draws, 1 % false alarms."""
    distance_mm = 1000.0
    nearer = np.array([trials.draw_stance_offset_mm(seed) for seed in range(400)])
    light = -2.0 * np.log1p(-nearer / distance_mm)
    low, high = stats.chi2.ppf([0.005, 0.995], nearer.size - 1) / (nearer.size - 1)
    assert (
        low < light.var(ddof=1) / shading_prior.LOG_SHADING_SOFTNESS**2 < high * 1.02
    )  # for its bend
    assert abs(nearer.mean()) < 2.6 * nearer.std() / np.sqrt(nearer.size)


def test_each_subject_is_simulated_at_its_drawn_position(tmp_path, monkeypatch):
    class Asked(Exception):
        """Stops before anything is rendered."""

    def simulate(rig, folder, **given):
        raise Asked(given["seed"], given["nearer_mm"])

    monkeypatch.setattr(trials, "calibrate_flash", lambda *_, **__: None)
    monkeypatch.setattr(trials, "resimulate", simulate)
    for seed in (520, 521):
        with pytest.raises(Asked) as asked:
            next(trials.run_trials(tmp_path, {seed: "III"}, width_px=64))
        assert asked.value.args == (seed, trials.draw_stance_offset_mm(seed))
    assert trials.draw_stance_offset_mm(520) != trials.draw_stance_offset_mm(521)
