"""The common properties of a person and the texels: closed forms, coverage, and what each adds."""

import numpy as np
import pytest

from reconstruction.fusion.person import POPULATION_MEAN, UNKNOWN_VARIANCE, Regions, estimate_person
from reconstruction.fusion.regions import hide_signals, summarize_regions
from reconstruction.fusion.signals import (
    LOG_RANGE,
    FusionError,
    RigBands,
    SignalTable,
    clip_to_range,
    residual_covariance,
    skin_of_person,
)
from reconstruction.fusion.texels import (
    OffsetModel,
    RigColors,
    estimate_texels,
    eumelanin_slope,
    melanin_depth_factor,
)

CAMERA = "Nikon 5100 (NPL)"
DOME, FLASH = RigBands("dome", CAMERA, "LED-B3"), RigBands("flash", CAMERA, "D55")
PROBE = RigBands("probe", CAMERA, "LED-B3", "sigma_tr")
RIGS = (DOME, FLASH)
DOME_ERROR, FLASH_ERROR, LIGHT_VARIANCE = 0.03, 0.01, 0.36


class Face:
    """Colors of a drawn person by two rigs, with the errors that their covariances state."""

    def __init__(self, seed, texels=1000):
        rng = np.random.default_rng(seed)
        self.properties = 0.8 * rng.standard_normal(6)
        mean = POPULATION_MEAN + rng.standard_normal(2) * [0.5, 0.3]
        self.log_skin = clip_to_range(mean + rng.standard_normal((texels, 2)) * [0.2, 0.3])
        unexplained = residual_covariance(RIGS, mean)
        calibration = np.diag([0.007**2] * 3 + [0.003**2] * 3)
        self.errors = OffsetModel(unexplained, calibration, 0.25 * unexplained)

        def draw(covariance, *count):
            return rng.standard_normal((*count, 6)) @ np.linalg.cholesky(covariance).T

        skin = skin_of_person(self.log_skin, self.properties)
        model = np.concatenate([rig.log_signals(skin) for rig in RIGS], axis=-1)
        self.signals = model + draw(unexplained) + draw(self.errors.local, texels)
        seen = self.signals + draw(calibration)
        noise = rng.standard_normal((texels, 6)) * ([DOME_ERROR] * 3 + [FLASH_ERROR] * 3)
        light = np.sqrt(LIGHT_VARIANCE) * rng.standard_normal((texels, 1))
        seen = seen + noise + np.concatenate([np.zeros((texels, 3)), np.tile(light, 3)], axis=-1)
        every = np.ones(texels, bool)
        own = [np.tile(e**2 * np.eye(3), (texels, 1, 1)) for e in (DOME_ERROR, FLASH_ERROR)]
        self.colors = (
            RigColors(0, seen[:, :3], own[0], every),
            RigColors(1, seen[:, 3:], own[1], every, LIGHT_VARIANCE),
        )

    def estimate(self, colors=None):
        chosen = self.colors if colors is None else colors
        labels = np.zeros(len(self.log_skin), int)
        regions, _ = summarize_regions(chosen, labels, self.errors)
        person = estimate_person(RIGS, regions, self.errors.offset_covariance)
        ((_, found),) = estimate_texels(person, chosen, self.errors)
        return person, found


@pytest.fixture(scope="module")
def faces():
    made = [Face(seed) for seed in range(12)]
    return [(face, face.estimate()) for face in made]


def test_table_between_nodes_is_accurate():
    table = SignalTable.build((*RIGS, PROBE), np.zeros(6))
    at = np.stack([np.random.default_rng(0).uniform(*ends, 300) for ends in LOG_RANGE], axis=-1)
    exact = [rig.log_signals(skin_of_person(at, np.zeros(6))) for rig in table.rigs]
    assert np.abs(table.evaluate(at)[0] - np.concatenate(exact, axis=-1)).max() < 1e-3


def test_table_slopes_equal_finite_differences():
    table = SignalTable.build(RIGS, np.zeros(6))
    at = np.log([[0.2, 0.012], [0.9, 0.03]])
    _, slopes = table.evaluate(at)
    step = np.array([1e-4, 0.0])
    difference = (table.evaluate(at + step)[0] - table.evaluate(at - step)[0]) / 2e-4
    assert np.allclose(slopes[..., 0], difference, atol=1e-5)


def test_properties_of_person_are_covered(faces):
    z = []
    for face, (person, _) in faces:
        sd = np.sqrt(np.diag(person.covariance))[:6]
        z.append((person.properties_sd - face.properties) / sd)
    # 72 draws within one standard error: 68 % and three binomial standard deviations
    assert 0.52 < np.mean(np.abs(z) < 1.0) < 0.9


def test_texel_intervals_cover_their_share(faces):
    inside, wide = [], []
    for face, (_, found) in faces:
        error = np.abs(found.log_skin - face.log_skin)[found.valid]
        sd = np.sqrt(np.einsum("naa->na", found.covariance + found.common))[found.valid]
        inside.append((error < sd).mean())
        wide.append((error < 0.4 * sd).mean())
    assert 0.5 < np.mean(inside) < 0.85
    assert np.mean(wide) < 0.5  # intervals of 0.4 of the width are found too narrow


