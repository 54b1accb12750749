"""Benchmark of template wrapping: scans of simulated people, and errors of the vertices.

Ground truth of a vertex of the default template is the point of the true surface with its texture
coordinates, which the simulator's people share. Their shapes differ by up to 4.5 % in each part.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from scipy.interpolate import RectBivariateSpline

from reconstruction.scan.closest_points import ScanSurface
from reconstruction.scan.face_template import FaceTemplate, load_default_template
from reconstruction.scan.repair import TriangleMesh
from reconstruction.scan.template_wrapping import WrappedTemplate, wrap_template
from rigsim.scanner.pods import ScannerSettings, scan_face
from rigsim.subject.expressions import displace_mesh, displacement_mm
from rigsim.subject.head import build_head
from skinrig.arrays import Float64Array
from skinrig.benchmarks.results import ErrorEstimate, Timing
from skinrig.benchmarks.stage import BenchmarkStage

PEOPLE_STATES: Final = (
    "neutral",
    "smile",
    "anger",
    "neutral",
    "surprise",
    "fear",
    "neutral",
    "disgust",
)
"""States of the people, in the order of their seeds."""
FIRST_SEED: Final = 100
"""The settings were chosen with seeds 0 to 7."""
LANDMARK_NOISE_MM: Final = 0.5
"""Standard deviation of a landmark's position along each axis."""
FEATURE_WORDS: Final = ("nose", "eye", "brow", "lip", "mouth", "lid", "fold", "chin", "glabella")
"""First words of the landmarks that a person can find; cheeks and jaws have no marks."""


@dataclass(frozen=True, slots=True, eq=False)
class ScannedFace:
    """Scan of a simulated face, with the ground truth of a template's vertices."""

    scan: TriangleMesh
    """As scanned, in the scanner's frame, mm."""
    true_vertices_mm: Float64Array
    """The template's vertices on the true surface, shape (V, 3)."""
    surface: TriangleMesh
    """The true surface."""
    landmarks_mm: dict[str, Float64Array]
    """Named points with `LANDMARK_NOISE_MM`."""

    def correspondence_errors_mm(self, found: WrappedTemplate) -> Float64Array:
        """Return the distances of valid vertices to their true positions, mm."""
        gap = found.mesh.vertices_mm - self.true_vertices_mm
        return np.asarray(np.linalg.norm(gap, axis=1)[found.valid])

    def surface_errors_mm(self, found: WrappedTemplate) -> Float64Array:
        """Return the distances of valid vertices to the true surface, mm."""
        there = ScanSurface(self.surface).find_closest(found.mesh.vertices_mm[found.valid])
        return there.distance_mm


@cache
def simulate_scan(seed: int, state: str, *, triangles: int = 40_000) -> ScannedFace:
    """Scan a simulated person with noise, flaws and clothes.

    Parameters
    ----------
    seed
        Seed of the person and of the scan.
    state
        Expression.
    triangles
        Approximate number of triangles of the scan.
    """
    mesh = build_head(np.random.default_rng([seed, 0]))
    mesh = displace_mesh(mesh, displacement_mm(mesh, state, seed=seed))
    rng = np.random.default_rng([seed, 77])
    scan = scan_face(mesh, rng=rng, scanner=ScannerSettings(triangles=triangles))
    rotation, shift = scan.to_dome[:3, :3], scan.to_dome[:3, 3]
    vertices = (mesh.vertices_mm.astype(np.float64) - shift) @ rotation
    u, v = (np.unique(mesh.uv[:, k].astype(np.float64)) for k in range(2))
    template, uv = load_default_template(), template_uv()
    grid = vertices.reshape(len(v), len(u), 3)
    true = [RectBivariateSpline(v, u, grid[..., k]).ev(uv[:, 1], uv[:, 0]) for k in range(3)]
    true_vertices = np.stack(true, axis=-1)
    noise = np.random.default_rng([seed, 78])
    return ScannedFace(
        TriangleMesh(scan.vertices_mm.astype(np.float64), scan.faces.astype(np.int64)),
        true_vertices,
        TriangleMesh(vertices, mesh.faces.astype(np.int64)),
        {
            name: point + LANDMARK_NOISE_MM * noise.standard_normal(3)
            for name, point in _carry_landmarks(template, true_vertices).items()
        },
    )


