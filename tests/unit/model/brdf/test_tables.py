"""Tables of materials: the grid, MERL files, and that Fresnel reflection is inside, once."""

import tracemalloc

import numpy as np
import pytest

from model import fresnel, merl
from model.brdf import recipe as brdf_recipe
from model.brdf import tables as brdf_tables
from reconstruction.brdf_basis import row_kernels


@pytest.fixture(scope="module")
def point_basis():
    return brdf_tables.default_basis(0.0)


def directions(rng, n, least=0.3):
    v = rng.standard_normal((20 * n, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    return v[v[:, 2] > least][:n]


def test_basis_has_59_materials_on_kernel_grid(point_basis):
    assert point_basis.size == len(set(point_basis.names)) == 59
    assert point_basis.table.shape[:3] == (
        row_kernels.NODES_D,
        row_kernels.NODES_PHI,
        row_kernels.NODES_H,
    )
    assert np.all(point_basis.table[..., 59:] == 0.0)
    tiny = point_basis.table[(point_basis.table > 0.0)].min()
    assert tiny >= np.float32(brdf_tables.MIN_STORED_VALUE)


def test_tables_follow_their_functions_away_from_the_horizon(point_basis, rng):
    light, view = directions(rng, 400), directions(rng, 400)
    found = point_basis.evaluate(light, view, [0.0, 0.0, 1.0])
    for material, (_, brdf) in enumerate(brdf_recipe.materials()):
        true = brdf(light, view)
        gap = np.sqrt(np.mean((found[:, material] - true) ** 2) / np.mean(true**2))
        assert gap < 0.03, point_basis.names[material]


def test_a_table_does_not_know_light_from_view(point_basis, rng):
    light, view = directions(rng, 50), directions(rng, 50)
    np.testing.assert_allclose(
        point_basis.evaluate(light, view, [0, 0, 1.0]),
        point_basis.evaluate(view, light, [0, 0, 1.0]),
        rtol=1e-9,
    )


def uniform_sky(basis, name, mu_view):
    """Return what one material sends to a view under light of radiance 1 from all sides."""
    mu = (np.arange(400) + 0.5) / 400
    phi = (np.arange(200) + 0.5) / 200 * np.pi
    mu_l, azimuth = np.meshgrid(mu, phi, indexing="ij")
    s = np.sqrt(1.0 - mu_l**2)
    light = np.stack([s * np.cos(azimuth), s * np.sin(azimuth), mu_l], axis=-1)
    view = np.array([np.sqrt(1.0 - mu_view**2), 0.0, mu_view])
    one = brdf_tables.tabulate({name: dict(brdf_recipe.materials())[name]})
    f = one.evaluate(light, view, [0.0, 0.0, 1.0])[..., 0]
    return float(np.mean(f * mu_l) * 2.0 * np.pi)


@pytest.mark.parametrize("mu_view", [1.0, 0.8, 0.6])
def test_white_furnace_stays_white_with_fresnel_counted_once(point_basis, mu_view):
    # A smooth lossless surface over a white inside: F_r from the table, and what enters comes
    # back, F_t(view) F_t(light) R_d / pi integrated with R_d = 1 / (1 - mean F_r).
    specular = uniform_sky(point_basis, "ggx 0.14 eta 1.4", mu_view)
    f_r = float(fresnel.reflectance(mu_view, 1.4))
    r_d = 1.0 / (1.0 - fresnel.diffuse_external(1.4))
    mu = (np.arange(2000) + 0.5) / 2000
    entering = np.mean(2.0 * mu * (1.0 - fresnel.reflectance(mu, 1.4)))
    total = specular + (1.0 - f_r) * entering * r_d
    assert total == pytest.approx(1.0, abs=0.003)
    assert specular == pytest.approx(f_r, rel=0.06)
    assert (1.0 - f_r) * entering * r_d + f_r * specular < 0.98  # F_r twice: not white


@pytest.mark.parametrize("mu_view", [1.0, 0.7, 0.3])
def test_basis_material_never_reflects_more_than_incident_light(point_basis, mu_view):
    for name in ("ggx 0.7 eta 1.55", "beckmann 0.3", "blinn 0.45", "sheen 0.25", "rough diffuse"):
        assert uniform_sky(point_basis, name, mu_view) < 1.02


def test_light_disc_widens_narrow_lobe_and_keeps_energy():
    sharp = {"ggx 0.05 eta 1.4": dict(brdf_recipe.materials())["ggx 0.05 eta 1.4"]}
    point, disc = (brdf_tables.tabulate(sharp, light_radius_rad=radius) for radius in (0.0, 0.08))
    z = np.array([0.0, 0.0, 1.0])
    angle = np.linspace(0.0, 0.6, 4000)
    light = np.stack([np.sin(angle), np.zeros(4000), np.cos(angle)], axis=-1)
    lobes = [basis.evaluate(light, z, z)[:, 0] for basis in (point, disc)]
    assert lobes[1][0] < 0.8 * lobes[0][0]
    energy = [np.sum(lobe * np.sin(angle) * np.cos(angle)) for lobe in lobes]
    assert energy[1] == pytest.approx(energy[0], rel=0.03)


def test_a_folder_of_merl_files_becomes_a_basis(tmp_path, rng):
    brdf = dict(brdf_recipe.materials())["ggx 0.22 eta 1.3"]
    h, d, phi = np.meshgrid(*merl.bin_centers(), indexing="ij")
    light, view = merl.to_directions(h, d, phi)
    above = (light[..., 2] > 0.0) & (view[..., 2] > 0.0)
    values = np.where(above, brdf(light, view), -1.0)
    merl.write(tmp_path / "a.binary", merl.MerlTable.from_values(values[..., None]))
    basis = brdf_tables.load(tmp_path, light_radius_rad=0.0)
    assert basis.names == ("a",)
    to, at = directions(rng, 300), directions(rng, 300)
    found, true = basis.evaluate(to, at, [0.0, 0.0, 1.0])[:, 0], brdf(to, at)
    assert np.sqrt(np.mean((found - true) ** 2) / np.mean(true**2)) < 0.05
    with pytest.raises(brdf_tables.BasisError, match=r"no \.binary"):
        brdf_tables.load(tmp_path / "nothing")
    (tmp_path / "b.binary").write_bytes(b"foreign")
    with pytest.raises(merl.MerlFileError, match=r"b\.binary"):
        brdf_tables.load(tmp_path)


@pytest.fixture(scope="module")
def flaws():
    """MERL tables of a matt 0.2 per sr with what measured files hold, all -1 below the horizon."""
    h, d, phi = np.meshgrid(*merl.bin_centers(), indexing="ij")
    light, view = merl.to_directions(h, d, phi)
    values = np.where((light[..., 2] > 0.0) & (view[..., 2] > 0.0), 0.2, -1.0)[..., None].repeat(
        3, -1
    )
    holes = values.copy()
    holes[::3, 5:9, 11::7, 1] = -1.0
    spiked = values.copy()
    spiked[0, 0] = 1e5
    dark = np.where(values > 0.0, 0.0, -1.0)
    no_blue = values.copy()
    no_blue[..., 2] = np.minimum(values[..., 2], 0.0)
    return {"holes": holes, "spiked": spiked, "dark": dark, "no_blue": no_blue}


def test_measured_folder_is_read_in_order_any_spelling(flaws, tmp_path, rng):
    for file, which in (
        ("Skin-B.BINARY", "no_blue"),
        ("a.binary", "spiked"),
        ("Z.Binary", "holes"),
    ):
        merl.write(tmp_path / file, merl.MerlTable.from_values(flaws[which]))
    (tmp_path / "readme.txt").write_text("of the measurement")
    (tmp_path / "folder").mkdir()
    tracemalloc.start()
    basis = brdf_tables.load(tmp_path, light_radius_rad=0.0)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 64e6  # two planes of a file and its mask, not three files of 35 MB
    assert basis.names == ("Skin-B", "Z", "a")
    to, at = directions(rng, 300), directions(rng, 300)
    away = np.linalg.norm(to + at, axis=-1) < 1.9
    found = basis.evaluate(to[away], at[away], [0.0, 0.0, 1.0])
    np.testing.assert_allclose(found[:, 1], 0.2, rtol=1e-6)  # holes have their neighbours' value
    np.testing.assert_allclose(found[:, 0], 0.4 / 3.0, rtol=1e-6)  # a channel of zeros counts
    tilted = np.arccos((to + at)[:, 2] / np.linalg.norm(to + at, axis=-1))[away] > 0.02
    np.testing.assert_allclose(found[tilted, 2], 0.2, rtol=1e-6)  # a spike stays where it is
    z = [0.0, 0.0, 1.0]
    assert basis.evaluate(z, z, z)[2] == pytest.approx(1e5)


def test_halves_of_merl_file_are_averaged(tmp_path, rng):
    values = np.full((90, 90, 180, 1), 0.1)
    values[:, :, 90:] = 0.3
    values[:45, :, 90:] = -1.0  # unknown: the other half counts
    merl.write(tmp_path / "a.binary", merl.MerlTable.from_values(values))
    brdf = brdf_tables.read_brdf(tmp_path / "a.binary")
    to, at = directions(rng, 400), directions(rng, 400)
    to, at = (v[(to[:, 2] > 0.1) & (at[:, 2] > 0.1)] for v in (to, at))
    theta_h = merl.to_angles(to, at, [0.0, 0.0, 1.0])[0]
    half_known = merl.bin_indices(theta_h, 0.0 * theta_h, 0.0 * theta_h)
    expected = np.where(np.array(half_known[0]) < 45, 0.1, 0.2)
    assert len(set(expected)) == 2
    np.testing.assert_allclose(brdf(to, at), expected)


def test_file_without_light_or_beyond_float32_is_reported(flaws, tmp_path):
    for which, message in (
        ("dark", "no value above 0"),
        ("nothing", "no value"),
        ("huge", "1e\\+4"),
    ):
        values = flaws.get(which, flaws["holes"].copy())
        if which == "huge":
            values[0, 0] = 1e40
        elif which == "nothing":
            values = np.full(3, -1.0)
        merl.write(tmp_path / "a.binary", merl.MerlTable.from_values(values))
        with pytest.raises(brdf_tables.BasisError, match=rf"a\.binary: got {message}"):
            brdf_tables.load(tmp_path)


def test_a_mixed_basis_is_the_mixture(point_basis, rng):
    mix = rng.random((3, 59))
    light, view = directions(rng, 20), directions(rng, 20)
    whole = point_basis.evaluate(light, view, [0.0, 0.0, 1.0])
    mixed = point_basis.mix_materials(mix).evaluate(light, view, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(mixed, whole @ mix.T, rtol=1e-5)
    with pytest.raises(brdf_tables.BasisError, match="weights"):
        point_basis.mix_materials(-mix)


def test_directions_below_horizon_reflect_nothing_degenerate_are_finite(point_basis):
    z = np.array([0.0, 0.0, 1.0])
    assert np.all(point_basis.evaluate(-z, z, z) == 0.0)
    side = np.array([1.0, 0.0, 0.0])
    for light, view in ((z, z), (side, -side), (side, side), (z, side)):
        assert np.all(np.isfinite(point_basis.evaluate(light, view, z)))
