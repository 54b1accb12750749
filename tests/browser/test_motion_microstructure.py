"""Strain, kernels, both convolutions and slopes of the page are the model's, pixel by pixel.

The page works in single precision and keeps slopes as half floats; the bounds below are some times
what was measured on one software driver. Coverage of the texture may differ at pixels whose
centers lie on an edge of a triangle: these are counted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from fixtures.packed_scenes import as_packed
from numpy.typing import NDArray
from twins.relief_growth import window as grown_window

from model.microstructure import FOREHEAD
from model.microstructure.convolution import LineKernels, convolve
from model.microstructure.map_windows import MapWindow
from model.microstructure.mesh_strain import MeshStrain, strain
from model.microstructure.strain_fields import TextureStrain, line_kernels, rasterize
from skinrig.viewer.microstructure.relief_growth import GrownRelief

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class WindowReference:
    """Everything of a window, row 0 at the top."""

    window: MapWindow
    size: int
    fields: TextureStrain
    kernels: tuple[LineKernels, LineKernels]
    relief: Float32
    convolved_s: Float32
    convolved: Float32
    tensor: NDArray[np.float64]
    metric: NDArray[np.float64]


def mesh_strain(scene: Any, weights: dict[str, float]) -> tuple[Any, MeshStrain]:
    """Return the mesh as the page holds it, and its strain."""
    mesh = as_packed(scene).mesh
    rest = mesh.vertices_mm.astype(np.float64)
    moved = rest + sum(w * mesh.shapes[n].astype(np.float64) for n, w in weights.items())
    return mesh, strain(rest, np.asarray(moved), mesh.faces, mesh.uv)


def growth(scene: Any) -> GrownRelief:
    """Return what the page grows its relief from."""
    facts = scene.facts["microstructure"]
    patch = as_packed(scene).textures["relief_patch"].values[..., 0]
    return GrownRelief(patch, facts["pixel_um"], facts["cell_px"], facts["seed"])


def window_reference(
    scene: Any, weights: dict[str, float], place: list[float], side: int, sampling: str
) -> WindowReference:
    """Return the model's window where the page has its own."""
    facts = scene.facts["microstructure"]
    level = int(place[2])
    size = facts["virtual_px"] >> level
    left, bottom = int(place[0]), int(place[1])
    window = MapWindow(size - bottom - side, size - bottom, left, left + side)
    mesh, found = mesh_strain(scene, weights)
    fields = rasterize(found, mesh.faces, mesh.uv, (size, size), window=window)
    s, t = line_kernels(fields, FOREHEAD)
    relief = grown_window(growth(scene), window.top, window.left, (side, side), level=level)
    still = np.zeros_like(t.alpha)
    one = convolve(
        relief, s.axis, t.axis, s.alpha, s.sigma_px, still, t.sigma_px, sampling=sampling
    )  # type: ignore[arg-type]
    two = convolve(
        relief, s.axis, t.axis, s.alpha, s.sigma_px, t.alpha, t.sigma_px, sampling=sampling
    )  # type: ignore[arg-type]
    tensor, metric = fields_of(found, mesh, size, window)
    return WindowReference(window, size, fields, (s, t), relief, one, two, tensor, metric)


