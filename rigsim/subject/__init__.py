"""Simulated subjects: head, pigment, blood, expressions and motion."""

from rigsim.subject.perfusion import STATE_NAMES
from rigsim.subject.person import PRESET_NAMES, SimulatedSubject, SubjectError, make_subject

__all__ = ["PRESET_NAMES", "STATE_NAMES", "SimulatedSubject", "SubjectError", "make_subject"]
