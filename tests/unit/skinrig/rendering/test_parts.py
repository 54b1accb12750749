"""Lookups, fewer lobes, shadow boundaries, pictures and folders of renderings."""

import numpy as np
import pytest

from model.brdf import microfacet
from model.brdf import tables as brdf_tables
from model.skin_reflectance import SkinReflectance
from rigsim.geometry.mesh import build_mesh
from skinrig.rendering import folder, shadow
from skinrig.rendering.bases import fit_nearest_weights, reduce_lobes
from skinrig.rendering.camera import RenderingError
from skinrig.rendering.folder import TONE_KNEE, Panel, apply_tone_curve, encode_sheet
from skinrig.rendering.geometry import FittedSurface
from skinrig.rendering.lookup_kernels import MAX_TEXEL_DISTANCE, look_up
from skinrig.rendering.shadow import MAX_SIGMA_TR_PER_MM, MIN_SIGMA_TR_PER_MM, ShadowBoundary

SIZE = 48


def facets(alpha):
    def brdf(light, view):
        cos_d = np.sqrt(np.maximum(0.5 + 0.5 * np.sum(light * view, axis=-1), 1e-12))
        cos_h = np.minimum((light[..., 2] + view[..., 2]) / (2.0 * cos_d), 1.0)
        mu = light[..., 2], view[..., 2], cos_h, cos_d
        return microfacet.brdf(*mu, roughness=alpha, eta=1.4)

    return brdf


@pytest.fixture(scope="module")
def model():
    """Return a flat patch, 60 mm wide, with shares that vary along two mixtures of three lobes."""
    lobes = brdf_tables.tabulate({f"m {a}": facets(a) for a in (0.2, 0.35, 0.5)})
    at = ((np.arange(SIZE) + 0.5) / SIZE - 0.5) * 60.0
    x, y = np.meshgrid(at, -at)
    one, two = np.array([1.0, 0.5, 0.0]), np.array([0.0, 0.5, 1.0])
    part = (x / 60.0 + 0.5)[..., None]
    shape = (SIZE, SIZE)
    return SkinReflectance(
        np.broadcast_to(np.float32([0.6, 0.4, 0.3]), (*shape, 3)).copy(),
        (part * one + (1.0 - part) * two).astype(np.float32),
        lobes,
        np.ones((*shape, 3), np.float32),
        np.broadcast_to(np.float32([0, 0, 1]), (*shape, 3)).copy(),
        np.stack([x, y, 0.0 * x], axis=-1).astype(np.float32),
        np.ones(shape, np.bool_),
    )


def test_texel_lookups_blend_positions_like_plain_loop():
    rng = np.random.default_rng(0)
    values = rng.random((6, 7, 2)).astype(np.float32)
    known = rng.random((6, 7)) < 0.7
    place = rng.random((6, 7, 3)).astype(np.float32) * 2.0
    width = np.full((6, 7), 0.5, np.float32)
    uv = rng.random((60, 2)).astype(np.float32)
    point = rng.random((60, 3)).astype(np.float32) * 2.0
    found, share = np.zeros((60, 2), np.float32), np.zeros(60, np.float32)
    look_up(values, known, place, width, uv, point, found, share)
    for i in range(60):
        x = np.clip(uv[i, 0] * 7 - 0.5, 0, 6)
        y = np.clip((1 - uv[i, 1]) * 6 - 0.5, 0, 5)
        total, blend = 0.0, np.zeros(2)
        for r in range(6):
            for c in range(7):
                weight = max(0.0, 1 - abs(r - y)) * max(0.0, 1 - abs(c - x))
                near = np.linalg.norm(place[r, c] - point[i]) <= MAX_TEXEL_DISTANCE * 0.5
                if known[r, c] and near:
                    total += weight
                    blend += weight * values[r, c]
        assert share[i] == pytest.approx(total, abs=1e-5)
        if total > 1e-4:
            np.testing.assert_allclose(found[i], blend / total, rtol=1e-4)
    assert 0 < np.count_nonzero(share) < 60


def test_points_without_own_texel_use_surface_neighborhood(model):
    corners = np.array([[-30.0, -30, 0], [30, -30, 0], [30, 30, 0], [-30, 30, 0]])
    mesh = build_mesh(corners, [[0, 1, 2], [0, 2, 3]], corners[:, :2] / 60.0 + 0.5)
    laid = FittedSurface.of(model, mesh)
    point = np.array([[10.0, 5.0, 0.0]], np.float32)
    up = np.array([[0.0, 0.0, 1.0]], np.float32)
    own = laid.at(np.float32([[10 / 60 + 0.5, 5 / 60 + 0.5]]), point, up)
    stray = laid.at(np.float32([[0.02, 0.02]]), point, up)  # coordinates of another place
    assert own.measured.all()
    assert stray.measured.all()
    np.testing.assert_allclose(stray.weights, own.weights, atol=0.02)


