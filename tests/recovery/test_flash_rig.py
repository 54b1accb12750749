"""Flash rig: simulate, capture through the drivers, calibrate, reconstruct, compare with the truth.

Subjects of seeds from 100 on; the model-error term was fitted on seeds 0 to 19.
"""

from datetime import date

import numpy as np
import pytest

from model import store
from reconstruction import pipeline
from skinrig.calibrating import calibrate
from skinrig.evaluation import compare
from skinrig.simulation import simulate_session

pytestmark = pytest.mark.render

WIDTH_PX = 320
TODAY = date.today()


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    """Calibrations made from simulated targets; rig and camera are the same for all subjects."""
    folder = tmp_path_factory.mktemp("calibration")
    for kind, target in (("white", "white"), ("polarization", "malus")):
        session = folder / f"session-{target}"
        simulate_session("flash", session, target=target, seed=3, width_px=WIDTH_PX)
        calibrate(kind, [session], folder / "store", created=TODAY)
    return folder / "store"


def reconstructed(folder, calibration, *, subject, seed, **more):
    done = simulate_session(
        "flash", folder / "session-flash", subject=subject, seed=seed, width_px=WIDTH_PX, **more
    )
    pipeline.reconstruct(
        done.session, want=["melanin", "hemoglobin"], out=folder / "maps", calibration=calibration
    )
    return store.read(folder / "maps"), store.read(done.truth)


@pytest.mark.long
@pytest.mark.parametrize(("subject", "seed"), [("I", 100), ("III", 102), ("IV", 103), ("VI", 105)])
def test_chromophores_are_recovered_within_15_percent(tmp_path, calibration, subject, seed, rng):
    """Median relative error over the skin, against the truth with lateral transport in it."""
    maps, truth = reconstructed(tmp_path, calibration, subject=subject, seed=seed)
    rows = [r for r in compare(maps, truth, rng=rng) if r.against == "blurred" and r.band is None]
    assert {row.name for row in rows} == {"melanin", "hemoglobin"}
    for row in rows:
        assert row.median_relative <= 0.15, row
        assert row.masked <= 0.25, row


@pytest.mark.long
def test_without_the_white_reference_the_error_grows(tmp_path, calibration, rng):
    """Shows that the test above can fail: the wrong white balance is taken for pigment."""
    simulate_session(
        "flash", tmp_path / "session-flash", subject="III", seed=102, width_px=WIDTH_PX
    )
    truth = store.read(tmp_path / "truth-flash")
    errors = []
    for used in (calibration, None):
        out = tmp_path / f"maps-{used is None}"
        pipeline.reconstruct(
            tmp_path / "session-flash", want=["melanin", "hemoglobin"], out=out, calibration=used
        )
        rows = compare(store.read(out), truth, rng=rng)
        errors.append(max(r.median_relative for r in rows if r.band is None))
    assert errors[1] > 2 * errors[0]
    assert errors[1] > 0.15


def test_a_subject_is_reconstructed_only_as_far_as_wanted(tmp_path):
    done = simulate_session(
        "flash", tmp_path / "session-flash", subject="II", seed=110, width_px=96
    )
    first = pipeline.reconstruct(done.session, want=["melanin"], out=tmp_path / "maps")
    assert first.ran == ("frames", "separation", "chromophores")
    assert "tsumura" in {name for name, _ in first.left_out}
    assert any("white" in text for text in first.assumed)
    again = pipeline.reconstruct(done.session, want=["melanin"], out=tmp_path / "maps")
    assert again.ran == ()
    assert again.reused == ("chromophores",)
    more = pipeline.reconstruct(done.session, want=["hemoglobin"], out=tmp_path / "maps")
    assert more.ran == ()
    maps = store.read(tmp_path / "maps").maps
    assert {"melanin", "hemoglobin"} <= set(maps)
    assert maps["melanin"].valid is not None
    valid = maps["melanin"].valid
    assert np.isfinite(maps["melanin"].stderr[valid]).all()
    assert (maps["melanin"].stderr[valid] > 0).all()


def test_reconstruction_needs_no_truth(tmp_path):
    import shutil

    done = simulate_session("flash", tmp_path / "session-flash", seed=111, width_px=96)
    shutil.rmtree(done.truth)
    outcome = pipeline.reconstruct(done.session, want=["hemoglobin"], out=tmp_path / "maps")
    assert "chromophores" in outcome.ran


def test_a_calibration_of_another_day_is_refused_by_name(tmp_path, calibration):
    from capture.calibration.store import CalibrationError

    done = simulate_session("flash", tmp_path / "session-flash", seed=112, width_px=96)
    with pytest.raises(CalibrationError, match="valid"):
        pipeline.reconstruct(
            done.session, want=["melanin"], out=tmp_path / "maps", calibration=calibration,
            on_date=date(TODAY.year + 2, 1, 1),
        )  # fmt: skip
    assert not (tmp_path / "maps").exists()


def test_an_interrupted_simulation_resumes_to_the_same_frames(tmp_path):
    whole = simulate_session("flash", tmp_path / "session-a", seed=113, width_px=96)
    seen = []

    def stop(text):
        seen.append(text)
        if len(seen) == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_session("flash", tmp_path / "session-b", seed=113, width_px=96, progress=stop)
    resumed = simulate_session("flash", tmp_path / "session-b", seed=113, width_px=96, resume=True)
    assert resumed.frames == whole.frames
