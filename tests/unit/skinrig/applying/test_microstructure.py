import dataclasses
import json

import numpy as np
import pytest

from model.microstructure.convolution import convolve
from model.microstructure.kernel_table import FOREHEAD, KernelTable, kernel_parameters
from model.microstructure.mesh_strain import StrainError
from model.microstructure.strain_fields import KernelRegions
from skinrig.applying.microstructure import ApplyMicrostructureError, apply_microstructure
from skinrig.blend_shapes.meshes import BlendShapeMesh


def square_mm(side=1.0, n=5):
    """A patch of skin a millimetre wide that fills its texture, and two shapes."""
    at = np.linspace(0.0, 1.0, n)
    u, v = np.meshgrid(at, at)
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    number = np.arange(n * n).reshape(n, n)
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    c, d = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    points = np.concatenate([side * uv, np.zeros((n * n, 1))], axis=1)
    return BlendShapeMesh(
        points.astype(np.float32),
        uv.astype(np.float32),
        faces.astype(np.int32),
        {
            "wide": (points * [0.2, -0.1, 0.0]).astype(np.float32),
            "far": (points * [1.0, 0.0, 0.0]).astype(np.float32),
        },
    )


def test_patch_stretched_along_x_uses_table_kernels(rng):
    height = rng.standard_normal((128, 128)).astype(np.float32)
    done = apply_microstructure(square_mm(), {"wide": 1.0}, height)
    alpha, sigma_um = kernel_parameters([1.2, 0.9])
    sigma_px = 1e-3 * sigma_um * 128.0  # 128 px are 1 mm
    expected = convolve(height, (1, 0), (0, 1), alpha[0], sigma_px[0], alpha[1], sigma_px[1])
    np.testing.assert_allclose(done.height, expected, atol=1e-4)
    report = done.report
    assert report.stretch_s == pytest.approx((1.2, 1.2), rel=1e-6)
    assert report.stretch_t == pytest.approx((0.9, 0.9), rel=1e-6)
    assert report.pixel_um == pytest.approx(1000.0 / 128.0, rel=1e-6)
    assert report.outside_share == 0.0
    assert report.covered_share == report.changed_share == 1.0
    json.dumps(dataclasses.asdict(report))


def test_neutral_weights_give_neutral_relief_bit_exactly(rng):
    height = rng.standard_normal((40, 60)).astype(np.float32)
    for weights in ({}, {"wide": 0.0}):
        done = apply_microstructure(square_mm(), weights, height)
        np.testing.assert_array_equal(done.height, height)
        assert done.report.changed_share == done.report.unresolved_share == 0.0


def test_vertices_beyond_fitted_range_are_counted_and_clamped(rng):
    height = rng.standard_normal((100, 100)).astype(np.float32)
    held = apply_microstructure(square_mm(), {"far": 0.9}, height)
    assert held.report.outside_share == held.report.above_share == 1.0
    assert held.report.below_share == held.report.clipped_share == 0.0
    end = convolve(
        height,
        (1, 0),
        (0, 1),
        *kernel_parameters(1.28)[:1],
        kernel_parameters(1.28)[1] * 0.1,
        0.0,
        1.0,
    )
    np.testing.assert_allclose(held.height, end, atol=1e-4)
    gone_on = apply_microstructure(square_mm(), {"far": 0.9}, height, extrapolate="formula")
    assert gone_on.report.clipped_share == 1.0
    assert np.abs(gone_on.height - held.height).max() > 0.1


def test_map_too_coarse_for_kernels_is_reported(rng):
    height = rng.standard_normal((32, 32)).astype(np.float32)
    done = apply_microstructure(square_mm(side=30.0), {"wide": 1.0}, height)
    np.testing.assert_array_equal(done.height, height)
    assert done.report.unresolved_share == 1.0
    assert done.report.pixel_um == pytest.approx(1e3 * 30.0 / 32.0, rel=1e-5)


