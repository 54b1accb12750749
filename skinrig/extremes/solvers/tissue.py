"""Extremes of the searches for equilibria: skin's layer, a pushed block, taped skin."""

from collections.abc import Callable
from typing import Final

import numpy as np

from capture.rig import load_rig
from rigsim.skin_patch.equilibrium import EquilibriumError, LayerProblem, find_equilibrium
from rigsim.skin_patch.microrelief import make_micro_skin
from rigsim.skin_patch.stretch import StretchedSkin, layer_problem, mean_gradient, stretch_skin
from rigsim.world.taped_skin import TapedSkin, TapedSkinError, TapeMechanics
from skinrig.applying.pushed_patch import (
    Push,
    PushDiverged,
    PushedPatch,
    PushError,
    SkinBlock,
    push_block,
)
from skinrig.errors import MissingExtra
from skinrig.extremes.expectations import ExpectationError, expect_error, expect_near, expect_within
from skinrig.extremes.inputs import InputPrecision

EQUILIBRIUM_TOL: Final = 1e-6
LAYER_NODES: Final = 64


def _flat_layer(real: InputPrecision, ratio: float, layer_um: float, depth_um: float) -> str:
    """Find the equilibrium of a wave on a layer at half length; return evaluations and residual."""
    x = np.arange(LAYER_NODES) * (2.0 * np.pi * 4 / LAYER_NODES)
    height = np.asarray(real(depth_um * np.cos(x)[None, :].repeat(8, 0)), np.float64)
    even = np.ones_like(height)
    problem = LayerProblem(
        neutral_um=height,
        membrane_um=ratio / 3.0 * layer_um * even,
        bending_um3=ratio / 9.0 * layer_um**3 * even,
        texel_um=10.0,
        gradient=np.diag([0.75, 1.0]),
        poisson=0.5,
    )
    return _solve(problem)


def _solve(problem: LayerProblem) -> str:
    state, went = find_equilibrium(problem, tolerance=EQUILIBRIUM_TOL)
    expect_within(went.residual, 0.0, EQUILIBRIUM_TOL, label="residual")
    if not np.isfinite(state).all():
        raise ExpectationError("state: got NaN, expected finite heights")
    if (np.diff(went.energies) > 1e-12 * abs(went.energies[0])).any():
        raise ExpectationError("energies: got a rise, expected none")
    return (
        f"residual {went.residual:.1e} after {went.evaluations} evaluations, condition "
        f"{went.condition:.2g}"
    )


def _stiff_layer(real: InputPrecision) -> str:
    return _flat_layer(real, 20.0, 12.0, 1.0)


def _rigid_layer(real: InputPrecision) -> str:
    return expect_error(lambda: _flat_layer(real, 1e4, 12.0, 1.0), EquilibriumError, "residual")


def _soft_layer(real: InputPrecision) -> str:
    return _flat_layer(real, 1e-3, 1.0, 1.0)


def _skin_at_ends(real: InputPrecision) -> str:
    skin = make_micro_skin("forehead", seed=0, size_mm=0.3)
    texts = []
    for stretch in (0.73, 1.28):  # ends of the paper's table
        problem = layer_problem(skin, mean_gradient(float(real(stretch)), 0.0))
        texts.append(f"r = {stretch:g}: {_solve(problem)}")
    return "; ".join(texts)


def _default_tolerance(real: InputPrecision) -> str:
    """Compare relief at the simulator's tolerance with relief at `EQUILIBRIUM_TOL`."""
    skin = make_micro_skin("forehead", seed=0, size_mm=0.3)
    problem = layer_problem(skin, mean_gradient(float(real(0.8)), 0.0))
    coarse, _ = find_equilibrium(problem, tolerance=5e-3)
    fine, _ = find_equilibrium(problem, tolerance=EQUILIBRIUM_TOL)
    off = float(np.sqrt(np.mean((coarse[2] - fine[2]) ** 2)) / fine[2].std())
    return expect_within(off, 0.0, 0.02, label="RMS difference of the relief over its RMS")


def _too_few_steps(real: InputPrecision) -> str:
    skin = make_micro_skin("cheek", seed=0, size_mm=0.4)
    problem = layer_problem(skin, mean_gradient(float(real(0.8)), 0.0))
    return expect_error(
        lambda: find_equilibrium(problem, tolerance=EQUILIBRIUM_TOL, steps=2),
        EquilibriumError,
        "residual",
        "after 2 steps",
    )


def _strained(real: InputPrecision, stretch: float) -> StretchedSkin:
    skin = make_micro_skin("forehead", seed=0, size_mm=0.3)
    return stretch_skin(skin, stretch=float(real(stretch)), angle_deg=0.0)


