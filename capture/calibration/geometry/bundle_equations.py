"""Normal equations of a bundle adjustment: residuals, derivatives, steps and covariance.

Each camera has fifteen parameters (fx, fy, cx, cy, k1, k2, p1, p2, k3, a rotation about its own
axes, a translation), each pose of the board six. The normal equations are summed from blocks, image
by image, with analytic derivatives.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from capture.arrays import Float64Array
from capture.calibration.geometry.board import MIN_BOARD_CORNERS, CornerObservation
from capture.calibration.geometry.board_pose import BoardPose, FlatTarget
from capture.calibration.geometry.intrinsics import CameraPose, distort
from capture.calibration.record import CalibrationError
from capture.calibration.robust import HUBER_SIGMAS, huber_weights, mad_sigma

_log = logging.getLogger(__name__)

Gauge: TypeAlias = Literal["board", "cameras"]
StopReason: TypeAlias = Literal["tolerance", "stalled"]
Sightings: TypeAlias = Mapping[tuple[str, int], CornerObservation]
Cameras: TypeAlias = Mapping[str, CameraPose]
BoardPoses: TypeAlias = Mapping[int, BoardPose]
Residuals: TypeAlias = Mapping[tuple[str, int], Float64Array]
N_CAMERA, N_LENS, N_POSE = 15, 9, 6  # parameters of a camera, of its lens, of a pose

MAX_BUNDLE_STEPS = 100
COST_TOL = 1e-10  # relative decrease of the cost
STALL_TOL = 1e-6  # largest predicted decrease, relative, at which rounding may end the steps
MIN_SIGMA_PX = 1e-9


class BundleError(CalibrationError):
    """Raised for corners that do not connect the cameras; the message names what is missing."""


class BundleDiverged(BundleError):
    """Raised when the steps of a bundle adjustment do not end."""


@dataclass(frozen=True, slots=True)
class LensPrior:
    """Standard deviations of a lens about its nominal values; 0 holds a parameter fixed.

    Attributes
    ----------
    focal : float
        Relative.
    principal : float
        Position of the principal point, relative to the image's width.
    k1, k2, tangential, k3 : float
        Coefficients of the distortion.
    """

    focal: float = 0.02
    principal: float = 0.02
    k1: float = 0.3
    k2: float = 1.0
    tangential: float = 0.01
    k3: float = 0.0

    def sigmas(self, camera: CameraPose) -> Float64Array:
        """Return the deviations of a camera's nine lens numbers."""
        fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
        shift = self.principal * camera.image_size[0]
        bending = [self.k1, self.k2, self.tangential, self.tangential, self.k3]
        return np.array([self.focal * fx, self.focal * fy, shift, shift, *bending])


@dataclass(frozen=True, slots=True)
class BundleEnd:
    """End of an adjustment: its steps, residual, condition and reason."""

    steps: int
    residual: float
    """Relative decrease of the misfit: by the last step, or predicted if none lowers it."""
    condition: float
    """Of the last normal equations, scaled to a diagonal of one, without a free gauge."""
    stop: StopReason


@dataclass(frozen=True, slots=True, eq=False)
class BundleResult:
    """Result of a bundle adjustment.

    Attributes
    ----------
    cameras : dict of str to CameraPose
        Cameras by view name, with standard errors.
    poses : dict of int to BoardPose
        Board poses by number.
    rms_px : dict of str to float
        Root mean square distance of a camera's corners to the fitted ones.
    sigma_px : float
        Noise of a corner's coordinate, estimated from the residuals.
    corners : dict of str to int
        Number of corners of each camera.
    outliers : dict of tuple to int
        Corners of each image (view, pose) farther than five sigmas; images without are omitted.
    center_covariance_mm2 : dict of str to ndarray of float64, shape (3, 3)
        Covariance of each camera's center of projection, rig frame.
    camera_covariance : ndarray of float64, shape (15 C, 15 C)
        Covariance of the parameters of all C cameras, in the order of their sorted names; see
        `step_camera`.
    end : BundleEnd
    """

    cameras: dict[str, CameraPose]
    poses: dict[int, BoardPose]
    rms_px: dict[str, float]
    sigma_px: float
    corners: dict[str, int]
    outliers: dict[tuple[str, int], int]
    center_covariance_mm2: dict[str, Float64Array]
    camera_covariance: Float64Array
    end: BundleEnd


