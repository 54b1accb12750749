"""Benchmark of the fusion of several rigs, on people whose skin is drawn."""
