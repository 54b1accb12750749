"""A probe's places found on a face, and translucency laid on its texture."""

import json

import numpy as np
import pytest

from model.skin import SkinAppearance, SkinMap
from reconstruction.subsurface.probe_sites import SITE_UV
from reconstruction.subsurface.translucency import TranslucencyError, TranslucencyPrior
from rigsim.subject.head import build_head
from skinrig.fitting import probe_sites
from skinrig.fitting.probe_sites import ProbeSiteError

CHANNELS = ("red", "green", "blue")
MEASURED = {"forehead": (0.50, 0.90, 1.50), "cheek": (0.62, 1.10, 1.60), "chin": (0.70, 1.30, 1.90)}


def face(side=65, *, flat=False):
    """Return the map of positions of a round face with a nose, and the tip of the nose."""
    u, v = np.meshgrid(np.linspace(-1.2, 1.2, side), np.linspace(1.0, -1.0, side))
    x, y = (70.0 * np.sin(u), 120.0 * v) if not flat else (60.0 * u, 120.0 * v)
    z = (80.0 * np.cos(u) * np.sqrt(1.2 - v**2) - 70.0) if not flat else np.zeros_like(x)
    z = z + 18.0 * np.exp(-(x**2 + (y + 5.0) ** 2) / 150.0)
    place = np.stack([x + 1.5, y, z], axis=-1).astype(np.float32)
    return SkinMap(place, "mm"), place.reshape(-1, 3)[np.argmax(place[..., 2])]


def probe(measured=MEASURED, stderr=0.02, files=None):
    rows = [
        {
            "site": site,
            "channel": channel,
            "sigma_tr_per_mm": value,
            "sigma_tr_stderr": None if value is None else stderr * value,
            "measurements": 3,
        }
        for site, values in measured.items()
        for channel, value in zip(CHANNELS, values, strict=True)
    ]
    document = json.dumps({"schema": "skinrig.subsurface/1", "sites": rows}).encode()
    return SkinAppearance(
        {}, "measured", files={"subsurface.json": document} if files is None else files
    )


def test_sites_match_mean_face_distances_and_map_interpolates():
    position, nose = face()
    found = probe_sites.map_translucency(probe(), position)
    assert [site.name for site in found.sites] == list(MEASURED)
    for site in found.sites:
        across, up = probe_sites.SITE_OFFSETS_FROM_NOSE_MM[site.name]
        assert (
            np.hypot(site.position_mm[0] - nose[0] - across, site.position_mm[1] - nose[1] - up)
            < 4.0
        )
        measured = 1.0 / np.array(MEASURED[site.name])
        stderr = found.map.stderr[site.texel]
        assert (np.abs(found.map.values[site.texel] - measured) < 2.0 * stderr).all()
        assert (stderr < 0.03 * measured).all()
    # at the ears nobody measured
    assert found.map.stderr[10, 0, 0] > 2.0 * found.map.stderr[found.sites[0].texel][0]
    assert found.left_out == ()
    assert "mean face" in found.assumed[0]


def test_the_layout_of_the_texture_does_not_matter():
    position, _ = face()
    straight = probe_sites.map_translucency(probe(), position).map
    order = np.random.default_rng(1).permutation(65 * 65)
    mixed = SkinMap(position.values.reshape(-1, 3)[order].reshape(65, 65, 3), "mm")
    laid = probe_sites.map_translucency(probe(), mixed).map
    np.testing.assert_allclose(
        laid.values.reshape(-1, 3), straight.values.reshape(-1, 3)[order], rtol=1e-5
    )


def test_table_sets_site_positions_and_names_others(tmp_path):
    position, _ = face()
    table = tmp_path / "sites.csv"
    table.write_text("name,x,y\ncheek,50,40\nscar,20,20\n")
    found = probe_sites.map_translucency(
        probe({**MEASURED, "scar": (0.6, 1.0, 1.5)}), position, landmarks=table
    )
    at = {site.name: site.texel for site in found.sites}
    assert at["cheek"] == (40, 50)
    assert at["scar"] == (20, 20)
    assert "cheek" not in found.assumed[0]
    assert "forehead, chin" in found.assumed[0]


