"""`skinrig fit reflectance` as a user calls it."""

import io
import json

import numpy as np
import pytest

from model import skin_reflectance, store
from model.brdf import tables as brdf_tables
from model.skin import SkinAppearance, SkinMap
from skinrig.cli import main

SIDE = 40


@pytest.fixture
def folders(tmp_path):
    """Write maps of a dome and of a probe of one subject."""
    u, v = np.meshgrid(np.linspace(-1.2, 1.2, SIDE), np.linspace(1.0, -1.0, SIDE))
    z = 80.0 * np.cos(u) * np.sqrt(1.2 - v**2) - 70.0 + 18.0 * np.exp(-(20 * u**2 + 96 * v**2))
    place = np.stack([70.0 * np.sin(u), 120.0 * v, z], axis=-1)
    lobes = brdf_tables.tabulate({"matte": lambda light, view: np.full(light.shape[:-1], 0.05)})
    stream = io.BytesIO()
    np.savez_compressed(
        stream, table=lobes.table[..., :1], materials=["matte"], mix=np.eye(1), light_radius_rad=0.0
    )
    maps = {
        "position": SkinMap(place, "mm"),
        "normals": SkinMap(np.broadcast_to([0.0, 0.0, 1.0], place.shape), "1"),
        "r_d": SkinMap(np.full(place.shape, 0.4), "1", np.full(place.shape, 0.01)),
        "basis_weight_0": SkinMap(np.full((SIDE, SIDE), 0.3), "1"),
    }
    parameters = {"assumed": ["lights as drawn"], "held_out": {"lights": ["L007"]}}
    dome = SkinAppearance(
        maps, "measured", parameters=parameters, files={"brdf_basis.npz": stream.getvalue()}
    )
    rows = [
        {"site": site, "channel": channel, "sigma_tr_per_mm": value, "sigma_tr_stderr": 0.02}
        for site in ("forehead", "chin")
        for channel, value in (("red", 0.5), ("green", 0.9), ("blue", 1.4))
    ]
    files = {"subsurface.json": json.dumps({"sites": rows}).encode()}
    probe = SkinAppearance({}, "simulated", parameters={"assumed": ["cold"]}, files=files)
    store.write(tmp_path / "dome", dome)
    store.write(tmp_path / "probe", probe)
    return tmp_path


def test_model_contains_dome_maps_and_probe_translucency_error(folders, capsys):
    out = folders / "model"
    argv = ["fit", "reflectance", str(folders / "dome"), str(folders / "probe"), "--out", str(out)]
    assert main([*argv, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "skinrig.fit/1"
    assert document["model"] == "reflectance"
    found = store.read(out)
    assert {"position", "normals", "r_d", "basis_weight_0", "translucency"} == set(found.maps)
    assert {"brdf_basis.npz", "subsurface.json"} == set(found.files)
    assert found.source == "simulated"
    assert found.parameters["held_out"] == {"lights": ["L007"]}
    told = found.parameters["assumed"]
    assert told[:2] == ["lights as drawn", "probe: cold"]
    assert "mean face" in told[2]
    assert {"dome", "probe"} <= set(found.inputs)
    sites = found.parameters["reflectance_model"]["sites"]
    assert [site["site"] for site in sites] == ["forehead", "chin"]
    model = skin_reflectance.assemble(found)
    assert list(model.assumed) == told
    row, column = sites[0]["texel"]
    np.testing.assert_allclose(model.translucency_mm[row, column], [2.0, 1.11, 0.714], rtol=0.04)
    assert (model.translucency_stderr_mm > 0).all()


def test_missing_probe_uses_population_and_reports_substitution(folders, capsys):
    out = folders / "model"
    assert main(["fit", "reflectance", str(folders / "dome"), "--out", str(out)]) == 0
    assert "assumed: translucency is the population's" in capsys.readouterr().out
    depth = store.read(out).maps["translucency"]
    assert "not measured" in depth.description
    np.testing.assert_allclose(
        depth.stderr[0, 0] / depth.values[0, 0], [0.3, 0.26, 0.21], atol=0.02
    )


@pytest.mark.parametrize(
    ("argv", "code", "says"),
    [
        (["nowhere"], 3, "nowhere"),
        (["probe"], 3, "position"),
        (["dome", "dome"], 3, "subsurface.json"),
        (["dome", "probe", "--landmarks", "none.csv"], 3, "none.csv"),
        (["dome", "--landmarks", "none.csv"], 2, "--probe, which is missing"),
    ],
)
def test_reflectance_fit_failure_gives_single_sentence(
    folders, capsys, monkeypatch, argv, code, says
):
    monkeypatch.chdir(folders)
    assert main(["fit", "reflectance", *argv, "--out", "model"]) == code
    told = capsys.readouterr().err
    assert says in told
    assert "Traceback" not in told
    assert not (folders / "model").exists()


def test_inputs_are_never_overwritten(folders, capsys, monkeypatch):
    monkeypatch.chdir(folders)
    assert main(["fit", "reflectance", "dome", "--out", "dome"]) == 3
    assert "another --out" in capsys.readouterr().err
