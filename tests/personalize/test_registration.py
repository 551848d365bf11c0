"""Registration: the motion that was tracked comes out at 30 fps, in the base's topology, nothing across a cut."""

import dataclasses

import numpy as np
import pytest
import trimesh

from model.motion import Motion
from personalize.registration import BaseFace, register, resample, transfer_between
from tracker.head import HeadModel, load_head
from tracker.track import Track


def orthonormal(basis: np.ndarray) -> np.ndarray:
    span, _ = np.linalg.qr(basis.reshape(len(basis), -1).T.astype(np.float64))
    return span.T.reshape(basis.shape).astype(np.float32)


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


def track_of(head: HeadModel, expression: np.ndarray, time: np.ndarray) -> Track:
    frames = len(time)
    zeros = np.zeros((frames, 3), np.float32)
    identity = np.random.default_rng(0).normal(0, 0.5, len(head.identity_basis)).astype(np.float32)
    return Track(
        time=time,
        valid=np.ones(frames, bool),
        confidence=np.ones(frames, np.float32),
        identity=identity,
        expression=expression.astype(np.float32),
        jaw=zeros,
        neck=zeros,
        eyes=np.zeros((frames, 2, 3), np.float32),
        rotation=zeros + 0.3,
        translation=zeros + 0.5,
        focal=500.0,
        principal=np.array([100, 100], np.float32),
        distortion=np.zeros(0, np.float32),
        size=(200, 200),
        head=f"{head.name}@{head.sha256}",
        lip_gap_mm=np.zeros(frames, np.float32),
        reprojection_px=np.zeros(frames, np.float32),
    )


def displacement_mm(motion: Motion, frame: int) -> np.ndarray:
    return np.tensordot(motion.coefficients[frame], motion.basis, axes=1) * 1000


def test_same_topology_gives_back_the_displacements(head: HeadModel) -> None:
    random = np.random.default_rng(1)
    time = np.arange(60) / 30
    expression = np.abs(random.normal(0, 0.1, (60, len(head.expression_basis))))
    base = BaseFace(head.template, head.faces, orthonormal(head.expression_basis))
    motion, report = register(track_of(head, expression, time), np.zeros(60, np.int32), head, base)
    assert not report["transferred"]
    assert report["projection_residual_mm"] < 1e-3
    assert 50 < report["eye_distance_mm"] < 75 and "prior" in report["scale"]
    assert motion.valid.all() and len(motion.valid) == 60
    for frame in (0, 17, 59):
        truth = np.tensordot(expression[frame], head.expression_basis, axes=1) * 1000
        assert np.abs(displacement_mm(motion, frame) - truth).max() < 2e-3


def test_the_pose_of_the_head_stays_out(head: HeadModel) -> None:
    time = np.arange(30) / 30
    expression = np.zeros((30, len(head.expression_basis)), np.float32)
    base = BaseFace(head.template, head.faces, orthonormal(head.expression_basis))
    motion, _ = register(track_of(head, expression, time), np.zeros(30, np.int32), head, base)
    assert np.abs(motion.coefficients).max() == 0


@pytest.mark.parametrize("rate", [24.0, 25.0, 29.97, 50.0, 60.0])
def test_resampling_at_true_times(rate: float) -> None:
    time = np.arange(int(4 * rate)) / rate
    values = np.stack([np.sin(2 * np.pi * 2 * time), time], axis=1).astype(np.float32)
    start, out, valid = resample(values, time, np.ones(len(time), bool), np.zeros(len(time), np.int32))
    at = start + np.arange(len(out)) / 30
    assert valid.all()
    assert np.abs(out[:, 1] - at).max() < 1e-5
    assert np.abs(out[:, 0] - np.sin(2 * np.pi * 2 * at)).max() < 0.05


def test_nothing_is_made_up_across_a_cut_or_a_gap() -> None:
    time = np.arange(100) / 25
    values = np.where(np.arange(100) < 50, 0.0, 1.0)[:, None].astype(np.float32)
    segment = (np.arange(100) >= 50).astype(np.int32)
    usable = np.ones(100, bool)
    usable[70:80] = False
    _, out, valid = resample(values, time, usable, segment)
    assert set(np.unique(out)) == {0.0, 1.0}
    at = np.arange(len(out)) / 30
    between = (at > time[49] + 1e-6) & (at < time[50] - 1e-6)
    assert between.any() and not valid[between].any()
    assert not valid[(at > time[69] + 1e-6) & (at < time[80] - 1e-6)].any()
    assert valid[(at < time[49]) | ((at > time[50]) & (at < time[69]))].all()


@pytest.mark.parametrize("rate", [30, 50, 60, 120])
def test_shots_never_stand_side_by_side(rate: int) -> None:
    """The first frame after a cut is left out: at 60 a second that may be just the one the motion passes over."""
    time = np.arange(6 * rate) / rate
    for cut in range(2 * rate, 2 * rate + 8):
        shot = (np.arange(len(time)) >= cut).astype(np.int32)
        usable = np.arange(len(time)) != cut
        _, out, valid = resample(shot[:, None].astype(np.float32), time, usable, shot)
        assert not (np.diff(out[:, 0]).astype(bool) & valid[1:] & valid[:-1]).any()
        assert (~valid).sum() <= 2 and valid[[0, -1]].all()


def test_another_topology_is_transferred(head: HeadModel) -> None:
    """A coarse ball with a bump is registered onto a finer one that is scaled and shifted."""

    def ball(subdivisions: int, scale: float, shift: float) -> tuple[np.ndarray, np.ndarray]:
        mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.1)
        bump = 1 + 0.3 * np.exp(-(((mesh.vertices - [0, 0, 0.1]) / 0.05) ** 2).sum(1))
        return (mesh.vertices * bump[:, None] * scale + shift).astype(np.float32), mesh.faces.astype(np.int32)

    template, faces = ball(3, 1.0, 0.0)
    other, other_faces = ball(4, 1.2, 0.01)
    base = BaseFace(template, faces, np.zeros((1, *template.shape), np.float32))
    transfer = transfer_between(base, other, other_faces)
    assert transfer.residual_mm < 1.0
    assert np.abs(transfer.apply(other) - (template * 1.2 + 0.01)).mean() < 0.003
    moved = np.broadcast_to(np.array([0, 0.002, 0], np.float32), other.shape)
    assert np.allclose(transfer.apply(moved), [0, 0.002, 0], atol=1e-6)


def test_the_motion_file_is_read_back(head: HeadModel, tmp_path) -> None:  # type: ignore[no-untyped-def]
    time = np.arange(30) / 30
    expression = np.full((30, len(head.expression_basis)), 0.1)
    base = BaseFace(head.template, head.faces, orthonormal(head.expression_basis))
    motion, _ = register(track_of(head, expression, time), np.zeros(30, np.int32), head, base)
    dataclasses.replace(motion, provenance={"tool": "personalize"}).save(tmp_path / "motion.npz")
    again = Motion.load(tmp_path / "motion.npz")
    assert np.array_equal(again.coefficients, motion.coefficients)
    assert again.topology == base.topology and again.provenance == {"tool": "personalize"}
