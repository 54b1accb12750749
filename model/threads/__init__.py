"""Threads of compiled kernels."""

from model.threads.blocks import run_in_blocks

__all__ = ["run_in_blocks"]
