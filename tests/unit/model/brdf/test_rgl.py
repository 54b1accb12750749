"""Measured materials: tabulated BRDFs come back, and files of others are understood or refused."""

import numpy as np
import pytest

from model.brdf import recipe as brdf_recipe
from model.brdf import rgl, tensor_file
from model.brdf.rgl import RglFileError
from model.brdf.tensor_file import TensorFileError


def directions(rng, count, *, lowest=0.1):
    z = rng.uniform(lowest, 1.0, count)
    phi = rng.uniform(0.0, 2.0 * np.pi, count)
    s = np.sqrt(1.0 - z**2)
    return np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1)


@pytest.fixture(scope="module")
def rough():
    return rgl.tabulate_brdf(dict(brdf_recipe.materials())["ggx 0.33 eta 1.4"], description="rough")


def adaptive(rng, *, spectral=False):
    """A file as the measured ones are: an uneven density for each elevation, ndf and sigma."""
    count, side = 5, 7
    data = rng.uniform(0.1, 1.0, (1, count, 4 if spectral else 3, side, side))
    fields = {
        "description": np.frombuffer(b"made up", np.uint8),
        "jacobian": np.ones(1, np.uint8),
        "phi_i": np.zeros(1, np.float32),
        "theta_i": np.linspace(0.0, 1.4, count),
        "ndf": rng.uniform(0.5, 2.0, (2, 9)),
        "sigma": rng.uniform(0.5, 1.0, (2, 9)),
        "vndf": rng.uniform(0.1, 3.0, (1, count, 11, 6)),
        "luminance": rng.uniform(0.5, 1.0, (1, count, side, side)),
        "spectra" if spectral else "rgb": data,
    }
    if spectral:
        fields["wavelengths"] = np.linspace(400.0, 700.0, 4)
    for name in ("sigma", "ndf"):  # the same on both sides of the seam in azimuth
        fields[name] = np.repeat(fields[name][:1], 2, 0)
    return {
        name: array if array.dtype == np.uint8 else array.astype(np.float32)
        for name, array in fields.items()
    }


@pytest.mark.parametrize("name", ["diffuse", "ggx 0.1 eta 1.4", "ggx 0.33 eta 1.4", "retro 0.3"])
def test_written_brdf_equals_its_source_brdf(name, rng, tmp_path):
    """Tolerance: linear interpolation between 45 elevations; the median is a third of a percent."""
    brdf = dict(brdf_recipe.materials())[name]
    rgl.write(tmp_path / "a.bsdf", rgl.tabulate_brdf(brdf, description=name))
    table = rgl.read(tmp_path / "a.bsdf")
    light, view = directions(rng, 3000), directions(rng, 3000)
    found, true = table.evaluate(light, view), brdf(light, view)
    assert table.description == name
    np.testing.assert_array_equal(found[:, 0], found[:, 2])
    assert np.sqrt(np.mean((found[:, 0] - true) ** 2) / np.mean(true**2)) < 0.06
    assert np.median(np.abs(found[:, 0] - true) / np.maximum(true, 1e-3)) < 0.01
    turned = rgl.RglTable(
        table.theta_i,
        table.ndf,
        1.2 * table.sigma,
        table.vndf,
        table.luminance,
        table.values,
        table.wavelengths_nm,
        "",
    )
    assert np.median(np.abs(turned.evaluate(light, view)[:, 0] / true - 1.0)) > 0.1  # it can fail


def test_colors_stay_apart_and_nothing_shines_from_below(rough):
    table = rgl.tabulate_brdf(
        lambda light, view: np.tile([0.1, 0.2, 0.3], (len(light), 1)), description=""
    )
    z = np.array([[0.0, 0.0, 1.0]])
    np.testing.assert_allclose(table.evaluate(z, z), [[0.1, 0.2, 0.3]], rtol=1e-5)
    assert np.all(rough.evaluate(-z, z) == 0.0)
    assert np.all(rough.evaluate(z, -z) == 0.0)
    assert table.evaluate(np.zeros((0, 3)), z[0]).shape == (0, 3)


