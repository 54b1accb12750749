"""Samples of surface points: their values, their directions, and which of them count."""

import dataclasses
import tracemalloc

import numpy as np
import pytest
import trimesh

from reconstruction.lumitexels.ray_casting import RayCaster
from reconstruction.lumitexels.samples import SampledSurface, compute_visibility
from reconstruction.lumitexels.store import LumitexelStore

RADIUS = 80.0


def gather(surface, *, images, **settings):
    """Return the samples of a whole surface, whose images are given by view and light."""
    store = LumitexelStore(surface, **settings, dtype=np.float32)
    for view in range(store.view_count):
        for light in range(store.light_count):
            image = images(view, light)
            if image is not None:
                store.add(view, light, *image)
    return store.chunk(0, len(surface))


FOCAL_PX, WIDTH, HEIGHT = 500.0, 200, 160


@dataclasses.dataclass(frozen=True)
class Pinhole:
    """A camera of these tests, looking at the origin, x right and y down in the image."""

    center_mm: np.ndarray

    def axes(self):
        back = self.center_mm / np.linalg.norm(self.center_mm)
        right = np.cross([0.0, 1.0, 0.0], back)
        right /= np.linalg.norm(right)
        return right, np.cross(back, right), back

    def project(self, points_mm):
        right, up, back = self.axes()
        local = np.asarray(points_mm) - self.center_mm
        depth = -(local @ back)
        scale = np.where(depth > 0, FOCAL_PX / np.where(depth > 0, depth, 1.0), np.nan)
        return np.stack(
            [(WIDTH - 1) / 2 + scale * (local @ right), (HEIGHT - 1) / 2 - scale * (local @ up)],
            axis=-1,
        )

    def sphere(self):
        """Return where the rays of all pixels meet the sphere, NaN where they do not."""
        right, up, back = self.axes()
        row, column = np.mgrid[0:HEIGHT, 0:WIDTH]
        way = (
            (column - (WIDTH - 1) / 2)[..., None] * right
            - (row - (HEIGHT - 1) / 2)[..., None] * up
            - FOCAL_PX * back
        )
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
        along = way @ self.center_mm
        inside = along**2 - self.center_mm @ self.center_mm + RADIUS**2
        root = np.sqrt(np.where(inside > 0, inside, np.nan))
        return self.center_mm + (-along - root)[..., None] * way


@dataclasses.dataclass(frozen=True)
class Points:
    """Lights that shine alike in all directions."""

    position_mm: np.ndarray
    intensity: np.ndarray

    def irradiance(self, points_mm):
        way = self.position_mm[:, None] - np.asarray(points_mm)[None]
        distance = np.linalg.norm(way, axis=-1, keepdims=True)
        return way / distance, self.intensity[:, None] / distance**2


CAMERAS = [Pinhole(np.array(c)) for c in ([0.0, 0, 500], [300.0, 100, 400])]
LIGHTS = Points(
    np.array([[0.0, 300, 600], [-500, 0, 300], [400, -200, 500], [0, 0, -700.0]]),
    np.array([[4e5, 5e5, 6e5]] * 4),
)
ALBEDO = np.array([0.7, 0.4, 0.2])
SPHERE = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
CASTER = RayCaster(SPHERE.vertices, SPHERE.faces)


def surface(stride=25):
    points = SPHERE.vertices[::stride]
    return SampledSurface(points, points / RADIUS)


def lambertian(view, light, *, lights=LIGHTS, camera=None):
    """Return what a camera sees of a Lambertian sphere, written out here."""
    points = (camera or CAMERAS[view]).sphere()
    way, white = lights.irradiance(points.reshape(-1, 3))
    way, white = (x[light].reshape(HEIGHT, WIDTH, 3) for x in (way, white))
    cosine = np.einsum("hwk,hwk->hw", way, points / RADIUS)
    # pixels beyond the silhouette hold nothing that can be used
    return np.where(np.isfinite(points), ALBEDO * white * np.clip(cosine, 0, 1)[..., None], np.nan)


