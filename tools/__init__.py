"""Builders of the embedded assets, run as `python -m tools.NAME`."""
