"""Flash rig: simulate, capture through the drivers, calibrate, reconstruct, compare with the truth.

Subjects of seeds from 100 on; model error and the light's prior were fitted on seeds 0 to 19, and
tools/judge_flash_rig.py judges 100 to 119.
"""

import dataclasses
import shutil
from datetime import date
from functools import cache

import numpy as np
import pytest

from capture.calibration import store as calibration_store
from capture.session import Session
from model import store
from reconstruction.pipeline import recipes as pipeline
from skinrig.calibrating.calibrate import calibrate
from skinrig.evaluating.flash import compare, limit
from skinrig.simulating.simulation import simulate_session

pytestmark = pytest.mark.render

WIDTH_PX = 512
TODAY = date.today()
PLAIN = ("lateral", "interreflections", "spectral", "optics", "relief_shadows")
NARROW = {"subject": "II", "seed": 114, "leave_out": PLAIN}
WANT = ["melanin", "hemoglobin", "diffuse"]  # the last states the noise, for the bounds


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    """Calibrations made from simulated targets; rig and camera are the same for all subjects."""
    folder = tmp_path_factory.mktemp("calibration")
    for kind, target in (("white", "white"), ("polarization", "malus")):
        session = folder / f"session-{target}"
        simulate_session("flash", session, target=target, seed=3, width_px=WIDTH_PX)
        calibrate(kind, [session], folder / "store", created=TODAY)
    return folder / "store"


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """Captures by subject and seed, each simulated when it is first asked for."""

    @cache
    def capture(subject, seed):
        folder = tmp_path_factory.mktemp(f"subject-{subject}")
        return simulate_session(
            "flash", folder / "session-flash", subject=subject, seed=seed, width_px=WIDTH_PX
        )

    return capture


@pytest.fixture(scope="module")
def narrow(tmp_path_factory):
    """A capture of few pixels, for what does not depend on how well skin is resolved."""
    folder = tmp_path_factory.mktemp("narrow")
    return simulate_session("flash", folder / "session-flash", width_px=96, **NARROW)


@pytest.mark.long
@pytest.mark.parametrize(("subject", "seed"), [("I", 300), ("III", 302), ("VI", 305)])
def test_chromophores_are_recovered_within_their_bounds(
    tmp_path, calibration, captured, subject, seed, rng
):
    """Median relative error over the skin, against the truth with lateral transport in it."""
    done = captured(subject, seed)
    pipeline.reconstruct(done.session, want=WANT, out=tmp_path / "maps", calibration=calibration)
    maps, truth = store.read(tmp_path / "maps"), store.read(done.truth)
    rows = [r for r in compare(maps, truth, rng=rng) if r.against == "blurred" and r.band is None]
    assert {row.name for row in rows} == {"melanin", "hemoglobin"}
    for row in rows:
        if row.name == "hemoglobin" and subject == "VI":
            # blood under so much melanin is hardly known: masked, or with a wide interval
            assert row.masked > 0.95 or row.median_stderr > 0.5
            continue
        assert np.isfinite(row.median_bound)
        assert row.median_relative <= limit(row), row
    melanin = next(row for row in rows if row.name == "melanin")
    assert melanin.masked <= 0.15


@pytest.mark.long
def test_white_balance_error_of_10_percent_breaks_bounds(tmp_path, calibration, captured, rng):
    """Shows that the test above can fail; 5 % could be the optics of the person's skin."""
    white = calibration_store.load(calibration, "white")
    tinted = dataclasses.replace(
        white, maps=dict(white.maps) | {"signal": white.maps["signal"] * np.float32([1.1, 1, 1])}
    )
    calibration_store.save(tinted, tmp_path / "tinted")
    done = captured("III", 302)
    pipeline.reconstruct(
        done.session, want=WANT, out=tmp_path / "maps", calibration=tmp_path / "tinted"
    )
    rows = compare(store.read(tmp_path / "maps"), store.read(done.truth), rng=rng)
    broken = [r for r in rows if r.band is None and not r.median_relative <= limit(r)]
    assert broken


