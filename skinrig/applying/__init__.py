"""Fitted models of a moving face, evaluated."""
