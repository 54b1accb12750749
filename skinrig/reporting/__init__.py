"""Sections, pictures and tables of the report."""
