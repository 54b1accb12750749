"""Benchmark of expression images laid over neutral, and of what a misalignment does to blends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from model import color_table
from model.color_table import ColorTable
from model.tissue_optics import ANISOTROPY_SKIN
from rigsim.subject import Subject, make_subject

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Points = dict[str, tuple[float, float]]

CAMERA, LIGHT = "Nikon 5100 (NPL)", "D65"


def smooth_displacement(
    side: int, *, bend_px: float, rms_px: float, rng: np.random.Generator
) -> Floats:
    """Return a smooth random displacement.

    Parameters
    ----------
    side
        Pixels a side.
    bend_px
        Standard deviation of the Gaussian that smooths white noise, px.
    rms_px
        Root mean square length of the displacement, px.
    rng
        Draws it.

    Returns
    -------
    ndarray of float64, shape (side, side, 2)
        Column and row, px.
    """
    drawn = np.stack(
        [gaussian_filter(rng.standard_normal((side, side)), bend_px) for _ in range(2)], axis=-1
    )
    return np.asarray(drawn * (rms_px / np.sqrt((drawn**2).sum(axis=-1).mean())))


@dataclass(frozen=True, slots=True)
class MovedFace:
    """Two pictures of a simulated face's texture, with what is known of them.

    Attributes
    ----------
    neutral, moving : ndarray of float32, shape (N, N, 3)
        White-balanced linear camera RGB of diffuse light, with noise; the second in a state of
        blood, and moved.
    variance_neutral, variance_moving : ndarray of float32, shape (N, N, 3)
    valid, valid_moving : ndarray of bool, shape (N, N)
        Skin in each.
    source_px : ndarray of float64, shape (N, N, 2)
        Where each pixel of the neutral picture is in the moving one.
    landmarks, landmarks_moving : dict
        Points spread over the face, as somebody placed them.
    melanin, hemoglobin, hemoglobin_at_rest : ndarray of float32, shape (N, N)
        Of the neutral picture, and the state's blood seen on it.
    hemoglobin_moving : ndarray of float32, shape (N, N)
        The state's blood where the moving picture shows it.
    """

    neutral: NDArray[np.float32]
    moving: NDArray[np.float32]
    variance_neutral: NDArray[np.float32]
    variance_moving: NDArray[np.float32]
    valid: Bools
    valid_moving: Bools
    source_px: Floats
    landmarks: Points
    landmarks_moving: Points
    melanin: NDArray[np.float32]
    hemoglobin: NDArray[np.float32]
    hemoglobin_at_rest: NDArray[np.float32]
    hemoglobin_moving: NDArray[np.float32]


def table() -> ColorTable:
    """Return the color table that pictures are made with."""
    return color_table.build(CAMERA, LIGHT, anisotropy=ANISOTROPY_SKIN)


def oval(side: int) -> Bools:
    """Return where a texture shows the face."""
    y, x = np.mgrid[:side, :side] / (side - 1.0) - 0.5
    return np.asarray((x / 0.34) ** 2 + (y / 0.40) ** 2 < 1.0)


def moved_face(
    face: Subject,
    displacement_px: Floats,
    *,
    state: str = "smile",
    noise: float = 0.01,
    landmarks: int = 24,
    landmark_noise_px: float = 1.0,
    rng: np.random.Generator,
) -> MovedFace:
    """Picture a face in neutral, and moved in a state of its blood.

    Parameters
    ----------
    face
        Its texture is the neutral picture.
    displacement_px
        (N, N, 2): where each pixel goes. It must not fold.
    state
        Of `rigsim.perfusion.STATES`.
    noise
        Relative standard deviation of each channel of each pixel.
    landmarks, landmark_noise_px
        How many, and how precisely somebody placed each along each axis.
    rng
        Draws noise.
    """
    side = face.size
    rows, columns = np.mgrid[:side, :side].astype(np.float64)
    back = np.zeros_like(displacement_px)
    for _ in range(60):
        at = [rows + back[..., 1], columns + back[..., 0]]
        back = -np.stack(
            [
                map_coordinates(displacement_px[..., k], at, order=1, mode="nearest")
                for k in range(2)
            ],
            axis=-1,
        )
    at = [rows + back[..., 1], columns + back[..., 0]]

    def pulled(image: Floats, order: int = 3) -> Floats:
        return np.asarray(map_coordinates(image, at, order=order, mode="nearest"))

    colors = table()
    light = 0.75 * np.clip(face.normal[..., 2], 0.05, 1.0)
    rest = face.hemoglobin(state)
    mask = oval(side)
    pictures, variances = [], []
    for blood, moved in ((face.hemoglobin(), False), (rest, True)):
        clean = colors.lookup(face.melanin, blood) * light[..., None]
        if moved:
            clean = np.stack([pulled(clean[..., k]) for k in range(3)], axis=-1)
        pictures.append((clean * (1.0 + noise * rng.standard_normal(clean.shape))).astype("f4"))
        variances.append(((noise * clean) ** 2).astype("f4"))
    points = spread_points(mask, landmarks)
    gone = points + displacement_px[points[:, 1], points[:, 0]]
    placed = [
        {
            f"point {k + 1}": (float(x), float(y))
            for k, (x, y) in enumerate(p + rng.normal(0.0, landmark_noise_px, p.shape))
        }
        for p in (points.astype(np.float64), gone)
    ]
    return MovedFace(
        pictures[0], pictures[1], variances[0], variances[1],
        mask, pulled(mask.astype(np.float64), 1) > 0.99,
        np.stack([columns, rows], axis=-1) + displacement_px,
        placed[0], placed[1],
        face.melanin, face.hemoglobin(), rest, pulled(rest.astype(np.float64)).astype("f4"),
    )  # fmt: skip


def spread_points(mask: Bools, count: int) -> NDArray[np.intp]:
    """Return points (count, 2), column and row, spread over a mask: each farthest from others."""
    inner = distance_transform_edt(mask) > 0.02 * mask.shape[0]
    places = np.argwhere(inner)[:, ::-1]
    chosen = [int(np.argmin(places[:, 1]))]
    away = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return places[chosen]


def face_of(preset: str, side: int, *, seed: int = 0) -> Subject:
    """Return a simulated face with a texture of so many pixels a side."""
    return make_subject(preset, seed=seed, size=side)
