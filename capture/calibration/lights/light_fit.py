"""Fit intensities and lobes of the lights, gains and vignetting of the cameras to a white plate.

The logarithm of the signal of a part of the plate is a sum: of the light's intensity, its lobe
there, the cosine of incidence, the distance, the camera's gain and its vignetting. All frames
together are fitted by a few Gauss-Newton steps. They also fit a small rotation of the plate at each
pose, within the error of its markers, and a small slope of each part, within the flatness of the
plate. Before that, the shading of each light is compared with that of all lights: parts, poses and
dark frames determine the position of a light.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from capture.arrays import BoolArray, Float64Array, Int64Array
from capture.calibration.geometry import CameraPose
from capture.calibration.lights.light_list import CameraResponse, LightTable
from capture.calibration.lights.white_plate import PlateSamples, WhitePlate
from capture.calibration.record import CalibrationError

_log = logging.getLogger(__name__)

# parameters of a light (intensities, exponent, tilt), of a camera, of a pose or a part
N_LIGHT, N_RESPONSE, N_TILT = 6, 5, 2
MIN_INCIDENCE_COSINE = 0.25  # of incidence: at grazing incidence the plate's waviness dominates
MAX_LAST_STEP_SIGMAS = 0.1
"""Last step, in standard errors, from which a fit is reported as unfinished."""
N_LIGHT_FIT_STEPS = 6
TILT_PRIOR_RAD = 0.05  # largest angle between an LED's axis and the rig's origin
EXPONENT_PRIOR_STD = 1.0
NORMAL_PRIOR_RAD = 2e-3  # error of the plate's normal from its markers
GAIN_PRIOR_STD = 0.2  # relative, of a camera's response
VIGNETTING_PRIOR_STD = 0.4
FRAME_RELATIVE_STDERR = 3e-3  # relative, common to a frame: the LED's pulses, the plate's position
# relative, of a part's mean: responses of pixels, form of the vignetting, cleanness
PLATE_PART_RELATIVE_STDERR = 3e-3
DEAD_LIGHT_BRIGHTNESS = 0.02  # of the usual brightness: a dimmer light is dead
DEAD_SIGMAS = 5.0
MAX_SHADING_MISFIT = 3e-3  # fraction of a light's energy unexplained by its own shading
MIN_SHADING_MISFIT_RATIO = 5.0  # smallest improvement of the fit by another light's shading


class LightFitError(CalibrationError):
    """Raised for frames of a white plate that cannot calibrate the lights."""


@dataclass(frozen=True, slots=True, eq=False)
class LightFit:
    """Lights and cameras fitted to frames of a white plate.

    Attributes
    ----------
    table : LightTable
        Table with intensities, lobes, axes and camera responses; dead and swapped lights are not
        valid in it.
    dead : tuple of str
        Lights that were switched on but dark.
    swapped : dict of str to str
        Lights with the shading of another: by the name that was switched on, the name of the light
        that appears to have shone.
    unobserved : tuple of str
        Lights without a usable frame (the plate never faced them).
    residual : float
        Root mean square relative residual of the parts.
    frames : int
        Number of frames used.
    """

    table: LightTable
    dead: tuple[str, ...]
    swapped: dict[str, str]
    unobserved: tuple[str, ...]
    residual: float
    frames: int


def find_swapped_lights(
    samples: Sequence[PlateSamples], table: LightTable
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Find lights whose frames show another light's shading, and dark ones.

    Parameters
    ----------
    samples : sequence of PlateSamples
        Frames lit by one light each, at several poses of the plate, including frames that the light
        cannot reach.
    table : LightTable
        Expected positions of the lights.

    Returns
    -------
    answers : dict of str to str
        By the light that was on, the light whose position explains the frames.
    dead : tuple of str
        Lights whose frames are dark although they should not be.
    """
    by_light: dict[str, list[PlateSamples]] = {}
    for row in samples:
        by_light.setdefault(row.light, []).append(row)
    names = [name for name in table.names if name in by_light]
    level, best = {}, {}
    for name in names:
        rows = by_light[name]
        points = np.concatenate([row.points_mm for row in rows])
        if not len(points):
            continue
        normals = np.concatenate([np.tile(row.normal, (len(row.points_mm), 1)) for row in rows])
        seen = np.concatenate([row.signal.mean(axis=1) / row.on_s for row in rows])
        noise = np.concatenate([row.variance.mean(axis=1) / 3 / row.on_s**2 for row in rows])
        shapes = _shapes(table, points, normals)  # (L, n)
        own = shapes[table.names.index(name)]
        bright = own > 0.3 * own.max(initial=0.0)
        if not bright.any() or own.max() <= 0:
            continue
        error = np.sqrt(noise[bright].sum()) / bright.sum()
        level[name] = (seen[bright].mean() / own[bright].mean(), seen[bright].mean() / error)
        energy = float(seen @ seen)
        power = np.sum(shapes**2, axis=1)
        match = np.clip(shapes @ seen, 0, None)
        left = 1 - match**2 / np.where(power > 0, power, np.inf) / max(energy, 1e-300)
        best[name] = (left[table.names.index(name)], int(np.argmin(left)), float(left.min()))
    usual = float(np.median([share for share, _ in level.values()])) if level else 0.0
    dead = tuple(
        name
        for name, (share, sigmas) in level.items()
        if share < DEAD_LIGHT_BRIGHTNESS * usual and (sigmas < DEAD_SIGMAS or best[name][0] > 0.5)
    )
    answers = {
        name: table.names[other]
        for name, (own_left, other, other_left) in best.items()
        if name not in dead
        and table.names[other] != name
        and own_left > max(MAX_SHADING_MISFIT, MIN_SHADING_MISFIT_RATIO * other_left)
    }
    # a light that shines elsewhere leaves its own position dark, too: it is not dead
    dark_but_elsewhere = {n for n in dead if best[n][2] < 0.05 and level[n][1] > DEAD_SIGMAS}
    answers.update({n: table.names[best[n][1]] for n in dark_but_elsewhere})
    return answers, tuple(n for n in dead if n not in dark_but_elsewhere)


