"""Simulate the dome's face scanner: two pods, each a stripe projector between two cameras.

A scan differs from the surface: ranges are noisy and blurred over a millimeter, skin that is not
visible to both a camera and its pod's projector is missing, clothes are included, triangles have
defects, and the mesh is in the scanner's own frame.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import ndimage

from rigsim.arrays import BoolArray, Float32Array, Float64Array, Int32Array
from rigsim.geometry.atlas import interpolate, sample
from rigsim.geometry.mesh import Mesh, MeshError, build_mesh, grid_faces
from rigsim.geometry.surface_noise import smooth_noise
from rigsim.render import Caster
from rigsim.scanner.flaws import add_mesh_defects, encode_binary_ply
from rigsim.scanner.fusion import RangeImage, fuse_range_images

POD_AZIMUTH_DEG: Final = (-38.0, 38.0)
"""Azimuths of the pods around the subject, from the front."""
CAMERA_OFFSET_DEG: Final = ((-9.0, 13.0), (9.0, -13.0))
"""Azimuth and elevation of a pod's cameras from its projector."""
WORKING_DISTANCE_MM: Final = 900.0
TARGET_MM: Final = (0.0, 0.0, -40.0)
"""Point that all devices face."""
MIN_INCIDENCE_COSINE: Final = 0.25
"""Smallest cosine of projection and of view at which stripes are decoded: 76 degrees."""
MAX_RANGE_JUMP_MM: Final = 4.0
"""Neighboring pixels whose ranges differ by more are at an edge and are omitted."""
WRAP_NOISE_FRACTION: Final = 0.4
"""Fraction of a range's noise in a wrapped template."""
WRAP_TANGENTIAL_STD_MM: Final = 0.25
"""Deviation along the surface of a wrapped template from the same skin, mm in each direction."""
COARSE_VOXELS_MM: Final = (8.0, 5.0)
"""Voxel sizes of two rough passes, which predict the number of triangles of a fine one."""


@dataclass(frozen=True, slots=True)
class ScannerSettings:
    """Resolution, noise and defects of a scanner."""

    triangles: int = 40_000
    """Approximate number of triangles in the result, 500 to 400,000."""
    resolution_mm: float = 1.0
    """Width at half height of the blur, mm, > 0."""
    noise_mm: float = 0.15
    """Standard deviation of a single range at normal incidence, mm, >= 0, before the blur."""
    warp_mm: float = 0.03
    """Standard deviation of slow errors over a camera's field, mm, >= 0."""
    offset_mm: float = 5.0
    """Length of the shift between the frames of scanner and dome, mm, >= 0."""
    offset_deg: float = 2.0
    """Angle of the rotation between them, degrees, 0 to 20."""
    flaws: bool = True
    """Whether triangles have defects: holes, islands, doubled and degenerate ones, fins."""
    clothes: bool = True
    """Whether the subject wears a collar that is scanned too."""

    def __post_init__(self) -> None:
        for name, good, expected in (
            ("triangles", 500 <= self.triangles <= 400_000, "500 to 400,000"),
            ("resolution_mm", 0 < self.resolution_mm <= 20, "0 < mm <= 20"),
            ("noise_mm", 0 <= self.noise_mm <= 5, "0 to 5"),
            ("warp_mm", 0 <= self.warp_mm <= 5, "0 to 5"),
            ("offset_mm", 0 <= self.offset_mm <= 100, "0 to 100"),
            ("offset_deg", 0 <= self.offset_deg <= 20, "0 to 20"),
        ):
            if not good:
                raise ValueError(f"{name}: got {getattr(self, name)}, expected {expected}")


@dataclass(frozen=True, slots=True, eq=False)
class ScanResult:
    """Mesh of the scanner, with ground truth of the simulation."""

    ply: bytes
    """The mesh in the scanner's frame, mm: a binary PLY."""
    to_dome: Float64Array
    """Ground truth: transform from scanner to rig frame, shape (4, 4)."""
    vertices_mm: Float32Array
    """Positions in the PLY, shape (V, 3), scanner frame."""
    faces: Int32Array
    """Triangles in the PLY, shape (F, 3)."""
    edge_mm: float
    """Typical length of an edge."""


