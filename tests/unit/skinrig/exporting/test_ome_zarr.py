"""Maps as OME-Zarr: read without Zarr's library, equal to the maps, and only with consent."""

import json
import time
from datetime import date
from importlib.util import find_spec

import numpy as np
import pytest

from capture.session import ConsentError
from model import store
from model.skin import SkinAppearance, SkinMap
from skinrig import consent
from skinrig.exporting.export import export
from skinrig.exporting.options import ExportError, ExportSettings

pytestmark = pytest.mark.skipif(find_spec("zarr") is None, reason="no zarr")


@pytest.fixture
def maps():
    rng = np.random.default_rng(3)
    values = rng.uniform(0.1, 0.9, (1100, 7, 3)).astype(np.float32)
    valid = rng.uniform(size=(1100, 7)) > 0.3
    color = SkinMap(values, "1", stderr=0.1 * values, valid=valid, description="camera RGB")
    gray = SkinMap(rng.uniform(size=(5, 7)).astype(np.float32), "mm")
    parameters = {"assumed": ["the light is D65"]}
    return SkinAppearance({"r_d": color, "translucency": gray}, "simulated", parameters, seed=7)


def read_image(folder):
    """Return array and axes of an image from the files alone, by the two specifications."""
    from numcodecs import Blosc

    ome = json.loads((folder / "zarr.json").read_text())["attributes"]["ome"]
    (scale,) = ome["multiscales"]
    (dataset,) = scale["datasets"]
    array = json.loads((folder / dataset["path"] / "zarr.json").read_text())
    axes = [one["name"] for one in scale["axes"]]
    assert (ome["version"], array["zarr_format"], array["dimension_names"]) == ("0.5", 3, axes)
    (transform,) = dataset["coordinateTransformations"]
    assert (transform["type"], len(transform["scale"])) == ("scale", len(axes))
    codecs = [codec["name"] for codec in array["codecs"]]
    assert codecs == ["bytes", "blosc"]
    kind = np.dtype({"float32": "<f4", "uint8": "u1"}[array["data_type"]])
    values = np.full(array["shape"], np.nan if kind.kind == "f" else 0, kind)
    chunk = array["chunk_grid"]["configuration"]["chunk_shape"]
    for index in np.ndindex(*(-(-n // c) for n, c in zip(array["shape"], chunk, strict=True))):
        file = folder / dataset["path"] / "c" / "/".join(map(str, index))
        if file.exists():
            block = np.frombuffer(Blosc().decode(file.read_bytes()), kind).reshape(chunk)
            at = tuple(slice(i * c, (i + 1) * c) for i, c in zip(index, chunk, strict=True))
            part = values[at]
            part[...] = block[tuple(slice(0, n) for n in part.shape)]
    return values, axes


def test_maps_are_equal_without_zarr_library(maps, tmp_path):
    out = tmp_path / "out"
    export(store.write(tmp_path / "a", maps), out, "ome-zarr", ExportSettings(with_errors=True))
    color = maps.maps["r_d"]
    values, axes = read_image(out / "maps.zarr" / "r_d")
    assert axes == ["c", "y", "x"]
    seen = np.moveaxis(values, 0, -1)
    np.testing.assert_array_equal(seen[color.valid], color.values[color.valid])
    assert np.isnan(seen[~color.valid]).all()
    errors, _ = read_image(out / "maps.zarr" / "r_d.stderr")
    np.testing.assert_array_equal(
        np.moveaxis(errors, 0, -1)[color.valid], color.stderr[color.valid]
    )
    mask, _ = read_image(out / "maps.zarr" / "r_d" / "labels" / "valid")
    np.testing.assert_array_equal(mask[2].astype(bool), color.valid)
    gray, axes = read_image(out / "maps.zarr" / "translucency")
    assert axes == ["y", "x"]
    np.testing.assert_array_equal(gray, maps.maps["translucency"].values)
    about = json.loads((out / "maps.zarr" / "translucency" / "zarr.json").read_text())
    about = about["attributes"]["skinrig"]
    assert (about["unit"], about["source"], about["seed"]) == ("mm", "simulated", 7)
    assert about["assumed"] == ["the light is D65"]


def test_xarray_opens_image_with_named_axes(maps, tmp_path):
    xarray = pytest.importorskip("xarray")
    export(store.write(tmp_path / "a", maps), tmp_path / "out", "ome-zarr")
    opened = xarray.open_zarr(tmp_path / "out" / "maps.zarr", group="r_d", consolidated=False)
    assert opened["0"].dims == ("c", "y", "x")
    assert not (tmp_path / "out" / "maps.zarr" / "r_d.stderr").exists()


def test_same_maps_give_same_bytes_at_other_time(maps, tmp_path, monkeypatch):
    folder = store.write(tmp_path / "a", maps)
    written = []
    for name, now in (("b", 1.0e9), ("c", 1.5e9)):
        monkeypatch.setattr(time, "time", lambda now=now: now)
        export(folder, tmp_path / name, "ome-zarr", ExportSettings(only=("r_d",)))
        files = sorted((tmp_path / name / "maps.zarr").rglob("*"))
        written.append([file.read_bytes() for file in files if file.is_file()])
    assert written[0] == written[1]
    assert len(written[0]) > 8


def test_unknown_map_and_missing_consent_are_refused(maps, patch, tmp_path):
    folder = store.write(tmp_path / "a", maps)
    with pytest.raises(ExportError, match="got melanin, expected some of r_d, translucency"):
        export(folder, tmp_path / "out", "ome-zarr", ExportSettings(only=("melanin",)))
    person = {consent.CONSENT_KEY: [patch.consent]}
    own = store.write(tmp_path / "m", SkinAppearance(dict(maps.maps), "measured", person))
    with pytest.raises(ConsentError, match="P042"):
        export(own, tmp_path / "out", "ome-zarr", use="film", today=date(2029, 1, 1))
    assert not (tmp_path / "out").exists()
    assert export(own, tmp_path / "out", "ome-zarr", use="research", today=date(2029, 1, 1)).files