@pytest.mark.long
def test_subject_is_reconstructed_only_as_far_as_requested(tmp_path, narrow):
    first = pipeline.reconstruct(narrow.session, want=["melanin"], out=tmp_path / "maps")
    assert first.ran == ("frames", "separation", "chromophores")
    assert "tsumura" in {name for name, _ in first.omitted}
    assert any("white" in text for text in first.assumed)
    again = pipeline.reconstruct(narrow.session, want=["melanin"], out=tmp_path / "maps")
    assert again.ran == ()
    assert again.reused == ("chromophores",)
    more = pipeline.reconstruct(narrow.session, want=["hemoglobin"], out=tmp_path / "maps")
    assert more.ran == ()
    maps = store.read(tmp_path / "maps").maps
    assert {"melanin", "hemoglobin"} <= set(maps)
    assert maps["melanin"].valid is not None
    valid = maps["melanin"].valid
    assert np.isfinite(maps["melanin"].stderr[valid]).all()
    assert (maps["melanin"].stderr[valid] > 0).all()


@pytest.mark.long
def test_wrong_noise_profile_is_harmless_with_calibrated_sensor(tmp_path, monkeypatch, narrow):
    simulate_session("flash", tmp_path / "session-flat", target="flat", seed=3, width_px=96)
    calibrate("sensor", [tmp_path / "session-flat"], tmp_path / "store", created=TODAY)

    def stderr(name, calibration):
        outcome = pipeline.reconstruct(
            narrow.session, want=["diffuse"], out=tmp_path / name, calibration=calibration
        )
        diffuse = store.read(tmp_path / name).maps["diffuse"]
        return outcome, diffuse.stderr[diffuse.valid].astype(float)

    assumed, honest = stderr("honest", None)
    known, measured = stderr("measured", tmp_path / "store")
    assert any("noise profiles" in text for text in assumed.assumed)
    assert not any("noise profiles" in text for text in known.assumed)
    np.testing.assert_allclose(np.median(measured / honest), 1.0, atol=0.05)
    read = Session.read

    def exaggerate(session, record):
        frame = read(session, record)
        scale, offset = frame.noise_profile
        return dataclasses.replace(frame, noise_profile=(100.0 * scale, 100.0 * offset))

    monkeypatch.setattr(Session, "read", exaggerate)
    # signals of few sigmas are masked, so that fewer pixels are left of what looks noisier
    _, believed = stderr("believed", None)
    assert np.median(believed) > 5.0 * np.median(honest)
    _, unmoved = stderr("unmoved", tmp_path / "store")
    np.testing.assert_array_equal(unmoved, measured)


@pytest.mark.long
def test_reconstruction_needs_no_truth(tmp_path, narrow):
    alone = shutil.copytree(narrow.session, tmp_path / "session-flash")
    outcome = pipeline.reconstruct(alone, want=["hemoglobin"], out=tmp_path / "maps")
    assert "chromophores" in outcome.ran


@pytest.mark.long
def test_calibration_of_other_day_is_refused_by_name(tmp_path, narrow):
    from capture.calibration.store import CalibrationError

    simulate_session("flash", tmp_path / "session-white", target="white", seed=3, width_px=96)
    calibration = tmp_path / "store"
    calibrate("white", [tmp_path / "session-white"], calibration, created=TODAY)
    with pytest.raises(CalibrationError, match="valid"):
        pipeline.reconstruct(
            narrow.session,
            want=["melanin"],
            out=tmp_path / "maps",
            calibration=calibration,
            on_date=date(TODAY.year + 2, 1, 1),
        )
    assert not (tmp_path / "maps").exists()


@pytest.mark.long
def test_an_interrupted_simulation_resumes_to_the_same_frames(tmp_path, narrow):
    seen = []

    def stop(text):
        seen.append(text)
        if len(seen) == 4:
            raise KeyboardInterrupt

    again = tmp_path / "session-flash"
    with pytest.raises(KeyboardInterrupt):
        simulate_session("flash", again, width_px=96, progress=stop, **NARROW)
    resumed = simulate_session("flash", again, width_px=96, resume=True, **NARROW)
    assert resumed.frames == narrow.frames
    sessions = Session.open(narrow.session), Session.open(again)
    records = [session.frames() for session in sessions]
    assert [r.index for r in records[0]] == [r.index for r in records[1]]
    pairs = zip(
        *([s.read(r).cfa for r in own] for s, own in zip(sessions, records, strict=True)),
        strict=True,
    )
    for whole, parts in pairs:
        np.testing.assert_array_equal(parts, whole)
