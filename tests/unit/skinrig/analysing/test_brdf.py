"""Datasets of surface BRDFs, simulated and measured, and what is told of them."""

import dataclasses
import io
import json

import numpy as np
import pytest

from model import store
from model.brdf import tables as brdf_tables
from model.skin import SkinAppearance, SkinMap
from reconstruction import brdf_basis, diffuse_albedo
from rigsim.population import population
from skinrig.analysing import brdf as analysing_brdf
from skinrig.analysing import brdf_space_datasets, brdf_space_figures
from skinrig.analysing.brdf import AnalysisError
from skinrig.analysing.brdf_space_datasets import CapturedSamples, DatasetError
from skinrig.cli import main

PERSON = population.draw_population()[4]


@pytest.fixture(scope="module")
def basis():
    return brdf_tables.default_basis()


@pytest.fixture(scope="module")
def skin():
    return brdf_space_datasets._skin(PERSON, {})


@pytest.fixture(scope="module")
def seen(skin) -> CapturedSamples:
    return brdf_space_datasets.sample_surface(*skin, 120, rng=np.random.default_rng(1))


@pytest.mark.long
def test_samples_are_true_reflection_with_stated_noise(seen):
    assert np.all(np.einsum("pmc,pc->pm", seen.light, seen.normals) >= 0.119)
    pull = (seen.f - seen.clean) / np.sqrt(seen.variance)
    # mean and variance of 57,600 normal deviates: 5 standard errors, false alarms below 1e-5
    count = pull.size
    assert abs(pull.mean()) < 5.0 / np.sqrt(count)
    assert abs(pull.var() - 1.0) < 5.0 * np.sqrt(2.0 / count)
    again = seen.again(10, rng=np.random.default_rng(3))
    assert not np.array_equal(again.f, seen.f[:10])
    np.testing.assert_array_equal(again.clean, seen.clean[:10])


@pytest.mark.long
def test_mixtures_of_materials_hold_the_true_surface_term(seen, basis):
    """Root of the squared error over that of the surface term, in the pairs that were measured."""
    fit = brdf_space_datasets.fit_materials(seen, basis)
    lobe = np.stack(
        [
            brdf_basis.evaluate(x, basis, to, at, n)
            for x, to, at, n in zip(fit.weights, seen.light, seen.view, seen.normals, strict=True)
        ]
    )
    assert np.linalg.norm(lobe - seen.surface) < 0.15 * np.linalg.norm(seen.surface)
    # another point's lobes do not
    other = np.stack(
        [
            brdf_basis.evaluate(x, basis, to, at, n)
            for x, to, at, n in zip(
                fit.weights[::-1], seen.light, seen.view, seen.normals, strict=True
            )
        ]
    )
    assert np.linalg.norm(other - seen.surface) > 0.2 * np.linalg.norm(seen.surface)


@pytest.mark.long
def test_points_without_diffuse_are_fitted_by_lobes_alone(skin, basis):
    surface, place, where = skin
    black = dataclasses.replace(surface, r_d=np.zeros_like(surface.r_d))
    seen = brdf_space_datasets.sample_surface(black, place, where, 60, rng=np.random.default_rng(2))
    found = diffuse_albedo.estimate(
        seen.f, seen.light, seen.view, seen.normals, eta=1.4, variance=seen.variance
    )
    assert np.median(np.abs(found.r_d)) < 0.01
    fit = brdf_space_datasets.fit_materials(seen, basis)
    assert fit.valid.all()
    assert np.all(fit.weights @ basis.strength() > 0.0)


@pytest.mark.long
def test_the_darkest_person_has_a_surface_too(basis):
    dark = dataclasses.replace(PERSON, melanin=population.POPULATION_MELANIN_RANGE[1])
    rng = np.random.default_rng(4)
    data = brdf_space_datasets.build_dataset_b(60, members=(dark,), rng=rng)
    assert len(data.weights) + data.lost == 60
    assert data.lost < 6
    found = analysing_brdf.analyze(data, basis, by_label=True, ranks=(1, 2, 4), rng=rng)
    assert found.held_out == "points"  # one person cannot be left out
    assert np.all(np.diff(found.curve.error) < 0.0)


@pytest.mark.long
def test_single_condition_is_dataset_and_conditions_share_points():
    rng = np.random.default_rng(5)
    only = brdf_space_datasets.build_dataset_a(40, conditions=("lotion",), rng=rng)
    assert only.labels == ("lotion",)
    assert set(only.label.tolist()) == {0}
    two = brdf_space_datasets.build_dataset_a(41, conditions=("normal", "powder"), rng=rng)
    counts = np.bincount(two.label)
    assert abs(int(counts[0]) - int(counts[1])) <= 1 + two.lost
    assert 0.0 < two.noise < 1.0


@pytest.mark.long
def test_mean_brdf_peaks_higher_under_lotion_than_powder(basis):
    rng = np.random.default_rng(6)
    data = brdf_space_datasets.build_dataset_a(
        90, conditions=("normal", "lotion", "powder"), rng=rng
    )
    found = analysing_brdf.analyze(data, basis, by_label=False, ranks=(1, 2), rng=rng)
    peak = {
        n: row[0].max() for n, row in brdf_space_figures.render_spheres(found.means, basis).items()
    }
    assert peak["powder"] < peak["normal"] < peak["lotion"]
    for png in (
        brdf_space_figures.draw_spheres(found.means, basis),
        brdf_space_figures.curves({"some": found.curve}),
    ):
        assert png.startswith(b"\x89PNG")