class BundleProblem:
    """Corners as arrays, and the normal equations of their residuals."""

    def __init__(
        self,
        sightings: Sightings,
        board: FlatTarget,
        start: Cameras,
        prior: LensPrior,
        gauge: Gauge,
        *,
        cameras_fixed: bool = False,
    ) -> None:
        self.images = {
            k: s for k, s in sorted(sightings.items()) if len(s.ids) >= MIN_BOARD_CORNERS
        }
        self.board = board
        self.names = sorted({name for name, _ in self.images})
        self.poses = sorted({pose for _, pose in self.images})
        self.start = start
        self.gauge = gauge
        self.sigmas = {name: prior.sigmas(start[name]) for name in self.names}
        self.first = len(self.names) * N_CAMERA  # index of the first pose parameter
        self.total = self.first + len(self.poses) * N_POSE
        free = np.zeros(self.total, bool)
        if not cameras_fixed:
            for i, name in enumerate(self.names):
                free[i * N_CAMERA : i * N_CAMERA + N_LENS] = self.sigmas[name] > 0
                free[i * N_CAMERA + N_LENS : (i + 1) * N_CAMERA] = True
        free[self.first :] = True
        if gauge == "board":
            at = self.first + self.poses.index(0) * N_POSE
            free[at : at + N_POSE] = False
        self.free = np.nonzero(free)[0]
        self.cameras_fixed = cameras_fixed

    def solve(
        self, cameras: Cameras, poses: BoardPoses
    ) -> tuple[dict[str, CameraPose], dict[int, BoardPose], BundleEnd]:
        """Run Levenberg's method with Huber's weights; estimate the scale again at each step."""
        cameras, poses = dict(cameras), dict(poses)
        damping = 1e-3
        for steps in range(1, MAX_BUNDLE_STEPS + 1):
            residuals = self._residuals(cameras, poses)
            sigma = self._sigma(residuals)
            cost = self._cost(residuals, cameras, sigma)
            H, g = self._equations(cameras, poses, residuals, sigma)
            while True:
                step = np.zeros(self.total)
                damped = H + damping * np.diag(np.diag(H))
                step[self.free] = cho_solve(cho_factor(damped), -g)
                trial = self._stepped(cameras, poses, step)
                after = self._residuals(*trial)
                new = self._cost(after, trial[0], sigma)
                if new <= cost or damping > 1e8:
                    break
                damping *= 10.0
            if new > cost:
                left = 0.0
                if cost > 1.0:  # a sum of squares over noise; below, the misfit is rounding
                    left = float(g @ cho_solve(cho_factor(H + 1e-6 * np.diag(np.diag(H))), g))
                    left /= cost
                if left > STALL_TOL:
                    _log.warning(
                        "bundle adjustment: after %d steps, no step lowers the misfit, although "
                        "derivatives predict %.2g of it; compare the errors with the residuals",
                        steps,
                        left,
                    )
                break
            cameras, poses = trial
            left = (cost - new) / max(cost, 1e-300)
            damping = max(damping / 10.0, 1e-12)
            if cost - new < COST_TOL * max(cost, 1e-300):
                break
        else:
            raise BundleDiverged(
                f"bundle adjustment: not converged after {MAX_BUNDLE_STEPS} steps; the last lowers "
                f"the misfit by {left:.2g} of it, expected below {COST_TOL}; condition "
                f"{self._condition(H):.2g}; show more poses of the board, tilted more"
            )
        stop: StopReason = "stalled" if left > STALL_TOL else "tolerance"
        return cameras, poses, BundleEnd(steps, left, self._condition(H), stop)

    def _condition(self, H: Float64Array) -> float:
        size = np.sqrt(np.diag(H))
        values = np.linalg.eigvalsh(H / np.outer(size, size))
        freedoms = 0 if self.gauge == "board" or self.cameras_fixed else N_POSE
        return float(values[-1] / max(values[freedoms], 1e-300))

    def solution_with_errors(
        self, cameras: dict[str, CameraPose], poses: dict[int, BoardPose], end: BundleEnd
    ) -> BundleResult:
        """Return the solution with standard errors in the gauge."""
        residuals = self._residuals(cameras, poses)
        sigma = self._sigma(residuals)
        weights = {key: _huber(r, sigma) for key, r in residuals.items()}
        square = sum(float((weights[k][:, None] * r**2).sum()) for k, r in residuals.items())
        count = 2.0 * sum(float(w.sum()) for w in weights.values())
        unknown = len(self.free) - (N_POSE if self.gauge == "cameras" else 0)
        noise = float(np.sqrt(square / max(count - unknown, 1.0)))
        H, _ = self._equations(cameras, poses, residuals, max(noise, MIN_SIGMA_PX))
        covariance = np.zeros((self.total,) * 2)
        covariance[np.ix_(self.free, self.free)] = self._inverse(H, cameras)
        found, centers = {}, {}
        for i, name in enumerate(self.names):
            block = covariance[i * N_CAMERA : (i + 1) * N_CAMERA, i * N_CAMERA : (i + 1) * N_CAMERA]
            camera = cameras[name]
            errors = np.sqrt(np.clip(np.diag(block), 0.0, None))
            matrix = np.zeros((3, 3))
            matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2] = errors[:4]
            found[name] = replace(
                camera,
                matrix_stderr=matrix,
                distortion_stderr=errors[4:9],
                rotation_stderr_rad=errors[9:12],
                translation_stderr_mm=errors[12:15],
            )
            to_center = np.hstack(_center_derivative(camera))
            centers[name] = to_center @ block[N_LENS:, N_LENS:] @ to_center.T
        rms, corners = {}, {}
        for name in self.names:
            mine = np.concatenate([r for (n, _), r in residuals.items() if n == name])
            rms[name] = float(np.sqrt((mine**2).sum(axis=1).mean()))
            corners[name] = len(mine)
        far = {
            key: int(np.count_nonzero(np.linalg.norm(r, axis=1) > 5.0 * max(noise, 1e-3)))
            for key, r in residuals.items()
        }
        outliers = {key: n for key, n in far.items() if n}
        joint = covariance[: self.first, : self.first]
        return BundleResult(found, poses, rms, noise, corners, outliers, centers, joint, end)

    def _inverse(self, H: Float64Array, cameras: Cameras) -> Float64Array:
        """Return the covariance; with a free frame, for a frame fixed by the camera centers."""
        if self.gauge == "board" or self.cameras_fixed:
            return np.asarray(np.linalg.inv(H))
        # gauge constraints: the sum of shifts and the sum of moments of the centers vanish
        B = np.zeros((N_POSE, self.total))
        middle = np.mean([cameras[name].center_mm for name in self.names], axis=0)
        for i, name in enumerate(self.names):
            to_center = np.hstack(_center_derivative(cameras[name]))
            arm = _cross_matrix(cameras[name].center_mm - middle)
            B[:3, i * N_CAMERA + N_LENS : (i + 1) * N_CAMERA] = to_center
            B[3:, i * N_CAMERA + N_LENS : (i + 1) * N_CAMERA] = arm @ to_center
        B = B[:, self.free]
        n = len(self.free)
        scale = np.sqrt(np.diag(H))
        bordered = np.zeros((n + N_POSE, n + N_POSE))
        bordered[:n, :n] = H / np.outer(scale, scale)
        B = B / scale
        B /= np.linalg.norm(B, axis=1, keepdims=True)
        bordered[n:, :n], bordered[:n, n:] = B, B.T
        inverse = np.linalg.inv(bordered)[:n, :n]
        return np.asarray(inverse / np.outer(scale, scale))

    def _residuals(self, cameras: Cameras, places: BoardPoses) -> Residuals:
        out = {}
        for (name, pose), s in self.images.items():
            r = cameras[name].project(places[pose].to_rig(self.board.points_mm[s.ids])) - s.pixels
            out[name, pose] = np.nan_to_num(r, nan=1e4)
        return out

    @staticmethod
    def _sigma(residuals: Residuals) -> float:
        """Return the noise by the median of the absolute residuals."""
        return max(mad_sigma(np.concatenate(list(residuals.values())).ravel()), MIN_SIGMA_PX)

    def _cost(self, residuals: Residuals, cameras: Cameras, sigma: float) -> float:
        total = 0.0
        for r in residuals.values():
            z = np.linalg.norm(r, axis=1) / sigma
            total += float(
                np.where(z <= HUBER_SIGMAS, z**2, 2 * HUBER_SIGMAS * z - HUBER_SIGMAS**2).sum()
            )
        for name in () if self.cameras_fixed else self.names:
            total += float((self._lens_pull(name, cameras[name]) ** 2).sum())
        return total

    def _lens_pull(self, name: str, camera: CameraPose) -> Float64Array:
        """Return the distance of a lens from its prior, in standard deviations; 0 where fixed."""
        sigmas = self.sigmas[name]
        gap = _lens(camera) - _lens(self.start[name])
        return np.divide(gap, sigmas, out=np.zeros(N_LENS), where=sigmas > 0)

    def _equations(
        self, cameras: Cameras, places: BoardPoses, residuals: Residuals, sigma: float
    ) -> tuple[Float64Array, Float64Array]:
        """Return the normal matrix and the gradient of half the cost, free parameters only."""
        H, g = np.zeros((self.total, self.total)), np.zeros(self.total)
        for (name, pose), sighting in self.images.items():
            # Gauss-Newton: H = sum J' W J and g = sum J' W r. Each image couples its camera only
            # with its pose; poses are not coupled with each other.
            of_camera, of_place = _derivatives(
                cameras[name], places[pose], self.board.points_mm[sighting.ids]
            )
            r = residuals[name, pose]
            w = np.repeat(_huber(r, sigma), 2) / sigma**2
            i, j = self.names.index(name) * N_CAMERA, self.first + self.poses.index(pose) * N_POSE
            A, B, rows = of_camera.reshape(-1, N_CAMERA), of_place.reshape(-1, N_POSE), r.ravel()
            at, to = slice(i, i + N_CAMERA), slice(j, j + N_POSE)
            H[to, to] += (B * w[:, None]).T @ B
            g[to] += B.T @ (w * rows)
            if not self.cameras_fixed:
                H[at, at] += (A * w[:, None]).T @ A
                H[at, to] += (A * w[:, None]).T @ B
                g[at] += A.T @ (w * rows)
        for i, name in enumerate(() if self.cameras_fixed else self.names):
            lens = np.arange(i * N_CAMERA, i * N_CAMERA + N_LENS)
            sigmas = self.sigmas[name]
            inverse = np.divide(1.0, sigmas, out=np.zeros(N_LENS), where=sigmas > 0)
            H[lens, lens] += inverse**2
            g[lens] += inverse * self._lens_pull(name, cameras[name])
        H[self.first :, : self.first] = H[: self.first, self.first :].T
        return H[np.ix_(self.free, self.free)], g[self.free]

    def _stepped(
        self, cameras: Cameras, places: BoardPoses, step: Float64Array
    ) -> tuple[dict[str, CameraPose], dict[int, BoardPose]]:
        new_cameras, new_places = dict(cameras), dict(places)
        for i, name in enumerate(() if self.cameras_fixed else self.names):
            d = step[i * N_CAMERA : (i + 1) * N_CAMERA]
            new_cameras[name] = step_camera(cameras[name], d)
        for j, pose in enumerate(self.poses):
            d = step[self.first + j * N_POSE : self.first + (j + 1) * N_POSE]
            new_places[pose] = BoardPose(
                _rotate(places[pose].rotation, d[:3]), places[pose].translation_mm + d[3:]
            )
        return new_cameras, new_places


