"""Check arguments of functions, and files of strangers."""

from model.checks.arguments import FINITE_RANGE, Checks

__all__ = ["FINITE_RANGE", "Checks"]
