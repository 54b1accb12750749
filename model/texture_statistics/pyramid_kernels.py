"""Filter half spectra of the steerable pyramid, several orientations per pass, compiled."""

# mypy: allow-untyped-defs

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def split(spectrum, rows, weight, fy, fx, toward, factor, out, begin, end):
    """Extract the orientation bands of one level from a spectrum.

    Parameters
    ----------
    spectrum : (H, W // 2 + 1) complex
        Of the whole image.
    rows : (h,) int64
        Rows of the level in ``spectrum``.
    weight : (h, w // 2 + 1) float
        The level's radial filter over the K - 1 th power of the radius.
    fy, fx : (h,), (w // 2 + 1,) float
        Frequencies, 1 at the image's Nyquist frequency.
    toward : (K, 2) float
        Cosine and sine of the orientations.
    factor : complex
        Phase of the filters.
    out : (K, h, w // 2 + 1) complex, written between rows ``begin`` and ``end``
    """
    order = toward.shape[0] - 1
    for k in range(toward.shape[0]):
        for y in range(begin, end):
            up = fy[y] * toward[k, 1]
            for x in range(fx.size):
                along = fx[x] * toward[k, 0] + up
                gain = weight[y, x]
                for _ in range(order):
                    gain *= along
                out[k, y, x] = factor * (gain * spectrum[rows[y], x])


@njit(cache=True, nogil=True, error_model="numpy")
def merge(bands, rows, weight, fy, fx, toward, factor, spectrum, begin, end):
    """Add the filtered orientations of one level to a spectrum: the adjoint of `split`.

    Parameters as of `split`; ``spectrum`` is added to, ``bands`` is read.
    """
    order = toward.shape[0] - 1
    for y in range(begin, end):
        for k in range(toward.shape[0]):
            up = fy[y] * toward[k, 1]
            for x in range(fx.size):
                along = fx[x] * toward[k, 0] + up
                gain = weight[y, x]
                for _ in range(order):
                    gain *= along
                spectrum[rows[y], x] += factor * (gain * bands[k, y, x])
