"""`skinrig fit brdf`: generated and read tables, projections to grids, fits by other materials."""

import json
import tracemalloc

import numpy as np
import pytest

from model import merl
from model.brdf import rgl, tables
from rigsim.light.generated_brdfs import generate_brdf
from skinrig.commands.reconstructing import check_rank
from skinrig.errors import UnusableError
from skinrig.exporting.brdfs import tabulate_merl
from skinrig.fitting import brdf_tables


def directions(rng, count):
    drawn = rng.standard_normal((8 * count, 3))
    drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    return drawn[drawn[:, 2] > 0.3][:count]


def test_generated_brdf_is_reciprocal_and_loses_light(rng):
    light, view = directions(rng, 400), directions(rng, 400)
    for number in range(5):
        brdf = generate_brdf(number, seed=3)
        np.testing.assert_allclose(brdf(light, view), brdf(view, light), rtol=1e-12)
    mu = np.sqrt((np.arange(600) + 0.5) / 600)
    phi = (np.arange(400) + 0.5) / 400 * np.pi
    c, azimuth = np.meshgrid(mu, phi, indexing="ij")
    s = np.sqrt(1.0 - c**2)
    sky = np.stack([s * np.cos(azimuth), s * np.sin(azimuth), c], axis=-1)
    for number in range(20):
        found = generate_brdf(number, seed=3)(sky, np.array([0.3, 0.0, np.sqrt(1 - 0.09)]))
        assert np.all(np.pi * found.mean(axis=(0, 1)) < 1.02)


def test_both_kinds_of_files_become_one_basis(tmp_path, rng):
    brdf = generate_brdf(1, seed=1)
    merl.write(tmp_path / "a.binary", tabulate_merl(brdf))
    rgl.write(tmp_path / "B.BSDF", rgl.tabulate_brdf(brdf, description="b"))
    basis = tables.load(tmp_path, light_radius_rad=0.0)
    assert basis.names == ("B", "a")
    light, view = directions(rng, 300), directions(rng, 300)
    found = basis.evaluate(light, view, [0.0, 0.0, 1.0])
    true = brdf(light, view).mean(axis=-1)
    errors = np.sqrt(np.mean((found - true[:, None]) ** 2, axis=0) / np.mean(true**2))
    assert np.all(errors < 0.05)
    other = generate_brdf(2, seed=1)(light, view).mean(axis=-1)
    assert np.sqrt(np.mean((found[:, 1] - other) ** 2) / np.mean(other**2)) > 0.1

    def measured(light, view):
        known = np.minimum(light[..., 2], view[..., 2]) > tables.MIN_MEASURED_COSINE
        return np.where(known, brdf(light, view).mean(axis=-1), np.nan)

    direct = tables.tabulate({"measured": measured})
    of_files = basis.table[..., :2].reshape(-1, 2).max(axis=0)
    np.testing.assert_allclose(of_files[0], direct.table.max(), rtol=0.01)
    # a MERL bin's center is up to half a degree from the node, where 1 / cosine is steep
    np.testing.assert_allclose(of_files[1], direct.table.max(), rtol=0.25)
    np.testing.assert_allclose(basis.strength(), direct.strength()[0], rtol=0.05)


def test_material_in_two_files_is_refused(tmp_path):
    for name in ("m.binary", "m.bsdf"):
        (tmp_path / name).touch()
    with pytest.raises(tables.BasisError, match=r"got m\.binary and m\.bsdf, expected one file"):
        tables.load(tmp_path)


def test_rank_is_limited_by_all_materials(tmp_path):
    for name in ("a.binary", "b.bsdf", "c.BSDF", "readme.txt"):
        (tmp_path / name).touch()
    check_rank(3, tmp_path)
    with pytest.raises(UnusableError, match="got 4, expected at most 3"):
        check_rank(4, tmp_path)


def test_dark_rgl_file_is_named(tmp_path):
    dark = rgl.tabulate_brdf(lambda light, view: 0.0 * light, description="dark")
    rgl.write(tmp_path / "a.bsdf", dark)
    with pytest.raises(tables.BasisError, match=r"a\.bsdf: got no value above 0"):
        tables.load(tmp_path)
    with pytest.raises(UnusableError, match=r"got 1 tables, expected 3 or more; add MERL"):
        brdf_tables.fit_tables(tmp_path / "out", tmp_path, count=1, seed=0)


def test_table_bright_at_horizon_alone_is_named(tmp_path):
    values = np.zeros((90, 90, 180, 1))
    values[89, 89, 90] = 1.0
    for name in "abc":
        merl.write(tmp_path / f"{name}.binary", merl.MerlTable.from_values(values))
    with pytest.raises(UnusableError, match=r"a\.binary: got no value above 0 at angles away"):
        brdf_tables.fit_tables(tmp_path / "out", tmp_path, count=1, seed=0)
    assert not (tmp_path / "out").exists()
    with pytest.raises(UnusableError, match=r"^--count: got 2 tables, expected 3 or more; enter"):
        brdf_tables.fit_tables(tmp_path / "out", None, count=2, seed=0)


def test_grid_keeps_what_is_linear_between_its_nodes(rng):
    h = merl.bin_centers()[0]
    grids = brdf_tables._GridFits()
    at = {"angles": 2.0 * h / np.pi, "merl": np.sqrt(2.0 * h / np.pi), "areas": 1.0 - np.cos(h)}
    for place, grid in enumerate(brdf_tables.GRID_LABELS):
        nodes = rng.uniform(0.5, 1.0, 8)
        along = np.interp(at[grid], np.linspace(0.0, 1.0, 8), nodes)
        table = np.broadcast_to(along[:, None, None], (90, 90, 180)).copy()
        if grid == "merl":
            table[60:, 20:] = np.nan  # unknown bins do not count
        errors = grids.errors(table)[0, :, 0]
        assert errors[place] < 5.0 * brdf_tables.SOLUTION_TOL
        assert np.all(np.delete(errors, place) > 1e-3)


def test_mixture_of_other_tables_has_no_error(rng):
    columns = rng.uniform(0.0, 1.0, (32, 12, 90, 4)).astype(np.float32)
    columns[..., 3] = 0.5 * columns[..., 0] + 0.25 * columns[..., 1]
    found = brdf_tables._mixture_errors(columns, tables.default_basis(0.0))
    assert found["tables"][3] < 1e-6
    assert found["tables"][2] > 0.1
    assert np.all(found["formulas"] > 0.1)


@pytest.mark.long
def test_thirty_whole_tables_are_fitted_in_stream(tmp_path):
    tracemalloc.start()
    found = brdf_tables.fit_tables(tmp_path, None, count=30, seed=0)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found["tables"] == 30
    assert peak < 200e6  # 30 tables have 350 MB
    assert json.loads((tmp_path / "tables.json").read_text()) == found
    for kind in ("mixture_error", "fit_error"):
        assert found[kind]["tables"]["50"] < 0.6 * found[kind]["formulas"]["50"]
    for rows in zip(*[iter(found["grids"])] * 3, strict=True):
        angles, square_root, areas = (row["error"]["50"] for row in rows)
        assert square_root < angles < areas
