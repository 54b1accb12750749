"""Filter heights and slopes: remove form from a relief, and reduce noise of slopes."""

from dataclasses import replace

import numpy as np
from numba import njit, prange
from scipy import fft, ndimage

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.normal_integration.slope_fields import SlopeField
from reconstruction.normal_integration.weighted_poisson import IntegrationError

SIGMA_PER_CUTOFF = float(np.sqrt(np.log(2.0) / 2.0) / np.pi)
"""Standard deviation of the Gaussian over the wavelength it halves (ISO 16610-21: 0.18739)."""
_TRUNCATE_SIGMAS = 4.0  # standard deviations at which the Gaussian ends


def high_pass(
    height: FloatArray, *, pixel: float, cutoff: float, valid: BoolArray | None = None
) -> FloatArray:
    """Remove form from a height: wavelengths longer than `cutoff`.

    Subtracts at each pixel the plane fitted to its surroundings with Gaussian weights, over valid
    pixels of the same connected part only, as the constants of parts are unrelated.

    Parameters
    ----------
    height : ndarray, shape (H, W)
    pixel : float
        Size of a pixel.
    cutoff : float
        Wavelength whose amplitude is halved, same unit as `pixel`.
    valid : ndarray of bool, shape (H, W), optional

    Returns
    -------
    ndarray, shape (H, W)
        Same type and unit as `height`; 0 where not valid and in parts of fewer than three pixels.

    Raises
    ------
    IntegrationError
        For shapes that do not fit, or a cutoff that is not above zero.

    Notes
    -----
    Farther than 0.75 cutoffs from borders and holes this is the Gaussian filter of ISO 16610-21:
    without phase; a wave of length l keeps the fraction 1 - 2^(-(cutoff / l)^2). Near borders the
    plane keeps a slope from leaking in (ISO 16610-28 for such methods): planes are removed
    everywhere, parabolas up to a constant away from borders.

    Examples
    --------
    >>> import numpy as np
    >>> plane = np.add.outer(np.arange(5.0), np.arange(6.0))
    >>> float(np.abs(high_pass(plane, pixel=1.0, cutoff=4.0)).max()) < 1e-9
    True
    """
    values = np.asarray(height)
    if values.dtype not in (np.float32, np.float64):
        values = values.astype(np.float64)
    Checks(IntegrationError).shape("height", values, ("H", "W"))
    Checks(IntegrationError).within("cutoff, pixel", (cutoff, pixel), "(0, inf)")
    good = np.ones(values.shape, bool) if valid is None else np.asarray(valid, bool)
    Checks(IntegrationError).shape("valid", good, values.shape)
    out = np.zeros_like(values)
    sigma = SIGMA_PER_CUTOFF * cutoff / pixel
    if good.all():
        return _without_planes(values, good, sigma)
    part, _ = ndimage.label(good)
    for number, box in enumerate(ndimage.find_objects(part), start=1):
        inside = part[box] == number
        if np.count_nonzero(inside) >= 3:
            left = _without_planes(np.where(inside, values[box], 0), inside, sigma)
            out[box][inside] = left[inside]
    return out


def _without_planes(values: FloatArray, inside: BoolArray, sigma: float) -> FloatArray:
    reach = max(1, int(np.ceil(_TRUNCATE_SIGMAS * sigma)))
    shape = values.shape
    kind = values.dtype
    size = [fft.next_fast_len(n + min(reach, n), real=True) for n in shape]
    moments = [_moments(n, min(reach, m - 1), sigma) for n, m in zip(size, shape, strict=True)]
    y = [
        np.fft.fft(k).conj().astype(np.complex64 if kind == np.float32 else complex)
        for k in moments[0]
    ]
    x = [np.fft.rfft(k).conj().astype(y[0].dtype) for k in moments[1]]

    middle = values[inside].mean()  # keeps float32 digits for the relief

    def averages(data: FloatArray, orders: list[tuple[int, int]]) -> list[FloatArray]:
        waves = fft.rfft2(data, size, workers=2)
        return [
            fft.irfft2(waves * (y[b][:, None] * x[a][None, :]), size, workers=2)[
                : shape[0], : shape[1]
            ]
            for a, b in orders
        ]

    orders = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
    if inside.all():
        ones = [
            [np.fft.ifft(np.fft.fft(np.ones(n), m) * np.fft.fft(k).conj()).real[:n] for k in of]
            for n, m, of in zip(shape, size, moments, strict=True)
        ]
        weights = [np.multiply.outer(ones[0][b], ones[1][a]).astype(kind) for a, b in orders]
    else:
        weights = averages(inside.astype(kind), orders)
    sums = averages(np.where(inside, values - middle, 0).astype(kind), orders[:3])
    out = np.zeros_like(values)
    _subtract_plane((values - middle).astype(kind), inside, *weights, *sums, out)
    return out