def scan_face(
    mesh: Mesh,
    *,
    rng: np.random.Generator,
    scanner: ScannerSettings | None = None,
    relief_um: Float32Array | None = None,
) -> ScanResult:
    """Simulate a scan of a face.

    Parameters
    ----------
    mesh
        The true surface in the rig frame, facing +z.
    rng
        Source of noise, flaws and the offset between the frames.
    scanner
        Its properties; those of `ScannerSettings` by default.
    relief_um
        Height of pores and wrinkles over the mesh as a texture, shape (N, N), um.

    Returns
    -------
    ScanResult

    Raises
    ------
    MeshError
        When the mesh is not visible to the scanner.
    """
    scanner = scanner or ScannerSettings()
    worn = _with_collar(mesh) if scanner.clothes else mesh
    caster = Caster(worn)
    images = [
        _range_image(caster, projector, camera, scanner, relief_um, len(mesh.faces), rng)
        for azimuth in POD_AZIMUTH_DEG
        for projector in [_pod_position(azimuth, 0.0)]
        for aside, up in CAMERA_OFFSET_DEG
        for camera in [_pod_position(azimuth + aside, up)]
    ]
    edge_mm = _voxel_size_for(images, scanner.triangles)
    vertices, faces = fuse_range_images(images, edge_mm)
    if scanner.flaws:
        vertices, faces = add_mesh_defects(vertices, faces, edge_mm=edge_mm, rng=rng)
    to_scanner = _draw_scanner_pose(scanner, rng)
    there = (vertices @ to_scanner[:3, :3].T + to_scanner[:3, 3]).astype(np.float32)
    return ScanResult(
        ply=encode_binary_ply(there, faces),
        to_dome=np.asarray(np.linalg.inv(to_scanner), np.float64),
        vertices_mm=there,
        faces=faces,
        edge_mm=edge_mm,
    )


def wrap_template(
    mesh: Mesh, *, rng: np.random.Generator, scanner: ScannerSettings | None = None
) -> ScanResult:
    """Simulate a scan of a face with a template wrapped onto it, to compare expressions.

    The template has the triangles and the texture coordinates of the mesh in every expression, so
    all scans share one texture. Wrapping closes holes and omits clothes; the remaining errors are
    one across the surface, from the scanner, and one along it, as skin without features is matched
    only roughly.

    Parameters
    ----------
    mesh
        The true surface in the rig frame, at rest or moved.
    rng
        Source of the errors and of the offset between the frames.
    scanner
        The scanner; of its flaws only noise, warp and offset are left.

    Returns
    -------
    ScanResult
        With texture coordinates in its PLY.
    """
    scanner = scanner or ScannerSettings()
    seed = int(rng.integers(2**31))
    points = mesh.vertices_mm
    # the template's stiffness averages the noise of many ranges
    fit = WRAP_NOISE_FRACTION * scanner.noise_mm * smooth_noise(points, (4.0,), seed=seed)
    fit += scanner.warp_mm * smooth_noise(points, (60.0,), seed=seed + 1)
    slide = np.stack([smooth_noise(points, (25.0,), seed=seed + 2 + k) for k in range(3)], axis=-1)
    slide -= np.sum(slide * mesh.normals, axis=-1, keepdims=True) * mesh.normals
    wrapped = points + fit[:, None] * mesh.normals + WRAP_TANGENTIAL_STD_MM * slide
    to_scanner = _draw_scanner_pose(scanner, rng)
    there = (wrapped @ to_scanner[:3, :3].T + to_scanner[:3, 3]).astype(np.float32)
    edges = mesh.vertices_mm[mesh.faces[:, 0]] - mesh.vertices_mm[mesh.faces[:, 1]]
    return ScanResult(
        ply=encode_binary_ply(there, mesh.faces, mesh.uv),
        to_dome=np.asarray(np.linalg.inv(to_scanner), np.float64),
        vertices_mm=there,
        faces=mesh.faces,
        edge_mm=float(np.median(np.linalg.norm(edges, axis=-1))),
    )


def _voxel_size_for(images: list[RangeImage], triangles: int) -> float:
    """Return the side of voxels for a number of triangles.

    A surface of area A with rims of length R gives about (a A - b R h) / h^2 of them: cells at
    the rims are lost.
    """
    counts = np.array([len(fuse_range_images(images, side)[1]) for side in COARSE_VOXELS_MM])
    if not counts.all():
        raise MeshError("scan: got no triangle, expected a face that looks towards +z")
    # Two coarse counts n h^2 = a A - b R h give both constants; then solve the quadratic for h.
    h = np.array(COARSE_VOXELS_MM)
    area, rim = np.linalg.solve(np.stack([np.ones(2), -h], axis=1), counts * h**2)
    rim = max(float(rim), 0.0)
    return float((-rim + math.sqrt(rim**2 + 4.0 * triangles * area)) / (2.0 * triangles))


def _pod_position(azimuth_deg: float, elevation_deg: float) -> Float64Array:
    a, e = math.radians(azimuth_deg), math.radians(elevation_deg)
    way = np.array([math.sin(a) * math.cos(e), math.sin(e), math.cos(a) * math.cos(e)])
    return np.array(TARGET_MM) + WORKING_DISTANCE_MM * way


