"""Moved faces in other states of blood are laid over neutral, and give the state's blood there.

The truth is a simulated face whose texture was moved by a smooth displacement and whose vessels
were dilated; the estimators know of neither.
"""

import numpy as np
import pytest
from twins.alignments import place_stderr

from model.facial_color import HemoglobinRig
from reconstruction.chromophores import posterior as chromophore_posterior
from reconstruction.chromophores import shading_prior
from reconstruction.correspondence import expression_alignment
from reconstruction.facial_color import shared_melanin
from rigsim.subject import make_subject
from skinrig.benchmarks.flash_rig.alignment import (
    displace_face,
    displace_map,
    face_mask,
    load_color_table,
    smooth_displacement,
)

SIDE = 256


@pytest.fixture(scope="module")
def face():
    return make_subject("III", seed=11, size=SIDE)


@pytest.fixture(scope="module")
def smiling(face):
    rng = np.random.default_rng(7)
    away = smooth_displacement(SIDE, bend_px=28.0, rms_px=5.0, rng=rng)
    return displace_face(face, away, state="smile", noise=0.004, rng=rng)


def laid_over(seen, **options):
    return expression_alignment.align(
        seen.moving,
        seen.neutral,
        landmarks_moving=seen.landmarks_moving,
        landmarks_neutral=seen.landmarks,
        valid_moving=seen.valid_moving,
        valid_neutral=seen.valid,
        **options,
    )


@pytest.fixture(scope="module")
def aligned(smiling):
    return laid_over(smiling)


def off(found, seen):
    return np.linalg.norm(found.source_px - seen.source_px, axis=-1)[found.valid]


@pytest.mark.long
def test_smile_motion_of_five_pixels_found_within_half(smiling, aligned):
    """Landmarks to 1 px leave more than that between them; not to align leaves all of it."""
    assert aligned.valid[smiling.valid].mean() > 0.93
    assert np.sqrt(np.mean(off(aligned, smiling) ** 2)) < 0.5
    by_landmarks = laid_over(smiling, rounds=0, max_error_px=50.0)
    assert np.sqrt(np.mean(off(by_landmarks, smiling) ** 2)) > 1.0
    rows, columns = np.mgrid[:SIDE, :SIDE]
    moved = np.linalg.norm(smiling.source_px - np.dstack([columns, rows]), axis=-1)
    assert np.sqrt(np.mean(moved[smiling.valid] ** 2)) > 4.0


@pytest.mark.long
def test_stated_position_error_covers_the_true_error(smiling, aligned):
    """Within twice the root mean square: 98 % for a normal error, 90 % asked; a quarter fails."""
    error, stated = off(aligned, smiling), aligned.error_px[aligned.valid]
    assert np.mean(error < 2.0 * stated) > 0.9
    assert np.mean(error < 0.5 * stated) < 0.9
    # larger where it says so
    order = np.argsort(stated)
    third = len(order) // 3
    assert np.mean(error[order[-third:]]) > 1.5 * np.mean(error[order[:third]])


@pytest.mark.long
@pytest.mark.parametrize("state", ["exercise", "fear"])
def test_varying_blood_is_not_read_as_motion(face, state):
    rng = np.random.default_rng(3)
    seen = displace_face(face, np.zeros((SIDE, SIDE, 2)), state=state, noise=0.004, rng=rng)
    change = np.abs(seen.hemoglobin_at_rest - seen.hemoglobin)[seen.valid]
    assert np.median(change) > 0.002
    found = laid_over(seen)
    assert np.median(off(found, seen)) < 0.1
    assert np.percentile(off(found, seen), 95) < 0.4


@pytest.mark.long
def test_features_alone_find_the_motion_too(smiling):
    found = expression_alignment.align(
        smiling.moving,
        smiling.neutral,
        valid_moving=smiling.valid_moving,
        valid_neutral=smiling.valid,
    )
    assert found.by == "features"
    assert np.sqrt(np.mean(off(found, smiling) ** 2)) < 0.5