def fit_lights(
    samples: Sequence[PlateSamples],
    table: LightTable,
    cameras: Mapping[str, CameraPose],
    *,
    plate: WhitePlate | None = None,
) -> LightFit:
    """Fit intensities, lobes, gains and vignetting to frames of a white plate.

    Parameters
    ----------
    samples : sequence of PlateSamples
        Frames lit by one light each.
    table : LightTable
        Calibrated positions, nominal axes and exponents; its intensities are not used.
    cameras : mapping of str to CameraPose
        Calibrated, by view name.
    plate : WhitePlate, optional
        Its reflectance and flatness.

    Returns
    -------
    LightFit
        The cameras' gains have a geometric mean of 1 in each channel; the standard errors do not
        include the common error of the plate's reflectance.

    Raises
    ------
    LightFitError
        If no frame is usable.
    """
    answers, dead = find_swapped_lights(samples, table)
    fit = _Fit(table, cameras, plate or WhitePlate())
    for row in samples:
        if row.light in table.names and row.light not in dead and row.light not in answers:
            fit.add(row)
    if not fit.frames:
        raise LightFitError(
            f"samples: none of {len(samples)} frames shows the plate lit from its front, "
            "neither dark nor saturated; check exposure, order of the lights and the plate's "
            "positions"
        )
    with threadpool_limits(limits=1, user_api="blas"):  # many small matrices
        return fit.solve(dead, answers)


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """A frame's parts with all quantities that are constant during the fit."""

    light: int
    view: str
    pose: int
    part: Int64Array  # (n,)
    turns: Float64Array  # derivative of the log by small slopes of the plate along its axes, (n, 2)
    known: Float64Array  # log of white, cosine, distance, (n,)
    direction: Float64Array  # unit vectors from the light to the parts, (n, 3)
    r2: Float64Array  # squared distance from the image's center, 1 in the corner
    log_signal: Float64Array  # (n, 3)
    relative: Float64Array  # relative variance, (n, 3)