def test_turning_both_directions_changes_nothing(rough, rng):
    light, view = directions(rng, 400), directions(rng, 400)
    c, s = np.cos(2.0), np.sin(2.0)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    once, twice = rough.evaluate(light, view), rough.evaluate(light @ turn.T, view @ turn.T)
    np.testing.assert_allclose(twice, once, rtol=1e-6)


@pytest.mark.parametrize("spectral", [False, True])
def test_files_of_others_come_back_to_the_byte(spectral, rng, tmp_path):
    fields = adaptive(rng, spectral=spectral)
    tensor_file.write(tmp_path / "a.bsdf", fields)
    table = rgl.read(tmp_path / "a.bsdf")
    assert table.evaluate(*[directions(rng, 50)] * 2).shape == (50, 4 if spectral else 3)
    rgl.write(tmp_path / "b.bsdf", table)
    back = tensor_file.read(tmp_path / "b.bsdf")
    assert set(back) == set(fields)
    for name, array in fields.items():
        assert back[name].tobytes() == array.tobytes()


def test_flattening_an_uneven_density_spreads_its_samples_evenly(rng, tmp_path):
    """Rationale: samples of the density, flattened, are uniform: each of 36 cells gets a share.

    Expected: chi-squared of 36 cells of 20 000 samples within the 0.001 quantile.
    """
    fields = adaptive(rng)
    tensor_file.write(tmp_path / "a.bsdf", fields)
    table = rgl.read(tmp_path / "a.bsdf")
    density = table.vndf[2].astype(np.float64)
    tries = rng.random((200_000, 2))
    x, y = tries[:, 0] * 5, tries[:, 1] * 10
    i, j = x.astype(int), y.astype(int)
    u, v = x - i, y - j
    at = (1 - v) * ((1 - u) * density[j, i] + u * density[j, i + 1])
    at += v * ((1 - u) * density[j + 1, i] + u * density[j + 1, i + 1])
    chosen = tries[rng.random(len(tries)) < at / density.max()][:20_000]
    slices = rgl._Interpolation(*[np.full(len(chosen), 2)] * 2, np.zeros(len(chosen)))
    flat = rgl._invert_sampling(table.vndf, slices, chosen)
    count, _, _ = np.histogram2d(flat[:, 0], flat[:, 1], bins=6, range=[[0, 1], [0, 1]])
    expected = len(chosen) / 36
    assert np.sum((count - expected) ** 2 / expected) < 66.6  # of 35 degrees of freedom
    raw, _, _ = np.histogram2d(chosen[:, 0], chosen[:, 1], bins=6, range=[[0, 1], [0, 1]])
    assert np.sum((raw - expected) ** 2 / expected) > 500.0


def test_invalid_isotropic_material_error_names_field(rng, tmp_path):
    path = tmp_path / "a.bsdf"
    for change, message in [
        ({"phi_i": np.zeros(8, np.float32)}, "anisotropic"),
        ({"rgb": None}, "field rgb is missing"),
        ({"vndf": np.ones((5, 11, 6), np.float32)}, "vndf: got 3 dimensions"),
        ({"luminance": np.ones((1, 5, 6, 6), np.float32)}, "luminance: got shape"),
        ({"vndf": np.zeros((1, 5, 2, 2), np.float32)}, "vndf: got an elevation without"),
        ({"sigma": np.full((2, 2), np.nan, np.float32)}, "sigma"),
        ({"theta_i": np.zeros(5, np.float32)}, "theta_i"),
    ]:
        fields = {k: v for k, v in (adaptive(rng) | change).items() if v is not None}
        tensor_file.write(path, fields)
        with pytest.raises(RglFileError, match=message):
            rgl.read(path)
    path.write_bytes(b"II*\0" * 30)
    with pytest.raises(TensorFileError, match="not a tensor file"):
        rgl.read(path)


def test_negative_or_nonfinite_brdf_is_refused():
    for value in (-1e-3, np.nan, np.inf):
        with pytest.raises(ValueError, match="brdf"):
            rgl.tabulate_brdf(lambda light, view, v=value: np.full(len(light), v), description="")
