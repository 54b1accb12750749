"""Render flat targets: a ChArUco board and a white plate with markers at its edge.

Every edge of print lies on a lattice, so that a plate is a small raster of reflectances.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit

from rigsim.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from rigsim.package_data import package_table
from rigsim.targets.flat import WHITE_REFLECTANCE
from rigsim.targets.mirror_ball import LampArrays

CELL_MM: Final = 4.5
"""Side of a lattice cell, and of one bit of a marker."""
MARKER_CELLS: Final = 6
"""Side of a marker: four bits and a black border of one on each side."""
SQUARE_CELLS: Final = 8
"""Side of a square of the board."""

PAPER_REFLECTANCE: Final = 0.80
INK_REFLECTANCE: Final = 0.05

DICT_4X4_50: Final[tuple[int, ...]] = package_table("dome_targets")["marker_bits"]
"""Bits of the first markers of the ArUco dictionary of that name, rows from the top, white is 1;
the dictionary is made as in Garrido-Jurado et al. 2014, doi:10.1016/j.patcog.2014.01.005."""

BOARD_SQUARES: Final = (7, 5)
"""Columns and rows of squares of the board; the top left one is black."""
PLATE_CELLS: Final = (56, 44)
"""Columns and rows of lattice cells of the white plate."""
PLATE_FIRST_MARKER: Final = 30
PLATE_MARGIN_CELLS: Final = 1


@dataclass(frozen=True, slots=True, eq=False)
class Plate:
    """A flat diffuse target; x right, y down in front view, z into it."""

    reflectance: Float64Array
    """Of each lattice cell, shape (rows, columns); row 0 is the top."""
    waviness: Float64Array
    """Amplitude of slope, wave vector in 1/mm (2) and phase of waves of the surface, (n, 4)."""

    @property
    def size_mm(self) -> tuple[float, float]:
        """Return width and height, mm."""
        rows, columns = self.reflectance.shape
        return columns * CELL_MM, rows * CELL_MM


def charuco_board() -> Plate:
    """Return a board of `BOARD_SQUARES` with a marker in every white square.

    Examples
    --------
    >>> charuco_board().size_mm
    (252.0, 180.0)
    """
    columns, rows = BOARD_SQUARES
    light = np.zeros((rows * SQUARE_CELLS, columns * SQUARE_CELLS), bool)
    number = 0
    for row in range(rows):
        for column in range(columns):
            if (row + column) % 2 == 0:
                continue
            top, left = row * SQUARE_CELLS, column * SQUARE_CELLS
            light[top : top + SQUARE_CELLS, left : left + SQUARE_CELLS] = True
            _print_marker(light, number, top + 1, left + 1)
            number += 1
    return Plate(np.where(light, PAPER_REFLECTANCE, INK_REFLECTANCE), np.zeros((0, 4)))


def white_plate(*, slope_deg: float, rng: np.random.Generator) -> Plate:
    """Return a plate of PTFE with eight markers at its edge, 180 x 126 mm of it bare.

    Parameters
    ----------
    slope_deg
        RMS of the surface's slope in each direction, degrees.
    rng
        Source of the surface's waves.
    """
    columns, rows = PLATE_CELLS
    light = np.ones((rows, columns), bool)
    edge = PLATE_MARGIN_CELLS
    lefts, tops = (
        (edge, (count - MARKER_CELLS) // 2, count - MARKER_CELLS - edge)
        for count in (columns, rows)
    )
    places = [(left, top) for top in tops for left in lefts if (left, top) != (lefts[1], tops[1])]
    for k, (left, top) in enumerate(places):
        _print_marker(light, PLATE_FIRST_MARKER + k, top, left)
    waves = 6
    length_mm = rng.uniform(30.0, 150.0, waves)
    angle = rng.uniform(0.0, 2.0 * np.pi, waves)
    vector = 2 * np.pi / length_mm[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # n waves of amplitude A along random directions have the slope A sqrt(n / 4) in each one.
    amplitude = np.full(waves, np.radians(slope_deg) * 2.0 / np.sqrt(waves))
    phase = rng.uniform(0.0, 2.0 * np.pi, waves)
    return Plate(
        np.where(light, WHITE_REFLECTANCE, INK_REFLECTANCE),
        np.column_stack([amplitude, vector, phase]),
    )


def _print_marker(light: BoolArray, number: int, top: int, left: int) -> None:
    """Print a marker into a raster, in place."""
    light[top : top + MARKER_CELLS, left : left + MARKER_CELLS] = False
    bits = DICT_4X4_50[number]
    for k in range(16):
        row, column = divmod(k, 4)
        light[top + 1 + row, left + 1 + column] = bool(bits >> (15 - k) & 1)


@dataclass(frozen=True, slots=True, eq=False)
class PlateImage:
    """Points of a plate in a camera's pixels, for all lights."""

    shape: tuple[int, int]
    """Rows and columns of the image."""
    pixel: Int64Array
    """Pixels with a point of the plate, index into the flat image, ascending, shape (n,)."""
    surface: Float64Array
    """Their reflectance, place x and y in mm, and slopes x and y, on the plate, shape (n, 5)."""

    def render(
        self, rotation: Float64Array, position_mm: Float64Array, lights: LampArrays
    ) -> Float32Array:
        """Return each pixel's signal: sum of ``strength lobe cos / d^2`` x reflectance.

        Parameters
        ----------
        rotation, position_mm
            Pose of the plate, as for `trace_plate`.
        lights
            Lights that are on: places in mm (L, 3), axes (L, 3), exponents (L,), strengths (L,).

        Returns
        -------
        ndarray of float32
            Shape (H, W); 0 outside the plate and behind it.
        """
        lamp_mm, lamp_axis, exponent, strength = lights
        lamps = (lamp_mm - position_mm) @ rotation
        out = np.zeros(self.shape[0] * self.shape[1], np.float32)
        given = (lamps, lamp_axis @ rotation, exponent, strength)
        _light_plate(self.pixel, self.surface, *given, out)
        return out.reshape(self.shape)


