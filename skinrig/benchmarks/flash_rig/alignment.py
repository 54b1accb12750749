"""Benchmark of aligning expression images to neutral, and of blends of misaligned maps."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from model import color_table
from model.color_table import ColorTable
from model.facial_color import HemoglobinRig
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.correspondence import expression_alignment
from rigsim.subject import SimulatedSubject, make_subject
from skinrig.arrays import BoolArray, Float32Array, Float64Array
from skinrig.benchmarks.results import ErrorEstimate, Knobs
from skinrig.benchmarks.stage import BenchmarkStage

Points = dict[str, tuple[float, float]]

LANDMARK_NOISE_PX = 1.0
"""Standard deviation of a manually placed landmark along each axis, px."""
TABLE_CAMERA, TABLE_ILLUMINANT = "Nikon 5100 (NPL)", "D65"


def smooth_displacement(
    side: int, *, bend_px: float, rms_px: float, rng: np.random.Generator
) -> Float64Array:
    """Draw a smooth random displacement field.

    Parameters
    ----------
    side
        Side of the image, px.
    bend_px
        Standard deviation of the Gaussian that smooths white noise, px.
    rms_px
        Root mean square length of the displacement, px.
    rng
        Generator of the noise.

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
class DisplacedFace:
    """Two images of a simulated face's texture, with their ground truth.

    Attributes
    ----------
    neutral, moving : ndarray of float32, shape (N, N, 3)
        White-balanced linear camera RGB of the diffuse reflection, with noise; the second with an
        expression's blood, and displaced.
    variance_neutral, variance_moving : ndarray of float32, shape (N, N, 3)
    valid, valid_moving : ndarray of bool, shape (N, N)
        Masks of skin.
    source_px : ndarray of float64, shape (N, N, 2)
        Position in the moving image of each pixel of the neutral image.
    landmarks, landmarks_moving : dict
        Points distributed over the face, with placement errors.
    melanin, hemoglobin, hemoglobin_at_rest : ndarray of float32, shape (N, N)
        Maps of the neutral image, and the expression's blood at the neutral positions.
    hemoglobin_moving : ndarray of float32, shape (N, N)
        The expression's blood at the positions of the moving image.
    """

    neutral: Float32Array
    moving: Float32Array
    variance_neutral: Float32Array
    variance_moving: Float32Array
    valid: BoolArray
    valid_moving: BoolArray
    source_px: Float64Array
    landmarks: Points
    landmarks_moving: Points
    melanin: Float32Array
    hemoglobin: Float32Array
    hemoglobin_at_rest: Float32Array
    hemoglobin_moving: Float32Array

    def align(self, landmarks: int, rounds: int) -> expression_alignment.Alignment:
        """Align the moving image to the neutral one with `landmarks` and `rounds` of flow."""
        names = list(self.landmarks)[:landmarks]
        return expression_alignment.align(
            self.moving,
            self.neutral,
            rounds=rounds,
            landmarks_moving={n: self.landmarks_moving[n] for n in names} or None,
            landmarks_neutral={n: self.landmarks[n] for n in names} or None,
            valid_moving=self.valid_moving,
            valid_neutral=self.valid,
        )

    def errors_px(self, found: expression_alignment.Alignment) -> Float64Array:
        """Return the distance of each aligned pixel from its true position, px, (n,)."""
        return np.asarray(np.linalg.norm(found.source_px - self.source_px, axis=-1)[found.valid])


def load_color_table() -> ColorTable:
    """Build the color table from which the images are synthesized."""
    return color_table.build(
        TABLE_CAMERA, TABLE_ILLUMINANT, anisotropy=ANISOTROPY_SKIN, exact_optics=True
    )


def face_mask(side: int) -> BoolArray:
    """Return the mask of the face in a texture, an ellipse, (side, side)."""
    y, x = np.mgrid[:side, :side] / (side - 1.0) - 0.5
    return np.asarray((x / 0.34) ** 2 + (y / 0.40) ** 2 < 1.0)


def sample_displaced(
    image: Float64Array, displacement_px: Float64Array, order: int = 3
) -> Float64Array:
    """Sample an image (N, N) at each pixel plus its displacement (column, row), px."""
    rows, columns = np.indices(image.shape, np.float64)
    at = [rows + displacement_px[..., 1], columns + displacement_px[..., 0]]
    return np.asarray(map_coordinates(image, at, order=order, mode="nearest"))


