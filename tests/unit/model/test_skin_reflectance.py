"""The reflectance model put together: maps, Fresnel's part, coefficients, energy."""

import io

import numpy as np
import pytest

from model import dipole, fresnel, skin_reflectance
from model.brdf import recipe as brdf_recipe
from model.brdf import tables as brdf_tables
from model.dipole.maps import DipoleMaps
from model.skin import SkinAppearance, SkinMap
from model.skin_reflectance import SkinReflectance, SkinReflectanceError, assemble

SIDE = 12
NAMES = ("ggx 0.33 eta 1.4", "beckmann 0.25", "sheen 0.4")


@pytest.fixture(scope="module")
def lobes():
    known = dict(brdf_recipe.materials())
    return brdf_tables.tabulate({name: known[name] for name in NAMES})


def packed(lobes, **changed):
    stored = {
        "table": lobes.table[..., : lobes.size],
        "materials": np.array(lobes.names),
        "mix": np.eye(lobes.size),
        "light_radius_rad": lobes.light_radius_rad,
    }
    stream = io.BytesIO()
    np.savez_compressed(stream, **{k: v for k, v in (stored | changed).items() if v is not None})
    return stream.getvalue()


def dome(lobes, *, without=(), normals=("normals", "normals_refined"), file=None, **more):
    rng = np.random.default_rng(2)
    shape = (SIDE, SIDE)
    maps = {
        "position": SkinMap(rng.uniform(-80, 80, (*shape, 3)), "mm"),
        "r_d": SkinMap(rng.uniform(0.1, 0.9, (*shape, 3)), "1", np.full((*shape, 3), 0.01)),
    }
    for k in range(lobes.size):
        valid = np.ones(shape, bool)
        valid[k, k] = False
        maps[f"basis_weight_{k}"] = SkinMap(rng.uniform(0, 1, shape), "1", None, valid)
    for name in normals:
        up = np.zeros((*shape, 3))
        up[..., 2 if name == "normals" else 1] = 1.02
        maps[name] = SkinMap(up, "1")
    maps |= more
    files = {skin_reflectance.BASIS_FILE: packed(lobes) if file is None else file}
    return SkinAppearance(
        {k: v for k, v in maps.items() if k not in without}, "measured", files=files
    )


def test_dome_maps_make_model_listing_unmeasured_parts(lobes):
    given = dome(lobes)
    model = assemble(given)
    assert model.shape == (SIDE, SIDE)
    assert [tuple(at) for at in np.argwhere(~model.valid)] == [(0, 0), (1, 1), (2, 2)]
    np.testing.assert_allclose(model.normals, np.broadcast_to([0, 1, 0], (SIDE, SIDE, 3)))
    assert len(model.assumed) == 1
    assert "0.598, 1.069, 1.672 per mm" in model.assumed[0]
    np.testing.assert_allclose(1.0 / model.translucency_mm[3, 4], [0.598, 1.069, 1.672], atol=5e-4)
    np.testing.assert_array_equal(model.r_d, given.maps["r_d"].values)
    assert np.array_equal(model.lobes.table, lobes.table)