def test_two_skin_types_use_own_kernels_and_blend(rng):
    height = rng.standard_normal((128, 128)).astype(np.float32)
    softer = KernelTable(
        (), ((1.5, -1.5),), None, (10.0, 5.0), (1.0, 1.1), "half as strong, fitted to 1.1"
    )
    mesh, weights = square_mm(), {"wide": 1.0}
    one, other = (apply_microstructure(mesh, weights, height, t).height for t in (FOREHEAD, softer))
    left = np.zeros((2, 4, 8))
    left[0, :, :3], left[1, :, 4:] = 1.0, 2.0
    left[:, :, 3] = 0.5
    done = apply_microstructure(mesh, weights, height, KernelRegions((FOREHEAD, softer), left))
    far = 12  # samples of the passes reach so many pixels
    np.testing.assert_allclose(done.height[:, : 40 - far], one[:, : 40 - far], atol=1e-5)
    np.testing.assert_allclose(done.height[:, 72 + far :], other[:, 72 + far :], atol=1e-5)
    assert np.abs(done.height - one)[:, 60:].max() > 0.1
    assert done.report.outside_share == pytest.approx(0.6)  # columns of vertices there
    tiled = apply_microstructure(
        mesh, weights, height, KernelRegions((FOREHEAD, softer), left), tile=50
    )
    np.testing.assert_array_equal(tiled.height, done.height)
    with pytest.raises(StrainError, match="weights"):
        KernelRegions((FOREHEAD, softer), left[:1])
    with pytest.raises(StrainError, match="weights: got"):
        KernelRegions((FOREHEAD, softer), left - 1.0)


def test_interrupted_run_resumes_and_gives_same_file(rng, tmp_path):
    height = rng.standard_normal((130, 170)).astype(np.float32)
    valid = rng.random(height.shape) > 0.01
    mesh, weights = square_mm(), {"wide": 0.8}
    whole = apply_microstructure(mesh, weights, height, valid=valid, tile=500)
    out = tmp_path / "folder" / "relief.npy"

    def stop(done, count):
        assert count == 9
        if done == 2:
            raise KeyboardInterrupt

    arguments = {"valid": valid, "tile": 64, "out": out}
    with pytest.raises(KeyboardInterrupt):
        apply_microstructure(mesh, weights, height, progress=stop, **arguments)
    journal = out.with_name("relief.npy.tiles.json")
    assert json.loads(journal.read_text())["finished"] == [0, 1]
    with pytest.raises(ApplyMicrostructureError, match="another"):
        apply_microstructure(mesh, {"wide": 0.7}, height, **arguments)
    with pytest.raises(ApplyMicrostructureError, match="another"):
        apply_microstructure(mesh, weights, height + 1.0, **arguments)
    told = journal.read_text()
    journal.write_text("{}")
    with pytest.raises(ApplyMicrostructureError, match="not a list"):
        apply_microstructure(mesh, weights, height, **arguments)
    journal.write_text(told)
    calls = []
    rest = apply_microstructure(
        mesh, weights, height, progress=lambda done, count: calls.append(done), **arguments
    )
    assert calls == list(range(3, 10))
    assert (rest.report.tiles, rest.report.tiles_before) == (9, 2)
    np.testing.assert_array_equal(np.load(out), whole.height)
    assert sorted(p.name for p in out.parent.iterdir()) == ["relief.npy"]


def test_mismatched_reliefs_and_meshes_are_refused(rng, tmp_path):
    mesh = square_mm()
    with pytest.raises(ApplyMicrostructureError, match="neutral_height"):
        apply_microstructure(mesh, {}, np.zeros(5, np.float32))
    with pytest.raises(ApplyMicrostructureError, match="valid"):
        apply_microstructure(mesh, {}, np.zeros((5, 5)), valid=np.ones((4, 5), bool))
    with pytest.raises(ApplyMicrostructureError, match=r"\.npy"):
        apply_microstructure(mesh, {}, np.zeros((5, 5)), out=tmp_path / "relief.exr")
    flat = BlendShapeMesh(mesh.vertices_mm, np.zeros_like(mesh.uv), mesh.faces, mesh.shapes)
    with pytest.raises(ApplyMicrostructureError, match="no triangle"):
        apply_microstructure(flat, {}, np.zeros((5, 5)), FOREHEAD)