def template_uv() -> Float64Array:
    """Return the texture coordinates of the default template's vertices, shape (V, 2)."""
    template = load_default_template()
    uv = np.zeros((len(template.mesh.vertices_mm), 2))
    uv[template.mesh.faces] = template.texture()
    return uv


def _carry_landmarks(
    template: FaceTemplate, true_vertices_mm: Float64Array
) -> dict[str, Float64Array]:
    """Return the landmarks of features on another face: the offset of the nearest vertex."""
    own, found = template.mesh.vertices_mm, {}
    for name, point in template.landmarks_mm.items():
        if name.split()[0] in FEATURE_WORDS:
            nearest = int(np.argmin(np.linalg.norm(own - point, axis=1)))
            found[name] = point + true_vertices_mm[nearest] - own[nearest]
    return found


def measure_template(stage: BenchmarkStage) -> None:
    """Measure errors over the number of steps, without and with landmarks and search."""
    count = 1 if stage.toy else 20
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    triangles = 8_000 if stage.toy else 40_000
    faces = [
        simulate_scan(seed, PEOPLE_STATES[seed % len(PEOPLE_STATES)], triangles=triangles)
        for seed in seeds
    ]
    settings = [(steps, False, False) for steps in ((2, 3) if stage.toy else (2, 4, 8, 16))]
    settings += [(steps, True, False) for steps in ((2, 3) if stage.toy else (8,))]
    settings += [] if stage.toy else [(8, False, True)]
    for steps, landmarks, search in settings:
        found, seconds = [], []
        for face in faces:
            began = time.process_time()
            given = face.landmarks_mm if landmarks else None
            found.append(
                wrap_template(
                    load_default_template(),
                    face.scan,
                    landmarks_mm=given,
                    search=search or None,
                    steps=steps,
                )
            )
            seconds.append(time.process_time() - began)
        _add(stage, (steps, landmarks, search), faces, found, seconds)


def _add(
    stage: BenchmarkStage,
    setting: tuple[int, bool, bool],
    faces: Sequence[ScannedFace],
    found: Sequence[WrappedTemplate],
    seconds: Sequence[float],
) -> None:
    """Add the point of a setting, and its limits where it is the default or has landmarks."""
    pairs = list(zip(faces, found, strict=True))
    along = [_rms(face.correspondence_errors_mm(one)) for face, one in pairs]
    across = [_rms(face.surface_errors_mm(one)) for face, one in pairs]
    along_z = [
        _rms(face.correspondence_errors_mm(one) / np.hypot(one.across_mm, one.along_mm)[one.valid])
        for face, one in pairs
    ]
    folded = sum(one.folded for one in found)
    steps, landmarks, search = setting
    stage.add(
        {"steps": steps, "landmarks": landmarks, "search": search},
        Timing(
            float(np.median(seconds)),
            (min(seconds), max(seconds)),
            seconds[0],
            None,
            no_memory_reason="processor time of single calls",
        ),
        _rms_error(along),
        {
            "surface_mm": round(_rms(across), 4),
            "worst_mm": round(max(along), 3),
            "error_over_uncertainty": round(_rms(along_z), 3),
            "valid_fraction": round(float(np.mean([one.valid.mean() for one in found])), 4),
            "folded": folded,
        },
    )
    if steps == 8 and not search:
        what = "with" if landmarks else "without"
        stage.limits["correspondence", what] = _rms(along)
        stage.limits["surface", what] = _rms(across)
        stage.limits["folded", what] = folded


def _rms(values: Sequence[float] | Float64Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _rms_error(values: Sequence[float]) -> ErrorEstimate:
    """Return the RMS of independent errors with its standard error."""
    rms, squares = _rms(values), np.square(values)
    half = float(squares.std() / np.sqrt(len(values)) / (2.0 * rms))
    return ErrorEstimate.symmetric(rms, half)
