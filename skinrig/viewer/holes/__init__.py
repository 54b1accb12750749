"""Closing of holes in scans."""
