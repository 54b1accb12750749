"""A measured relief grown over a mesh and moved with it."""

import numpy as np
import pytest

from model import store
from model.microstructure.kernel_table import FOREHEAD
from model.skin import SkinAppearance, SkinMap
from skinrig.appearances import dynamic
from skinrig.applying.expression import ApplyError, ExpressionRequest, apply_expression
from skinrig.applying.relief import ReliefEvaluator, ReliefRequest

MICRO = (dynamic.MICROSTRUCTURE,)
NPY_HEADER = b"\x93NUMPY\x01\x00v\x00" + (
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (150, 150), }".ljust(117) + b"\n"
)
"""Header of a file whose heights are missing."""


def relief_map(seed, side=160, wave_px=1.5):
    from scipy import ndimage

    rough = np.random.default_rng(seed).standard_normal((side, side))
    smooth = ndimage.gaussian_filter(rough, wave_px)
    return SkinMap((8.0 * smooth / smooth.std()).astype(np.float32), "um")


def write_folder(path, wave_px=1.5):
    sites, maps, files = {}, {}, {}
    for seed, site in enumerate(("forehead", "cheek")):
        maps[f"microrelief_{site}"] = relief_map(seed, wave_px=wave_px)
        files[f"kernel_table_{site}.json"] = FOREHEAD.to_json().encode()
        sites[site] = {
            "pixel_um": 20.0,
            "map": f"microrelief_{site}",
            "table": f"kernel_table_{site}.json",
        }
    part = SkinAppearance(maps, "measured", {"sites": sites}, {}, files=files)
    dynamic.add(path, dynamic.MICROSTRUCTURE, part)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_folder(tmp_path_factory.mktemp("patches") / "moving")


@pytest.fixture(scope="module")
def sheet(tmp_path_factory):
    """A square of 12 mm that one shape draws out by 20 % to the right."""
    x, y = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9))
    uv = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32)
    vertices = np.concatenate([12.0 * uv, np.zeros((81, 1), np.float32)], axis=1)
    k = np.arange(72).reshape(8, 9)[:, :8].ravel()
    faces = np.concatenate([np.stack([k, k + 1, k + 10], 1), np.stack([k, k + 10, k + 9], 1)])
    drawn = np.zeros((1, 81, 3), np.float16)
    drawn[0, :, 0] = 0.2 * vertices[:, 0]
    path = tmp_path_factory.mktemp("sheet") / "sheet.npz"
    np.savez(
        path,
        vertices_mm=vertices,
        uv=uv,
        faces=faces.astype(np.int32),
        shape_names=np.array(["drawn"]),
        shape_deltas_mm=drawn,
    )
    return path


def applied(folder, sheet, out, weights, **other):
    options = {"size_px": 300, "site": "forehead", "extrapolate": "hold", "seed": 1} | other
    relief = ReliefEvaluator.of(
        sheet, weights, ReliefRequest(**options), out=out, progress=lambda _: None
    )
    return apply_expression(folder, ExpressionRequest(weights), out=out, parts=MICRO, relief=relief)


@pytest.fixture(scope="module")
def rest(folder, sheet, tmp_path_factory):
    """The relief of a sheet at rest, 600 x 600."""
    out = tmp_path_factory.mktemp("rest") / "out"
    return applied(folder, sheet, out, {"drawn": 0.0}, size_px=600)


def slopes(height, axis):
    return np.diff(height[20:-20, 20:-20].astype(float), axis=axis).std()


def test_drawn_out_skin_is_smoother_along_pull(folder, sheet, rest, tmp_path):
    done = applied(folder, sheet, tmp_path / "out", {"drawn": 1.0}, size_px=600)
    before = done.maps["displacement_neutral"].values
    after = done.maps["displacement"].values
    assert slopes(after, 1) < 0.95 * slopes(before, 1)
    assert slopes(after, 0) > slopes(after, 1)
    told = done.figures["microstructure"]
    assert told["stretch_s"] == pytest.approx((1.2, 1.2), abs=2e-3)
    assert told["pixel_um"] == pytest.approx(20.0, rel=1e-3)
    # at rest nothing happens to it
    np.testing.assert_array_equal(rest.maps["displacement"].values, before)


def test_the_relief_keeps_its_size_on_the_skin(sheet, tmp_path):
    """Twice the pixels show the same waves over twice as many of them; waves of 60 um."""
    smooth = write_folder(tmp_path / "smooth", wave_px=3.0)
    coarse = applied(smooth, sheet, tmp_path / "a", {"drawn": 0.0}, size_px=300)
    fine = applied(smooth, sheet, tmp_path / "b", {"drawn": 0.0}, size_px=600)
    ratio = slopes(coarse.maps["displacement"].values, 0) / slopes(
        fine.maps["displacement"].values, 0
    )
    assert 1.5 < ratio < 2.2