def image(view, light):
    signal = lambertian(view, light)
    return signal, np.full_like(signal, 1e-4), None


def test_lambertian_sphere_samples_are_albedo_over_pi():
    """Bilinear sampling on a sphere errs by curvature; well inside it is far below 0.5 %."""
    found = gather(surface(), cameras=CAMERAS, lights=LIGHTS, images=image, caster=CASTER)
    inner = found.valid & (found.cos_light > 0.3) & (found.cos_view > 0.4)
    assert inner.sum() > 200
    np.testing.assert_allclose(
        found.f[inner], np.broadcast_to(ALBEDO / np.pi, found.f[inner].shape), rtol=5e-3
    )
    # wrong lights give wrong samples: the test can fail
    dim = dataclasses.replace(LIGHTS, position_mm=LIGHTS.position_mm * 1.1)
    wrong = gather(surface(), cameras=CAMERAS, lights=dim, images=image, caster=CASTER)
    assert np.abs(wrong.f[inner] / (ALBEDO / np.pi) - 1).mean() > 0.05


def test_directions_and_cosines_are_those_of_geometry():
    where = surface()
    found = gather(where, cameras=CAMERAS, lights=LIGHTS, images=image, caster=CASTER)
    for sample in range(8):
        light = LIGHTS.position_mm[found.light[sample]] - where.points_mm
        view = CAMERAS[found.view[sample]].center_mm - where.points_mm
        for got, way in ((found.light_dir, light), (found.view_dir, view)):
            want = way / np.linalg.norm(way, axis=1, keepdims=True)
            np.testing.assert_allclose(got[:, sample], want, atol=1e-6)
    np.testing.assert_allclose(
        found.cos_light, np.einsum("pmk,pk->pm", found.light_dir, where.normals), atol=1e-6
    )
    assert found.light.tolist() == [0, 1, 2, 3] * 2
    assert found.view.tolist() == [0] * 4 + [1] * 4


def test_point_counts_only_when_facing_light_and_camera():
    found = gather(surface(5), cameras=CAMERAS, lights=LIGHTS, images=image, caster=CASTER)
    assert (found.cos_light[found.valid] > 0.1).all()
    assert (found.cos_view[found.valid] > 0.1).all()
    behind = found.light == 3
    assert not (found.valid[:, behind] & (found.cos_light[:, behind] < 0)).any()
    np.testing.assert_array_equal(found.f[~found.valid], 0.0)
    assert np.isinf(found.variance[~found.valid]).all()


def test_occluder_before_light_removes_only_its_samples():
    where = surface(5)
    barrier = trimesh.creation.box(extents=(30, 30, 1)).apply_translation(
        0.5 * LIGHTS.position_mm[2]
    )
    both = trimesh.util.concatenate([SPHERE, barrier])
    centers = np.array([c.center_mm for c in CAMERAS])
    free, shaded = (
        compute_visibility(where, c, cameras_mm=centers, lights_mm=LIGHTS.position_mm)
        for c in (CASTER, RayCaster(both.vertices, both.faces))
    )
    np.testing.assert_array_equal(free.light[[0, 1, 3]], shaded.light[[0, 1, 3]])
    lost = free.light[2] & ~shaded.light[2]
    # closed form: where the way to the light meets the box
    way = LIGHTS.position_mm[2] - where.points_mm
    middle = 0.5 * LIGHTS.position_mm[2]
    at = where.points_mm + way * ((middle[2] - where.points_mm[:, 2]) / way[:, 2])[:, None]
    off = np.abs(at - middle)[:, :2].max(axis=1)
    assert 10 < lost.sum() < free.light[2].sum()
    assert lost[(off < 14) & free.light[2]].all()
    assert not lost[off > 16].any()
    rim = compute_visibility(
        where,
        RayCaster(both.vertices, both.faces),
        cameras_mm=centers,
        lights_mm=LIGHTS.position_mm,
        light_radius_mm=20.0,
    )
    assert (rim.light[2] <= shaded.light[2]).all()
    assert rim.light[2].sum() < shaded.light[2].sum()


