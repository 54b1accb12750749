"""Simulated subjects: head, pigment, blood, expressions and motion."""

from rigsim.subject.perfusion import STATES
from rigsim.subject.person import PRESETS, Subject, SubjectError, make_subject

__all__ = ["PRESETS", "STATES", "Subject", "SubjectError", "make_subject"]
