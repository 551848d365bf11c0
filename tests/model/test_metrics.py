"""The metrics, worked by hand on a few vertices."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from model import metrics
from model.errors import ModelError
from model.metrics import score
from tests.model import talker

ONE_SHOT = np.zeros(6, int)


def moved(*offsets: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Two frames; the reference's two vertices stand still, the sample's are off by these, in both frames."""
    reference = np.random.default_rng(0).standard_normal((1, 2, 3)).repeat(2, axis=0)
    return (reference + np.array(offsets)).astype(np.float32), reference.astype(np.float32)


def test_distances_by_hand() -> None:
    sample, reference = moved((3, 4, 0), (0, 0, 1))
    assert metrics.l2(sample, reference) == pytest.approx(3.0, abs=1e-5)
    assert metrics.l2_paper(sample, reference, 10) == pytest.approx(0.6, abs=1e-5)
    assert metrics.lip_max(sample, reference) == pytest.approx(5.0, abs=1e-5)
    assert metrics.lve(sample, reference) == pytest.approx(25.0, abs=1e-4)


def test_warping_forgives_a_delay_and_counts_a_difference() -> None:
    curve = np.array([0, 0, 1, 5, 1, 0, 0], np.float32)
    assert metrics.lip_sync(np.roll(curve, 1), curve) == 0.0
    assert metrics.lip_sync(curve + 2, curve) == pytest.approx(_slow_warp(curve + 2, curve) / 7)
    assert metrics.lip_sync(np.array([4.0], np.float32), np.array([1, 1, 2], np.float32)) == pytest.approx(
        8 / 3
    )


def test_warping_equals_the_textbook_recursion() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.random(23).astype(np.float32), rng.random(31).astype(np.float32)
    assert metrics.lip_sync(a, b) == pytest.approx(_slow_warp(a, b) / 31, rel=1e-5)


def _slow_warp(a: np.ndarray, b: np.ndarray) -> float:
    table = np.full((len(a) + 1, len(b) + 1), np.inf)
    table[0, 0] = 0
    for i in range(len(a)):
        for j in range(len(b)):
            table[i + 1, j + 1] = abs(a[i] - b[j]) + min(table[i, j + 1], table[i + 1, j], table[i, j])
    return float(table[-1, -1])


def test_warping_of_vertices_by_hand() -> None:
    """A constant offset of (3, 4, 0) on one of two vertices costs 2.5 mm a frame."""
    rest = np.zeros((4, 2, 3), np.float32)
    offset = rest.copy()
    offset[:, 0] = (3, 4, 0)
    assert metrics.lip_dtw(offset, rest) == pytest.approx(2.5)


def test_diversity_by_hand() -> None:
    """Two vertices 3 and 4 mm apart make 5 stacked; of three samples two agree: (0 + 5 + 5) / 3."""
    samples = np.zeros((3, 2, 2, 3), np.float32)
    samples[2, :, 0, 0], samples[2, :, 1, 1] = 3, 4
    assert metrics.diversity(samples) == pytest.approx(10 / 3)
    assert metrics.diversity(samples[:1]) == 0.0


def test_correlation_and_its_border() -> None:
    curve = np.sin(np.arange(30)).astype(np.float32)
    assert metrics.lip_gap_r(3 * curve + 2, curve) == pytest.approx(1.0)
    assert metrics.lip_gap_r(-curve, curve) == pytest.approx(-1.0)
    assert metrics.lip_gap_r(np.full(30, 2.3, np.float32), curve) == 0.0


def test_a_closure_counts_within_60_ms_and_within_its_shot() -> None:
    reference = np.array([5, 5, 0, 5, 5, 5], np.float32)

    def reached(closed_at: int, shot: np.ndarray = ONE_SHOT) -> float:
        sample = np.full(6, 5, np.float32)
        sample[closed_at] = 0.4
        return metrics.closure(sample, reference, shot, fps=30)

    assert [reached(frame) for frame in range(5)] == [0, 1, 1, 1, 0]
    assert reached(3, shot=np.array([0, 0, 0, 1, 1, 1])) == 0.0
    assert metrics.closure(reference, reference + 1, ONE_SHOT, 30) == 1.0


def test_closures_are_counted_by_runs() -> None:
    reference = np.array([0, 0, 0, 5, 0, 5], np.float32)
    sample = np.array([0, 5, 5, 5, 5, 5], np.float32)
    assert metrics.closure(sample, reference, ONE_SHOT, 30) == 0.5


def test_spread_and_velocity_by_hand() -> None:
    reference = np.random.default_rng(2).standard_normal((6, 4)).astype(np.float32)
    assert metrics.spread(0.5 * reference + 3, reference) == pytest.approx(0.5)
    assert metrics.velocity(2 * reference, reference, ONE_SHOT) == pytest.approx(2.0)
    jump = reference.copy()
    jump[3:] += 100
    assert metrics.velocity(jump, reference, np.array([0, 0, 0, 1, 1, 1])) == pytest.approx(1.0, rel=1e-3)
    assert metrics.spread(reference, 0 * reference) == 1.0


