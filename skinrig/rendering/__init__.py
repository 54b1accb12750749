"""Render fitted skin models and compare renderings with photographs: `skinrig render`."""
