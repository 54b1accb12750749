"""Small faces in the format of a dome's maps, with traits that are known."""

import io
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from model import store
from model.brdf import tables as brdf_tables
from model.skin import SkinAppearance, SkinMap

SIZE = 64
MARKS = {
    "nose tip": (0, 0),
    "nose bridge": (0, 30),
    "nose wing left": (-18, -5),
    "nose wing right": (18, -5),
    "eye inner left": (-20, 33),
    "eye inner right": (20, 33),
    "eye outer left": (-55, 34),
    "eye outer right": (55, 34),
    "upper lip": (0, -27),
    "lower lip": (0, -42),
    "mouth corner left": (-30, -35),
    "mouth corner right": (30, -35),
    "chin": (0, -62),
    "jaw left": (-75, -45),
    "jaw right": (75, -45),
    "forehead": (0, 75),
    "cheek left": (-55, 0),
    "cheek right": (55, 0),
    "temple left": (-80, 50),
    "temple right": (80, 50),
}
"""Arc to the right and height, mm."""


def at(arc, height, wide=1.0):
    """Return a point of the face: a cylinder with a nose."""
    angle = np.asarray(arc) / 85.0
    nose = 12.0 * np.exp(-((np.asarray(arc) / 12) ** 2) - (np.asarray(height) / 14) ** 2)
    x = wide * 85.0 * np.sin(angle)
    z = 85.0 * np.cos(angle) + nose - 97.0
    return np.stack(np.broadcast_arrays(x, np.asarray(height, float), z), axis=-1)


def grain(rng, size=SIZE):
    """Return smooth and fine noise of unit deviation, (size, size)."""
    coarse = np.kron(rng.standard_normal((8, 8)), np.ones((size // 8, size // 8)))
    return gaussian_filter(coarse, size / 16) * 2 + 0.5 * gaussian_filter(
        rng.standard_normal((size, size)), 1.0
    )


def face(seed=0, *, dark=0.0, oily=0.0, size=SIZE, wide=1.0, color=(0.32, 0.22, 0.17), flat=False):
    """Return an appearance: `dark` lowers the log of R_d, `oily` swaps rough for smooth lobes."""
    rng = np.random.default_rng(seed)
    # two islands of a texture, the lower half of the face to the left, with gutters around
    position = np.zeros((size, size, 3))
    on = np.zeros((size, size), bool)
    half, edge = size // 2, 2
    for k, (low, high) in enumerate(((-90.0, 0.0), (0.0, 90.0))):
        columns = slice(k * half + edge, (k + 1) * half - edge)
        rows = slice(edge, size - edge)
        arc = np.linspace(-110, 110, size - 2 * edge)[::-1]
        height = np.linspace(low, high, half - 2 * edge)
        position[rows, columns] = at(arc[:, None], height[None, :], wide)
        on[rows, columns] = True
    texture = np.zeros((size, size)) if flat else grain(rng, size)
    noise = np.asarray([1.0, 1.15, 1.3]) * (0.06 * texture[..., None])
    r_d = np.asarray(color) * np.exp(-dark * np.asarray([1.0, 1.1, 1.2]) + noise)
    valid = on.copy()
    valid[size // 2 : size // 2 + 3, 8:11] = False
    mix = np.zeros((4, 59))
    mix[[0, 1, 2, 3], [5, 20, 40, 50]] = 1.0
    weights = 0.3 + 0.1 * rng.random((size, size, 4))
    weights[..., 0] += 0.3 * oily
    weights[..., 3] *= 1.0 - 0.6 * oily
    maps = {
        "position": SkinMap(position, "mm", None, on, "rig frame"),
        "normals": SkinMap(np.broadcast_to([0.0, 0, 1], position.shape), "1", None, on, "world"),
        "r_d": SkinMap(r_d, "1", 0.01 * r_d, valid, "diffuse reflectance"),
        "lobe_residual": SkinMap(0.01 * weights[..., 0], "1/sr", None, valid, "RMS"),
    }
    for k in range(4):
        maps[f"basis_weight_{k}"] = SkinMap(
            weights[..., k], "1", np.full((size, size), 0.02), valid, "share"
        )
    return SkinAppearance(
        maps,
        "simulated",
        {"session": "session-x", "truth": f"truth-{seed}"},
        {"session": "sha256:0"},
        {"skinrig": "0"},
        files={"brdf_basis.npz": basis_file(mix)},
    )


def basis_file(mix):
    """Return the lobes' file."""
    tables = brdf_tables.default_basis()
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        materials=np.array(tables.names),
        mix=mix,
        table=tables.mix_materials(mix).table[..., : len(mix)],
        light_radius_rad=tables.light_radius_rad,
        ranks=np.array([4]),
        error_by_rank=np.array([0.1]),
    )
    return stream.getvalue()


def write(folder: Path, seed: int, **traits) -> Path:
    """Write a face and its truth; return the appearance's folder."""
    wide = traits.get("wide", 1.0)
    marks = {n: at(*p, wide).tolist() for n, p in MARKS.items()}
    truth = SkinAppearance({}, "simulated", {"kind": "truth", "landmarks_mm": marks})
    store.write(folder / f"truth-{seed}", truth)
    return store.write(folder / f"appearance-{seed}", face(seed, **traits))


def population(folder: Path, count=8, size=SIZE) -> tuple[list[Path], Path]:
    """Write faces, half of them tanned, half of those and of the others oily, and their labels."""
    paths, lines = [], ["name,tan,oily,age"]
    for k in range(count):
        tan, oily = k % 2, (k // 2) % 2
        age = 20 + 5 * k
        paths.append(
            write(
                folder,
                k,
                dark=0.35 * tan + 0.003 * (age - 20),
                oily=float(oily),
                size=size,
                wide=1.0 + 0.01 * (k % 3),
            )
        )
        lines.append(f"{k},{tan},{oily},{age}")
    labels = folder / "labels.csv"
    labels.write_text("\n".join(lines) + "\n")
    return paths, labels


@pytest.fixture(scope="session")
def dome_faces():
    """Functions that make faces, see above."""
    return SimpleNamespace(
        at=at, face=face, write=write, population=population, basis_file=basis_file, marks=MARKS
    )
