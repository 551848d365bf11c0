"""Motions as pictures and films."""