def _excess_ratio(real: InputPrecision, stretch: float, low: float, high: float) -> str:
    found = _strained(real, stretch)
    ratio = found.excess_length / found.neutral_excess_length
    return expect_within(ratio, low, high, label="excess length over that at rest")


def _halved_relief(real: InputPrecision) -> str:
    return _excess_ratio(real, 0.5, 1.0, np.inf)


def _shortened_relief(real: InputPrecision) -> str:
    return _excess_ratio(real, 0.73, 1.0, np.inf)


def _doubled_relief(real: InputPrecision) -> str:
    return _excess_ratio(real, 2.0, 0.0, 1.0)


def _hardly_stretched_relief(real: InputPrecision) -> str:
    found = _strained(real, 1.0 + 1e-5)
    return "heights, um " + expect_near(found.height_um, found.skin.height_um, absolute=0.01)


def _pushed(block: SkinBlock, probe: Push, check: Callable[[PushedPatch], str]) -> str:
    try:
        found = push_block(block, probe)
    except MissingExtra:
        return "not run: scikit-fem is not installed"
    end = found.outcome
    return f"{check(found)}, {end.iterations} iterations, condition {end.condition:.1g}"


def _incompressible_push(real: InputPrecision) -> str:
    block = SkinBlock(poisson=0.5, divisions=(6, 6, 3))
    probe = Push(contact_mm=2.0, depth_mm=float(real(0.5)))
    return _pushed(
        block, probe, lambda found: expect_within(found.volume_ratio, 0.995, 1.005, label="volume")
    )


def _no_push(real: InputPrecision) -> str:
    probe = Push(contact_mm=2.0, tip_mm=1e6, depth_mm=float(real(0.0)), shift_mm=(0.0, 0.0))
    return _pushed(
        SkinBlock(divisions=(6, 6, 3)),
        probe,
        lambda found: expect_near(found.deformed_mm, found.rest_mm, absolute=1e-5),
    )


def _push_through(real: InputPrecision) -> str:
    probe = Push(contact_mm=2.0, depth_mm=float(real(50.0)))
    try:
        return expect_error(
            lambda: push_block(SkinBlock(divisions=(4, 4, 2)), probe), PushDiverged, "% of it"
        )
    except ExpectationError as error:
        if "MissingExtra" in str(error):
            return "not run: scikit-fem is not installed"
        raise


def _contact_between_nodes(real: InputPrecision) -> str:
    probe = Push(contact_mm=float(real(0.01)), center_mm=(0.3, 0.3))
    try:
        return expect_error(
            lambda: push_block(SkinBlock(divisions=(4, 4, 2)), probe), PushError, "contact"
        )
    except ExpectationError as error:
        if "MissingExtra" in str(error):
            return "not run: scikit-fem is not installed"
        raise


def _taped(**changes: float) -> TapedSkin:
    plain = {
        "stiffness_n": 0.7,
        "stiffening": 5.0,
        "buckles_at": 0.72,
        "detaches_at": 1.3,
        "tape_n_per_mm": 6.0,
        "slips_at_n": 0.09,
        "hardening_n_per_mm": 2.0,
    }
    caliper = load_rig("gradient").caliper
    if caliper is None:
        raise ExpectationError("caliper: got none, expected that of the gradient rig")
    skin = TapedSkin(caliper, mechanics=TapeMechanics(**(plain | changes)))
    skin.attach(0.0)
    return skin


def _rigid_tape(real: InputPrecision) -> str:
    skin = _taped(tape_n_per_mm=np.inf, slips_at_n=np.inf)
    start = skin.state.aperture_mm
    skin.move(float(real(1.1)) * start)
    return "stretch " + expect_near(skin.state.stretch, 1.1, relative=1e-6)


def _stiffest_skin(real: InputPrecision) -> str:
    skin = _taped(stiffness_n=float(real(1e6)), slips_at_n=np.inf)
    skin.move(1.1 * skin.state.aperture_mm)
    expect_near(skin.state.stretch, 1.0, absolute=1e-4)
    return "the tape gives way: stretch 1"


def _linear_spring(real: InputPrecision) -> str:
    skin = _taped(stiffening=float(real(0.0)), slips_at_n=np.inf)
    length = skin.state.aperture_mm
    skin.move(1.1 * length)
    # the skin and the tape in series: k (r - 1) = c (1.1 L - r L)
    expected = (0.7 + 6.0 * 1.1 * length) / (0.7 + 6.0 * length)
    return "stretch " + expect_near(skin.state.stretch, expected, relative=1e-6)


def _tape_without_stiffness(real: InputPrecision) -> str:
    return expect_error(lambda: _taped(tape_n_per_mm=float(real(0.0))), TapedSkinError, "tape")
