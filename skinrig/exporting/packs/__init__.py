"""Exports of map packs."""
