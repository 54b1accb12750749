import os
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from fixtures.product_code import ROOT

from model import skin_tone, spectra, tissue_optics
from model.skin_tone.measured import ALL_BANDS, COLOR_QUANTITIES, TABLE_PERCENTILES

WORKBOOK = Path(os.environ.get("ISSA_WORKBOOK", "")) if "ISSA_WORKBOOK" in os.environ else None
"""Workbook of the archive, where the environment names one."""


def test_table_has_increasing_percentiles_in_every_band():
    table = skin_tone.measured_skin()
    assert list(table.spectra) == [*skin_tone.ITA_BANDS, ALL_BANDS]
    counts = [table.spectra[band] for band in skin_tone.ITA_BANDS]
    assert sum(counts) == table.spectra[ALL_BANDS] == 15_255
    for band in table.spectra:
        for quantity in COLOR_QUANTITIES:
            row = table.values[band, quantity]
            assert row.shape == (len(TABLE_PERCENTILES),)
            assert np.all(np.diff(row) > 0.0)


def test_angles_stay_in_their_band():
    table = skin_tone.measured_skin()
    ends = [table.values[band, "ita_deg"][[0, -1]] for band in skin_tone.ITA_BANDS]
    assert skin_tone.ita_band(ends).T.tolist() == [[1, 2, 3, 4, 5, 6]] * 2


def test_rank_and_percentile_are_inverse():
    table = skin_tone.measured_skin()
    at = [table.at("II", "hue_deg", p) for p in (1.0, 30.0, 95.0)]
    np.testing.assert_allclose(table.rank("II", "hue_deg", at), [1.0, 30.0, 95.0])
    with pytest.raises(ValueError, match=r"quantity: got 'blue'"):
        table.rank("II", "blue", 0.0)
    with pytest.raises(ValueError, match="band"):
        table.at("VII", "hue_deg", 50.0)


def test_halves_keep_subjects_together_and_balance():
    subjects = [f"{n % 11}-{n // 11}" for n in range(22_000)]
    half = skin_tone.setting_half(subjects)
    assert half.mean() == pytest.approx(0.5, abs=0.02)
    order = np.random.default_rng(1).permutation(len(subjects))
    again = skin_tone.setting_half([subjects[k] for k in order])
    np.testing.assert_array_equal(again, half[order])
    other = skin_tone.setting_half(subjects, seed=7)
    assert (other == half).mean() == pytest.approx(0.5, abs=0.02)


def test_sphere_specular_is_a_beam_at_eight_degrees():
    sine = np.sin(np.radians(8.0))
    inside = np.sqrt(1.0 - (sine / 1.4) ** 2)
    outside = np.cos(np.radians(8.0))
    s = (outside - 1.4 * inside) / (outside + 1.4 * inside)
    p = (1.4 * outside - inside) / (1.4 * outside + inside)
    assert skin_tone.sphere_specular() == pytest.approx(0.5 * (s**2 + p**2), rel=1e-12)


def test_specular_part_moves_dark_skin_into_measured_chroma():
    nm = spectra.WAVELENGTH_NM
    blood = tissue_optics.blood_absorption(nm)
    baseline = spectra.baseline_absorption(nm)
    scattering = 9.2 * (nm / 500.0) ** -1.421
    melanin = 0.18 * 0.61 * spectra.eumelanin_absorption(nm)
    absorption = np.stack([melanin + 0.39 * 0.18 * spectra.pheomelanin_absorption(nm) + baseline,
                           0.018 * blood + baseline], axis=-1)  # fmt: skip
    diffuse = tissue_optics.layer_stack_reflectance(
        absorption,
        np.stack([scattering, 0.5 * scattering], axis=-1),
        [0.09, np.inf],
        anisotropy=0.8,
    )
    table = skin_tone.measured_skin()
    ranks = []
    for spectrum in (diffuse, diffuse + skin_tone.sphere_specular()):
        _, chroma = skin_tone.hue_chroma(skin_tone.lab_of_spectra(spectrum))
        ranks.append(float(table.rank("VI", "chroma", chroma)))
    assert ranks[0] == 100.0  # diffuse alone is outside measured skin
    assert 5.0 < ranks[1] < 95.0


@pytest.mark.long
@pytest.mark.skipif(WORKBOOK is None, reason="ISSA_WORKBOOK does not name the workbook")
def test_tool_makes_the_committed_table(tmp_path, monkeypatch):
    pytest.importorskip("openpyxl")
    out = tmp_path / "skin_percentiles.csv"
    monkeypatch.setattr(sys, "argv", ["tool", str(WORKBOOK), str(out)])
    with pytest.raises(SystemExit) as finished:
        runpy.run_path(str(ROOT / "tools/make_skin_percentiles.py"), run_name="__main__")
    assert finished.value.code == 0
    assert out.read_text() == (ROOT / "model/data/skin_percentiles.csv").read_text()