def _moments(size: int, reach: int, sigma: float) -> list[Float64Array]:
    """Return g, u g, u^2 g around 0 on a ring of `size`, u in standard deviations."""
    u = np.arange(-reach, reach + 1)
    g = np.exp(-0.5 * (u / sigma) ** 2)
    g /= g.sum()
    rings = []
    for power in range(3):
        ring = np.zeros(size)
        ring[u] = g * (u / sigma) ** power
        rings.append(ring)
    return rings


@njit(cache=True, parallel=True, error_model="numpy")
def _subtract_plane(h, inside, s, sx, sy, sxx, sxy, syy, t, tx, ty, out):  # type: ignore[no-untyped-def]
    """Write h less the value at the pixel of the plane with these weighted moments.

    Normal equations about the window's center of mass (a, b) / n: covariances xx, yy, xy of the
    positions, x1, y1 of position and height.
    """
    rows, columns = h.shape
    for i in prange(rows):
        for j in range(columns):
            if not inside[i, j]:
                continue
            n, a, b = float(s[i, j]), float(sx[i, j]), float(sy[i, j])
            mean = t[i, j] / n
            xx = sxx[i, j] / n - (a / n) ** 2
            yy = syy[i, j] / n - (b / n) ** 2
            xy = sxy[i, j] / n - a * b / (n * n)
            x1 = tx[i, j] / n - mean * a / n
            y1 = ty[i, j] / n - mean * b / n
            det = xx * yy - xy * xy
            value = mean
            # a part that is a line along one axis has a slope along it only
            if det > 1e-3 * xx * yy and xx > 1e-4 and yy > 1e-4:
                p, q = (x1 * yy - y1 * xy) / det, (y1 * xx - x1 * xy) / det
                value = mean - (p * a + q * b) / n
            elif xx > 1e-4 and xx >= yy:
                value = mean - x1 / xx * a / n
            elif yy > 1e-4:
                value = mean - y1 / yy * b / n
            out[i, j] = h[i, j] - value


def denoise_slopes(
    slopes: SlopeField, *, strength: float = 1.0, sigma_px: float = 1.0
) -> SlopeField:
    """Smooth slopes where their differences are noise, and keep them elsewhere.

    Parameters
    ----------
    slopes : SlopeField
        With `scale`, which is the variance of the noise.
    strength : float
        Factor of the stated variance, >= 0; 0 returns the slopes unchanged.
    sigma_px : float
        Standard deviation of the Gaussian window, px, in (0, 3].

    Returns
    -------
    SlopeField
        Variances are those after smoothing; noise is then correlated between neighbors.

    Raises
    ------
    IntegrationError
        Without standard errors, or for settings out of range.

    Notes
    -----
    At each pixel a plane is fitted to both slopes in the window, weighted by Gaussian and
    variance. Deviations from it beyond the noise are kept: the output is
    f + a (g - f) with f the plane's value, a = max(0, 1 - s E / Q), Q the weighted sum of squared
    residuals of both slopes and E its expectation for noise alone (a local Wiener filter, Lee 1980,
    doi 10.1109/TPAMI.1980.4766994, about a plane instead of a mean). The transfer inside is
    a + (1 - a) exp(-sigma^2 theta^2 / 2), theta in radians per pixel: positive, so that nothing
    rings; at a = 0 noise's variance falls to 1 / (4 pi sigma^2), 0.08 for one pixel.
    """
    if not slopes.scale > 0.0:
        raise IntegrationError(
            "stderr_rad: got none, expected the noise to remove; give it, or set denoise=0"
        )
    Checks(IntegrationError).within("strength", strength, "[0, inf)")
    Checks(IntegrationError).within("sigma_px", sigma_px, "(0, 3]")
    if strength == 0.0:
        return slopes
    reach = int(np.ceil(3.0 * sigma_px))
    u = np.arange(-reach, reach + 1)
    g = np.exp(-0.5 * (u / sigma_px) ** 2)
    gx, gy = np.zeros_like(slopes.gx), np.zeros_like(slopes.gy)
    vx, vy = np.ones_like(slopes.variance_x), np.ones_like(slopes.variance_y)
    _denoise(
        slopes.gx,
        slopes.gy,
        slopes.variance_x,
        slopes.variance_y,
        slopes.valid,
        slopes.scale,
        strength,
        g,
        gx,
        gy,
        vx,
        vy,
    )
    return replace(slopes, gx=gx, gy=gy, variance_x=vx, variance_y=vy)