def test_weights_exact_with_fewer_mixtures_are_found(model):
    two = reduce_lobes(model, 2, rng=np.random.default_rng(0))
    assert two.lobes.size == 2
    up = np.array([0.0, 0.0, 1.0])
    light = np.array([0.3, 0.1, 0.95]) / np.linalg.norm([0.3, 0.1, 0.95])
    old = model.weights @ model.lobes.evaluate(light, up, up)
    new = two.weights @ two.lobes.evaluate(light, up, up)
    np.testing.assert_allclose(new, old, rtol=0.02)
    one = reduce_lobes(model, 1, rng=np.random.default_rng(0))
    worse = one.weights @ one.lobes.evaluate(light, up, up)
    assert np.abs(worse / old - 1.0).max() > 3.0 * np.abs(new / old - 1.0).max()
    assert reduce_lobes(model, 3, rng=np.random.default_rng(0)) is model


def test_nearest_weights_are_nonnegative_and_keep_mixture_weights(model):
    mix = np.array([[1.0, 0.0, 0.0], [0.0, 0.3, 0.7]])
    shares = np.array([[2.0, 0.3, 0.7], [0.0, 0.0, 0.0], [0.0, 0.6, 1.4]])
    found = fit_nearest_weights(shares, mix, model.lobes)
    np.testing.assert_allclose(found, [[2.0, 1.0], [0.0, 0.0], [0.0, 2.0]], atol=2e-3)
    assert np.all(fit_nearest_weights(np.eye(3), mix, model.lobes) >= 0.0)


def test_more_lobes_than_a_model_has_are_refused(model):
    with pytest.raises(RenderingError, match="reconstruct SESSION --rank 24"):
        reduce_lobes(model, 24, rng=np.random.default_rng(0))


@pytest.mark.long
@pytest.mark.render
def test_shadow_widens_with_smaller_sigma_tr(model, monkeypatch):
    """Rationale: light that spreads by 1/sigma_tr crosses the edge so far.

    Expected: width in proportion to 1/sigma_tr for one R_d, within 15 %: a grid of 0.07 mm and the
    fraction of the fall that the finite picture cuts off. Without spreading the half shadow of the
    light is left, 0.1 mm and a pixel.
    """
    monkeypatch.setattr(shadow, "PATCH_TEXELS", 128)
    boundary = ShadowBoundary.on_plane(model, size_px=160)
    rise = {}
    for sigma in (MIN_SIGMA_TR_PER_MM, MAX_SIGMA_TR_PER_MM, None):
        rise[sigma] = shadow.measure_rise_mm(
            *shadow.measure_profile(boundary.render(sigma, subpixels=1))
        )
    assert np.all(rise[None] < 0.35)
    assert np.all(rise[MIN_SIGMA_TR_PER_MM] > rise[MAX_SIGMA_TR_PER_MM])
    ratio = rise[MIN_SIGMA_TR_PER_MM][:2] / rise[MAX_SIGMA_TR_PER_MM][:2]
    expected = np.array(MAX_SIGMA_TR_PER_MM[:2]) / MIN_SIGMA_TR_PER_MM[:2]
    np.testing.assert_allclose(ratio, expected, rtol=0.15)


def test_shadow_is_right_of_middle(model, monkeypatch):
    monkeypatch.setattr(shadow, "PATCH_TEXELS", 32)
    seen = ShadowBoundary.on_plane(model, size_px=48).render(None, subpixels=1)
    place, level = shadow.measure_profile(seen)
    assert np.all(level[place < -0.6, 1] > 0.2)
    assert np.all(level[place > 0.6] == 0.0)


def test_tones_are_linear_below_knee_and_grow_above():
    linear = np.array([0.0, 0.2, 0.4])
    np.testing.assert_array_equal(
        apply_tone_curve(2.0 * linear, 0.5), apply_tone_curve(linear, 1.0)
    )
    bright = apply_tone_curve(np.array([TONE_KNEE, 1.0, 1.5, 2.0]), 1.0).astype(int)
    assert np.all(np.diff(bright) > 0)


def test_a_sheet_shows_its_panels_pixel_by_pixel():
    matplotlib_image = pytest.importorskip("matplotlib.image")
    import io

    image = np.zeros((20, 150, 3), np.uint8)
    image[3, 5] = (255, 0, 0)
    data = encode_sheet([[Panel("one", image), Panel("two", image)]], title="both")
    shown = matplotlib_image.imread(io.BytesIO(data), format="png")[..., :3]
    reds = np.argwhere((shown == (1.0, 0.0, 0.0)).all(axis=-1))
    assert len(reds) == 2
    assert reds[1, 1] - reds[0, 1] == 150 + 8
    with pytest.raises(ValueError, match="one"):
        encode_sheet([[Panel("one", image), Panel("two", image[:10])]])


def test_rendering_replaces_only_older_rendering(tmp_path):
    image = np.zeros((2, 3, 3), np.float32)
    out = tmp_path / "picture"
    for word in ("first", "second"):
        done = folder.write(out, images={"a": image}, pictures={}, document={"said": word})
    assert done["said"] == "second"
    assert done["files"] == ["a.exr"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["picture"]
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").write_text("dear")
    with pytest.raises(RenderingError, match="expected a new folder or a rendering"):
        folder.write(tmp_path / "other", images={}, pictures={}, document={})
    assert (tmp_path / "other" / "letter.txt").read_text() == "dear"


def test_rendering_with_failed_write_leaves_nothing(tmp_path):
    with pytest.raises(TypeError):
        folder.write(
            tmp_path / "x",
            images={"a": np.zeros((2, 2, 3), np.float32)},
            pictures={"b": None},
            document={},
        )
    assert list(tmp_path.iterdir()) == []
