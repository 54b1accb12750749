"""A fiber probe's camera made of discs, Poisson numbers and nothing of the package's simulator."""

import numpy as np
import pytest
from scipy.special import erfc

from capture.calibration.fiber.darks import CameraNoise, measure_darks
from capture.rig import load_rig

EXPOSURES_S = 30.0 * 2.0 ** (-(22 - np.arange(23)) * 2 / 3)
RADIUS_PX, EDGE_PX = 13.0, 1.5


class FiberCamera:
    """Discs with blurred edges on a Bayer sensor with dark current, hot pixels and offsets."""

    def __init__(
        self,
        rng,
        *,
        shift=(3.0, -2.0),
        turn_rad=0.004,
        jitter_px=0.8,
        dark_e_per_s=0.2,
        hot=20,
        mixing=None,
        veil=0.0,
        places=None,
    ):
        rig = load_rig("probe")
        view = rig.view("cam")
        self.rng, self.rig, self.view = rng, rig, view
        self.nominal = np.array([fiber.spot_px for fiber in rig.probe.fibers])
        self.names = tuple(fiber.name for fiber in rig.probe.fibers)
        self.noise = CameraNoise.from_view(view)
        self.shape = (view.height_px, view.width_px)
        if places is None:
            middle = self.nominal.mean(axis=0)
            away = self.nominal + rng.normal(0, jitter_px, self.nominal.shape) - middle
            turn = np.array([[np.cos(turn_rad), -np.sin(turn_rad)],
                             [np.sin(turn_rad), np.cos(turn_rad)]])  # fmt: skip
            places = away @ turn.T + middle + np.array(shift)
        self.places = places
        self.discs = np.zeros((28, *self.shape), np.float32)
        for disc, (a, b) in zip(self.discs, places, strict=True):
            rows, columns = (slice(max(int(v) - 26, 0), int(v) + 27) for v in (b, a))
            y, x = np.mgrid[rows, columns]
            part = disc[rows, columns]
            y, x = y[: part.shape[0], : part.shape[1]], x[: part.shape[0], : part.shape[1]]
            part[:] = 0.5 * erfc((np.hypot(x - a, y - b) - RADIUS_PX) / (np.sqrt(2) * EDGE_PX))
        row, column = np.mgrid[: self.shape[0], : self.shape[1]]
        self.color = row % 2 + column % 2  # RGGB: 0, 1, 2 for R, G, B
        self.of_color = [self.discs[:, self.color == c] for c in range(3)]
        self.response = 1 + 0.006 * rng.normal(size=self.shape)
        self.bias_e = rng.normal(0, 1.0, self.shape)
        self.dark = np.full(self.shape, dark_e_per_s)
        where = rng.integers(0, self.dark.size, hot)
        self.dark.ravel()[where] = rng.uniform(20, 400, hot)
        self.mixing = np.eye(28) if mixing is None else mixing
        self.veil = veil

    def rate(self, light):
        """Return electrons per second and pixel; light in a pixel of each spot, shape (28, 3)."""
        mixed = (self.mixing @ light).astype(np.float32)
        mean = np.zeros(self.shape)
        if light.any():
            for c in range(3):
                veil = self.veil * light[:, c].sum()
                mean[self.color == c] = mixed[:, c] @ self.of_color[c] + veil
        return mean * self.response

    def expose(self, rate, exposure_s, *, dark=1.0):
        """Return one frame of some electrons per second and pixel."""
        mean = (rate + self.dark * dark) * exposure_s
        electrons = np.minimum(self.rng.poisson(np.minimum(mean, 1e5)), 1.05 * 18_000.0)
        electrons = electrons + self.rng.normal(0, 7.0, self.shape) + self.bias_e
        value = np.rint(electrons / self.noise.gain_e_per_dn) + self.noise.black_dn
        return np.clip(value, 0, self.noise.white_dn).astype(np.uint16)

    def series(self, light, exposures_s=EXPOSURES_S, **about):
        rate = self.rate(np.asarray(light, float))
        return [self.expose(rate, t, **about) for t in exposures_s]

    def darks(self, exposures_s=(0.00115, 1.0, 30.0), repeats=3, *, temperature_c=None, dark=1.0):
        times = [t for t in exposures_s for _ in range(repeats)]
        frames = self.series(np.zeros((28, 3)), times, dark=dark)
        return measure_darks(frames, times, noise=self.noise, temperature_c=temperature_c)

    def own_light(self, light, spots):
        """Return what each spot's aperture gets of its own fiber, full scales per second."""
        full = self.noise.gain_e_per_dn * self.noise.span_dn
        result = np.empty((28, 3))
        for i in range(28):
            image = np.where(spots.mask(i, self.shape), self.discs[i] * self.response, 0.0)
            for c in range(3):
                result[i, c] = image[self.color == c].sum() * light[i, c] / full
        return result


@pytest.fixture(scope="session")
def fiber_camera():
    return FiberCamera


@pytest.fixture(scope="session")
def all_brackets_s():
    return EXPOSURES_S


@pytest.fixture(scope="session")
def brackets_s():
    """Every second one, from the same shortest to the same longest."""
    return EXPOSURES_S[::2]


@pytest.fixture(scope="session")
def five_decades():
    """Electrons per second of a pixel: from fiber to fiber over five decades, colors differ."""
    return np.geomspace(3e6, 30.0, 28)[:, None] * np.array([0.6, 1.0, 0.5])
