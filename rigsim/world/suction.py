"""Simulate a contact probe's head on the skin: cup, pump, leaks, and the skin below.

Pressures are suction: mbar below the ambient pressure, > 0. Air is counted in mL at ambient
pressure. The cup between head and skin, and the skin that rises into it, form one volume,

    C dp/dt = pump - L p,    C = volume / 1013.25 mbar + skin compliance in mL/mbar,

with all leaks along its rim in L. The pump has a regulator: it takes ``K (wanted - p)``, limited by
the pump's flow, which falls linearly from its free flow to zero at its dead head. A leak therefore
makes the suction settle lower than requested, at K / (K + L) of it, and a large one keeps it down;
the controller reads the gauge only. When vented, the cup fills through a wide hole. Between two
changes p is a single exponential, so that the state can be evaluated at any time.

The skin's compliance is the fast, elastic one; its creep over some seconds is not modeled.
"""

import dataclasses
import math
import zlib
from bisect import bisect_right
from dataclasses import dataclass
from typing import Final

import numpy as np

ATMOSPHERE_MBAR: Final = 1013.25
"""Standard atmosphere, mbar (ISO 2533:1975)."""
OPEN_RIM_LEAK_ML_PER_S_MBAR: Final = 1.0
"""Leak of a head without contact, mL/s per mbar: about a hundred pumps."""
SKIN_COMPLIANCE_ML_PER_MBAR: Final = {
    "forehead": 4e-4,
    "cheek": 8e-4,
    "chin": 6e-4,
    "abdomen": 1e-3,
}
"""Volume of skin that rises into the cup per suction, mL/mbar: tenths of a millimeter over the
rim's area at tens of mbar, more at loose skin. This project's choice; other sites are as the
chin."""
ROOM_TEMPERATURE_C: Final = 24.0
"""Final temperature of a camera without cooling, degrees Celsius."""
CAMERA_WARMING_TAU_S: Final = 120.0
"""Time constant of a camera's warming, s."""


class SuctionError(ValueError):
    """A head or a pump with an invalid description or use."""


@dataclass(frozen=True, slots=True)
class HeadState:
    """Contact of a contact probe's head, and its camera's temperature, at one time."""

    site: str
    """Its location: a site of the skin, "phantom", or empty: in the air."""
    angle_deg: float
    """Rotation of the head about its own axis, degrees, 0 <= angle < 360."""
    placed: bool
    """Whether it touches the surface on which it was placed."""
    suction_mbar: float
    """Suction below it, mbar below the ambient pressure, >= 0."""
    camera_c: float
    """Temperature of the camera's sensor, degrees Celsius."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SuctionMechanics:
    """One cup and one pump on one surface."""

    cup_ml: float = 2.0
    """Volume of cup and tube, mL, > 0."""
    skin_ml_per_mbar: float = 6e-4
    """Volume that rises into the cup per suction, mL/mbar, >= 0; 0 is a rigid block."""
    regulator_ml_per_s_mbar: float = 8e-3
    """Flow of the pump per missing suction, mL/s per mbar, > 0."""
    free_flow_ml_per_s: float = 0.8
    """Maximum flow, at zero suction, mL/s, > 0."""
    dead_head_mbar: float = 300.0
    """Suction at which the flow is zero, mbar, > 0."""
    leak_ml_per_s_mbar: float = 1e-4
    """Leaks along the rim, mL/s per mbar, >= 0."""
    vent_ml_per_s_mbar: float = 0.05
    """Width of the vent, mL/s per mbar, > 0."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            least = 0.0 if field.name.startswith(("skin", "leak")) else math.ulp(0.0)
            if not least <= value < math.inf:
                raise SuctionError(f"{field.name}: got {value}, expected a finite number > 0")
        if self.regulator_ml_per_s_mbar * self.dead_head_mbar <= self.free_flow_ml_per_s:
            raise SuctionError(
                f"regulator_ml_per_s_mbar: got {self.regulator_ml_per_s_mbar}, expected more than "
                "free_flow_ml_per_s / dead_head_mbar"
            )

    @property
    def compliance_ml_per_mbar(self) -> float:
        """Volume of air to be removed per suction, mL/mbar."""
        return self.cup_ml / ATMOSPHERE_MBAR + self.skin_ml_per_mbar

    @property
    def time_constant_s(self) -> float:
        """Time constant with which the regulated pump settles, s.

        Examples
        --------
        >>> round(SuctionMechanics().time_constant_s, 2)
        0.32
        """
        return self.compliance_ml_per_mbar / (
            self.regulator_ml_per_s_mbar + self.leak_ml_per_s_mbar
        )


