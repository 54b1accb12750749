"""Stretched skin from a simulated session to strain, normals, heights, histograms and kernels."""

import json
import shutil

import numpy as np
import pytest

from capture.session import Session
from model import store
from reconstruction.kernel_fit import fit_kernel
from reconstruction.kernel_fit.fit import ALPHA_GRID, SIGMAS_UM
from reconstruction.normal_histogram.statistics import measure_normals
from reconstruction.pipeline import recipes as pipeline
from reconstruction.pipeline.gradient.images import GradientImages
from reconstruction.pipeline.inputs import InputsError
from skinrig.evaluating import microrelief as evaluation
from skinrig.reporting.report import build
from skinrig.simulating.simulation import simulate_session

pytestmark = [pytest.mark.long, pytest.mark.render]

STATES = ["a000_m1", "a000_n0", "a000_p1", "a000_p2"]
WANT = ("normals", "height", "strain", "histograms", "kernels")


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """Return a session of 1.2 mm of cheek in four states, and its truth."""
    out = tmp_path_factory.mktemp("gradient") / "session-cheek"
    done = simulate_session(
        "gradient", out, site="cheek", seed=4, width_px=200, angles=(0.0,), steps=(-1, 2)
    )
    return done


@pytest.fixture(scope="module")
def made(captured):
    """Return the appearance reconstructed from it, and the truth."""
    out = captured.session.parent / "appearance-cheek"
    pipeline.reconstruct(captured.session, want=WANT, out=out, truth=captured.truth.name)
    return store.read(out), store.read(captured.truth)


def test_every_state_that_was_captured_is_there(made):
    found, _ = made
    assert evaluation.find_states(found) == STATES
    assert {"strain.json", "histograms.json", "kernels.json"} <= set(found.files)


def test_skin_stretch_is_measured_within_half_percent(made):
    rows = evaluation.compare_stretch(*made)
    assert [row.state for row in rows]
    assert all(abs(row.error) <= 0.005 for row in rows)
    # five standard errors: 1 in a million a state, were neighbors' texture not shared
    strained = [row for row in rows if row.state != "a000_n0"]
    assert all(abs(row.error) < 5 * row.stderr for row in strained)


def test_caliper_reading_alone_errs_where_tape_slips(made):
    rows = {row.state: row for row in evaluation.compare_stretch(*made)}
    slipped = rows["a000_p2"]
    assert abs(slipped.reading - slipped.truth) > 3 * abs(slipped.error)


def test_normals_are_correct_only_up_to_lens_resolution(made):
    rows = evaluation.compare(*made, rng=np.random.default_rng(0))
    for row in rows:
        assert row.mean_deg < 2.5, row
        assert row.unblurred_deg > row.mean_deg
        assert row.masked < 0.02


def test_heights_follow_true_topography(made):
    found, true = made
    for row in evaluation.compare(found, true, rng=np.random.default_rng(0)):
        assert row.height_relative < 0.25, row
    # of another state they would not
    one = evaluation.true_relief(found, true, "a000_n0")
    other = found.maps["height_a000_p2"].values
    assert np.std(other - one) > 0.3 * np.std(one)


def test_stretching_smooths_and_compression_roughens(made):
    (rows,) = evaluation.normal_variances(made[0]).values()
    stretch, _, variance, stderr = np.array(rows).T
    assert (np.diff(stretch) > 0).all()
    assert (np.diff(variance) < 0).all()
    assert variance[0] - variance[-1] > 3 * stderr[-1]


def test_nothing_is_made_twice(captured, made):
    out = captured.session.parent / "appearance-cheek"
    again = pipeline.reconstruct(captured.session, want=WANT, out=out, truth=captured.truth.name)
    assert again.ran == ()


def test_unrequested_results_are_omitted(captured, tmp_path):
    outcome = pipeline.reconstruct(captured.session, want=["strain"], out=tmp_path / "maps")
    assert outcome.ran == ("diagnosis", "strain")
    assert "kernels" in {name for name, _ in outcome.omitted}


def test_the_report_shows_states_and_trends(captured, made):
    page = build([captured.session.parent])
    for words in ("From compressed to stretched", "roughness along the jaws", "Strain of the skin"):
        assert words in page


def test_a_state_without_a_pattern_still_has_normals(captured, tmp_path):
    images = GradientImages(Session.open(captured.session))
    patterns = images.of(images.neutral)
    from reconstruction.gradient_normals import from_patterns

    some = {key: value for key, value in patterns.values.items() if key[0] != "-x"}
    found = from_patterns(some, variance=dict(patterns.variance), smoothing=1.0)
    whole = from_patterns(patterns.values, variance=dict(patterns.variance), smoothing=1.0)
    assert found.valid.mean() > 0.95
    assert np.median(found.stderr_rad) > np.median(whole.stderr_rad)


def test_states_without_neutral_are_refused(captured, tmp_path):
    plan_only = tmp_path / "session"
    shutil.copytree(captured.session, plan_only)
    session = Session.open(plan_only)
    kept = [r for r in session.frames("gradient") if int(r.index["caliper"]) != 0]

    class Without:
        id = session.id
        path = session.path
        rig = session.rig

        def frames(self, kind=None, **index):
            return kept if kind == "gradient" else []

    with pytest.raises(InputsError, match="neutral"):
        GradientImages(Without())


def test_documents_are_strict_json(made):
    for name in ("strain.json", "histograms.json", "kernels.json"):
        document = json.loads(made[0].files[name], parse_constant=lambda word: pytest.fail(word))
        assert document["schema"].startswith("skinrig.")


def test_kernel_halves_histogram_distance_at_every_step():
    """On 7 mm of true relief, without camera: eq. (7) at the caliper's steps."""
    from rigsim.skin_patch.microrelief import make_micro_skin
    from rigsim.skin_patch.stretch import required_size_mm, stretch_skin

    side, pixel_um = 880, 8.0
    skin = make_micro_skin("cheek", seed=5, size_mm=required_size_mm(side * pixel_um / 1e3, 0.8))
    rows, columns = np.mgrid[0:side, 0:side]
    x = (columns - (side - 1) / 2) * pixel_um / 1e3
    y = ((side - 1) / 2 - rows) * pixel_um / 1e3
    neutral = stretch_skin(skin, stretch=1.0, angle_deg=0.0).sample(x, y).height_um
    variance = {1.0: measure_normals(neutral, pixel=pixel_um).variance_x}
    for r in (0.8, 0.9, 1.1, 1.2):
        state = stretch_skin(skin, stretch=r, angle_deg=0.0)
        strained = state.sample(x * state.stretch_s, y * state.stretch_t).height_um
        found = measure_normals(
            strained, pixel=(pixel_um * state.stretch_t, pixel_um * state.stretch_s)
        )
        variance[r] = found.variance_x
        fit = fit_kernel(
            neutral,
            found.histogram,
            stretch=r,
            axis="x",
            pixel_um=pixel_um,
            stretch_across=state.stretch_t,
            grid=(ALPHA_GRID[::5], SIGMAS_UM[::5]),
        )
        assert fit.distance <= 0.5 * fit.distance_before, (r, fit.distance, fit.distance_before)
        assert (fit.alpha > 0) == (r > 1)
    assert sorted(variance, key=variance.get, reverse=True) == sorted(variance)