class _Fit:
    """Frames of a plate, and the parameters of the model.

    Order of the parameters: each light, each camera's response, the rotation of the plate at each
    pose, and the slope of each of its parts.
    """

    def __init__(
        self, table: LightTable, cameras: Mapping[str, CameraPose], plate: WhitePlate
    ) -> None:
        self.table, self.cameras, self.plate = table, cameras, plate
        self.views = sorted(cameras)
        self.frames: list[_Frame] = []
        self._poses: dict[bytes, int] = {}
        self._responses = N_LIGHT * len(table.names)  # index of the first camera parameter
        self._turns = self._responses + N_RESPONSE * len(cameras)
        up = np.where(np.abs(table.axis[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
        side = np.cross(table.axis, up)
        self._side = side / np.linalg.norm(side, axis=1, keepdims=True)
        self._across = np.cross(table.axis, self._side)

    def add(self, row: PlateSamples) -> None:
        """Add a frame's parts that are lit from their front, if there are enough."""
        pose = self._poses.setdefault(row.normal.tobytes(), len(self._poses))
        light = self.table.names.index(row.light)
        to_light = self.table.position_mm[light] - row.points_mm
        distance = np.linalg.norm(to_light, axis=1)
        cosine = to_light @ row.normal / distance
        clear = (row.signal > 20 * np.sqrt(row.variance)).all(axis=1)
        good = (cosine > MIN_INCIDENCE_COSINE) & clear
        if np.count_nonzero(good) < 4:
            return
        size = np.array(self.cameras[row.view].image_size, float)
        r2 = np.sum((row.pixels - (size - 1) / 2) ** 2, axis=1) / np.sum((size / 2) ** 2)
        toward = to_light[good] / distance[good, None]
        turns = toward @ row.rotation[:, :2] / cosine[good, None]
        known = np.log(self.plate.reflectance * cosine[good] / distance[good] ** 2)
        relative = row.variance[good] / row.signal[good] ** 2 + PLATE_PART_RELATIVE_STDERR**2
        place = turns, known, -toward, r2[good]
        seen = np.log((row.signal / row.on_s)[good]), relative
        self.frames.append(_Frame(light, row.view, pose, row.part[good], *place, *seen))

    def solve(self, dead: tuple[str, ...], swapped: dict[str, str]) -> LightFit:
        """Return the fit; `dead` and `swapped` are of `find_swapped_lights`."""
        lights, last = len(self.table.names), self._turns
        relief = last + N_TILT * (1 + max(f.pose for f in self.frames))
        total = relief + N_TILT * (1 + max(int(f.part.max()) for f in self.frames))
        middle, prior = np.zeros(total), np.zeros(total)
        middle[3 : self._responses : N_LIGHT] = self.table.exponent
        of_light = [0.0] * 3 + [1 / EXPONENT_PRIOR_STD**2] + [1 / TILT_PRIOR_RAD**2] * 2
        of_response = [1 / GAIN_PRIOR_STD**2] * 3 + [1 / VIGNETTING_PRIOR_STD**2] * 2
        prior[: self._responses] = np.tile(of_light, lights)
        prior[self._responses : last] = np.tile(of_response, len(self.views))
        prior[last:relief] = 1 / NORMAL_PRIOR_RAD**2
        prior[relief:] = 1 / self.plate.slope_rad**2
        used = np.zeros(total, bool)
        # Intensities and gains share a free factor per channel. It is fixed by a strong weight on
        # the sum of the cameras' log gains, so that their geometric mean is 1.
        gauge = np.zeros((3, total))
        gauge[:, self._responses : last] = np.tile(np.eye(3, N_RESPONSE), len(self.views))
        numbers = middle.copy()
        # start each intensity at the mean of its frames: the lobe is near 1
        for k in range(lights):
            mine = [f.log_signal - f.known[:, None] for f in self.frames if f.light == k]
            if mine:
                numbers[N_LIGHT * k : N_LIGHT * k + 3] = np.concatenate(mine).mean(axis=0)
        covariance, square, count = np.eye(total), 0.0, 1
        for _ in range(N_LIGHT_FIT_STEPS):
            H, g = np.diag(prior) + 1e6 * gauge.T @ gauge, prior * (numbers - middle)
            g += 1e6 * gauge.T @ (gauge @ numbers)
            square, count = 0.0, 0
            for f in self.frames:
                bump_at = (relief + N_TILT * f.part[:, None] + [0, 1]).ravel()
                columns = np.r_[self._columns(f), bump_at]
                r, J = self._rows(f, numbers, columns)
                w = 1 / f.relative.ravel()
                JW = J * w[:, None]
                # parts of a frame share an error, covariance D + s^2 1 1': inverted by Woodbury's
                # formula
                ones = JW.sum(axis=0)
                share = FRAME_RELATIVE_STDERR**2 / (1 + FRAME_RELATIVE_STDERR**2 * w.sum())
                H[np.ix_(columns, columns)] += JW.T @ J - share * np.outer(ones, ones)
                g[columns] += JW.T @ r - share * ones * (w @ r)
                used[columns] = True
                square += float(r @ r)
                count += len(r)
            free = np.ix_(used, used)
            covariance = np.zeros((total, total))
            covariance[free] = np.linalg.inv(H[free])
            step = -covariance @ np.where(used, g, 0.0)
            numbers = numbers + step
            if np.abs(step).max() < 1e-8:
                break
        errors = np.sqrt(np.clip(np.diag(covariance), 0, None))
        unfinished = float(np.max(np.abs(step) / np.where(errors > 0.0, errors, np.inf)))
        if unfinished > MAX_LAST_STEP_SIGMAS:
            _log.warning(
                "lights by a plate: not converged after %d steps, last step %.2g standard errors",
                N_LIGHT_FIT_STEPS,
                unfinished,
            )
        table, seen = self._table(numbers, errors)
        silent = [name for name, ok in zip(table.names, seen, strict=True) if not ok]
        unseen = tuple(name for name in silent if name not in dead and name not in swapped)
        rms = float(np.sqrt(square / max(count, 1)))
        return LightFit(table, dead, swapped, unseen, rms, len(self.frames))

    def _columns(self, f: _Frame) -> Int64Array:
        """Return the columns of a frame's light, camera and pose."""
        camera = self._responses + N_RESPONSE * self.views.index(f.view)
        starts = (N_LIGHT * f.light, camera, self._turns + N_TILT * f.pose)
        sizes = (N_LIGHT, N_RESPONSE, N_TILT)
        return np.concatenate([at + np.arange(n) for at, n in zip(starts, sizes, strict=True)])

    def _rows(
        self, f: _Frame, numbers: Float64Array, columns: Int64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Return residuals, model minus measured, shape (3 n,), and derivatives by the columns."""
        n = len(f.known)
        mine = numbers[columns]
        light, camera = mine[:N_LIGHT], mine[N_LIGHT : N_LIGHT + N_RESPONSE]
        axis, by_side, by_across = self._tilted(f.light, light[4:6])
        cosine = np.clip(f.direction @ axis, 1e-6, None)
        lobe = light[3] * np.log(cosine)
        vignetting = np.clip(1 + camera[3] * f.r2 + camera[4] * f.r2**2, 0.05, None)
        common = f.known + lobe + np.log(vignetting)
        model = common[:, None] + light[:3] + camera[:3]
        A = np.zeros((n, 3, N_LIGHT + N_RESPONSE))
        A[:, :, :3] = A[:, :, N_LIGHT : N_LIGHT + 3] = np.eye(3)
        A[:, :, 3] = np.log(cosine)[:, None]
        A[:, :, 4] = (light[3] * (f.direction @ by_side) / cosine)[:, None]
        A[:, :, 5] = (light[3] * (f.direction @ by_across) / cosine)[:, None]
        A[:, :, N_LIGHT + 3] = (f.r2 / vignetting)[:, None]
        A[:, :, N_LIGHT + 4] = (f.r2**2 / vignetting)[:, None]
        turns = np.repeat(f.turns, 3, axis=0)
        bumps = np.zeros((3 * n, N_TILT * n))
        row = np.arange(3 * n)[:, None]
        bumps[row, N_TILT * (row // 3) + [0, 1]] = turns
        turn, slopes = np.split(mine[N_LIGHT + N_RESPONSE :], [N_TILT])
        residual = (model - f.log_signal).ravel() + turns @ turn + bumps @ slopes
        return residual, np.concatenate([A.reshape(3 * n, -1), turns, bumps], axis=1)

    def _tilted(self, light: int, tilt: Float64Array) -> tuple[Float64Array, ...]:
        """Return a light's axis, and its derivatives by the tilt to each side."""
        side, across = self._side[light], self._across[light]
        raw = self.table.axis[light] + tilt[0] * side + tilt[1] * across
        length = np.linalg.norm(raw)
        axis = raw / length
        return axis, *((way - (way @ axis) * axis) / length for way in (side, across))

    def _table(self, numbers: Float64Array, errors: Float64Array) -> tuple[LightTable, BoolArray]:
        """Return lights and cameras of the fitted parameters, and the observed lights."""
        table, lights = self.table, len(self.table.names)
        rows = numbers[: self._responses].reshape(lights, N_LIGHT)
        row_errors = errors[: self._responses].reshape(lights, N_LIGHT)
        seen = np.zeros(lights, bool)
        seen[[f.light for f in self.frames]] = True
        tilts = np.where(seen[:, None], rows[:, 4:6], 0.0)
        intensity = np.where(seen[:, None], np.exp(rows[:, :3]), 0.0)
        responses = {}
        for c, view in enumerate(self.views):
            if any(f.view == view for f in self.frames):
                at = slice(self._responses + N_RESPONSE * c, self._responses + N_RESPONSE * (c + 1))
                mine, error = numbers[at], errors[at]
                gain = np.exp(mine[:3])
                responses[self.cameras[view].serial] = CameraResponse(
                    gain, mine[3:].copy(), gain * error[:3], error[3:].copy()
                )
        exponent = np.clip(np.where(seen, rows[:, 3], table.exponent), 0.0, None)
        axis = np.array([self._tilted(k, tilts[k])[0] for k in range(lights)])
        found = table.position_mm, intensity, exponent
        own_errors = intensity * row_errors[:, :3], np.where(seen, row_errors[:, 3], 0.0)
        stderrs = table.position_stderr_mm, *own_errors
        valid = table.valid & seen
        return LightTable(*found, table.names, axis, valid, *stderrs, responses), seen


def _shapes(table: LightTable, points: Float64Array, normals: Float64Array) -> Float64Array:
    """Return the signal of each light of intensity 1 at points with normals, shape (L, n)."""
    to_light = table.position_mm[:, None] - points
    distance = np.linalg.norm(to_light, axis=-1)
    cosine = np.clip(np.sum(to_light * normals, axis=-1) / distance, 0.0, None)
    off = np.clip(-np.einsum("lnk,lk->ln", to_light, table.axis) / distance, 1e-9, None)
    return np.asarray(off ** table.exponent[:, None] * cosine / distance**2)
