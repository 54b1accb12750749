"""Benchmark of the scanner's stripes: errors of the fused surface over patterns, light and pixels.

Ground truth is the simulator's own mesh, and the actual geometry of the scanner is given, so that
the errors are those of the stripes alone. The points of range images are the simulated scan that
sessions without stripes have as an attachment.
"""

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from capture.calibration.geometry import CameraPose
from capture.rig import Scanner, load_rig
from reconstruction.scan.closest_points import ScanSurface
from reconstruction.scan.range_fusion import fuse_ranges
from reconstruction.scan.repair import ScanMeshError, TriangleMesh, repair_mesh
from reconstruction.scan.stripe_decoding import StripeCode, decode_stripes
from reconstruction.scan.triangulation import drop_contradictions, triangulate_stripes
from rigsim.as_built.scanner import ActualScanner, build_scanner
from rigsim.boxes.scanner import ProjectorLight
from rigsim.population.files import load_subject
from rigsim.render import Caster
from rigsim.scanner.pods import ScannerSettings, scan_face
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.dome.stripes import StripedFace, StripeScene
from skinrig.arrays import BoolArray, Float64Array
from skinrig.benchmarks.results import ErrorEstimate, Timing
from skinrig.benchmarks.stage import BenchmarkStage

FIRST_SEED: Final = 100
"""The settings were chosen with seeds 1 and 2."""
SKIN_TYPES: Final = ("I", "III", "V", "II", "IV", "VI")
PHASE_STEPS: Final = 6
WIDTH_PX: Final = 320
VOXEL_PIXELS: Final = 2.5
SATURATING_FACTOR: Final = 10.0
"""Exposure of the saturated case over the default one."""
WRONG_ANGLE_RAD: Final = 0.005
"""Rotation of the projectors in the case of a wrong pose."""


@dataclass(frozen=True, slots=True)
class StripeSetting:
    """Setting of one scan."""

    steps: int = PHASE_STEPS
    exposure: float = 1.0
    """Exposure over the default one of the rig."""
    width_px: int = WIDTH_PX
    case: str = "default"
    """"default", "saturated", "one projector", "wrong pose" or "no overlap"."""


@dataclass(frozen=True, slots=True, eq=False)
class ScannedPerson:
    """A simulated face in front of the scanner, and its true surface."""

    scene: DomeScene
    seed: int

    def truth(self) -> ScanSurface:
        """Return the true surface."""
        mesh = self.scene.subject.mesh
        vertices = mesh.vertices_mm.astype(np.float64)
        return ScanSurface(TriangleMesh(vertices, mesh.faces.astype(np.int64)))


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceErrors:
    """Errors of a scanned surface."""

    across_mm: Float64Array
    """Signed distances of vertices from the true surface, > 0 outside."""
    stderr_mm: Float64Array
    """Their standard errors; empty where the scan states none."""
    area_mm2: float
    seconds: float
    """Processor time of decoding, triangulation and fusion."""

    @property
    def rms_mm(self) -> float:
        """Root mean square error, mm; NaN without vertices."""
        return float(np.sqrt(np.mean(self.across_mm**2))) if len(self.across_mm) else np.nan

    @property
    def coverage(self) -> float:
        """Fraction of errors within one standard error."""
        if not len(self.stderr_mm):
            return np.nan
        return float(np.mean(np.abs(self.across_mm) < self.stderr_mm))


@cache
def simulate_person(seed: int, skin_type: str) -> ScannedPerson:
    """Build a face for the scanner."""
    rig = load_rig("dome").subset(lights=["L060"], views=["C00"]).resized(64)
    face = load_subject(skin_type).face(seed=seed, size=256)
    return ScannedPerson(DomeScene(rig, face, seed=seed), seed)


def scan_person(person: ScannedPerson, setting: StripeSetting) -> SurfaceErrors:
    """Simulate the stripes on a face, decode them, and compare the surface with the truth."""
    nominal = load_rig("dome").scanner
    if nominal is None:
        raise ValueError("dome: got no scanner, expected one in the shipped rig")
    scanner = dataclasses.replace(
        nominal.resized(setting.width_px),
        phase_steps=setting.steps,
        exposure_s=nominal.exposure_s * setting.exposure,
        max_show_s=10.0,
    )
    actual = build_scanner(scanner, seed=person.seed)
    face = StripedFace(Caster(person.scene.subject.mesh), person.scene.texture)
    scene = StripeScene(actual, face, seed=person.seed)
    used = scanner.projectors[: 1 if setting.case == "one projector" else None]
    frames = {
        (projector.name, camera): _expose(scene, scanner, projector.name, camera)
        for projector in used
        for camera in projector.cameras
    }
    began = time.process_time()
    try:
        mesh, stderr = _decode(actual, scanner, frames, setting.case)
    except ScanMeshError:
        nothing = np.zeros(0)
        return SurfaceErrors(nothing, nothing, 0.0, time.process_time() - began)
    seconds = time.process_time() - began
    across, inside = _distances(person.truth(), mesh)
    area = 0.5 * float(np.linalg.norm(mesh.face_vectors(), axis=1).sum())
    return SurfaceErrors(across, stderr[inside], area, seconds)