def trace_plate(
    rays: Float64Array,
    eye_mm: Float64Array,
    rotation: Float64Array,
    position_mm: Float64Array,
    plate: Plate,
    subpixels: int,
) -> PlateImage:
    """Trace a camera's pixels to a plate.

    Parameters
    ----------
    rays
        Directions through the corners of pixels, shape (H + 1, W + 1, 3).
    eye_mm
        Center of projection, shape (3,).
    rotation, position_mm
        From the plate's axes to the rig frame, and the position of its top left corner.
    plate
        The plate.
    subpixels
        Rays along each side of pixels that an edge of print crosses.
    """
    shape = rays.shape[0] - 1, rays.shape[1] - 1
    surface = np.zeros((*shape, 5))
    eye = rotation.T @ (eye_mm - position_mm)
    if eye[2] < 0.0:
        turned = np.ascontiguousarray(rotation.T)
        _trace_plate(rays, eye, turned, plate.reflectance, plate.waviness, subpixels, surface)
    flat = surface.reshape(-1, 5)
    pixel = np.flatnonzero(flat[:, 0])
    return PlateImage(shape, pixel, flat[pixel])


@njit(cache=True, nogil=True)
def _trace_plate(  # type: ignore[no-untyped-def]
    rays, eye, turned, reflectance, waviness, subpixels, out
):
    height, width = rays.shape[0] - 1, rays.shape[1] - 1
    rows, columns = reflectance.shape
    # intersections of the pixel corners' rays with the plate's plane, in cells; far outside if none
    hit = np.empty((height + 1, width + 1, 2))
    for i in range(height + 1):
        for j in range(width + 1):
            d = turned @ rays[i, j]
            if d[2] <= 1e-9:
                hit[i, j, 0] = -1e9
                hit[i, j, 1] = -1e9
            else:
                s = -eye[2] / d[2]
                hit[i, j, 0] = (eye[0] + s * d[0]) / CELL_MM
                hit[i, j, 1] = (eye[1] + s * d[1]) / CELL_MM
    for i in range(height):
        for j in range(width):
            u_low = min(hit[i, j, 0], hit[i, j + 1, 0], hit[i + 1, j, 0], hit[i + 1, j + 1, 0])
            u_high = max(hit[i, j, 0], hit[i, j + 1, 0], hit[i + 1, j, 0], hit[i + 1, j + 1, 0])
            v_low = min(hit[i, j, 1], hit[i, j + 1, 1], hit[i + 1, j, 1], hit[i + 1, j + 1, 1])
            v_high = max(hit[i, j, 1], hit[i, j + 1, 1], hit[i + 1, j, 1], hit[i + 1, j + 1, 1])
            if u_high <= 0.0 or v_high <= 0.0 or u_low >= columns or v_low >= rows or u_low < -1e8:
                continue
            even = u_low >= 0.0 and v_low >= 0.0 and u_high < columns and v_high < rows
            value = 0.0
            if even:
                value = reflectance[int(v_low), int(u_low)]
                for row in range(int(v_low), int(v_high) + 1):
                    for column in range(int(u_low), int(u_high) + 1):
                        even = even and reflectance[row, column] == value
            if not even:
                value = 0.0
                for a in range(subpixels):
                    for b in range(subpixels):
                        y, x = (a + 0.5) / subpixels, (b + 0.5) / subpixels
                        u = (1 - y) * ((1 - x) * hit[i, j, 0] + x * hit[i, j + 1, 0]) + y * (
                            (1 - x) * hit[i + 1, j, 0] + x * hit[i + 1, j + 1, 0]
                        )
                        v = (1 - y) * ((1 - x) * hit[i, j, 1] + x * hit[i, j + 1, 1]) + y * (
                            (1 - x) * hit[i + 1, j, 1] + x * hit[i + 1, j + 1, 1]
                        )
                        if 0.0 <= u < columns and 0.0 <= v < rows:
                            value += reflectance[int(v), int(u)]
                value /= subpixels * subpixels
            if value == 0.0:
                continue
            x_mm = (
                0.25
                * CELL_MM
                * (hit[i, j, 0] + hit[i, j + 1, 0] + hit[i + 1, j, 0] + hit[i + 1, j + 1, 0])
            )
            y_mm = (
                0.25
                * CELL_MM
                * (hit[i, j, 1] + hit[i, j + 1, 1] + hit[i + 1, j, 1] + hit[i + 1, j + 1, 1])
            )
            slope_x = 0.0
            slope_y = 0.0
            for w in range(waviness.shape[0]):
                kx, ky = waviness[w, 1], waviness[w, 2]
                k = (kx * kx + ky * ky) ** 0.5
                wave = waviness[w, 0] * np.sin(kx * x_mm + ky * y_mm + waviness[w, 3])
                slope_x += wave * kx / k
                slope_y += wave * ky / k
            out[i, j, 0] = value
            out[i, j, 1], out[i, j, 2] = x_mm, y_mm
            out[i, j, 3], out[i, j, 4] = slope_x, slope_y


@njit(cache=True, nogil=True)
def _light_plate(  # type: ignore[no-untyped-def]
    pixel, surface, lamps, axes, lamp_exponent, lamp_strength, out
):
    for n in range(len(pixel)):
        value, x_mm, y_mm = surface[n, 0], surface[n, 1], surface[n, 2]
        slope_x, slope_y = surface[n, 3], surface[n, 4]
        length = (1.0 + slope_x * slope_x + slope_y * slope_y) ** 0.5
        light = 0.0
        for m in range(lamps.shape[0]):
            dx, dy, dz = lamps[m, 0] - x_mm, lamps[m, 1] - y_mm, lamps[m, 2]
            cosine = (slope_x * dx + slope_y * dy - dz) / length
            if cosine <= 0.0:
                continue
            square = dx * dx + dy * dy + dz * dz
            d = square**0.5
            off = -(axes[m, 0] * dx + axes[m, 1] * dy + axes[m, 2] * dz) / d
            if off <= 0.0:
                continue
            light += lamp_strength[m] * off ** lamp_exponent[m] * cosine / (d * square)
        out[pixel[n]] = value * light
