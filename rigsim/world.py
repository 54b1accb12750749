"""One simulated world: its clock, its boxes and cameras, its light.

`World.advance` is the only door through which time passes, for ports, cameras and servers alike,
so that everyone who looks sees the same lamps. A world has a virtual clock, which jumps to whatever
comes next, or the real one. Boxes live as long as their world, not as long as the port to them.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import threading
import time
import zlib
from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from capture.devices.camera import Exposure
from capture.rig import LedLimits, Rig, View, load_rig

from .boxes.controller import Controller, Device
from .boxes.dome import DomeUnit, LedPulse
from .boxes.flash import FlashPop, FlashUnit
from .faults import NO_FAULTS, Faults
from .link import Link

if TYPE_CHECKING:
    from .camera import CameraBody

__all__ = ["FlashPop", "LedPulse", "Light", "Scene", "World", "WorldClock", "get"]

SERIAL_NUMBERS = {"flash": "FL-0001", "dome": "DM-0001"}
TRANSCRIPT_LINES = 4096

Light = FlashPop | LedPulse
"""Light that came out of a box: a pop of the flash, or a stretch of one LED's light."""


class Scene(Protocol):
    """What is in front of the cameras."""

    def exposure(
        self, view_name: str, *, pops: Sequence[Any], exposure_s: float, seed: int
    ) -> NDArray[np.uint16]:
        """Return the DN, shape (H, W), of one exposure lit by `pops`.

        They are what the rig's box gives: `FlashPop` of the flash, or `LedPulse` of the dome,
        clipped to the time in which the shutter was open.
        """


class WorldClock:
    """A world's time as a clock for ports and drivers."""

    def __init__(self, world: World) -> None:
        self._world = world

    def monotonic(self) -> float:
        """Return the world's time, in s."""
        return self._world.now

    def sleep(self, seconds: float) -> None:
        """Let `seconds` of the world's time pass."""
        self._world.wait(self._world.now + seconds)