@dataclass(frozen=True, slots=True)
class CameraCooler:
    """Camera cooler that keeps one temperature until it fails."""

    setpoint_c: float
    """Degrees Celsius."""
    fails_after_s: float = math.inf
    """World time, s."""

    def camera_c(self, t_s: float) -> float:
        """Return the temperature of the camera at a world time, s, in degrees Celsius.

        Examples
        --------
        >>> cooler = CameraCooler(5.0, fails_after_s=10.0)
        >>> cooler.camera_c(10.0), round(cooler.camera_c(130.0), 1)
        (5.0, 17.0)
        """
        warm_s = t_s - self.fails_after_s
        if warm_s <= 0.0:
            return self.setpoint_c
        return ROOM_TEMPERATURE_C + (self.setpoint_c - ROOM_TEMPERATURE_C) * math.exp(
            -warm_s / CAMERA_WARMING_TAU_S
        )


@dataclass(frozen=True, slots=True)
class _Phase:
    """An interval without switching: p relaxes as one exponential."""

    t_s: float
    site: str
    angle_deg: float
    placed: bool
    from_mbar: float
    drive_mbar_per_s: float
    rate_per_s: float

    def suction_mbar(self, t_s: float) -> float:
        """Return the suction at a time of this phase, mbar."""
        # dp/dt = drive - rate p has the solution p0 + (drive - rate p0) (1 - exp(-rate t)) / rate.
        passed_s = max(0.0, t_s - self.t_s)
        slope = self.drive_mbar_per_s - self.rate_per_s * self.from_mbar
        if self.rate_per_s == 0.0:
            return self.from_mbar + slope * passed_s
        return self.from_mbar - slope * math.expm1(-self.rate_per_s * passed_s) / self.rate_per_s

    def reaches_s(self, mbar: float) -> float:
        """Return when the rising suction reaches `mbar`, world s; inf for never."""
        slope = self.drive_mbar_per_s - self.rate_per_s * self.from_mbar
        if self.rate_per_s == 0.0:
            return self.t_s + (mbar - self.from_mbar) / slope if slope > 0.0 else math.inf
        share = self.rate_per_s * (mbar - self.from_mbar) / slope if slope > 0.0 else math.inf
        return self.t_s - math.log1p(-share) / self.rate_per_s if share < 1.0 else math.inf


