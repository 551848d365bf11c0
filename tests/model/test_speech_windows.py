"""Windows over long sound: they cover everything, and where context does not matter they are the whole."""

import pytest
import torch

from model.speech_windows import OVERLAP, WINDOW, fade_weights, in_windows, window_starts


@pytest.mark.parametrize("rows", [1, 1499, 1500, 1501, 2500, 7777])
def test_windows_cover_everything(rows: int) -> None:
    weight = torch.zeros(rows)
    for start in window_starts(rows):
        part = weight[start : start + WINDOW]
        part += fade_weights(len(part))[:, 0]
    assert weight.min() > 0


@pytest.mark.parametrize("rows", [1, 30, 31, 40, 77])
def test_a_function_of_the_row_alone_is_as_without_windows(rows: int) -> None:
    values = torch.randn(rows, 3, generator=torch.Generator().manual_seed(0))
    longest = 0

    def encode(first: int, stop: int) -> torch.Tensor:
        nonlocal longest
        longest = max(longest, stop - first)
        return values[first:stop]

    torch.testing.assert_close(in_windows(rows, 3, encode, window=30, overlap=10), values)
    assert longest == min(rows, 30)


def test_neighbouring_windows_fade_into_each_other() -> None:
    """Window 0 says 0, window 1 says 1: a line from one to the other over the rows they share."""
    rows = WINDOW + OVERLAP
    result = in_windows(rows, 1, lambda first, stop: torch.full((stop - first, 1), float(first > 0)))[:, 0]
    shared = result[OVERLAP:WINDOW]
    assert (result[:OVERLAP] == 0).all() and (result[WINDOW:] == 1).all()
    assert (shared.diff() >= 0).all() and shared.diff().max() < 2 / OVERLAP