@pytest.mark.long
def test_state_blood_is_mapped_onto_neutral_face(smiling, aligned):
    """Warped blood against the state's blood at rest: interpolation leaves less than the change."""
    blood, seen = aligned.warp(smiling.hemoglobin_moving, smiling.valid_moving)
    error = (blood - smiling.hemoglobin_at_rest)[seen]
    unmoved = (smiling.hemoglobin_moving - smiling.hemoglobin_at_rest)[seen]
    assert np.sqrt(np.mean(error**2)) < 0.25 * np.sqrt(np.mean(unmoved**2))


@pytest.mark.long
def test_joint_inversion_of_aligned_states_improves_changes(smiling, aligned):
    colors, prior = load_color_table(), shading_prior.face_prior()
    rgb, seen = aligned.warp(smiling.moving, smiling.valid_moving)
    variance, _ = aligned.warp(smiling.variance_moving, smiling.valid_moving)
    both = np.stack([smiling.neutral, rgb])
    noise = np.stack([smiling.variance_neutral, np.maximum(variance, 1e-10)])
    valid = np.stack([smiling.valid, seen])
    truth = smiling.hemoglobin_at_rest - smiling.hemoglobin
    part = (slice(96, 160), slice(80, 176))  # cheeks, to be quick
    joint = shared_melanin.estimate_shared_melanin(
        both[:, *part],
        colors,
        prior=prior,
        variance=noise[:, *part],
        valid=valid[:, *part],
        shading_window_px=shared_melanin.SHADING_WINDOW_PX,
    )
    each = [
        chromophore_posterior.estimate(
            both[k][part], colors, prior=prior, variance=noise[k][part], valid=valid[k][part]
        )
        for k in (0, 1)
    ]
    good = joint.valid_states.all(axis=0) & each[0].valid & each[1].valid
    assert good.mean() > 0.9
    error = np.abs(joint.change[1] - truth[part])[good]
    alone = np.abs(each[1].hemoglobin - each[0].hemoglobin - truth[part])[good]
    assert np.median(error) < 0.6 * np.median(alone)
    # what the places are off by is not in it
    place = place_stderr(aligned, np.where(valid[1], smiling.hemoglobin_at_rest, np.nan))[part]
    stated = np.hypot(joint.stderr_change[1], place)[good]
    # nominal 0.95; faces of seeds 2, 3, 5 and 11 give 0.86 to 0.89
    assert np.mean(error < 2 * stated) > 0.85
    assert np.mean(error < 0.5 * stated) < 0.9


@pytest.mark.long
@pytest.mark.parametrize("state", ["smile", "exercise"])
def test_blends_tolerate_misaligned_maps_but_interpolated_maps_fail(face, state):
    """Jimenez et al. 2010, section 4.2: good results even with imperfect alignment.

    At full weight interpolation is the misplaced map itself. Measured against the change of the
    state: the blend's error grows little up to a few pixels, interpolation's is larger at once.
    """
    neutral = face.hemoglobin().astype(np.float64)
    truth = face.hemoglobin(state).astype(np.float64)
    mask = face_mask(SIDE)
    size = np.sqrt(np.mean((truth - neutral)[mask] ** 2))
    blended, interpolated = {}, {}
    for off_px in (0.0, 1.0, 2.0, 4.0):
        seen = displace_map(truth, off_px, rng=np.random.default_rng(5))
        rig = HemoglobinRig.from_maps(neutral, {state: seen}, radius_px=12.0, valid=mask)
        blend = rig.blend({state: 1.0, "neutral": 0.0})
        blended[off_px] = np.sqrt(np.nanmean((blend - truth)[mask] ** 2)) / size
        interpolated[off_px] = np.sqrt(np.mean((seen - truth)[mask] ** 2)) / size
    # at 0 px interpolation is exact and the blend is not: that is its price
    assert interpolated[0.0] < 1e-9 < blended[0.0]
    for off_px in (1.0, 2.0, 4.0):
        assert blended[off_px] < 0.6 * interpolated[off_px]
    grown = blended[2.0] - blended[0.0]
    assert grown < 0.25 * (interpolated[2.0] - interpolated[0.0])
