"""A small face of a dome: a bulging patch with a texture that tells its corners apart."""

from types import SimpleNamespace

import numpy as np
import pytest

from model import store
from model.brdf import recipe as brdf_recipe
from model.brdf import tables as brdf_tables
from model.skin import SkinAppearance, SkinMap
from model.skin_reflectance import BASIS_FILE
from reconstruction.pipeline.dome.lobes import _basis_bytes
from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import build_mesh
from skinrig.exporting.materials.tangents import FramedMesh

collect_ignore = ["materials/read_in_blender.py"]  # of Blender's Python

SIDE, GRID = 64, 13
MATERIALS = ("ggx 0.22 eta 1.4", "ggx 0.4 eta 1.4")
CONSENT = {"pseudonym": "P042", "consent_scope": ["research"], "consent_expires": "2030-01-01"}


def bulging_mesh(shapes=False):
    """100 mm wide, rising 30 mm towards +z in the middle; u runs along x, v along y."""
    u, v = np.meshgrid(np.linspace(0, 1, GRID), np.linspace(0, 1, GRID))
    x, y = 100 * (u - 0.5), 100 * (v - 0.5)
    z = 30 * np.cos(np.pi * (u - 0.5)) * np.cos(np.pi * (v - 0.5))
    points = np.stack([x, y, z], -1).reshape(-1, 3)
    corner = np.arange(GRID * GRID).reshape(GRID, GRID)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    moved = {}
    if shapes:
        moved = {"jawOpen": np.zeros_like(points), "smile left": 0.02 * points}
        moved["jawOpen"][: len(points) // 2] = (0.0, -8.0, 1.0)
    uv = np.stack([u, v], -1).reshape(-1, 2)
    return build_mesh(points, faces, uv, shapes=moved)


def bumpy(normals, seed=3):
    """Normals turned by up to some 15 degrees, as relief does."""
    rng = np.random.default_rng(seed)
    turned = normals + 0.15 * rng.standard_normal(normals.shape)
    return (turned / np.linalg.norm(turned, axis=-1, keepdims=True)).astype(np.float32)


def face(**more):
    """Return the appearance of the patch; keywords replace fields."""
    mesh = bulging_mesh()
    atlas = unwrap(mesh, SIDE)
    rows, columns = np.mgrid[0:SIDE, 0:SIDE] / SIDE
    r_d = np.stack([0.5 + 0.2 * columns, 0.3 + 0.2 * rows, 0.2 + 0.1 * columns], -1)
    valid = atlas.covered.copy()
    valid[:4, :4] = False  # the corner at u = 0, v = 1 is not known
    every = dict(brdf_recipe.materials())
    materials = brdf_tables.tabulate({name: every[name] for name in MATERIALS})
    mix = np.eye(2)
    oily = (columns < 0.5).astype(np.float32)
    depth = np.stack([2.0 + rows, 1.0 + 0.0 * rows, 0.5 + 0.0 * rows], -1)
    stderr = np.full((SIDE, SIDE, 3), 0.01)
    maps = {
        "position": SkinMap(atlas.position_mm, "mm", valid=valid),
        "normals": SkinMap(bumpy(atlas.normal), "1", stderr, valid, "world frame"),
        "r_d": SkinMap(r_d, "1", stderr, valid, "camera RGB over that of a perfect white"),
        "basis_weight_0": SkinMap(0.8 * oily, "1", stderr[..., 0], valid),
        "basis_weight_1": SkinMap(0.6 * (1.0 - oily), "1", stderr[..., 0], valid),
        "translucency": SkinMap(depth, "mm", 5 * stderr, valid),
    }
    files = {
        BASIS_FILE: _basis_bytes(materials, 2, {2: (mix, 0.0)}),
        "mesh.obj": FramedMesh.of(mesh).to_obj(1.0, "mm").encode(),
    }
    fields = {"maps": maps, "source": "simulated", "files": files, "seed": 5, **more}
    return SkinAppearance(**fields)


@pytest.fixture(scope="session")
def patch():
    """What the small face is made by, for tests that need another."""
    return SimpleNamespace(
        mesh=bulging_mesh, bumpy=bumpy, face=face, consent=CONSENT, side=SIDE, materials=MATERIALS
    )


@pytest.fixture(scope="session")
def simulated_face():
    return face()


@pytest.fixture(scope="session")
def face_folder(simulated_face, tmp_path_factory):
    return store.write(tmp_path_factory.mktemp("face") / "appearance", simulated_face)


@pytest.fixture(scope="session")
def shapes_file(tmp_path_factory):
    """The same mesh with two blend shapes, as .npz."""
    mesh = bulging_mesh(shapes=True)
    path = tmp_path_factory.mktemp("mesh") / "shapes.npz"
    np.savez(
        path,
        vertices_mm=mesh.vertices_mm,
        faces=mesh.faces,
        uv=mesh.uv,
        shape_names=np.array(list(mesh.shapes)),
        shape_deltas_mm=np.stack([*mesh.shapes.values()]),
    )
    return path