def step_camera(camera: CameraPose, change: Float64Array) -> CameraPose:
    """Return a camera whose parameters have changed.

    Parameters
    ----------
    camera : CameraPose
    change : ndarray of float64, shape (15,)
        Of fx, fy, cx, cy (px), k1, k2, p1, p2, k3, of a rotation about its own axes (rad), and of
        `CameraPose.translation_mm`.
    """
    matrix = camera.matrix.copy()
    matrix[0, 0] += change[0]
    matrix[1, 1] += change[1]
    matrix[:2, 2] += change[2:4]
    matrix[0, 0], matrix[1, 1] = max(matrix[0, 0], 1.0), max(matrix[1, 1], 1.0)
    return replace(
        camera,
        matrix=matrix,
        distortion=camera.distortion + change[4:9],
        rotation=_rotate(camera.rotation, change[9:12]),
        translation_mm=camera.translation_mm + change[12:15],
    )


def _derivatives(
    camera: CameraPose, pose: BoardPose, points_mm: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return d pixel / d camera, shape (n, 2, 15), and d pixel / d pose, shape (n, 2, 6)."""
    on_board = points_mm @ pose.rotation.T
    turned = (on_board + pose.translation_mm) @ camera.rotation.T
    local = turned + camera.translation_mm
    x, y, z = local.T
    a, b = x / z, y / z
    k1, k2, p1, p2, k3 = camera.distortion
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    r2 = a * a + b * b
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * r2 * k3)  # d radial / d r2
    focal = np.array([fx, fy])
    # d distorted / d (a, b)
    across = 2 * a * b * slope + 2 * p1 * a + 2 * p2 * b
    D = np.empty((len(a), 2, 2))
    D[:, 0, 0] = radial + 2 * a * a * slope + 2 * p1 * b + 6 * p2 * a
    D[:, 0, 1] = D[:, 1, 0] = across
    D[:, 1, 1] = radial + 2 * b * b * slope + 6 * p1 * b + 2 * p2 * a
    P = np.zeros((len(a), 2, 3))  # d (a, b) / d local
    P[:, 0, 0] = P[:, 1, 1] = 1 / z
    P[:, 0, 2], P[:, 1, 2] = -a / z, -b / z
    to_pixel = (focal[:, None] * D) @ P
    of_camera = np.zeros((len(a), 2, N_CAMERA))
    bent = distort(np.stack([a, b], axis=-1), camera.distortion)
    of_camera[:, 0, 0], of_camera[:, 1, 1] = bent.T
    of_camera[:, 0, 2] = of_camera[:, 1, 3] = 1.0
    radii = np.stack([r2, r2**2, r2**3], axis=-1)
    terms = np.zeros((len(a), 2, 5))
    for column, k in ((0, 0), (1, 1), (4, 2)):
        terms[:, 0, column], terms[:, 1, column] = a * radii[:, k], b * radii[:, k]
    terms[:, 0, 2], terms[:, 1, 2] = 2 * a * b, r2 + 2 * b * b
    terms[:, 0, 3], terms[:, 1, 3] = r2 + 2 * a * a, 2 * a * b
    of_camera[:, :, 4:9] = focal[:, None] * terms
    of_camera[:, :, 9:12] = -to_pixel @ _cross_matrix(turned)
    of_camera[:, :, 12:15] = to_pixel
    from_rig = to_pixel @ camera.rotation
    return of_camera, np.concatenate([-from_rig @ _cross_matrix(on_board), from_rig], axis=-1)


def _center_derivative(camera: CameraPose) -> tuple[Float64Array, Float64Array]:
    """Return the derivative of a camera's center by its rotation and its translation."""
    back = -camera.rotation.T
    # C = -R' t and R becomes exp([w]) R: dC = -R' [t] w - R' dt
    return back @ _cross_matrix(camera.translation_mm), back


def _cross_matrix(v: Float64Array) -> Float64Array:
    """Return the matrices of the cross product with v, shape (..., 3, 3)."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return np.asarray(out - np.swapaxes(out, -1, -2))


def _rotate(rotation: Float64Array, turn: Float64Array) -> Float64Array:
    """Return a rotation after a small rotation, orthonormal again."""
    product = Rotation.from_rotvec(turn).as_matrix() @ rotation
    u, _, v = np.linalg.svd(product)
    return np.asarray(u @ v)


def _lens(camera: CameraPose) -> Float64Array:
    K = camera.matrix
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *camera.distortion])


def _huber(residual: Float64Array, sigma: float) -> Float64Array:
    return huber_weights(np.linalg.norm(residual, axis=1) / sigma)