def test_seam_by_hand() -> None:
    """Positions 0 0 0 3 3 3: velocity jumps by 3 before and after; the reference's jumps are 1, but across a cut."""
    sample = np.array([0, 0, 0, 3, 3, 3], np.float32)
    reference = np.array([0, 0, 1, 2, 50, 50, 50], np.float32)
    shot = np.array([0, 0, 0, 0, 1, 1, 1])
    # Within shots: |1 - 0 - 0 + 0| = 1, then 0, and 0 after the cut; the 99th percentile of (1, 0, 0) is .98.
    kept = np.array([1, 1, 1, 0, 0, 0], bool)
    assert metrics.seam(sample, kept, reference, shot) == pytest.approx(3 / 0.98)
    # A keyframe at 4: the seam 3|4 sees the jump at 3, the seam 4|5 sees that at 4, which is none.
    keyframe = np.array([0, 0, 0, 0, 1, 0], bool)
    assert metrics.seam(sample, keyframe, reference, shot) == pytest.approx(1.5 / 0.98)
    assert metrics.seam(sample, ~kept & kept, reference, shot) == 0.0
    assert metrics.seam(sample, kept, 0 * reference, shot) == math.inf
    assert metrics.seam(sample[:1], kept[:1], reference, shot) == 0.0


def test_opening_is_negative_where_lips_overlap() -> None:
    mesh = talker.checkpoint([talker.sequence(40, 0)])
    template = mesh.template.copy()
    template[3] = (0.001, 0.002, 0.001)
    rest = metrics.lip_opening_mm(template, mesh.basis, mesh.regions, np.zeros((2, 5, talker.K), np.float32))
    assert rest.shape == (2, 5) and np.allclose(rest, -2.0)


def test_score_equals_the_functions_on_decoded_vertices() -> None:
    reference, other = talker.sequence(40, 0), talker.sequence(40, 1)
    mesh = talker.checkpoint([reference])
    samples = np.stack([other.coefficients, reference.coefficients * 0.5])
    found = score(samples, reference, mesh)
    vertices = 1000 * np.tensordot(samples, mesh.basis, axes=1)
    truth = 1000 * np.tensordot(reference.coefficients, mesh.basis, axes=1)
    gaps = [np.linalg.norm(v[..., 1, :] - v[..., 3, :], axis=-1) for v in (*vertices, truth)]
    lips = talker.REGIONS["lips"]
    expected = {
        "l2_face": np.mean([metrics.l2(v, truth) for v in vertices]),
        "l2_lip": np.mean([metrics.l2(v[:, lips], truth[:, lips]) for v in vertices]),
        "lip_sync": np.mean([metrics.lip_sync(gap, gaps[-1]) for gap in gaps[:-1]]),
        "lip_dtw": np.mean([metrics.lip_dtw(v[:, lips], truth[:, lips]) for v in vertices]),
        "spread": np.mean([metrics.spread(v, truth) for v in vertices]),
        "velocity": np.mean([metrics.velocity(v, truth, np.zeros(40, int)) for v in vertices]),
        "div_e": metrics.diversity(vertices),
        "div_lip": metrics.diversity(vertices[:, :, lips]),
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-4)


def test_score_looks_at_valid_frames_only() -> None:
    reference = talker.sequence(40, 0)
    coefficients, valid = reference.coefficients.copy(), reference.valid.copy()
    coefficients[10:15], valid[10:15] = np.nan, False
    samples = reference.coefficients[None].copy()
    samples[:, 10:15] += 1.0
    found = score(
        samples, replace(reference, coefficients=coefficients, valid=valid), talker.checkpoint([reference])
    )
    assert found["l2_face"] == 0.0 and found["velocity"] == 1.0 and found["lip_gap_r"] == pytest.approx(1.0)


@pytest.mark.parametrize("frames", [1, 2, 40])
def test_score_of_constant_motion_is_finite(frames: int) -> None:
    mesh = talker.checkpoint([talker.sequence(40, 0)])
    reference = talker.sequence(frames, 0)
    found = score(np.full((1, frames, talker.K), 0.01, np.float32), reference, mesh)
    assert all(math.isfinite(value) for value in found.values())
    assert found["lip_gap_r"] == 0.0 and found["div_e"] == 0.0


def test_score_refuses_what_it_cannot_judge() -> None:
    reference = talker.sequence(40, 0)
    mesh = talker.checkpoint([reference])
    with pytest.raises(ModelError, match="shape"):
        score(reference.coefficients, reference, mesh)
    with pytest.raises(ModelError, match="no valid frame"):
        score(reference.coefficients[None], replace(reference, valid=np.zeros(40, bool)), mesh)
    with pytest.raises(ModelError, match="'face'"):
        score(
            reference.coefficients[None], reference, replace(mesh, regions={"lips": talker.REGIONS["lips"]})
        )