def test_signal_intervals_cover_their_share(faces):
    inside = []
    for face, (_, found) in faces:
        sd = np.sqrt(found.signal_variance + found.signal_common)
        inside.append((np.abs(found.log_signals - face.signals) < sd)[found.valid].mean())
    assert 0.5 < np.mean(inside) < 0.85


def test_two_rigs_err_less_than_one():
    face = Face(3)
    error = []
    for colors in (face.colors, face.colors[:1], face.colors[1:]):
        _, found = face.estimate(colors)
        gap = found.log_skin - face.log_skin
        # contrast within the face: the common error is apart
        error.append(np.median(np.abs(gap - np.median(gap, axis=0)), axis=0))
    assert (error[0] < error[1]).all()
    assert error[0][0] < error[2][0]


def test_two_rigs_reflectance_errs_less_than_dome():
    face = Face(3)
    _, found = face.estimate()
    fused = np.abs(found.log_signals - face.signals)[:, :3]
    dome = np.abs(face.colors[0].log_rgb - face.signals[:, :3])
    assert (np.median(fused, axis=0) < np.median(dome, axis=0)).all()


def test_texel_of_exact_color_recovers_skin():
    skin = np.log([[0.25, 0.012]])
    signals = SignalTable.build((DOME,), np.zeros(6)).evaluate(skin)[0]
    tight = Regions(signals, np.tile(1e-8 * np.eye(3), (1, 1, 1)))
    person = estimate_person((DOME,), tight, 1e-8 * np.eye(3), known=range(6))
    errors = OffsetModel(*(1e-9 * np.eye(3) for _ in range(3)))
    colors = RigColors(0, signals, np.tile(1e-8 * np.eye(3), (1, 1, 1)), np.ones(1, bool))
    ((_, found),) = estimate_texels(person, [colors], errors)
    assert np.allclose(found.log_skin, skin, atol=1e-3)


def test_outlier_of_one_rig_moves_little():
    face = Face(5)
    person, _ = face.estimate()
    bad = face.colors[0].log_rgb.copy()
    bad[0] -= 1.0
    moved = (RigColors(0, bad, face.colors[0].covariance, face.colors[0].valid), face.colors[1])
    before, after = (
        next(estimate_texels(person, colors, face.errors))[1] for colors in (face.colors, moved)
    )
    assert np.abs(after.log_skin[0, 0] - before.log_skin[0, 0]) < 0.4
    assert after.misfit[0] > 20.0 * before.misfit[0]
    assert np.array_equal(after.log_skin[1:], before.log_skin[1:])


def test_nevus_of_one_rig_keeps_its_color():
    """A blue nevus, unlike any skin of melanin and blood, has the color of its only rig.

    Its error of 3 % is stated. The model's skin alone errs by 0.66 in log red.
    """
    face = Face(5)
    person, _ = face.estimate()
    dome = face.colors[0]
    dark = dome.log_rgb.copy()
    dark[0] += [-0.9, -0.7, -0.2]
    ((_, found),) = estimate_texels(
        person, [RigColors(0, dark, dome.covariance, dome.valid)], face.errors
    )
    off = found.log_signals[0, :3] - dark[0]
    model = person.table.evaluate(found.log_skin[:1])[0][0, :3] - dark[0]
    assert np.abs(off).max() < 0.02
    assert np.abs(model).max() > 0.4
    assert (found.signal_variance[0, :3] < (1.5 * DOME_ERROR) ** 2).all()


def test_texels_without_color_are_masked():
    face = Face(6)
    person, _ = face.estimate()
    none = np.zeros(len(face.log_skin), bool)
    hidden = RigColors(0, face.colors[0].log_rgb, face.colors[0].covariance, none)
    ((_, found),) = estimate_texels(person, [hidden], face.errors)
    assert not found.valid.any()


def test_regions_without_texels_raise():
    face = Face(7, texels=5)
    with pytest.raises(FusionError, match="20 valid texels"):
        summarize_regions(face.colors, np.zeros(5, int), face.errors)


def test_regions_without_signals_raise():
    hidden = hide_signals(np.eye(3), np.ones(3, bool))
    with pytest.raises(FusionError, match="no known signal"):
        estimate_person((DOME,), Regions(np.zeros((1, 3)), hidden[None]), np.eye(3))


def test_regions_of_wrong_shape_raise():
    with pytest.raises(FusionError, match="expected"):
        estimate_person((DOME,), Regions(np.zeros((1, 2)), np.zeros((1, 2, 2))), np.eye(3))


def test_regions_without_rig_lose_its_columns():
    regions = Regions(np.zeros((1, 6)), np.eye(6)[None] + 0.5)
    left = regions.without(slice(0, 3)).covariance[0]
    assert (np.diag(left)[:3] == UNKNOWN_VARIANCE).all()
    assert (left[:3, 3:] == 0.0).all()


def test_depth_factor_follows_kind_of_melanin():
    up = np.zeros(6)
    up[5] = 0.01
    change = np.log(melanin_depth_factor(up) / melanin_depth_factor(np.zeros(6))) / 0.01
    assert np.isclose(change, eumelanin_slope(), rtol=1e-2)


def test_texels_of_different_numbers_raise():
    face = Face(8, texels=30)
    person, _ = face.estimate()
    with pytest.raises(FusionError, match="one number"):
        next(estimate_texels(person, [face.colors[0], face.colors[1].part(slice(3))], face.errors))
    with pytest.raises(FusionError, match="got none"):
        next(estimate_texels(person, [], face.errors))