def test_unknown_or_unscanned_sites_are_omitted_with_reason():
    position, _ = face()
    upper = SkinMap(position.values, "mm", valid=position.values[..., 1] > -20.0)
    found = probe_sites.map_translucency(probe({**MEASURED, "elbow": (0.6, 1.0, 1.5)}), upper)
    why = dict(found.left_out)
    assert "unknown" in why["elbow"]
    assert "the scan ends" in why["chin"]
    assert [site.name for site in found.sites] == ["forehead", "cheek"]
    np.testing.assert_array_equal(found.map.valid, upper.valid)
    with pytest.raises(ProbeSiteError, match="elbow: unknown position"):
        probe_sites.map_translucency(probe({"elbow": (0.6, 1.0, 1.5)}), position)


def test_missing_channel_fit_is_omitted_all_missing_masked():
    position, _ = face()
    found = probe_sites.map_translucency(probe({**MEASURED, "cheek": (None, 1.1, 1.6)}), position)
    assert [what for what, _ in found.left_out] == ["cheek, channel 0"]
    assert found.map.valid.all()
    without_red = {name: (None, *values[1:]) for name, values in MEASURED.items()}
    assert not probe_sites.map_translucency(probe(without_red), position).map.valid.any()
    nothing = dict.fromkeys(MEASURED, (None, None, None))
    with pytest.raises(TranslucencyError, match="got no usable measurement"):
        probe_sites.map_translucency(probe(nothing), position)


def test_flat_patches_and_single_texels_get_map():
    flat, _ = face(flat=True)
    assert probe_sites.map_translucency(probe(), flat).map.valid.all()
    one = SkinMap(np.zeros((1, 1, 3), np.float32), "mm")
    with pytest.raises(ProbeSiteError, match="the scan ends"):
        probe_sites.map_translucency(probe(), one)
    none = SkinMap(np.zeros((4, 4, 3), np.float32), "mm", valid=np.zeros((4, 4), bool))
    with pytest.raises(ProbeSiteError, match="no valid texel"):
        probe_sites.map_translucency(probe(), none)


@pytest.mark.parametrize("files", [{}, {"subsurface.json": b"{}"}, {"subsurface.json": b"\xff"}])
def test_a_probe_without_sites_is_named(files):
    with pytest.raises(ProbeSiteError, match=r"subsurface\.json"):
        probe_sites.map_translucency(probe(files=files), face()[0])


@pytest.mark.parametrize("seed", [0, 5])
def test_simulated_head_sites_are_found_within_a_centimeter(seed):
    mesh = build_head(np.random.default_rng(seed), columns=84, rows=90)
    points = mesh.vertices_mm[: len(mesh.vertices_mm) // 85 * 85]
    found = probe_sites.map_translucency(probe(), SkinMap(points.reshape(-1, 85, 3), "mm"))
    for site in found.sites:
        true = mesh.vertices_mm[np.argmin(np.linalg.norm(mesh.uv - SITE_UV[site.name], axis=1))]
        # below the chin skin faces down: places one behind the other are one height
        axes = [0, 1] if site.name == "chin" else [0, 1, 2]
        assert np.linalg.norm((np.array(site.position_mm) - true)[axes]) < 10.0


def test_interpolated_site_ignores_expectation_of_its_texel():
    """A texel without colors has no expectation of its own; its neighbors count."""
    y, x = np.mgrid[0:24, 0:24]
    at = np.stack([4.0 * x, -4.0 * y, np.zeros((24, 24))], axis=-1)
    sites = [
        probe_sites.ProbeSite("a", (1.0,) * 3, (0.05,) * 3, (6, 6), tuple(at[6, 6])),
        probe_sites.ProbeSite("b", (1.0,) * 3, (0.05,) * 3, (18, 18), tuple(at[18, 18])),
    ]
    expected = np.ones((24, 24, 3), np.float32)
    expected[6, 6] = 1e-3
    prior = TranslucencyPrior(np.zeros(3), np.full(3, 0.3), np.full(3, 0.05))
    found = probe_sites.interpolate_sites(
        sites, SkinMap(at, "mm"), prior=prior, expected_mm=expected
    )
    others = np.ones((24, 24), bool)
    others[6, 6] = False
    assert np.abs(found.map.values[others] - 1.0).max() < 0.1
