"""Capture plans: steps, plans, and the plan generators of each rig."""

from capture.plan.flash import (
    FLAT_POWERS,
    MALUS_ANGLES_DEG,
    Target,
    flash_calibration_plan,
    flash_plan,
)
from capture.plan.steps import (
    POLARIZER_STATES,
    STEP_KINDS,
    Kind,
    Plan,
    PlanError,
    Polarizer,
    Step,
    Value,
)

__all__ = [
    "FLAT_POWERS",
    "MALUS_ANGLES_DEG",
    "POLARIZER_STATES",
    "STEP_KINDS",
    "Kind",
    "Plan",
    "PlanError",
    "Polarizer",
    "Step",
    "Target",
    "Value",
    "flash_calibration_plan",
    "flash_plan",
]