def scan_by_range_images(person: ScannedPerson) -> SurfaceErrors:
    """Simulate the scan that sessions without stripes have as an attachment."""
    began = time.process_time()
    rng = np.random.default_rng([person.seed, 7])
    found = scan_face(person.scene.subject.mesh, rng=rng, scanner=ScannerSettings(clothes=False))
    seconds = time.process_time() - began
    turn, shift = found.to_dome[:3, :3], found.to_dome[:3, 3]
    vertices = found.vertices_mm.astype(np.float64) @ turn.T + shift
    mesh, _ = repair_mesh(TriangleMesh(vertices, found.faces.astype(np.int64)), max_hole_mm=0.0)
    across, _ = _distances(person.truth(), mesh)
    area = 0.5 * float(np.linalg.norm(mesh.face_vectors(), axis=1).sum())
    return SurfaceErrors(across, np.zeros(0), area, seconds)


def _expose(scene: StripeScene, scanner: Scanner, projector: str, camera: str) -> Float64Array:
    """Return the frames of one camera and projector, DN, shape (patterns, H, W)."""
    count = scanner.pattern_count(scanner.projector(projector), "columns")
    lights = [
        ProjectorLight(projector, "columns", k, 1.0, 0.0, scanner.exposure_s) for k in range(count)
    ]
    shots = [
        scene.exposure(camera, pops=[light], exposure_s=scanner.exposure_s, seed=number)
        for number, light in enumerate(lights)
    ]
    return np.array(shots, np.float64)


def _decode(
    actual: ActualScanner, scanner: Scanner, frames: dict[tuple[str, str], Float64Array], case: str
) -> tuple[TriangleMesh, Float64Array]:
    devices = {
        name: dataclasses.replace(CameraPose.nominal(view), distortion=actual.distortion[name])
        for name, view in (dict(actual.views) | dict(actual.projectors)).items()
    }
    if case == "wrong pose":
        turn = np.array([[1, 0, WRONG_ANGLE_RAD], [0, 1, 0], [-WRONG_ANGLE_RAD, 0, 1]])
        turn /= np.linalg.norm(turn, axis=1, keepdims=True)
        for name in actual.projectors:
            lamp = devices[name]
            shift = -turn @ lamp.rotation @ lamp.center_mm
            rotation = turn @ lamp.rotation
            devices[name] = dataclasses.replace(lamp, rotation=rotation, translation_mm=shift)
    # a face beyond the range has no overlap of camera and projector
    limits = (100.0, 300.0) if case == "no overlap" else scanner.range_mm
    maps = []
    for projector in scanner.projectors:
        code = StripeCode(projector.width_px, scanner.period_px, scanner.phase_steps)
        mine = []
        for camera in projector.cameras:
            if (shots := frames.get((projector.name, camera))) is None:
                continue
            view = actual.views[camera]
            electrons = (shots - view.black_level) * view.gain_e_per_dn
            phase = electrons[code.bits :]
            noise = np.maximum(phase, 0.0) + view.read_noise_e**2 + view.gain_e_per_dn**2 / 12.0
            usable = (shots[code.bits :] < view.white_level).all(axis=0)
            gray = electrons[: code.bits]
            found = decode_stripes(gray, phase, code, variance=noise, usable=usable)
            lamp = devices[projector.name]
            mine.append(triangulate_stripes(devices[camera], lamp, found, limits_mm=limits))
        maps += drop_contradictions(mine, devices[projector.name]) if mine else []
    view = scanner.views[0]
    return fuse_ranges(maps, voxel_mm=VOXEL_PIXELS * view.distance_mm / view.focal_px)


def _distances(truth: ScanSurface, mesh: TriangleMesh) -> tuple[Float64Array, BoolArray]:
    """Return signed distances of the vertices next to the true surface, and which they are."""
    found = truth.find_closest(mesh.vertices_mm)
    inside = ~found.on_border
    gap = np.einsum("nk,nk->n", mesh.vertices_mm - found.points_mm, found.normals)
    return gap[inside], inside