def _range_image(
    caster: Caster,
    projector: Float64Array,
    camera: Float64Array,
    scanner: ScannerSettings,
    relief_um: Float32Array | None,
    skin_faces: int,
    rng: np.random.Generator,
) -> RangeImage:
    """Return ranges where one camera decodes the stripes of one projector."""
    pitch_mm = min(0.7 * scanner.resolution_mm, 1.5)
    side = 2 * round(190.0 / pitch_mm)
    empty = RangeImage.from_view(camera, np.array(TARGET_MM), side, pitch_mm / WORKING_DISTANCE_MM)
    ways = empty.rays().reshape(-1, 3).astype(np.float32)
    prim, weight = caster.first_hit(np.broadcast_to(camera.astype(np.float32), ways.shape), ways)
    fields = interpolate(caster.attributes, caster.mesh.faces, prim, weight)
    points, normals, uv = fields[:, :3], fields[:, 3:6], fields[:, 6:8]
    range_mm = np.linalg.norm(points - camera, axis=1)
    to_projector = projector - points
    length = np.linalg.norm(to_projector, axis=1)
    to_projector /= length[:, None]
    cos_camera = -np.einsum("nk,nk->n", ways, normals)
    cos_projector = np.einsum("nk,nk->n", to_projector, normals)
    good = (
        (prim >= 0) & (cos_camera > MIN_INCIDENCE_COSINE) & (cos_projector > MIN_INCIDENCE_COSINE)
    )
    start = points[good] + 0.05 * normals[good]
    good[good] = ~caster.is_blocked(start, to_projector[good], length[good])
    if relief_um is not None:
        skin = good & (prim < skin_faces)
        height_mm = 1e-3 * sample(relief_um, uv, skin)
        range_mm -= np.where(skin, height_mm / np.maximum(cos_camera, MIN_INCIDENCE_COSINE), 0.0)
    noise = rng.standard_normal(len(range_mm)) * scanner.noise_mm
    range_mm += noise / np.sqrt(np.clip(cos_camera * cos_projector, MIN_INCIDENCE_COSINE**2, 1.0))
    ranges, good = range_mm.reshape(side, side), good.reshape(side, side)
    good &= _smooth_around(ranges, good)
    sigma_px = scanner.resolution_mm / 2.3548 / pitch_mm
    weight_sum = ndimage.gaussian_filter(good.astype(np.float64), sigma_px)
    total = ndimage.gaussian_filter(np.where(good, ranges, 0.0), sigma_px)
    blurred = total / np.maximum(weight_sum, 1e-9)
    slow = ndimage.gaussian_filter(rng.standard_normal((side, side)), side / 12, mode="wrap")
    blurred += scanner.warp_mm * slow / slow.std()
    return empty.with_ranges(
        np.where(good & (weight_sum > 0.5), blurred, np.nan),
        np.clip(cos_camera * cos_projector, 0.0, 1.0).reshape(side, side),
    )


def _smooth_around(ranges: Float64Array, good: BoolArray) -> BoolArray:
    """Return the pixels whose good neighbors are at about the same range."""
    far = ndimage.maximum_filter(np.where(good, ranges, -np.inf), 3)
    near = ndimage.minimum_filter(np.where(good, ranges, np.inf), 3)
    with np.errstate(invalid="ignore"):
        return np.asarray(far - near < MAX_RANGE_JUMP_MM)


def _with_collar(mesh: Mesh) -> Mesh:
    """Add a collar that opens towards the shoulders below the mesh's lower edge."""
    low = float(mesh.vertices_mm[:, 1].min())
    neck = mesh.vertices_mm[mesh.vertices_mm[:, 1] < low + 8.0]
    middle = 0.5 * (neck.min(axis=0) + neck.max(axis=0))
    radius = 0.5 * float(np.ptp(neck[:, 0])) + 6.0
    turn, drop = np.linspace(-2.4, 2.4, 64), np.linspace(0.0, 1.0, 24)
    phi, t = np.meshgrid(turn, drop)
    wide = radius + 70.0 * t**1.5 + 2.5 * t * np.sin(9.0 * phi)
    points = np.stack(
        [wide * np.sin(phi), low + 6.0 - 55.0 * t, middle[2] + 0.8 * wide * np.cos(phi)], axis=-1
    ).reshape(-1, 3)
    collar = build_mesh(points, grid_faces(*phi.shape), np.zeros((len(points), 2)))
    return Mesh(
        np.concatenate([mesh.vertices_mm, collar.vertices_mm]),
        np.concatenate([mesh.faces, collar.faces + np.int32(len(mesh.vertices_mm))]),
        np.concatenate([mesh.uv, collar.uv]),
        np.concatenate([mesh.normals, collar.normals]),
    )


def _draw_scanner_pose(scanner: ScannerSettings, rng: np.random.Generator) -> Float64Array:
    """Draw the motion from the rig frame to the scanner's: fixed size, random direction."""
    axis, shift = rng.standard_normal(3), rng.standard_normal(3)
    x, y, z = axis / np.linalg.norm(axis)
    angle = math.radians(scanner.offset_deg)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix = np.eye(4)
    # Rodrigues' formula
    matrix[:3, :3] += math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
    matrix[:3, 3] = scanner.offset_mm * shift / np.linalg.norm(shift)
    return matrix