@njit(cache=True, inline="always", error_model="numpy")
def _plane(values, variance, valid, i, j, g, scale):  # type: ignore[no-untyped-def]
    """Return a window's plane here, its residuals' Q and E, and the variance of f and f, g.

    M = X' X / v is inverted by its cofactors (c..): its last row over det gives f, and the trace
    of M^-1 times the noise's moments (k..) is what the fit takes off E.
    """
    reach = g.size // 2
    rows, columns = values.shape
    m, mx, my, mxx, mxy, myy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    t, tx, ty = 0.0, 0.0, 0.0
    k, kx, ky, kxx, kxy, kyy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    weights, squares = 0.0, 0.0
    here = values[i, j]
    for a in range(max(0, i - reach), min(rows, i + reach + 1)):
        for b in range(max(0, j - reach), min(columns, j + reach + 1)):
            if not valid[a, b]:
                continue
            y, x = float(a - i), float(b - j)
            w = g[a - i + reach] * g[b - j + reach]
            o = w / (scale * variance[a, b])
            d = values[a, b] - here
            weights += w
            squares += o * d * d
            m += o
            mx += o * x
            my += o * y
            mxx += o * x * x
            mxy += o * x * y
            myy += o * y * y
            t += o * d
            tx += o * x * d
            ty += o * y * d
            e = o * w
            k += e
            kx += e * x
            ky += e * y
            kxx += e * x * x
            kxy += e * x * y
            kyy += e * y * y
    cxx, cxy, cx = myy * m - my * my, mx * my - mxy * m, mxy * my - mx * myy
    cyy, cy, c = mxx * m - mx * mx, mxy * mx - my * mxx, mxx * myy - mxy * mxy
    det = mxx * cxx + mxy * cxy + mx * cx
    if not det > 1e-9 * m * mxx * myy:
        return here, 0.0, 0.0, scale * variance[i, j], scale * variance[i, j]
    p, q = (cxx * tx + cxy * ty + cx * t) / det, (cxy * tx + cyy * ty + cy * t) / det
    f = (cx * tx + cy * ty + c * t) / det
    Q = squares - (p * tx + q * ty + f * t)
    E = weights - (cxx * kxx + cyy * kyy + c * k + 2.0 * (cxy * kxy + cx * kx + cy * ky)) / det
    # variance of f: last row c of M^-1 on both sides of X' (w^2 / v) X
    spread = (
        cx * (cx * kxx + cy * kxy + c * kx)
        + cy * (cx * kxy + cy * kyy + c * ky)
        + c * (cx * kx + cy * ky + c * k)
    ) / (det * det)
    shared = c / det * g[reach] * g[reach]  # its covariance with the value here
    return here + f, max(Q, 0.0), max(E, 0.0), spread, shared


@njit(cache=True, parallel=True, error_model="numpy")
def _denoise(gx, gy, vx, vy, valid, scale, strength, g, outx, outy, outvx, outvy):  # type: ignore[no-untyped-def]
    """Write smoothed slopes and their variances over ``scale``."""
    rows, columns = gx.shape
    for i in prange(rows):
        for j in range(columns):
            if not valid[i, j]:
                continue
            fx, Qx, Ex, sx, bx = _plane(gx, vx, valid, i, j, g, scale)
            fy, Qy, Ey, sy, by = _plane(gy, vy, valid, i, j, g, scale)
            Q, E = Qx + Qy, Ex + Ey
            a = max(0.0, 1.0 - strength * E / Q) if Q > 0.0 else 0.0
            outx[i, j] = fx + a * (gx[i, j] - fx)
            outy[i, j] = fy + a * (gy[i, j] - fy)
            b = 1.0 - a
            outvx[i, j] = (b * b * sx + 2.0 * a * b * bx) / scale + a * a * vx[i, j]
            outvy[i, j] = (b * b * sy + 2.0 * a * b * by) / scale + a * a * vy[i, j]
