"""The one exception that a user's input can cause."""

from __future__ import annotations


class UserError(Exception):
    """What the user gave cannot be used. The message is one line: what, where, what to do. Exit code 2."""
