"""Synthetic talkers: lips that close, weights that stay in range, seeds that mean something, truth that is true."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from personalize.pictures import FrameReader
from personalize.talkers.film import ASSETS, DEMO_DISTANCE_M, Truth, demo_identity, render_talker
from personalize.talkers.motion import FACING, talker_motion
from personalize.talkers.style import Style
from personalize.talkers.visemes import ARKIT_NAMES, BILABIALS, VISEMES, Phone, load_phones
from tracker.head import load_head
from tracker.raster import project

DEMO_PHONES = ASSETS / "demo_speech.json"
SENTENCE = [
    Phone(name, 0.12 * index, 0.12 * (index + 1))
    for index, name in enumerate(["SIL", "M", "AA", "P", "IY", "B", "UW", "AE", "F", "OY", "S", "SIL"])
]


@pytest.fixture(scope="module")
def demo_phones() -> list[Phone]:
    return load_phones(DEMO_PHONES)


def test_demo_phones_follow_one_another(demo_phones: list[Phone]) -> None:
    assert demo_phones[0].start == 0 and len(demo_phones) > 300
    assert all(a.end == b.start for a, b in zip(demo_phones, demo_phones[1:]))


@pytest.mark.parametrize("seed", range(4))
def test_weights_stay_in_range(demo_phones: list[Phone], seed: int) -> None:
    motion = talker_motion(demo_phones, 40.0, 30.0, seed, Style.random(seed))
    weights = motion.expression
    assert weights.shape == (1200, len(ARKIT_NAMES)) and weights.dtype == np.float32
    assert weights.min() >= 0 and weights.max() <= 1
    jaw, close = ARKIT_NAMES.index("jawOpen"), ARKIT_NAMES.index("mouthClose")
    assert (weights[:, close] <= weights[:, jaw]).all()
    assert (weights.std(axis=0) > 0.01).sum() > 25  # the whole face is alive


@pytest.mark.parametrize("fps", [25.0, 30.0])
def test_lips_close_on_bilabials_and_open_on_vowels(demo_phones: list[Phone], fps: float) -> None:
    head = load_head()
    motion = talker_motion(demo_phones, 40.0, fps, 3, Style())
    identity = np.zeros(len(head.identity_basis), np.float32)
    gap = head.lip_gap_mm(head.vertices(identity, motion.expression_for(head.expression_names)))

    def extreme(names: set[str], pick: np.ufunc) -> np.ndarray:
        spans = [(int(p.start * fps), int(p.end * fps) + 2) for p in demo_phones if p.name in names]
        return np.array([pick.reduce(gap[a:b]) for a, b in spans])

    closed = extreme(set(BILABIALS), np.minimum)
    assert closed.max() < 0.5 and closed.min() > -1.0
    assert np.median(extreme({"AA", "AE", "AY", "AW"}, np.maximum)) > 6.0


def test_lips_round_for_uw_and_spread_for_iy() -> None:
    motion = talker_motion(SENTENCE, 1.5, 100.0, 0, Style(variation=0.0))
    pucker = motion.expression[:, ARKIT_NAMES.index("mouthPucker")]
    stretch = motion.expression[:, ARKIT_NAMES.index("mouthStretchLeft")]
    iy, uw = 51, 75  # middles of the phones
    assert pucker[uw] > pucker[iy] + 0.15 and stretch[iy] > stretch[uw] + 0.03


def test_a_seed_means_the_same_motion_at_any_rate() -> None:
    slow = talker_motion(SENTENCE, 2.0, 25.0, 7)
    fast = talker_motion(SENTENCE, 2.0, 50.0, 7)
    np.testing.assert_allclose(fast.expression[::2], slow.expression, atol=1e-6)
    np.testing.assert_allclose(fast.rotation[::2], slow.rotation, atol=1e-5)


def test_another_seed_is_another_take_of_the_same_words() -> None:
    first, second = (talker_motion(SENTENCE, 1.5, 30.0, seed, Style()) for seed in (1, 2))
    jaw = ARKIT_NAMES.index("jawOpen")
    assert np.abs(first.expression - second.expression).max() > 0.05
    assert np.corrcoef(first.expression[:, jaw], second.expression[:, jaw])[0, 1] > 0.8


def test_the_head_faces_the_camera_and_turns(demo_phones: list[Phone]) -> None:
    motion = talker_motion(demo_phones, 40.0, 30.0, 0)
    turn = FACING.inv() * Rotation.from_rotvec(motion.rotation)
    yaw, pitch, _ = turn.as_euler("YXZ", degrees=True).T
    assert 16 < np.ptp(yaw) < 44 and np.abs(pitch).max() < 20
    assert (motion.translation[:, 2] > 0.4).all()


def test_unknown_phones_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "phones.json"
    path.write_text('[{"phone": "QQ", "start": 0, "end": 1}]')
    with pytest.raises(ValueError, match="unknown phones QQ"):
        load_phones(path)


def test_every_viseme_asks_for_something_possible() -> None:
    for parts in VISEMES.values():
        for viseme in parts:
            assert all(0 <= value <= 1 for value in viseme.targets.values())


def test_film_and_truth_agree(tmp_path: Path) -> None:
    """The picture shows skin where the truth puts the nose, and the truth survives its file."""
    head = load_head()
    motion = talker_motion(SENTENCE, 0.4, 25.0, 0, distance=DEMO_DISTANCE_M)
    size, focal = (160, 128), 190.0
    path = tmp_path / "talker.mp4"
    truth = render_talker(path, motion, demo_identity(head, 0), head, size, focal, seed=0)
    stored = Truth.load(tmp_path / "talker.truth.npz")
    np.testing.assert_array_equal(stored.expression, truth.expression)
    assert stored.head == f"{head.name}@{head.sha256}" and stored.focal == focal
    frames = [rgb for _, rgb in FrameReader(path)]
    assert len(frames) == len(stored.time) == 10
    face = stored.neutral[head.regions["face"]]
    nose = face[face[:, 2].argmax()]
    for frame, rotation, shift in zip(frames, stored.rotation, stored.translation):
        posed = Rotation.from_rotvec(rotation).apply(nose) + shift
        x, y = project(posed, float(stored.focal), stored.principal).round().astype(int)
        red, green, blue = frame[y, x].astype(int)
        assert red > green > blue and red > 90