def test_the_same_seed_grows_the_same_relief(folder, sheet, tmp_path):
    maps = [
        applied(folder, sheet, tmp_path / str(k), {"drawn": 0.5}, seed=seed).maps["displacement"]
        for k, seed in enumerate((1, 1, 2))
    ]
    np.testing.assert_array_equal(maps[0].values, maps[1].values)
    assert not np.array_equal(maps[0].values, maps[2].values)


def test_unmatched_names_are_refused_and_nothing_is_written(folder, sheet, tmp_path):
    with pytest.raises(ApplyError, match="drown"):
        applied(folder, sheet, tmp_path / "out", {"drown": 1.0})
    with pytest.raises(ApplyError, match="site"):
        applied(folder, sheet, tmp_path / "out", {"drawn": 1.0}, site="knee")
    with pytest.raises(ApplyError, match="size"):
        applied(folder, sheet, tmp_path / "out", {"drawn": 1.0}, size_px=10)
    with pytest.raises(ApplyError, match="extrapolate"):
        applied(folder, sheet, tmp_path / "out", {"drawn": 1.0}, extrapolate="guess")
    assert not (tmp_path / "out").exists()


def test_large_maps_are_written_next_to_folder(folder, sheet, tmp_path, monkeypatch):
    monkeypatch.setattr("skinrig.applying.relief.MAX_EXR_SIDE_PX", 256)
    out = tmp_path / "out"
    applied(folder, sheet, out, {"drawn": 1.0})
    large = np.load(tmp_path / "out-large" / "displacement.npy", mmap_mode="r")
    assert large.shape == (300, 300)
    shown = store.read(out).maps["displacement"]
    np.testing.assert_array_equal(shown.values, large[::2, ::2])
    assert "one of 2 pixels" in shown.description


def test_spatial_noise_has_patch_height_and_deforms_alike(folder, sheet, tmp_path):
    done = applied(folder, sheet, tmp_path / "out", {"drawn": 1.0}, size_px=400, source="noise")
    before = done.maps["displacement_neutral"].values
    after = done.maps["displacement"].values
    assert before.std() == pytest.approx(8.0, rel=0.15)
    assert slopes(after, 1) < 0.95 * slopes(before, 1)
    with pytest.raises(ApplyError, match="synthesize"):
        applied(folder, sheet, tmp_path / "no", {"drawn": 1.0}, source="paint")


def test_mesoscale_keeps_its_long_waves(folder, sheet, rest, tmp_path):
    side = 150
    wave = 40.0 * np.cos(2.0 * np.pi * (np.arange(side) + 0.5) / 50.0)  # 4 mm
    path = tmp_path / "scan.npy"
    np.save(path, np.broadcast_to(wave, (side, side)))
    whole = applied(folder, sheet, tmp_path / "b", {"drawn": 0.0}, size_px=600, mesoscale=path)
    assert "mesoscale" in whole.inputs
    difference = whole.maps["displacement_neutral"].values.astype(float)
    difference -= rest.maps["displacement_neutral"].values
    fine = 40.0 * np.cos(2.0 * np.pi * (np.arange(600) + 0.5) / 200.0)
    np.testing.assert_allclose(difference, np.broadcast_to(fine, (600, 600)), atol=1.0)


@pytest.mark.parametrize(
    ("values", "match"),
    [
        (np.zeros((150, 140)), "150 x 140"),
        (np.zeros((20, 20)), "600 um, expected at most 250 um; give a finer map"),
        (np.zeros((900, 900)), "600"),
        (np.full((150, 150), np.nan), "no valid texel on the mesh, expected some; export"),
        (np.zeros((150, 150), complex), "complex128, expected a .npy file"),
        (np.array([[None]]), "empty, damaged or pickled file, expected"),
        (b"", "an empty, damaged"),
        (b"heights", "an empty, damaged"),
        (b"PK\x03\x04", "an empty, damaged"),
        (NPY_HEADER, "an empty, damaged"),
        (NPY_HEADER.replace(b"}", b" "), "an empty, damaged"),
        (None, "No such file"),
    ],
)
def test_unusable_mesoscale_map_is_refused_before_growth(
    folder, sheet, tmp_path, monkeypatch, values, match
):
    monkeypatch.setattr("model.displacement_synthesis.growth.grow", None)
    path = tmp_path / "scan.npy"
    if isinstance(values, bytes):
        path.write_bytes(values)
    elif values is not None:
        np.save(path, values)
    with pytest.raises(ApplyError, match=match) as caught:
        applied(folder, sheet, tmp_path / "no", {"drawn": 0.0}, size_px=600, mesoscale=path)
    assert str(caught.value).startswith(f"{path}: got ")
    assert ("finer map" in str(caught.value)) == (np.shape(values) == (20, 20))


def test_mesoscale_needs_measured_patches(folder, sheet, tmp_path):
    with pytest.raises(ApplyError, match="--mesoscale"):
        applied(folder, sheet, tmp_path / "no", {}, source="noise", mesoscale=tmp_path / "a.npy")