def displace_face(
    face: SimulatedSubject,
    displacement_px: Float64Array,
    *,
    state: str = "smile",
    noise: float = 0.01,
    landmarks: int = 24,
    rng: np.random.Generator,
) -> DisplacedFace:
    """Synthesize a neutral image of a face, and a displaced one with an expression's blood.

    Parameters
    ----------
    face
        Subject whose texture is the neutral image.
    displacement_px
        (N, N, 2): displacement of each pixel; it must not fold.
    state
        One of `rigsim.subject.perfusion.STATE_NAMES`.
    noise
        Relative standard deviation of each channel of each pixel.
    landmarks
        Number of landmarks.
    rng
        Generator of noise and placement errors.
    """
    side = face.size
    back = np.zeros_like(displacement_px)
    # fixed-point iteration of the inverse displacement: b(x) = -d(x + b(x))
    for _ in range(60):
        back = -np.stack(
            [sample_displaced(displacement_px[..., k], back, 1) for k in range(2)], axis=-1
        )
    colors = load_color_table()
    light = 0.75 * np.clip(face.normal[..., 2], 0.05, 1.0)
    rest = face.hemoglobin(state)
    mask = face_mask(side)
    images, variances = [], []
    for blood, moved in ((face.hemoglobin(), False), (rest, True)):
        clean = colors.lookup(face.melanin, blood) * light[..., None]
        if moved:
            clean = np.stack([sample_displaced(clean[..., k], back) for k in range(3)], axis=-1)
        images.append((clean * (1.0 + noise * rng.standard_normal(clean.shape))).astype("f4"))
        variances.append(((noise * clean) ** 2).astype("f4"))
    points = farthest_point_sample(mask, landmarks)
    gone = points + displacement_px[points[:, 1], points[:, 0]]
    placed = [
        {
            f"point {k + 1}": (float(x), float(y))
            for k, (x, y) in enumerate(p + rng.normal(0.0, LANDMARK_NOISE_PX, p.shape))
        }
        for p in (points.astype(np.float64), gone)
    ]
    return DisplacedFace(
        images[0],
        images[1],
        variances[0],
        variances[1],
        mask,
        sample_displaced(mask.astype(np.float64), back, 1) > 0.99,
        np.indices((side, side), np.float64)[::-1].transpose(1, 2, 0) + displacement_px,
        placed[0],
        placed[1],
        face.melanin,
        face.hemoglobin(),
        rest,
        sample_displaced(rest.astype(np.float64), back).astype("f4"),
    )


def farthest_point_sample(mask: BoolArray, count: int) -> NDArray[np.intp]:
    """Sample points of a mask, each farthest from those before it; column and row (count, 2)."""
    inner = distance_transform_edt(mask) > 0.02 * mask.shape[0]
    candidates = np.argwhere(inner)[:, ::-1]
    chosen = [int(np.argmin(candidates[:, 1]))]
    distance = np.linalg.norm(candidates - candidates[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(candidates - candidates[chosen[-1]], axis=1))
    return candidates[chosen]


def measure_alignment(stage: BenchmarkStage) -> None:
    """Measure alignment by few and many landmarks, by features, with and without dense flow."""
    side = 128 if stage.toy else 512
    rng = np.random.default_rng(1)
    face = make_subject("III", seed=2, size=side)
    away = smooth_displacement(side, bend_px=side / 10, rms_px=side / 50, rng=rng)
    displaced = displace_face(face, away, state="exercise", noise=0.005, landmarks=48, rng=rng)
    still = displace_face(face, np.zeros_like(away), state="exercise", noise=0.005, rng=rng)
    effort = [(8, 0), (24, 0), (48, 0), (24, 2)]
    if not stage.toy:
        both = [(n, rounds) for n in (48, 0) for rounds in (0, 2)]
        effort = [(8, 0), (8, 2), *((24, n) for n in (0, 1, 2, 4)), *both]
    for count, rounds in effort:
        timing, found = stage.time(
            lambda: displaced.align(count, rounds), repeats=1, memory=(count, rounds) == (24, 2)
        )
        error = displaced.errors_px(found)
        if (count, rounds) == (24, 2):
            covered = float((error < 2.0 * found.error_px[found.valid]).mean())
        knobs = {"by": found.by, "landmarks": count, "rounds": rounds}
        stage.add(knobs, timing, _rms(error, side))
    stage.measure_bands(lambda band: _on_skin(band.preset, 128 if stage.toy else 256))
    stage.description_values["moved_px"] = side / 50
    if not stage.toy:
        bare, dense = (stage.find_point(landmarks=24, rounds=n) for n in (0, 2))
        stage.limits = {
            "false_motion": float(np.median(still.errors_px(still.align(24, 2)))),
            "covered": covered,
            "by_flow": bare.error / dense.error,
            "seconds": dense.timing.seconds,
        }


def _on_skin(preset: str, side: int) -> ErrorEstimate:
    """Return the error on skin of a preset with 24 landmarks, dense flow and 1 % noise."""
    rng = np.random.default_rng(4)
    away = smooth_displacement(side, bend_px=side / 10, rms_px=side / 50, rng=rng)
    displaced = displace_face(
        make_subject(preset, seed=2, size=side), away, state="exercise", rng=rng
    )
    return _rms(displaced.errors_px(displaced.align(24, 2)), side)


MISALIGNMENTS_PX = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)