class ProbeHead:
    """The probe's head on, or off, the skin; its time only moves forward.

    Parameters
    ----------
    cooler
        Cooler of the camera behind it.
    seed
        Seed of rim and skin at each site, >= 0: leaks of 0.5 to 2 % of the regulator's flow on
        skin, a tenth of that on a phantom, and a skin compliance within a fifth of the site's own.
    leak
        A further leak, relative to the regulator's flow, >= 0: the suction settles at no more than
        1 / (1 + leak) of the requested one.
    pump_dead
        The pump's motor does not turn.
    lifts_after_s
        The head detaches, once, at this time after the pump was first switched on, s.
    mechanics
        The same cup, pump, rim and skin everywhere, instead of drawn ones.

    Examples
    --------
    >>> head = ProbeHead(CameraCooler(5.0), seed=1)
    >>> head.place("cheek", 45.0, 0.0)
    >>> head.start_suction(60.0, 1.0)
    >>> round(head.suction_mbar(1.3)), round(head.suction_mbar(4.0))
    (35, 59)
    >>> head.state_at(0.5)
    HeadState(site='cheek', angle_deg=45.0, placed=True, suction_mbar=0.0, camera_c=5.0)
    """

    def __init__(
        self,
        cooler: CameraCooler,
        *,
        seed: int = 0,
        leak: float = 0.0,
        pump_dead: bool = False,
        lifts_after_s: float = math.inf,
        mechanics: SuctionMechanics | None = None,
    ) -> None:
        if not 0.0 <= leak < math.inf:
            raise SuctionError(f"leak: got {leak}, expected a finite number >= 0")
        self._cooler = cooler
        self._seed = seed
        self._leak = leak
        self._pump_dead = pump_dead
        self._lifts_after_s = lifts_after_s
        self._fixed = mechanics
        self._lifts_at_s = math.inf
        self._switch_s = math.inf  # when a pump at full speed enters its regulator's range
        self._wanted_mbar: float | None = None
        self._vented = True
        self.mechanics = self._mechanics("")
        self._phases: list[_Phase] = []
        self._begin(0.0, site="", angle_deg=0.0, placed=False)

    def _mechanics(self, site: str) -> SuctionMechanics:
        if self._fixed is not None:
            return self._fixed
        plain = SuctionMechanics()
        rng = np.random.default_rng([self._seed, 0x7375, zlib.crc32(site.encode())])
        rim, skin = float(rng.uniform(0.005, 0.02)), float(rng.uniform(0.8, 1.2))
        give = SKIN_COMPLIANCE_ML_PER_MBAR.get(site, SKIN_COMPLIANCE_ML_PER_MBAR["chin"])
        if site == "phantom":
            rim, give = 0.1 * rim, 0.0
        leak = plain.regulator_ml_per_s_mbar * (rim + self._leak)
        return dataclasses.replace(plain, skin_ml_per_mbar=give * skin, leak_ml_per_s_mbar=leak)

    # events -----------------------------------------------------------------------

    def place(self, site: str, angle_deg: float, now: float) -> None:
        """Place the head at a site; `site` "" is in the air."""
        if not 0.0 <= angle_deg < 360.0:
            raise SuctionError(f"angle_deg: got {angle_deg}, expected 0 <= degrees < 360")
        self.advance(now)
        if not self._vented:
            raise SuctionError(f"site: got {site!r}, expected a vented head; vent it first")
        self.mechanics = self._mechanics(site)
        self._begin(now, site=site, angle_deg=angle_deg, placed=bool(site))

    def remove(self, now: float) -> None:
        """Take the head off, or detach it by a fault."""
        self.advance(now)
        last = self._phases[-1]
        if last.placed:
            self._begin(now, site="", angle_deg=last.angle_deg, placed=False)

    def start_suction(self, target_mbar: float, now: float) -> None:
        """Close the vent and switch the pump on."""
        if not 0.0 < target_mbar < math.inf:
            raise SuctionError(f"target_mbar: got {target_mbar}, expected mbar > 0")
        self.advance(now)
        self._vented, self._wanted_mbar = False, target_mbar
        if math.isinf(self._lifts_at_s):
            self._lifts_at_s = now + self._lifts_after_s
        self._renew(now)

    def vent(self, now: float) -> None:
        """Switch the pump off and open the vent."""
        self.advance(now)
        if not self._vented:
            self._vented, self._wanted_mbar = True, None
            self._renew(now)

    # time -------------------------------------------------------------------------------------

    def advance(self, now: float) -> None:
        """Advance time to `now`, in s."""
        while (due := min(self._switch_s, self._lifts_at_s)) <= now:
            if self._lifts_at_s <= due:
                self._lifts_at_s = self._lifts_after_s = math.inf
                last = self._phases[-1]
                if last.placed:
                    self._begin(due, site="", angle_deg=last.angle_deg, placed=False)
            else:
                self._renew(due)

    def suction_mbar(self, now: float) -> float:
        """Return the suction now, mbar."""
        self.advance(now)
        return max(0.0, self._phases[-1].suction_mbar(now))

    def camera_c(self, now: float) -> float:
        """Return the temperature of the camera, degrees Celsius."""
        return self._cooler.camera_c(now)

    def state_at(self, t_s: float) -> HeadState:
        """Return the head's state at a time up to now, world s."""
        first = bisect_right(self._phases, t_s, key=lambda phase: phase.t_s)
        phase = self._phases[max(first - 1, 0)]
        suction_mbar = max(0.0, phase.suction_mbar(t_s))
        camera_c = self._cooler.camera_c(t_s)
        return HeadState(phase.site, phase.angle_deg, phase.placed, suction_mbar, camera_c)

    @property
    def change_times_s(self) -> tuple[float, ...]:
        """World times at which something was switched or changed, s, ascending."""
        return tuple(phase.t_s for phase in self._phases)

    def _renew(self, now: float) -> None:
        last = self._phases[-1]
        self._begin(now, site=last.site, angle_deg=last.angle_deg, placed=last.placed)

    def _begin(self, now: float, *, site: str, angle_deg: float, placed: bool) -> None:
        """Begin a phase with the present switching state."""
        law = self.mechanics
        from_mbar = self._phases[-1].suction_mbar(now) if self._phases else 0.0
        share = 1.0 / law.compliance_ml_per_mbar
        leak = law.leak_ml_per_s_mbar if placed else OPEN_RIM_LEAK_ML_PER_S_MBAR
        drive, rate, regulated_mbar = 0.0, leak, math.inf
        if self._vented:
            rate += law.vent_ml_per_s_mbar
        elif self._wanted_mbar is not None and not self._pump_dead:
            falls = law.free_flow_ml_per_s / law.dead_head_mbar
            gain = law.regulator_ml_per_s_mbar
            # The regulator requests K (wanted - p), the pump's maximum is F - falls p. Below the
            # suction at which both are equal the pump runs at its maximum.
            regulated_mbar = (gain * self._wanted_mbar - law.free_flow_ml_per_s) / (gain - falls)
            if from_mbar >= regulated_mbar - 1e-9:
                drive, rate = gain * self._wanted_mbar, rate + gain
                regulated_mbar = math.inf
            else:
                drive, rate = law.free_flow_ml_per_s, rate + falls
        phase = _Phase(now, site, angle_deg, placed, from_mbar, drive * share, rate * share)
        if self._phases and self._phases[-1].t_s == now:
            self._phases.pop()
        self._phases.append(phase)
        self._switch_s = math.inf
        if math.isfinite(regulated_mbar):
            self._switch_s = phase.reaches_s(regulated_mbar)
