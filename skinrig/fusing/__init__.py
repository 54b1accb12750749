"""Fuse one person's measurements by several rigs: `skinrig fuse`."""
