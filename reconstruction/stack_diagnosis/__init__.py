"""Diagnose images under listed lights: which list, frames and curve the pixels contradict."""

from reconstruction.stack_diagnosis.diagnosis import Diagnosis as Diagnosis
from reconstruction.stack_diagnosis.diagnosis import diagnose_stack as diagnose_stack
from reconstruction.stack_diagnosis.finding import Finding as Finding
