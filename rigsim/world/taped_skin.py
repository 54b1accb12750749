"""Simulate living skin and the tape that holds it between the jaws of a caliper.

The skin is a spring whose stiffness grows with stretch (a J-shaped curve, Fung 1967 [1]_). It is
stiffer along one direction of the body than across (Flynn et al. 2011 [2]_ on forearms), and it
buckles at a shortening limit, beyond which its resistance no longer grows. Double-sided tape
deforms elastically; beyond a shear force it slips and hardens. The skin therefore stretches by less
than the jaws move, and it does not return exactly when the jaws do. Beyond a stretch limit the tape
detaches.

The mechanics are independent of time: neither the jaws' speed nor pauses matter. A move in one step
and the same move in parts end alike.

References
----------
.. [1] Y. C. Fung, "Elasticity of soft tissues in simple elongation", Am. J. Physiol. 213,
   1532-1544 (1967), doi:10.1152/ajplegacy.1967.213.6.1532
.. [2] C. Flynn, A. Taberner, P. Nielsen, "Mechanical characterisation of in vivo human skin using
   a 3D force-sensitive micro-robot and finite element analysis", Biomech. Model. Mechanobiol. 10,
   27-38 (2011), doi:10.1007/s10237-010-0216-8
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from capture.rig import Caliper

MIN_STRETCH, MAX_STRETCH = 0.2, 2.5
"""Range in which the skin's stretch is sought; no caliper's jaws reach beyond."""


class TapedSkinError(ValueError):
    """Skin, tape or a move with an invalid description."""


@dataclass(frozen=True, slots=True)
class GripState:
    """State of the caliper's grip at one time."""

    angle_deg: float
    """Direction of the jaws' axis, from +x towards +y, degrees, 0 <= angle < 180."""
    step: int
    """Nearest step of the jaws; 0 is neutral."""
    aperture_mm: float
    """Distance of the jaws, mm: the caliper's reading."""
    stretch: float
    """Length of the skin along the jaws' axis over its length at rest; 1 is neutral."""
    attached: bool
    """Whether the tape holds."""
    buckled: bool
    """Whether the skin has buckled out of its plane."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TapeMechanics:
    """Skin and the tape under each jaw, along one direction."""

    stiffness_n: float
    """Force per stretch of skin at rest, N, > 0: modulus times thickness times the jaws' width."""
    stiffening: float
    """Fung's exponent: stiffness grows as e^(stiffening (r - 1)), >= 0; 0 is a linear spring."""
    buckles_at: float
    """Stretch at which skin buckles, 0 < r < 1."""
    detaches_at: float
    """Stretch at which the tape detaches, > 1."""
    tape_n_per_mm: float
    """Elastic stiffness of the tape under both jaws in shear, N/mm, > 0; inf is rigid."""
    slips_at_n: float
    """Shear force from which the tape slips, N, > 0; inf never slips."""
    hardening_n_per_mm: float
    """Increase of the force per slip, N/mm, > 0."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            good = value >= 0.0 if field.name == "stiffening" else value > 0.0
            finite = math.isfinite(value) or field.name in ("tape_n_per_mm", "slips_at_n")
            if not (good and finite):
                raise TapedSkinError(f"{field.name}: got {value}, expected a number > 0")
        if not MIN_STRETCH < self.buckles_at < 1.0 < self.detaches_at < MAX_STRETCH:
            raise TapedSkinError(
                f"buckles_at, detaches_at: got {self.buckles_at}, {self.detaches_at}, expected "
                f"{MIN_STRETCH} < buckles_at < 1 < detaches_at < {MAX_STRETCH}"
            )

    def force_n(self, stretch: float) -> float:
        """Return the force of skin at a stretch, N; > 0 pulls the jaws together.

        Examples
        --------
        >>> skin = draw_mechanics(0, angle_deg=0.0)
        >>> skin.force_n(1.0)
        0.0
        >>> skin.force_n(1.2) - skin.force_n(1.1) > skin.force_n(1.1) > 0.0
        True
        """
        # Fung: dF/dr = k exp(a (r - 1)) integrates to F = k (exp(a (r - 1)) - 1) / a from r = 1.
        strain = max(stretch, self.buckles_at) - 1.0
        if strain <= 0.0 or self.stiffening == 0.0:
            return self.stiffness_n * strain
        return self.stiffness_n * math.expm1(self.stiffening * strain) / self.stiffening


def draw_mechanics(
    seed: int, *, angle_deg: float, stiffness: float = 1.0, tape_seed: int | None = None
) -> TapeMechanics:
    """Draw the mechanics of a subject's skin and tape along one direction.

    Parameters
    ----------
    seed
        The subject, >= 0; same seed and angle, same numbers.
    angle_deg
        Direction of the jaws, degrees.
    stiffness
        Stiffness of the skin relative to normal, > 0.
    tape_seed
        Seed of the tape's bond, which is new in each session; None: `seed`.

    Notes
    -----
    Ranges, drawn uniformly: 0.5 to 0.9 N per unit of stretch at rest (10 mm wide jaws on 1.5 mm of
    skin of 30 to 60 kPa, in the range of in-vivo tests at small strain); 10 to 35 % more or
    less along and across the skin's own direction; stiffening 4 to 6; buckling at r = 0.70 to 0.76
    and detachment at 1.25 to 1.35, the ends of the range that Nagano et al. 2015
    (doi:10.1145/2766894) reached. The tape is this project's choice: 4 to 8 N/mm in shear, slip
    from 0.06 to 0.12 N on, hardening by 1.5 to 3 N/mm: a few percent of 8 mm at large steps.
    """
    if not stiffness > 0.0:
        raise TapedSkinError(f"stiffness: got {stiffness}, expected more than 0")
    subject = np.random.default_rng([seed, 0x736B])
    at_rest_n = subject.uniform(0.5, 0.9)
    stiffening = subject.uniform(4.0, 6.0)
    anisotropy = subject.uniform(0.1, 0.35)
    along_deg = subject.uniform(0.0, 180.0)
    bond_seed = seed if tape_seed is None else tape_seed
    tape = np.random.default_rng([bond_seed, 0x7470, round(100.0 * (angle_deg % 180.0))])
    direction = 1.0 + anisotropy * math.cos(math.radians(2.0 * (angle_deg - along_deg)))
    return TapeMechanics(
        stiffness_n=float(stiffness * at_rest_n * direction),
        stiffening=float(stiffening),
        buckles_at=float(tape.uniform(0.70, 0.76)),
        detaches_at=float(tape.uniform(1.25, 1.35)),
        tape_n_per_mm=float(tape.uniform(4.0, 8.0)),
        slips_at_n=float(tape.uniform(0.06, 0.12)),
        hardening_n_per_mm=float(tape.uniform(1.5, 3.0)),
    )


class TapedSkin:
    """Skin that is, or is not, taped to the jaws of a caliper.

    Parameters
    ----------
    caliper
        Caliper of the jaws; its aperture at step 0 is where they are taped to the skin.
    seed
        The subject, see `draw_mechanics`.
    stiffness
        Stiffness of the skin relative to normal, > 0.
    tape_seed
        See `draw_mechanics`.
    mechanics
        The same mechanics along every direction instead of drawn ones.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> skin = TapedSkin(load_rig("gradient").caliper, seed=1)
    >>> skin.attach(45.0)
    >>> skin.move(8.8)
    >>> 1.0 < skin.state.stretch < 1.1, skin.state.step
    (True, 1)
    """

    def __init__(
        self,
        caliper: Caliper,
        *,
        seed: int = 0,
        stiffness: float = 1.0,
        tape_seed: int | None = None,
        mechanics: TapeMechanics | None = None,
    ) -> None:
        self._caliper = caliper
        self._seed = seed
        self._stiffness = stiffness
        self._tape_seed = tape_seed
        self._fixed = mechanics
        self._angle_deg = caliper.angles_deg[0]
        self._aperture_mm = caliper.aperture_mm
        self._rest_mm = caliper.aperture_mm
        self._attached = False
        self._stretch = 1.0
        self._force_n = 0.0
        self._slip_mm = 0.0
        self.mechanics = self._mechanics(self._angle_deg)

    def _mechanics(self, angle_deg: float) -> TapeMechanics:
        if self._fixed is not None:
            return self._fixed
        return draw_mechanics(
            self._seed, angle_deg=angle_deg, stiffness=self._stiffness, tape_seed=self._tape_seed
        )

    @property
    def force_n(self) -> float:
        """Force on the jaws, N; > 0 pulls them together, < 0 pushes them apart."""
        return self._force_n

    @property
    def slip_mm(self) -> float:
        """Permanent slip of the tape, mm; > 0 after stretching."""
        return self._slip_mm

    @property
    def state(self) -> GripState:
        """Present state of the grip."""
        caliper = self._caliper
        return GripState(
            angle_deg=self._angle_deg,
            step=round((self._aperture_mm - caliper.aperture_mm) / caliper.step_mm),
            aperture_mm=self._aperture_mm,
            stretch=self._stretch,
            attached=self._attached,
            buckled=self._attached and self._stretch <= self.mechanics.buckles_at,
        )

    def attach(self, angle_deg: float) -> None:
        """Tape the jaws to skin at rest, at their present distance, with fresh tape."""
        if not 0.0 <= angle_deg < 180.0:
            raise TapedSkinError(f"angle_deg: got {angle_deg}, expected 0 <= degrees < 180")
        self.release()
        self._angle_deg = angle_deg
        self._rest_mm = self._aperture_mm
        self.mechanics = self._mechanics(angle_deg)
        self._attached = True

    def turn(self, angle_deg: float) -> None:
        """Turn the empty jaws."""
        if self._attached:
            raise TapedSkinError(
                f"angle_deg: got {angle_deg}, expected empty jaws; release the skin first"
            )
        self._angle_deg = angle_deg

    def release(self) -> None:
        """Release the skin, which returns to rest."""
        self._attached = False
        self._stretch, self._force_n, self._slip_mm = 1.0, 0.0, 0.0

    def move(self, aperture_mm: float) -> None:
        """Move the jaws to a distance; the skin follows as far as the tape holds."""
        if not aperture_mm > 0.0:
            raise TapedSkinError(f"aperture_mm: got {aperture_mm}, expected more than 0")
        self._aperture_mm = aperture_mm
        if not self._attached:
            return
        law = self.mechanics
        stretch, force_n = self._balance(self._slip_mm, 0.0)
        excess_n = force_n - law.hardening_n_per_mm * self._slip_mm
        if abs(excess_n) > law.slips_at_n:
            # The tape slips until its hardening balances the force: |F| = slips_at + hardening |s|,
            # so the slip s = soft F - soft yields is linear in F with soft = 1 / hardening.
            yields_n = math.copysign(law.slips_at_n, excess_n)
            soft = 1.0 / law.hardening_n_per_mm
            stretch, force_n = self._balance(-yields_n * soft, soft)
            self._slip_mm = (force_n - yields_n) * soft
        self._stretch, self._force_n = stretch, force_n
        if stretch >= law.detaches_at:
            self.release()

    def _balance(self, offset_mm: float, soft_mm_per_n: float) -> tuple[float, float]:
        """Return stretch and force at which skin, tape and a slip of offset + soft F fill the jaws.

        The total length grows with the stretch, so that bisection finds the only equilibrium.
        """
        law, gap_mm = self.mechanics, self._aperture_mm - offset_mm
        soft = soft_mm_per_n + 1.0 / law.tape_n_per_mm
        low, high = MIN_STRETCH, MAX_STRETCH
        for _ in range(60):
            middle = 0.5 * (low + high)
            if self._rest_mm * middle + soft * law.force_n(middle) < gap_mm:
                low = middle
            else:
                high = middle
        stretch = 0.5 * (low + high)
        return stretch, law.force_n(stretch)