def test_translucency_comes_from_values_or_maps_any_size(lobes):
    assert assemble(dome(lobes), translucency=(2.0, 1.0, 0.5)).assumed == ()
    # a ramp over the texture stays one, between the centres of the outermost texels
    ramp = np.broadcast_to((np.arange(6)[:, None, None] + 0.5) / 6 + 1.0, (6, 3, 3))
    given = SkinMap(ramp, "mm", stderr=0.1 * ramp)
    model = assemble(dome(lobes), translucency=given)
    expected = (np.arange(SIDE) + 0.5) / SIDE + 1.0
    np.testing.assert_allclose(model.translucency_mm[1:-1, 5, 0], expected[1:-1], rtol=1e-6)
    np.testing.assert_allclose(model.translucency_stderr_mm, 0.1 * model.translucency_mm, rtol=1e-5)
    own = SkinMap(np.full((SIDE, SIDE, 3), 0.7), "mm")
    assert assemble(dome(lobes, translucency=own)).translucency_mm[0, 0, 0] == np.float32(0.7)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"without": ("r_d",)}, "--maps r_d"),
        ({"without": ("basis_weight_2",)}, "basis_weight_2"),
        ({"normals": ()}, "--maps normals"),
        ({"file": b"PK\3\4 damaged"}, "cannot be read"),
        ({"file": b""}, "cannot be read"),
        ({"r_d": SkinMap(np.ones((3, 3, 3)), "1")}, r"got shape \(3, 3\), expected \(12, 12\)"),
    ],
)
def test_missing_or_mismatched_input_is_reported(lobes, change, says):
    with pytest.raises(SkinReflectanceError, match=says):
        assemble(dome(lobes, **change))
    with pytest.raises(SkinReflectanceError, match="older version"):
        assemble(dome(lobes, file=packed(lobes, table=None)))


@pytest.mark.parametrize("given", [np.ones((2, 2, 3)), 0.0, np.nan, -1.0])
def test_translucencies_that_no_skin_has_are_refused(lobes, given):
    with pytest.raises(SkinReflectanceError, match="translucency"):
        assemble(dome(lobes), translucency=given)


def test_models_with_faulty_values_are_refused_unless_masked(lobes):
    whole = even_model(lobes)
    fields = {name: getattr(whole, name) for name in SkinReflectance.__dataclass_fields__}
    for name, value in (("weights", -0.1), ("r_d", np.nan), ("normals", 2.0)):
        values = np.array(fields[name])
        values[0, 0] = value
        with pytest.raises(SkinReflectanceError, match=name):
            SkinReflectance(**{**fields, name: values})
        valid = whole.valid.copy()
        valid[0, 0] = False
        assert SkinReflectance(**{**fields, name: values, "valid": valid}).valid.sum() == 8
    with pytest.raises(SkinReflectanceError, match="eta"):
        SkinReflectance(**{**fields, "eta": 0.9})


def even_model(lobes, r_d=0.5, valid=True, weights=None):
    shape = (3, 3)
    up = np.broadcast_to([0.0, 0.0, 1.0], (*shape, 3))
    share = [1.0] + [0.0] * (lobes.size - 1) if weights is None else weights
    return SkinReflectance(
        np.full((*shape, 3), r_d),
        np.broadcast_to(share, (*shape, lobes.size)),
        lobes,
        np.full((*shape, 3), 1.5),
        up,
        10.0 * up,
        np.full(shape, valid),
    )


def hemisphere(count=48):
    """Return directions over the upper hemisphere and weights that integrate with the cosine."""
    node, weight = np.polynomial.legendre.leggauss(count)
    cosine, weight = 0.5 * (node + 1.0), 0.5 * weight
    turn = (np.arange(2 * count) + 0.5) * np.pi / count
    mu, phi = np.meshgrid(cosine, turn, indexing="ij")
    sine = np.sqrt(1.0 - mu**2)
    to = np.stack([sine * np.cos(phi), sine * np.sin(phi), mu], axis=-1).reshape(-1, 3)
    return to, np.repeat(weight * cosine * np.pi / count, 2 * count)


def local_diffuse(model, rows, light, view):
    """Return the diffuse reflection of light that leaves where it entered."""
    passed = [
        skin_reflectance.transmittance(np.asarray(v)[..., 2], model.eta) for v in (light, view)
    ]
    r_d = model.r_d.reshape(-1, 3)[rows].astype(np.float64)
    return r_d * (passed[0] * passed[1])[..., None] / np.pi