@pytest.mark.long
def test_unsampleable_input_is_refused(skin, rng):
    surface, place, where = skin
    with pytest.raises(DatasetError, match="samples: got 5000"):
        brdf_space_datasets.sample_surface(surface, place, where, 5, samples=5000, rng=rng)
    with pytest.raises(DatasetError, match="samples"):
        brdf_space_datasets.sample_surface(surface, place, np.zeros_like(where), 5, rng=rng)
    with pytest.raises(DatasetError, match="points: got 3 for 7"):
        brdf_space_datasets.build_dataset_a(3, rng=rng)
    with pytest.raises(DatasetError, match="points"):
        brdf_space_datasets.build_dataset_b(0, rng=rng)


def appearance(basis, rank, rng, *, names=None):
    """Return a folder's content: texels that mix `rank` mixtures of materials."""
    mix = rng.exponential(size=(rank, basis.size)) * (rng.random((rank, basis.size)) < 0.08)
    mix[:, 0] += 1e-3
    mix /= (mix @ basis.strength())[:, None]
    stream = io.BytesIO()
    made = {"light_radius_rad": basis.light_radius_rad, "table": basis.table}
    np.savez(stream, mix=mix, materials=np.array(names or basis.names), **made)
    valid = np.ones((24, 24), np.bool_)
    valid[0] = False
    maps = {
        f"basis_weight_{k}": SkinMap(
            rng.exponential(size=(24, 24)).astype(np.float32), "1", valid=valid
        )
        for k in range(rank)
    }
    return SkinAppearance(maps, "simulated", seed=0, files={"brdf_basis.npz": stream.getvalue()})


@pytest.mark.long
def test_measured_faces_are_analyzed_by_label(tmp_path, basis, capsys):
    rng = np.random.default_rng(7)
    agreed = {"pseudonym": "P7", "consent_scope": ["research"], "consent_expires": "2031-01-31"}
    for name in ("a", "b", "c"):
        face = appearance(basis, 3, rng)
        if name == "b":
            face = dataclasses.replace(face, source="measured", parameters={"consent": [agreed]})
        store.write(tmp_path / f"appearance-{name}", face)
    table = tmp_path / "labels.csv"
    table.write_text("name,lotion,age\na,1,30\nb,1,40\nc,0,50\n", encoding="utf-8")
    folders = [str(tmp_path / f"appearance-{n}") for n in "abc"]
    argv = ["analyse", "brdf", *folders, "--labels", str(table), "--points", "60"]
    assert main([*argv, "--method", "brdf", "--out", str(tmp_path / "out"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [d["name"] for d in told["datasets"]] == ["a", "b", "c", "all"]
    for document in told["datasets"][:3]:
        # a face holds as many lobes as it was reconstructed with
        error = dict(zip(document["ranks"], document["error"], strict=True))
        assert error[3] < 0.1 * error[1]
        assert max(error) == 3
        assert "--rank 24" in document["left_out"][0][1]
    assert told["datasets"][3]["plateau"] > 3
    assert told["datasets"][3]["held_out"] == "people"
    for name in ("figure-14.png", "figure-15.png", "curves.csv", "analysis.json"):
        assert (tmp_path / "out" / name).stat().st_size > 0
    kept = json.loads((tmp_path / "out" / "analysis.json").read_text(encoding="utf-8"))
    assert (kept["source"], kept["consent"]) == ("measured", [agreed])
    assert kept["data"] == told["data"] == "sessions of the light dome"
    assert main(["report", str(tmp_path / "out"), "--out", str(tmp_path / "report.html")]) == 0
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert ">P7</th>" in page
    assert "research, until 2031-01-31" in page


@pytest.mark.long
def test_faces_without_usable_lobes_are_named(tmp_path, basis, capsys):
    rng = np.random.default_rng(8)
    bare = SkinAppearance({"r_d": SkinMap(np.ones((8, 8), np.float32), "1")}, "simulated", seed=0)
    store.write(tmp_path / "appearance-bare", bare)
    other = appearance(basis, 2, rng, names=[f"m{k}" for k in range(basis.size)])
    store.write(tmp_path / "appearance-other", other)
    out = tmp_path / "out"
    with pytest.raises(AnalysisError, match="bare: holds no lobes"):
        analysing_brdf.analyze_measured(out, [tmp_path / "appearance-bare"])
    with pytest.raises(AnalysisError, match="--merl-basis DIR"):
        analysing_brdf.analyze_measured(out, [tmp_path / "appearance-other"])
    for argv, says in (
        ([], "Missing"),
        (["--out", str(out), "--labels", "x.csv"], "--labels"),
        (["--out", str(out), "--points", "3"], "--points"),
        (["--out", str(out), "--method", "pca"], "--method"),
        ([str(tmp_path / "appearance-bare"), "--out", str(out)], "holds no lobes"),
    ):
        assert main(["analyse", "brdf", *argv]) != 0
        shown = "".join(capsys.readouterr())
        assert says in shown
        assert "Traceback" not in shown
    assert not out.exists()
