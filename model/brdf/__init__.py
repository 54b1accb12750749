"""Tabulated BRDFs: table layouts, recipes, microfacet lobes and files."""