@pytest.mark.parametrize("angle_deg", [0.0, 40.0, 70.0, 85.0])
def test_skin_never_reflects_more_than_incident_light(lobes, angle_deg):
    view, weight = hemisphere()
    light = [np.sin(np.radians(angle_deg)), 0.0, np.cos(np.radians(angle_deg))]
    model, rows = even_model(lobes, r_d=1.0), np.zeros(len(view), int)
    shares = model.weights.reshape(-1, lobes.size)[rows]
    surface = skin_reflectance.lobe_brdf(lobes, shares, light, view, [0.0, 0.0, 1.0]) @ weight
    inside = local_diffuse(model, rows, light, view).T @ weight
    passed = skin_reflectance.transmittance(light[2])
    # what enters once and leaves once, with the exact mean transmittance
    np.testing.assert_allclose(inside, passed * (1 - fresnel.diffuse_external(1.4)), rtol=1e-4)
    assert surface > 0.01
    assert surface + inside.max() <= 1.0
    # without the transmittances more would come back than falls on it
    assert surface + inside.max() / passed / 0.923 > 1.0


def test_surface_is_its_lobes_containing_all_fresnel(lobes):
    model = assemble(dome(lobes))
    rng = np.random.default_rng(4)
    light, view = (v / np.linalg.norm(v, axis=1)[:, None] for v in rng.normal(size=(2, 40, 3)))
    up, rows = np.array([0.0, 0.0, 1.0]), rng.integers(0, SIDE * SIDE, 40)
    shares = model.weights.reshape(-1, lobes.size)[rows]
    found = skin_reflectance.lobe_brdf(lobes, shares, light, view, up)
    np.testing.assert_allclose(found, (lobes.evaluate(light, view, up) * shares).sum(-1))
    hidden = (light[:, 2] <= 0) | (view[:, 2] <= 0)
    assert 0 < hidden.sum() < 40
    assert not found[hidden].any()
    diffuse = local_diffuse(model, rows, light, view)
    assert not diffuse[hidden].any()
    passed = [1.0 - fresnel.reflectance(v[~hidden, 2], 1.4) for v in (light, view)]
    expected = model.r_d.reshape(-1, 3)[rows[~hidden]] * (passed[0] * passed[1])[:, None] / np.pi
    np.testing.assert_allclose(diffuse[~hidden], expected, rtol=1e-6)


@pytest.mark.parametrize("eta", [1.3, 1.4, 1.5])
def test_scattering_albedo_rises_with_r_d_over_decades(eta):
    r_d = np.concatenate([np.geomspace(1e-6, 0.5, 40), 1.0 - np.geomspace(0.4, 1e-9, 60)])
    found = DipoleMaps.of(r_d[:, None], np.ones((100, 1)), eta=eta)
    deficit = found.deficit[:, 0]
    assert found.valid.all()
    assert (np.diff(deficit) < 0.0).all()
    np.testing.assert_allclose(dipole.absorbed_fraction(deficit, eta), 1.0 - r_d, rtol=1e-9)
    # section 9: the coefficients give sigma_tr and alpha' back
    sigma_a, sigma_s = found.sigma_a_per_mm, found.sigma_s_prime_per_mm
    np.testing.assert_allclose(dipole.effective_transport(sigma_a, sigma_s), 1.0, rtol=1e-7)
    np.testing.assert_allclose(found.albedo_prime, 1.0 - found.deficit)


def test_r_d_above_unity_is_outlier_zero_unscattered(lobes):
    found = DipoleMaps.of([[1.2, -0.1, np.nan], [0.0, 1.0, 0.5]], 2.0, eta=1.4)
    assert found.outlier.tolist() == [[True, True, False], [False, False, False]]
    assert found.valid.tolist() == [[False, False, False], [True, False, True]]
    assert np.isnan(found.sigma_a_per_mm[~found.valid]).all()
    assert found.sigma_s_prime_per_mm[1, 0] == pytest.approx(0.0, abs=1e-12)
    assert found.sigma_a_per_mm[1, 0] == pytest.approx(0.5 / np.sqrt(3.0))
    nothing = even_model(lobes, valid=False).dipole()
    assert not nothing.valid.any()
    assert not nothing.outlier.any()