def measure_stripes(stage: BenchmarkStage) -> None:
    """Measure errors over phase steps, exposure and width, then the extremes."""
    count = 1 if stage.toy else 6
    people = [
        simulate_person(FIRST_SEED + k, SKIN_TYPES[k % len(SKIN_TYPES)]) for k in range(count)
    ]
    width = 160 if stage.toy else WIDTH_PX
    default = StripeSetting(width_px=width)
    settings = [
        dataclasses.replace(default, steps=n) for n in ((3, 6) if stage.toy else (3, 4, 8, 12))
    ]
    if not stage.toy:
        settings += [dataclasses.replace(default, exposure=e) for e in (0.1, 0.3, 3.0)]
        settings += [dataclasses.replace(default, width_px=w) for w in (160, 640)]
    usual = [scan_person(person, default) for person in people]
    _add_stripes(stage, default, usual)
    for setting in settings:
        if setting != default:
            _add_stripes(stage, setting, [scan_person(person, setting) for person in people])
    ranges = [scan_by_range_images(person) for person in people]
    _add(stage, {"source": "range images", "case": "default"}, ranges, {})
    rms_mm = _rms([one.rms_mm for one in usual])
    stage.limits["rms"] = rms_mm
    stage.limits["least"] = stage.limits["most"] = float(np.mean([one.coverage for one in usual]))
    stage.limits["better"] = _rms([one.rms_mm for one in ranges]) / rms_mm
    _measure_extremes(stage, people, default, usual)


def _measure_extremes(
    stage: BenchmarkStage,
    people: Sequence[ScannedPerson],
    default: StripeSetting,
    usual: Sequence[SurfaceErrors],
) -> None:
    """Measure cases that must lose surface, or be found wrong, but invent nothing."""
    area = np.array([one.area_mm2 for one in usual])
    for case, exposure in (
        ("saturated", SATURATING_FACTOR),
        ("one projector", 1.0),
        ("wrong pose", 1.0),
        ("no overlap", 1.0),
    ):
        setting = dataclasses.replace(default, case=case, exposure=exposure)
        found = [scan_person(person, setting) for person in people]
        share = float(np.mean(np.array([one.area_mm2 for one in found]) / area))
        stage.limits["area", case] = share
        if case != "no overlap":
            _add_stripes(stage, setting, found)
        if case in ("saturated", "one projector"):
            stage.limits["kept", case] = _rms([one.rms_mm for one in found if len(one.across_mm)])
        elif case == "wrong pose":
            stage.limits["wrong"] = _rms([one.rms_mm for one in found])
    dark = max(range(len(people)), key=lambda k: SKIN_TYPES[k % len(SKIN_TYPES)] == "VI")
    stage.limits["dark"] = usual[dark].rms_mm


def _add_stripes(
    stage: BenchmarkStage, setting: StripeSetting, found: Sequence[SurfaceErrors]
) -> None:
    scanner = load_rig("dome").scanner
    bits = 0 if scanner is None else scanner.gray_bits(scanner.projectors[0].width_px)
    knobs: dict[str, str | int | float] = {
        "source": "stripes",
        "case": setting.case,
        "steps": setting.steps,
        "exposure": setting.exposure,
        "width_px": setting.width_px,
    }
    _add(stage, knobs, found, {"patterns": bits + setting.steps})


def _add(
    stage: BenchmarkStage,
    knobs: dict[str, str | int | float],
    found: Sequence[SurfaceErrors],
    extra: dict[str, str | int | float],
) -> None:
    errors = np.array([one.rms_mm for one in found if len(one.across_mm)])
    seconds = [one.seconds for one in found]
    half = float(errors.std() / np.sqrt(max(len(errors), 1))) if len(errors) else np.nan
    extra = {**extra, "area_cm2": round(float(np.mean([one.area_mm2 for one in found])) / 100, 1)}
    covered = [one.coverage for one in found]
    if np.isfinite(covered).any():
        extra["coverage"] = round(float(np.nanmean(covered)), 3)
    stage.add(
        knobs,
        Timing(
            float(np.median(seconds)),
            (min(seconds), max(seconds)),
            seconds[0],
            None,
            no_memory_reason="processor time of single calls",
        ),
        ErrorEstimate.nonnegative(_rms(errors), half),
        extra,
    )


def _rms(values: Sequence[float] | Float64Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