def fields_of(
    found: MeshStrain, mesh: Any, size: int, window: MapWindow
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return T - 1 and the texture's metric at pixels, between vertices; NaN outside of faces.

    Written for tests: each triangle over all pixels of its box.
    """
    shape = window.shape
    out = np.full((*shape, 6), np.nan)
    x = mesh.uv[:, 0].astype(np.float64) * size - 0.5 - window.left
    y = (1.0 - mesh.uv[:, 1].astype(np.float64)) * size - 0.5 - window.top
    values = np.concatenate([found.tensor, found.uv_metric], axis=1)
    for face in mesh.faces[::-1]:
        if not found.valid[face].all():
            continue
        low_x, high_x = max(int(np.ceil(x[face].min())), 0), int(np.floor(x[face].max()))
        low_y, high_y = max(int(np.ceil(y[face].min())), 0), int(np.floor(y[face].max()))
        if low_x >= shape[1] or low_y >= shape[0] or high_x < low_x or high_y < low_y:
            continue
        columns = np.arange(low_x, min(high_x, shape[1] - 1) + 1)
        rows = np.arange(low_y, min(high_y, shape[0] - 1) + 1)
        if not (columns.size and rows.size):
            continue
        edges = np.array([x[face[1:]] - x[face[0]], y[face[1:]] - y[face[0]]])
        if np.linalg.det(edges) == 0.0:
            continue
        inverse = np.linalg.inv(edges)
        to = np.stack(np.meshgrid(columns - x[face[0]], rows - y[face[0]]), axis=-1)
        weights = to @ inverse.T
        inside = (weights >= 0.0).all(axis=2) & (weights.sum(axis=2) <= 1.0)
        corner = values[face]
        here = corner[0] + weights @ (corner[1:] - corner[0])
        part = out[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        part[inside] = here[inside]
    return out[..., :3], out[..., 3:]


def slopes(
    height_um: Float32, tensor: NDArray[np.float64], metric: NDArray[np.float64], size: int
) -> NDArray[np.float64]:
    """Return n_x / n_z and n_y / n_z of a relief on the moved skin; rows count downward."""
    h = np.asarray(height_um, np.float64)
    inner = np.stack(
        [0.5 * (h[1:-1, 2:] - h[1:-1, :-2]), -0.5 * (h[2:, 1:-1] - h[:-2, 1:-1])], axis=-1
    )
    gradient = np.zeros((*h.shape, 2))
    gradient[1:-1, 1:-1] = 1e-3 * size * inner  # mm per unit of u and of v
    a, b, c = np.moveaxis(metric, -1, 0)
    on_rest = np.stack(
        [a * gradient[..., 0] + b * gradient[..., 1], b * gradient[..., 0] + c * gradient[..., 1]],
        axis=-1,
    )
    stretch = np.empty((*h.shape, 2, 2))
    stretch[..., 0, 0], stretch[..., 1, 1] = 1.0 + tensor[..., 0], 1.0 + tensor[..., 2]
    stretch[..., 0, 1] = stretch[..., 1, 0] = tensor[..., 1]
    stretch[np.isnan(stretch).any(axis=(2, 3))] = np.eye(2)
    return -np.einsum("...ij,...j->...i", np.linalg.inv(stretch), on_rest)


SIDE = 256
ALL = (
    "relief",
    "window_cover",
    "window_pad",
    "window_tensor",
    "window_metric",
    "kernel_s",
    "kernel_t",
    "convolved_s",
    "convolved",
    "microstructure",
)


def show(viewer: Any, scene: Any, weights: dict[str, float], at: Any, **more: Any) -> list[float]:
    """Show a pose with the window held, and return where the window is."""
    rest = dict.fromkeys(scene.mesh.shapes, 0.0)
    told = viewer.set(
        weights=rest | weights,
        microstructure_at=at,
        microstructure_window_px=SIDE,
        microstructure=2,
        **more,
    )
    return list(told["microstructure_place"])


def close(
    found: Any, expected: Any, where: Any, *, median: float, p999: float, most: float
) -> None:
    """Compare by median, 99.9th percentile and the largest difference."""
    error = np.abs(np.asarray(found, np.float64) - expected)[where]
    got = (np.median(error), np.percentile(error, 99.9), error.max())
    assert error.size > 1000
    assert all(g <= b for g, b in zip(got, (median, p999, most), strict=True)), got


def inner(reach_px: int) -> NDArray[np.bool_]:
    """Return the window without the margin that both passes reach across."""
    mask = np.zeros((SIDE, SIDE), bool)
    mask[2 * reach_px : -2 * reach_px, 2 * reach_px : -2 * reach_px] = True
    return mask


@pytest.mark.long
@pytest.mark.parametrize(
    ("weights", "at", "sampling"),
    [
        ({"anger": 0.8}, [0.5, 0.75, 0], "cubic"),
        ({"anger": 0.8}, [0.5, 0.75, 0], "linear"),
        ({"happiness": 1.0}, [0.35, 0.45, 1], "cubic"),
        ({"surprise": 0.7, "smile": 0.4}, [0.5, 0.7, 3], "cubic"),
    ],
    ids=["forehead", "forehead bilinear", "cheek", "coarse"],
)
def test_strained_window_buffers_match_model(viewer, procedural_scene, weights, at, sampling):
    number = {"linear": 0, "cubic": 1}[sampling]
    place = show(viewer, procedural_scene, weights, at, microstructure_sampling=number)
    assert place[2:] == [at[2], 1]
    got = {name: viewer.read(name) for name in ALL}
    want = window_reference(procedural_scene, weights, place, SIDE, sampling)
    covered, known = want.fields.covered, want.fields.covered | want.fields.padded
    assert np.count_nonzero((got["window_cover"][..., 0] > 0.5) != covered) <= 1e-3 * SIDE**2
    assert np.count_nonzero((got["window_pad"][..., 3] > 0.5) != known) <= 1e-3 * SIDE**2
    inside = covered & (got["window_cover"][..., 0] > 0.5) & np.isfinite(want.tensor[..., 0])
    close(got["window_tensor"][..., :3], want.tensor, inside, median=3e-5, p999=3e-4, most=5e-4)
    close(got["window_metric"][..., :3], want.metric, inside, median=1e-7, p999=3e-6, most=5e-6)
    everywhere = np.ones((SIDE, SIDE), bool)
    close(got["relief"][..., 0], want.relief, everywhere, median=3e-4, p999=0.02, most=0.05)
    for name, lines in zip(("kernel_s", "kernel_t"), want.kernels, strict=True):
        kernel = got[name]
        # the sign of an axis means nothing; rows of the page's axes count upward
        cosine = np.abs(np.sum(kernel[..., :2] * [1.0, -1.0] * lines.axis, axis=2))
        close(cosine, 1.0, inside, median=1e-6, p999=1e-4, most=1e-3)
        close(kernel[..., 2], lines.alpha, inside, median=2e-4, p999=2e-3, most=4e-3)
        # sigma jumps from one line to the other at a ratio of 1, where alpha is 0
        steady = inside & (np.abs(lines.alpha) > 5e-3)
        close(kernel[..., 3], lines.sigma_px, steady, median=2e-4, p999=1e-3, most=2e-3)
    facts = procedural_scene.facts["microstructure"]
    middle = inner(facts["reach_px"])
    for name, height in (("convolved_s", want.convolved_s), ("convolved", want.convolved)):
        close(got[name][..., 0], height, middle, median=5e-4, p999=0.03, most=0.08)
    for channels, height in ((slice(0, 2), want.convolved), (slice(2, 4), want.relief)):
        expected = slopes(height, want.tensor, want.metric, want.size)
        close(
            got["microstructure"][..., channels],
            expected,
            middle & inside,
            median=3e-4,
            p999=3e-3,
            most=8e-3,
        )
    if at[2] == 0:  # and the bounds above tell the convolution from none at all
        moved = np.abs(want.convolved - want.relief)[middle]
        assert np.median(moved) > 100 * 5e-4
        assert np.percentile(moved, 99.9) > 10 * 0.03


@pytest.mark.long
def test_strain_continues_around_island_border_as_in_model(open_page, procedural_scene):
    from skinrig.viewer import page

    mesh = procedural_scene.mesh
    middle = mesh.uv[mesh.faces].mean(axis=1)
    kept = np.hypot(*(middle - [0.5, 0.7]).T) > 0.03
    scene = replace(procedural_scene, mesh=replace(mesh, faces=mesh.faces[kept]))
    viewer = open_page(page.build(scene))
    weights = {"surprise": 1.0}
    place = show(viewer, scene, weights, [0.5, 0.7, 3])
    want = window_reference(scene, weights, place, SIDE, "cubic")
    fields = want.fields
    assert 0.2 < fields.covered.mean() < 0.95
    assert np.count_nonzero(fields.padded) > 300
    differs = (viewer.read("window_cover")[..., 0] > 0.5) != fields.covered
    assert np.count_nonzero(differs) <= 1e-3 * SIDE**2
    known = viewer.read("window_pad")[..., 3] > 0.5
    assert np.count_nonzero(known != (fields.covered | fields.padded)) <= 1e-3 * SIDE**2
    found = [viewer.read(name)[..., 2] for name in ("kernel_s", "kernel_t")]
    for alpha, lines in zip(found, want.kernels, strict=True):
        error = np.abs(alpha - lines.alpha)[fields.padded & known]
        # a pixel whose coverage differs carries its values to few others
        assert np.median(error) < 1e-3
        assert np.mean(error > 5e-3) < 0.01
        # and its neighbors' values are not all alike: carrying on the wrong ones would show
        assert np.std(lines.alpha[fields.padded]) > 0.02
    assert viewer.problems == []


@pytest.mark.long
def test_whole_texture_strain_matches_model(viewer, procedural_scene):
    weights = {"disgust": 1.0}
    show(viewer, procedural_scene, weights, None)
    found = viewer.read("strain")
    mesh, at_vertices = mesh_strain(procedural_scene, weights)
    want = rasterize(at_vertices, mesh.faces, mesh.uv, found.shape[:2], pad_px=0)
    inside = want.covered & (viewer.read("strain_tensor")[..., 3] > 0.5)
    assert np.count_nonzero(inside != want.covered) <= 2e-3 * inside.size
    # rasters snap vertices to 1/256 of a pixel, which small triangles with steep strain show
    close(found[..., :2], want.stretch, inside, median=1e-5, p999=1e-3, most=1e-2)
    apart = inside & (want.stretch[..., 0] - want.stretch[..., 1] > 0.01)
    cosine = np.abs(np.sum(found[..., 2:] * [1.0, -1.0] * want.axes[..., 0, :], axis=2))
    close(cosine, 1.0, apart, median=1e-6, p999=1e-3, most=2e-2)
    assert np.ptp(want.stretch[inside]) > 0.3


@pytest.mark.long
def test_pose_convolution_runs_once_despite_light_camera_motion(viewer, procedural_scene):
    show(viewer, procedural_scene, {"anger": 1.0}, [0.5, 0.75, 0])

    def draws() -> dict[str, int]:
        passes = viewer.page.evaluate("() => window.viewer.statistics.passes")
        return {name: passes[name]["draws"] for name in ("convolved", "relief", "surface")}

    before = draws()
    viewer.set(light_azimuth_deg=-20.0)
    viewer.set(camera_yaw_deg=10.0)
    after = draws()
    assert after["surface"] == before["surface"] + 2
    assert after["convolved"] == before["convolved"]
    viewer.set(weights={"anger": 0.9})
    last = draws()
    assert last["convolved"] == after["convolved"] + 1
    assert last["relief"] == before["relief"]


@pytest.mark.long
def test_split_view_shows_static_and_moved_microstructure(viewer, procedural_scene):
    rest = dict.fromkeys(procedural_scene.mesh.shapes, 0.0)
    viewer.set(
        weights=rest | {"anger": 1.0},
        camera_distance_mm=150.0,
        camera_fov_deg=8.0,
        camera_target_mm=[0.0, 40.0, 0.0],
        microstructure_window_px=512,
    )
    pictures = []
    for mode in (0, 1, 2, 3):
        told = viewer.set(microstructure=mode)
        assert told["microstructure_place"][3] == 1
        pictures.append(viewer.read("specular")[..., 0])
    width = pictures[0].shape[1]
    thirds = [
        slice(2, width // 3 - 2),
        slice(width // 3 + 2, 2 * width // 3 - 2),
        slice(2 * width // 3 + 2, width - 2),
    ]
    for mode, columns in enumerate(thirds):
        np.testing.assert_array_equal(pictures[3][:, columns], pictures[mode][:, columns])
        for other in {0, 1, 2} - {mode}:
            assert np.abs(pictures[other] - pictures[mode])[:, columns].mean() > 1e-4