class World:
    """A rig made of physics.

    Parameters
    ----------
    rig
        What stands there; by default the flash rig that ships.
    seed
        Seeds boxes, faults and sensors: same seed, same bytes.
    clock
        ``"virtual"``: time passes when somebody waits; ``"real"``: by itself.
    scene
        What the cameras see; without one, frames hold black level and read noise.
    faults
        What goes wrong; by default nothing.

    Attributes
    ----------
    scene : Scene or None
        May be exchanged between exposures.
    pops : list of FlashPop
        All pops so far.
    pulses : list of LedPulse
        All light of LEDs that has ended, in the order in which it did.
    """

    def __init__(
        self,
        rig: Rig | None = None,
        *,
        seed: int = 0,
        clock: Literal["virtual", "real"] = "virtual",
        scene: Scene | None = None,
        faults: Faults | None = None,
    ) -> None:
        if clock not in ("virtual", "real"):
            raise ValueError(f"clock: got {clock!r}, expected 'virtual' or 'real'")
        self.rig = load_rig("flash") if rig is None else rig
        self.seed = seed
        self.virtual = clock == "virtual"
        self.scene = scene
        self.faults = NO_FAULTS if faults is None else faults
        self.pops: list[FlashPop] = []
        self.pulses: list[LedPulse] = []
        self.clock = WorldClock(self)
        self.transcript: deque[str] = deque(maxlen=TRANSCRIPT_LINES)
        self.lock = threading.RLock()
        self._digest = hashlib.sha256()
        self._started = time.monotonic()
        self._now = 0.0
        self._name = ""
        self._cameras: dict[str, CameraBody] = {}
        self._dome: DomeUnit | None = None
        self._links = {name: self._make_box(name) for name in self.rig.boxes}

    def _make_box(self, name: str) -> Link:
        kinds = {"flash": self._make_flash, "dome": self._make_dome}
        if name not in kinds:
            raise ValueError(f"boxes: got {name!r}, expected one of {', '.join(kinds)}")
        rng = self.rng_for("box", name)
        box = Controller(
            kinds[name](rng),
            serial=self.faults.serial or SERIAL_NUMBERS[name],
            protocol=self.faults.protocol,
            rng=rng,
        )
        return Link(
            box, faults=self.faults, rng=self.rng_for("link", name), record=self._record_bytes
        )

    def _make_flash(self, rng: np.random.Generator) -> Device:
        return FlashUnit(
            on_pop=self.pops.append,
            on_trigger=self._trigger,
            recycle_s=self.rig.recycle_s,
            pops_per_min=self.rig.max_pops_per_min,
            move_s=self.rig.polarizer_move_s,
            misfire=self.faults.misfire,
            slow_charge=self.faults.slow_charge,
            lamp_dead=self.faults.lamp_dead,
            heat=self.faults.heat,
            interlock=self.faults.interlock,
            rng=rng,
        )

    def _make_dome(self, rng: np.random.Generator) -> Device:
        self._dome = DomeUnit(
            self.rig.lights,
            self.rig.leds or LedLimits(),
            cameras=len(self.rig.views),
            on_pulse=self.pulses.append,
            on_trigger=self._trigger,
            dead=self.faults.dead_leds,
            weak=self.faults.weak_leds,
            heat=self.faults.heat,
            interlock=self.faults.interlock,
        )
        return self._dome

    def rng_for(self, *names: str) -> np.random.Generator:
        """Return a generator that depends on the world's seed and on `names` only."""
        words = [zlib.crc32(name.encode()) for name in names]
        return np.random.default_rng(np.random.SeedSequence([self.seed, *words]))

    # time -------------------------------------------------------------------------------------

    @property
    def now(self) -> float:
        """The world's time, in s since it was made."""
        return self._now if self.virtual else time.monotonic() - self._started

    def deadline(self) -> float:
        """Return when something will next happen, in s; inf for never."""
        with self.lock:
            return min(
                (link.deadline(self._now) for link in self._links.values()), default=math.inf
            )

    def advance(self, now: float) -> None:
        """Let time pass up to `now`, in s; everything due before happens at its own time."""
        with self.lock:
            while (due := self.deadline()) <= now:
                self._now = max(self._now, due)
                for link in self._links.values():
                    link.advance(self._now)
            self._now = max(self._now, now)

    def wait(self, until: float) -> None:
        """Let the world's time come to `until`, in s: at once, or by waiting."""
        if self.virtual:
            self.advance(until)
            return
        while (remaining := until - self.now) > 0.0:
            self.advance(self.now)
            time.sleep(min(remaining, max(0.0, self.deadline() - self.now)))
        self.advance(self.now)

    # boxes ------------------------------------------------------------------------------------

    def link(self, name: str) -> Link:
        """Return the line to the box called `name`."""
        if name not in self._links:
            raise KeyError(f"box: got {name!r}, expected one of {', '.join(self._links)}")
        return self._links[name]

    def box(self, name: str) -> Controller:
        """Return the box called `name`."""
        return self.link(name).box

    def _record_bytes(self, now: float, direction: str, data: bytes) -> None:
        line = f"{now:.6f} {direction} {data!r}"
        self.transcript.append(line)
        self._digest.update(line.encode() + b"\n")

    @property
    def transcript_sha256(self) -> str:
        """Hash of everything that went over the lines, with its times."""
        return self._digest.hexdigest()

    # cameras ----------------------------------------------------------------------------------

    def camera(self, view_name: str) -> CameraBody:
        """Return the camera of a view; it lives as long as the world."""
        from .camera import CameraBody

        with self.lock:
            if view_name not in self._cameras:
                self._cameras[view_name] = CameraBody(self, self.rig.view(view_name))
            return self._cameras[view_name]

    def _trigger(self, now: float, mask: int = -1) -> None:
        """Pulse the camera line; a dome pulses the lines of the mask's bits, in the rig's order."""
        for number, view in enumerate(self.rig.views):
            if mask >> number & 1 and view.name in self._cameras:
                self._cameras[view.name].edge(now)

    def light_between(self, start: float, end: float) -> tuple[Light, ...]:
        """Return pops from `start` to `end`, both included, and LEDs' light clipped to them."""
        with self.lock:
            return self.pops_between(start, end) + self._pulses_between(start, end)

    def _pulses_between(self, start: float, end: float) -> tuple[Light, ...]:
        # light is kept in the order in which it ended
        first = bisect_right(self.pulses, start, key=lambda pulse: pulse.t_off_s)
        found = self.pulses[first:]
        if self._dome is not None:
            found += self._dome.light_now(self.now)
        return tuple(
            dataclasses.replace(
                pulse, t_on_s=max(pulse.t_on_s, start), t_off_s=min(pulse.t_off_s, end)
            )
            for pulse in found
            if pulse.t_on_s < end and pulse.t_off_s > start
        )

    def pops_between(self, start: float, end: float) -> tuple[FlashPop, ...]:
        """Return the pops from `start` to `end`, both included, in s."""
        with self.lock:
            return tuple(pop for pop in self.pops if start <= pop.t_s <= end)

    def expose(
        self,
        view_name: str,
        exposure: Exposure,
        t_start: float,
        *,
        seed: int,
        pops: Iterable[Light] | None = None,
    ) -> NDArray[np.uint16]:
        """Return the DN, shape (H, W), of an exposure that began at `t_start`.

        Parameters
        ----------
        view_name
            Camera.
        exposure
            Its settings.
        t_start
            World time of the shutter's opening, s.
        seed
            Of the sensor's noise.
        pops
            Light that was seen; by default what came while the shutter was open.
        """
        end = t_start + exposure.exposure_s
        seen = self.light_between(t_start, end) if pops is None else tuple(pops)
        scene = self.scene
        if scene is None:
            return _dark_frame(self.rig.view(view_name), np.random.default_rng(seed))
        return scene.exposure(view_name, pops=seen, exposure_s=exposure.exposure_s, seed=seed)

    # names ------------------------------------------------------------------------------------

    def register(self, name: str) -> str:
        """Make the world reachable as ``sim://flash?world=NAME`` and return `name`."""
        other = _BENCH.setdefault(name, self)
        if other is not self:
            raise ValueError(f"name: got {name!r}, which another world has; unregister it first")
        self._name = name
        return name

    def unregister(self) -> None:
        """Take the world's name away; doing so twice is allowed."""
        if _BENCH.get(self._name) is self:
            del _BENCH[self._name]
        self._name = ""


_BENCH: dict[str, World] = {}


def get(name: str) -> World:
    """Return the registered world called `name`.

    Raises
    ------
    KeyError
        When there is none.
    """
    if name not in _BENCH:
        known = ", ".join(_BENCH) or "none"
        raise KeyError(f"world: got {name!r}, expected a registered one: {known}")
    return _BENCH[name]


def _dark_frame(view: View, rng: np.random.Generator) -> NDArray[np.uint16]:
    noise = rng.normal(view.black_level, view.read_noise_e / view.gain_e_per_dn, _shape(view))
    return np.rint(np.clip(noise, 0, 2**view.bit_depth - 1)).astype(np.uint16)


def _shape(view: View) -> tuple[int, int]:
    return view.height_px, view.width_px
