"""Wrinkles fitted to faces whose furrows rise by laws that are not the model's.

The truths are heights: buckled skin of the simulated face, and furrows that deepen less than
proportionally and narrow as they do. One map, eight zones and weights cannot show them exactly;
how much they show is the model's error, and what is not furrowed alike must show as more.
"""

import numpy as np
import pytest

from model import metrics, wrinkles
from model.wrinkles import JIMENEZ2011_TABLE
from reconstruction.wrinkles import fit as wrinkle_fit
from reconstruction.wrinkles import texels as wrinkle_texels
from reconstruction.wrinkles import zones as wrinkle_zones
from rigsim.subject import make_subject
from skinrig.benchmarks.gradient_rig import wrinkles as bench_wrinkles

EXPRESSIONS = ("anger", "disgust", "fear", "happiness", "sadness", "surprise")


def part_of_neutral_s_error(model, neutral, states, covered):
    """Return the root mean square angle to the truth, relative to that of the neutral face."""
    ours = theirs = 0.0
    for name, normals in states.items():
        shown = model.evaluate({name: 1.0}).normals
        ours += np.nansum(metrics.angular_error_rad(shown, normals)[covered] ** 2)
        theirs += np.nansum(metrics.angular_error_rad(neutral, normals)[covered] ** 2)
    return np.sqrt(ours / theirs)


def test_deepening_narrowing_grooves_follow_weighted_single_map():
    rng = np.random.default_rng(0)
    neutral, states = bench_wrinkles.synthesize_wrinkled_face(192, rng=rng)
    masks = bench_wrinkles.make_zone_masks(32)
    covered = np.ones((192, 192), bool)
    fit = wrinkle_fit.fit_wrinkle_map(neutral, states, masks, size=(96, 96), clamp="signed")
    left = part_of_neutral_s_error(fit.model(), neutral, states, covered)
    assert left < 0.4
    # weights follow the table that raised the furrows, up to each zone's scale and law
    got = np.array([fit.layer.table.rows[name] for name in JIMENEZ2011_TABLE.rows])
    true = np.array(list(JIMENEZ2011_TABLE.rows.values()))
    for z in range(8):
        assert np.corrcoef(got[:, z], true[:, z])[0, 1] > 0.9
    # zones in wrong places must show: the test can fail
    wrong = wrinkle_fit.fit_wrinkle_map(
        neutral, states, np.roll(masks, 11, axis=1), size=(96, 96), clamp="signed"
    )
    assert part_of_neutral_s_error(wrong.model(), neutral, states, covered) > 1.5 * left


def test_unfitted_expression_is_represented_by_bounded_weights():
    neutral, states = bench_wrinkles.synthesize_wrinkled_face(192, rng=np.random.default_rng(1))
    fear = states.pop("fear")
    masks = bench_wrinkles.make_zone_masks(32)
    fit = wrinkle_fit.fit_wrinkle_map(neutral, states, masks, size=(96, 96), clamp="signed")
    weights = wrinkle_fit.fit_weights(fit.layer, neutral, fear)
    assert weights.explained > 0.8
    assert weights.weights.min() >= 0.0
    assert weights.weights.max() <= 1.0
    shown = wrinkles.combine(wrinkles.encode(neutral), fit.layer.wrinkle, masks, weights.weights)
    ours = metrics.angular_error_rad(shown, fear).mean()
    assert ours < 0.5 * metrics.angular_error_rad(neutral, fear).mean()


@pytest.mark.long
@pytest.mark.timeout(900)
def test_buckled_wrinkles_return_as_map_with_data_zones():
    """Rationale: buckling amplitude goes with the root of the shortening, and lines are fixed.

    Expected: the lines being fixed, each texel's expressions are one pattern to a few per cent;
    eight zones and a map of half the resolution leave well under half of the neutral error.
    """
    size = 256
    face = make_subject("II", seed=5, size=size)
    covered = np.asarray(face.atlas.covered)
    neutral = face.tangent_normal()
    states = {name: face.with_expression(name).tangent_normal() for name in EXPRESSIONS}
    base = wrinkle_texels.measure_derivatives(neutral, valid=covered)
    measured = {n: wrinkle_texels.measure_derivatives(s, valid=covered) for n, s in states.items()}
    found = wrinkle_zones.estimate_amplitudes(base, measured, size=(32, 32))
    zones = wrinkle_zones.fit_zones(found, zones=8, rng=np.random.default_rng(0))
    assert zones.rank_one_fraction > 0.85
    fit = wrinkle_fit.fit_wrinkle_map(base, measured, zones.masks, size=(128, 128))
    assert fit.explained > 0.7
    assert part_of_neutral_s_error(fit.model(), neutral, states, covered) < 0.6
    alone = wrinkle_fit.fit_wrinkle_map(base, measured, np.ones((1, 2, 2)), size=(128, 128))
    assert alone.explained < 0.7 * fit.explained  # one zone cannot tell expressions apart
    held_out = {name: one for name, one in measured.items() if name != "fear"}
    without = wrinkle_fit.fit_wrinkle_map(base, held_out, zones.masks, size=(128, 128))
    weights = wrinkle_fit.fit_weights(without.layer, base, measured["fear"])
    assert weights.explained > 0.5