def test_bad_and_missing_pixels_take_their_samples():
    def spoiled(view, light):
        signal, variance, _ = image(view, light)
        if (view, light) == (1, 2):
            return None
        good = np.ones((HEIGHT, WIDTH), bool)
        good[:, : WIDTH // 2] = view == 1
        return signal, variance, good

    where = surface(5)
    whole = gather(where, cameras=CAMERAS, lights=LIGHTS, images=image, caster=CASTER)
    found = gather(where, cameras=CAMERAS, lights=LIGHTS, images=spoiled, caster=CASTER)
    assert not found.valid[:, (found.view == 1) & (found.light == 2)].any()
    rest = (found.view == 1) & (found.light != 2)
    np.testing.assert_array_equal(found.valid[:, rest], whole.valid[:, rest])
    column = CAMERAS[0].project(where.points_mm)[:, 0]
    kept = found.valid[:, found.view == 0].any(axis=1)
    assert not kept[column < WIDTH // 2].any()
    assert kept[column > WIDTH // 2].any()


@pytest.mark.long
def test_variances_are_those_of_noisy_samples(rng):
    """One light 400 times: variance of the samples over their variance within 4 deviations.

    The mean over about 70 points of ratios of deviation sqrt(2 / 400) each; neighbours share
    pixels, so 30 of them count as independent: 4 deviations are 0.05.
    """
    where = surface(40)
    sigma = 0.01
    signal = lambertian(0, 0)
    lights = Points(
        np.tile(LIGHTS.position_mm[:1], (400, 1)), np.tile(LIGHTS.intensity[:1], (400, 1))
    )
    variance = np.full_like(signal, sigma**2)
    found = gather(
        where,
        cameras=CAMERAS[:1],
        lights=lights,
        images=lambda v, m: (signal + sigma * rng.standard_normal(signal.shape), variance, None),
        caster=CASTER,
    )
    valid = found.valid[:, 0]
    ratio = np.var(found.f, axis=1, ddof=1)[valid] / found.variance[valid, 0]
    assert valid.sum() > 50
    assert ratio.mean() == pytest.approx(1.0, abs=0.05)


def test_moved_subject_with_known_poses_gives_rest_samples():
    """The sphere is turned and shifted 3 mm before each frame; only the shift shows in images."""
    angle = 0.02
    turn = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    poses = np.tile(np.eye(4), (4, 1, 1))
    shifts = np.array([[3.0, 0, 0], [0, 3, 0], [0, 0, 3], [2, -2, 1]])
    poses[:, :3, :3], poses[:, :3, 3] = turn, shifts

    def moved(view, light):
        away = -shifts[light]  # the camera's and the light's shift against the sphere
        camera = _Shifted(CAMERAS[view], away)
        lights = dataclasses.replace(LIGHTS, position_mm=LIGHTS.position_mm + away)
        signal = lambertian(view, light, lights=lights, camera=camera)
        return signal, np.full_like(signal, 1e-4), None

    words = {"cameras": CAMERAS, "lights": LIGHTS, "images": moved, "caster": CASTER}
    known = gather(surface(), poses=poses, **words)
    by_frame = gather(surface(), poses=np.concatenate([poses, poses]), **words)
    ignored = gather(surface(), **words)
    inner = known.valid & (known.cos_light > 0.4) & (known.cos_view > 0.4)
    assert inner.sum() > 100
    errors = [np.abs(x.f[inner] / (ALBEDO / np.pi) - 1) for x in (known, ignored)]
    assert errors[0].max() < 5e-3
    assert errors[1].mean() > 5 * errors[0].mean()
    np.testing.assert_array_equal(known.f, by_frame.f)
    # directions are given in the frame of the points
    there = np.einsum(
        "mji,mpj->mpi",
        np.tile(poses[:, :3, :3], (2, 1, 1)),
        np.tile(LIGHTS.position_mm - shifts, (2, 1))[:, None] - surface().points_mm[None] @ turn.T,
    )
    there /= np.linalg.norm(there, axis=-1, keepdims=True)
    np.testing.assert_allclose(known.light_dir, there.swapaxes(0, 1), atol=1e-6)


@dataclasses.dataclass(frozen=True)
class _Shifted:
    """A camera moved beside another without turning."""

    camera: Pinhole
    shift: np.ndarray

    def sphere(self):
        right, up, back = self.camera.axes()
        center = self.camera.center_mm + self.shift
        row, column = np.mgrid[0:HEIGHT, 0:WIDTH]
        way = (
            (column - (WIDTH - 1) / 2)[..., None] * right
            - (row - (HEIGHT - 1) / 2)[..., None] * up
            - FOCAL_PX * back
        )
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
        along = way @ center
        inside = along**2 - center @ center + RADIUS**2
        return center + (-along - np.sqrt(np.where(inside > 0, inside, np.nan)))[..., None] * way


def test_binned_image_is_read_at_cell_centers():
    """A ramp over the columns: cell k of width 2 stands for pixel 2 k + 0.5."""
    ramp = np.broadcast_to(2 * np.arange(WIDTH // 2) + 0.5, (HEIGHT // 2, WIDTH // 2))
    signal = np.repeat(ramp[..., None], 3, axis=-1).astype(np.float32)
    where = surface(40)
    found = gather(
        where,
        cameras=CAMERAS[:1],
        lights=LIGHTS,
        images=lambda v, m: (signal, np.ones_like(signal), None),
        caster=CASTER,
        binning=2,
    )
    _, white = LIGHTS.irradiance(where.points_mm)
    seen = (found.f * np.pi * white.swapaxes(0, 1) * found.cos_light[..., None])[found.valid]
    column = np.broadcast_to(CAMERAS[0].project(where.points_mm)[:, :1], found.valid.shape)
    np.testing.assert_allclose(seen[:, 1], column[found.valid], rtol=1e-4)


def test_disk_store_gives_same_samples_chunk_by_chunk(tmp_path):
    where = surface(5)
    words = {"cameras": CAMERAS, "lights": LIGHTS, "caster": CASTER}
    whole = gather(where, images=image, **words)
    store = LumitexelStore(where, folder=tmp_path, **words)
    for view in range(2):
        for light in range(4):
            store.add(view, light, *image(view, light))
    covered = 0
    for rows, part in store.chunks(77):
        np.testing.assert_array_equal(part.valid, whole.valid[rows])
        np.testing.assert_array_equal(part.light_dir, whole.light_dir[rows])
        np.testing.assert_allclose(part.f, whole.f[rows], rtol=1.5e-3)
        spread = np.sqrt(part.variance[part.valid] / whole.variance[rows][part.valid])
        np.testing.assert_allclose(spread, 1.0, rtol=1.5e-3)
        covered += len(part.valid)
    assert covered == len(where)


@pytest.mark.parametrize("on_disk", [False, True])
def test_view_of_interrupted_store_gives_same_samples(tmp_path, on_disk):
    """The second store reads one view's images; the other's samples come from the first store."""
    where, folder = surface(5), tmp_path if on_disk else None
    words = {"cameras": CAMERAS, "lights": LIGHTS, "caster": CASTER, "folder": folder}

    def fill(store, view):
        for light in range(4):
            store.add(view, light, *image(view, light))

    interrupted = LumitexelStore(where, **words)
    fill(interrupted, 0)
    samples = interrupted.view_samples(0)
    assert (samples.table is None) == on_disk
    whole = LumitexelStore(where, **(words | {"folder": None}))
    resumed = LumitexelStore(where, **words)
    for view in range(2):
        fill(whole, view)
    resumed.put_view(0, samples)
    fill(resumed, 1)
    expected, found = whole.chunk(0, len(where)), resumed.chunk(0, len(where))
    assert expected.valid.any()
    for field in dataclasses.fields(expected):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(expected, field.name))


def test_requested_samples_are_kept_until_new_image_arrives(tmp_path, monkeypatch):
    where = surface(5)
    words = {"cameras": CAMERAS, "lights": LIGHTS, "caster": CASTER}

    def filled(folder=None):
        store = LumitexelStore(where, folder=folder, **words)
        for view in range(2):
            for light in range(4):
                store.add(view, light, *image(view, light))
        return store

    store = filled()
    first = [part for _, part in store.chunks(77)]
    assert all(a is b for a, (_, b) in zip(first, store.chunks(77), strict=True))
    signal, *rest = image(1, 2)
    store.add(1, 2, 2.0 * signal, *rest)
    changed = store.chunk(0, 77)
    there = first[0].valid & (first[0].view == 1) & (first[0].light == 2)
    assert there.any()
    np.testing.assert_allclose(changed.f[there], 2.0 * first[0].f[there], rtol=2e-3)
    # what is too large to keep, or on disk, is put together anew, and the same
    on_disk = filled(tmp_path)
    assert on_disk.chunk(0, 77) is not on_disk.chunk(0, 77)
    monkeypatch.setattr("reconstruction.lumitexels.store.MAX_CACHED_BYTES", 0)
    large = filled()
    assert large.chunk(0, 77) is not large.chunk(0, 77)
    np.testing.assert_array_equal(large.chunk(0, 77).f, first[0].f)


def test_memory_does_not_grow_with_the_tables(tmp_path):
    """Four times the points: memory grows by less than a quarter of what the tables on disk do."""
    points = trimesh.creation.icosphere(subdivisions=6, radius=RADIUS).vertices
    angles = np.linspace(-1, 1, 60)
    lights = Points(
        700 * np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1), np.ones((60, 3))
    )
    flat = np.ones((HEIGHT, WIDTH, 3), np.float32)
    peaks, tables = [], []
    for count in (5_000, 20_000):
        where = SampledSurface(points[:count], points[:count] / RADIUS)
        folder = tmp_path / f"{count}"
        folder.mkdir()
        tracemalloc.start()
        try:
            store = LumitexelStore(
                where, cameras=CAMERAS, lights=lights, caster=CASTER, folder=folder
            )
            for view in range(len(CAMERAS)):
                for light in range(60):
                    store.add(view, light, flat, flat)
            samples = sum(int(part.valid.sum()) for _, part in store.chunks(500))
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
        tables.append(sum(file.stat().st_size for file in folder.iterdir()))
        assert samples > count
    assert peaks[1] - peaks[0] < 0.25 * (tables[1] - tables[0])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"poses": np.eye(4)[None]}, "poses: got shape"),
        ({"poses": np.tile(2 * np.eye(4), (4, 1, 1))}, "not rigid"),
        ({"binning": 0}, "binning"),
    ],
)
def test_arguments_that_do_not_fit_are_named(change, says):
    words = {"cameras": CAMERAS, "lights": LIGHTS, "images": image, "caster": CASTER}
    with pytest.raises(ValueError, match=says):
        gather(surface(), **words, **change)


def test_surface_requires_unit_normal_per_point():
    with pytest.raises(ValueError, match="lengths of normals: got"):
        SampledSurface(np.zeros((2, 3)), np.ones((2, 3)))
    with pytest.raises(ValueError, match="normals: got"):
        SampledSurface(np.zeros((2, 3)), np.zeros((3, 3)))
    with pytest.raises(ValueError, match="finite"):
        SampledSurface(np.full((2, 3), np.nan), np.zeros((2, 3)))


def test_point_inside_mesh_has_no_valid_samples():
    where = SampledSurface(np.zeros((1, 3)), np.array([[0.0, 0, 1]]))
    found = gather(where, cameras=CAMERAS, lights=LIGHTS, images=image, caster=CASTER)
    assert not found.valid.any()
