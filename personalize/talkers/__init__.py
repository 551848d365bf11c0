"""Synthetic talkers: made-up facial motion for known speech, with known truth."""
