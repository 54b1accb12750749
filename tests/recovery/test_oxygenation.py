"""Oxygenation of the flash rig: LEDs through plan, drivers, sensor, calibration and maps."""

import numpy as np
import pytest

from capture.plan import flash_plan
from capture.plan.led_bands import parse_bands
from capture.rig import load_rig
from capture.session import Session
from model import store
from reconstruction.pipeline import recipes as pipeline
from reconstruction.pipeline.graph import StageError
from skinrig.calibrating.calibrate import calibrate
from skinrig.simulating.simulation import simulate_session

pytestmark = pytest.mark.render

LEDS = parse_bands("450,580,600")
WIDTH_PX = 192  # with lateral scattering; at 96 px mosaic aliasing of skin detail exceeds noise
PLAIN = ("interreflections", "spectral", "optics", "relief_shadows")
NARROW = {"width_px": WIDTH_PX, "seed": 411}
SUBJECT = """schema = "skinrig.subject/1"
preset = "II"
oxygenation = {oxygenation}
scattering_per_mm = 8.3
scattering_slope = 1.6
baseline_amplitude = 1.15
eumelanin_fraction = 0.72
"""


pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def calibrations(tmp_path_factory):
    """White references with and without LEDs."""
    folder = tmp_path_factory.mktemp("white")
    for name, bands in (("leds", LEDS), ("plain", ())):
        session = folder / f"session-{name}"
        simulate_session("flash", session, target="white", width_px=WIDTH_PX, bands=bands)
        calibrate("white", [session], folder / name)
    return folder


@pytest.fixture(scope="module")
def people(tmp_path_factory):
    """Sessions of two people that differ in oxygenation only."""
    made = {}
    for oxygenation in (0.5, 0.9):
        folder = tmp_path_factory.mktemp("person")
        (folder / "person.toml").write_text(SUBJECT.format(oxygenation=oxygenation))
        made[oxygenation] = simulate_session(
            "flash",
            folder / "session-flash",
            subject=str(folder / "person.toml"),
            bands=LEDS,
            leave_out=PLAIN,
            **NARROW,
        )
    return made


def test_maps_recover_oxygenation_of_two_people(people, calibrations, tmp_path):
    """Expected: within two standard errors, and 0.6 of the difference between them.

    Rationale: both people are near +-2 standard deviations of the prior, toward whose mean an
    estimate with a standard error of half the prior's is drawn by a quarter to a third.
    """
    medians = {}
    for oxygenation, done in people.items():
        out = tmp_path / f"maps-{oxygenation}"
        pipeline.reconstruct(
            done.session, want=["oxygenation"], out=out, calibration=calibrations / "leds"
        )
        maps, truth = store.read(out).maps, store.read(done.truth).maps
        found, skin = maps["oxygenation"], truth["mask"].values > 0.5
        np.testing.assert_allclose(truth["oxygenation"].values[skin], oxygenation, rtol=1e-6)
        good = found.valid & skin
        assert good.sum() > 0.9 * skin.sum()
        medians[oxygenation] = np.median(found.values[good])
        stderr = np.median(found.stderr[good])
        assert abs(medians[oxygenation] - oxygenation) < 2.0 * stderr
        assert np.std(found.values[good]) < stderr < 0.097
    assert medians[0.9] - medians[0.5] > 0.6 * 0.4


def test_session_stores_led_frames_as_controller_reported(people):
    session = Session.open(people[0.9].session)
    found = [r for r in session.frames("subject") if "light" in r.index]
    assert [record.line.actual["light"] for record in found] == list(LEDS)
    assert all(record.line.actual["polarizer"] == "crossed" for record in found)
    assert len(session.frames("subject", polarizer="crossed")) == 1


def test_missing_led_frames_or_whites_are_refused(people, calibrations, tmp_path):
    plan = flash_plan(load_rig("flash").resized(WIDTH_PX), darks=1)
    plain = simulate_session(
        "flash", tmp_path / "session-plain", plan=plan, leave_out=PLAIN, **NARROW
    )
    assert "oxygenation" not in store.read(plain.truth).maps
    for done, white, why in (
        (plain, "leds", "without frames under narrow-band LEDs"),
        (people[0.9], "plain", "without their white references"),
    ):
        with pytest.raises(StageError, match=why):
            pipeline.reconstruct(
                done.session,
                want=["oxygenation"],
                out=tmp_path / "maps",
                calibration=calibrations / white,
            )
