"""Typology angle of people with drawn tissue: flash sessions, and photographs of face and chart.

Seeds are not those of docs/reference/maps.md. Ground truth are the spectra of the simulator's own
layers, integrated to CIE Lab; the estimate has seen a camera's RGB alone.
"""

from datetime import date

import numpy as np
import pytest

from capture.importers import import_photos
from capture.session import Session
from model import skin_tone, store
from reconstruction.pipeline import recipes as pipeline
from rigsim.population.files import SCHEMA
from rigsim.subject.person_skin import draw_tissue
from rigsim.tissue.skin_table import WAVELENGTH_NM, SkinTable
from skinrig.calibrating.calibrate import calibrate
from skinrig.simulating.simulation import simulate_session

pytestmark = [pytest.mark.render, pytest.mark.long, pytest.mark.timeout(600)]

WIDTH_PX = 320
TODAY = date.today()
PEOPLE = {"light": (0.012, 521), "tan": (0.035, 522), "dark": (0.16, 523)}
"""Melanosome fraction and seed."""


@pytest.fixture(scope="module")
def targets(tmp_path_factory):
    """Folder with sessions of a white reference and a chart, and their calibrations."""
    folder = tmp_path_factory.mktemp("targets")
    for target, kind in (("white", "white"), ("chart", "color")):
        simulate_session("flash", folder / target, target=target, seed=9, width_px=WIDTH_PX)
        calibrate(kind, [folder / target], folder / "calibration", created=TODAY)
    return folder


def capture(folder, name):
    """Simulate a session of a person; return the result and the properties of the tissue."""
    melanin, seed = PEOPLE[name]
    file = folder / "person.toml"
    file.write_text(f'schema = "{SCHEMA}"\nmelanin = {melanin}\n')
    done = simulate_session(
        "flash", folder / "session", subject=str(file), seed=seed, width_px=WIDTH_PX
    )
    return done, draw_tissue(seed)


def true_angle(truth, properties, good):
    """Return typology angles, degrees, of the ground truth's chromophores."""
    melanin, blood = (
        truth.maps[name].values[good].astype(float) for name in ("melanin", "hemoglobin")
    )
    spectra = SkinTable.load(properties).spectra(melanin, blood) + (0.4 / 2.4) ** 2
    return skin_tone.ita(skin_tone.lab_of_spectra(spectra, WAVELENGTH_NM))


@pytest.mark.parametrize("name", PEOPLE)
def test_typology_angle_is_that_of_skin(tmp_path, targets, name):
    done, properties = capture(tmp_path, name)
    pipeline.reconstruct(
        done.session,
        want=["ita", "diffuse", "lab"],
        out=tmp_path / "maps",
        calibration=targets / "calibration",
    )
    maps, truth = store.read(tmp_path / "maps"), store.read(done.truth)
    good = maps.maps["ita"].mask & (truth.maps["mask"].values > 0)
    assert good.sum() > 0.9 * (truth.maps["mask"].values > 0).sum()
    angle = true_angle(truth, properties, good)
    error = np.abs(maps.maps["ita"].values[good] - angle)
    assert np.median(error) < 2.5
    # one image's light varies by far more than the angle may
    shaded = maps.maps["diffuse"].values[good].mean(axis=-1)
    level = shaded / np.quantile(shaded, 0.98)
    assert np.median(level) < 0.9
    dim = level < 0.5
    assert dim.sum() > 100
    assert np.median(error[dim]) < 6.0
    lightness = maps.maps["lab"].values[good][:, 0]
    assert np.corrcoef(lightness, level)[0, 1] < 0.6
    inside = error <= maps.maps["ita"].stderr[good]
    # the face is at the reference's position, so the interval's part by position is not used
    assert inside.mean() > 0.68


def test_photograph_of_chart_gives_skin_tone(tmp_path, targets):
    done, properties = capture(tmp_path, "tan")

    def photograph(session, kind, name):
        frames = Session.open(session).frames(kind, polarizer="crossed")
        path = Session.open(session).path / frames[0].line.file
        out = tmp_path / f"session-{name}"
        import_photos(path, out=out, kind=kind)
        return out

    chart = photograph(targets / "chart", "chart", "chart")
    calibrate("color", [chart], tmp_path / "store", created=TODAY)
    face = photograph(done.session, "subject", "face")
    pipeline.reconstruct(
        face, want=["ita", "monk"], out=tmp_path / "maps", calibration=tmp_path / "store"
    )
    maps, truth = store.read(tmp_path / "maps"), store.read(done.truth)
    good = maps.maps["ita"].mask & (truth.maps["mask"].values > 0)
    angle = true_angle(truth, properties, good)
    assert np.median(np.abs(maps.maps["ita"].values[good] - angle)) < 2.0
    tones = [maps.maps[f"monk{end}"].values[good] for end in ("_low", "", "_high")]
    assert (tones[0] <= tones[1]).all()
    assert (tones[1] <= tones[2]).all()
