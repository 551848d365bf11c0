"""Phones' pictures of high dynamic range look like those of usual range, by formulas written down anew here."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from personalize.hdr import HLG, KNEE, PQ, ROWS, _hlg, _pq, usual_range
from personalize.pictures import FrameReader

COLOURS = np.array(  # skin, lips, greys, and the three primaries
    [
        *([190, 150, 130], [150, 95, 90], [90, 60, 50], [30, 25, 24]),
        *([120, 120, 120], [15, 15, 15], [200, 200, 200]),
        *([200, 40, 40], [40, 200, 40], [40, 40, 200]),
    ],
    np.uint8,
)


def _primaries(*xy: tuple[float, float]) -> np.ndarray:
    """[3, 3] red, green and blue at xy to CIE XYZ, white at D65."""
    columns = np.array([[x / y, 1, (1 - x - y) / y] for x, y in xy]).T
    x, y = 0.3127, 0.3290
    return columns * np.linalg.solve(columns, [x / y, 1, (1 - x - y) / y])


BT709 = _primaries((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
BT2020 = _primaries((0.708, 0.292), (0.170, 0.797), (0.131, 0.046))


def stored(rgb: np.ndarray, transfer: int) -> np.ndarray:
    """[.., 3] 0..1 as it would be filmed what a screen shows of rgb [.., 3] u8, white at 203 cd/m^2."""
    light = 203 * (rgb / 255.0) ** 2.4 @ (np.linalg.inv(BT2020) @ BT709).T
    if transfer == PQ:
        power = (light / 1e4) ** (2610 / 16384)
        return ((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)) ** (2523 / 32)
    # The scene of a screen of 1000 cd/m^2, whose brightness has the power 1.2 as a whole.
    whole = (light / 1000) @ BT2020[1]
    scene = light / 1000 * (whole ** (1 / 1.2 - 1))[..., None]
    bright = 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene), bright)


def test_levels_that_the_standards_name() -> None:
    assert _pq(np.array([0.0, 0.5081, 0.7518, 1.0])) == pytest.approx(
        [0, 100, 1000, 10_000], rel=2e-3, abs=1e-9
    )
    assert _hlg(np.array([0.0, 0.5, 0.75, 1.0])) == pytest.approx([0, 1 / 12, 0.265, 1], rel=2e-3)


@pytest.mark.parametrize("transfer", [PQ, HLG])
def test_what_a_usual_screen_shows_comes_back(transfer: int) -> None:
    picture = np.round(65535 * stored(COLOURS, transfer)).astype(np.uint16)[None]
    back = usual_range(picture, transfer)[0].astype(float)
    assert COLOURS.max() <= 255 * KNEE
    np.testing.assert_allclose(back, COLOURS, atol=1.0)


@pytest.mark.parametrize("transfer", [PQ, HLG])
def test_what_is_brighter_than_white_is_told_apart(transfer: int) -> None:
    grey = np.linspace(0, 65535, 200).astype(np.uint16)
    seen = usual_range(np.repeat(grey[None, :, None], 3, 2), transfer)[0]
    assert (np.ptp(seen, axis=1) <= 1).all() and (np.diff(seen.astype(int), axis=0) >= 0).all()
    white = np.searchsorted(grey, 65535 * (0.58 if transfer == PQ else 0.75))
    assert seen[0].max() == 0 and 225 < seen[white, 0] < 250 < seen[-1, 0]


def test_a_picture_of_many_rows_is_that_of_each() -> None:
    """Tall pictures are taken some rows at a time."""
    stored = np.random.default_rng(0).integers(0, 65536, (2 * ROWS + 22, 3, 3)).astype(np.uint16)
    whole = usual_range(stored, PQ)
    np.testing.assert_array_equal(whole, np.concatenate([usual_range(row[None], PQ) for row in stored]))


@pytest.mark.parametrize("colours_named", [True, False])
@pytest.mark.parametrize("transfer", [PQ, HLG])
def test_a_film_of_high_range_is_read_in_the_colours_of_the_usual_one(
    tmp_path: Path, transfer: int, colours_named: bool
) -> None:
    picture = np.repeat(np.repeat(COLOURS[None], 32, 0), 32, 1)
    signal = stored(picture, transfer)
    luma = signal @ [0.2627, 0.6780, 0.0593]
    blue, red = (signal[..., 2] - luma) / 1.8814, (signal[..., 0] - luma) / 1.4746
    planes = [876 * luma + 64, *(896 * part[::2, ::2] + 512 for part in (blue, red))]
    path = tmp_path / "film.mov"
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=25, options={"crf": "8"})
        stream.height, stream.width = luma.shape
        stream.pix_fmt = "yuv420p10le"
        colours = stream.codec_context
        colours.color_trc, colours.color_primaries, colours.color_range = transfer, 9, 1
        colours.colorspace = 9 if colours_named else 2
        for index in range(3):
            frame = av.VideoFrame(luma.shape[1], luma.shape[0], "yuv420p10le")
            for plane, values in zip(frame.planes, planes):
                padded = np.zeros((plane.height, plane.line_size // 2), np.uint16)
                padded[: values.shape[0], : values.shape[1]] = np.round(values)
                plane.update(padded.tobytes())
            frame.pts, frame.time_base = index, Fraction(1, 25)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    _, read = next(FrameReader(path))
    middles = read[16, 16::32].astype(float)
    np.testing.assert_allclose(middles, COLOURS, atol=3.0)
    _, small = next(FrameReader(path, max_side=160))
    np.testing.assert_allclose(small[8, 8::16].astype(float), COLOURS, atol=3.0)