def measure_misalignment(stage: BenchmarkStage) -> None:
    """Compare blending by local statistics with interpolation of misaligned maps.

    Jimenez et al. 2010, section 4.2, state that local statistics tolerate imperfect alignment and
    interpolated maps do not.
    """
    side = 128 if stage.toy else 512
    face = make_subject("III", seed=2, size=side)
    mask = face_mask(side)
    neutral = face.hemoglobin().astype(np.float64)
    for state in ("exercise",) if stage.toy else ("exercise", "smile"):
        truth = face.hemoglobin(state).astype(np.float64)
        size = _rms((truth - neutral)[mask], side).error
        for off_px in MISALIGNMENTS_PX[:3] if stage.toy else MISALIGNMENTS_PX:
            map_of_state = displace_map(truth, off_px, rng=np.random.default_rng(3))

            def blended(radius: float) -> Float64Array:
                if radius == 0.0:
                    return neutral + 1.0 * (map_of_state - neutral)
                rig = HemoglobinRig.from_maps(
                    neutral, {state: map_of_state}, radius_px=radius, valid=mask
                )
                return np.asarray(rig.blend({state: 1.0, "neutral": 0.0}), np.float64)

            for radius in (0.0, 16.0) if stage.toy else (0.0, 8.0, 16.0, 32.0):
                timing, found = stage.time(lambda: blended(radius), repeats=1, memory=False)
                error = (found - truth)[mask] / size
                outcome = _rms(error[np.isfinite(error)], side)
                way = "blended" if radius else "interpolated"
                knobs: Knobs = {"state": state, "way": way, "off_px": off_px}
                knobs |= {"radius_px": radius} if radius else {}
                stage.add(knobs, timing, outcome)
        if not stage.toy:
            kept = stage.find_point(state=state, off_px=2.0, way="interpolated")
            blend = stage.find_point(state=state, off_px=2.0, radius_px=16.0)
            stage.limits["ratio", state] = kept.error / blend.error


def displace_map(image: Float64Array, rms_px: float, *, rng: np.random.Generator) -> Float64Array:
    """Displace a map by a smooth random field of the given RMS length, px."""
    if rms_px == 0.0:
        return image
    side = image.shape[0]
    return sample_displaced(
        image, smooth_displacement(side, bend_px=side / 12.8, rms_px=rms_px, rng=rng)
    )


def _rms(values: Float64Array, side: int) -> ErrorEstimate:
    """Return a root mean square over pixels that are correlated within patches, with interval."""
    squares = np.square(values)
    # pixels are correlated over side / 10: the number of independent values is that of patches
    patches = max(values.size / (side / 10.0) ** 2, 2.0)
    mean, stderr = float(squares.mean()), float(squares.std()) / np.sqrt(patches)
    low, high = np.sqrt([max(mean - stderr, 0.0), mean + stderr]).tolist()
    return ErrorEstimate(float(np.sqrt(mean)), (low, high))
