"""Other trackers' folders: known parameters -> files in their formats -> Track -> the same vertices in the camera."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from personalize.errors import UserError
from personalize.heads import read_flame
from personalize.pipeline import STAGES, TRACKED_STAGES, personalize_video
from personalize.registration import BaseFace, register
from personalize.settings import Settings
from personalize.shots import Frames
from personalize.stage import output_paths
from personalize.tracked import placement, read_track_of
from personalize.tracked_files import matrix_of_6d, read_tracked
from tests.flame_factory import FakeFlame, six, write_frame
from tests.personalize.video_factory import moving, write_video
from tracker.head import HeadModel, load_head
from tracker.landmark_indices import BLENDSHAPE_NAMES, POINTS
from tracker.track import Landmarks, Track

FAKE = FakeFlame()
COUNT, SIZE, CROP, SCALE, CORNER = 12, (1280, 720), (512, 512), 1.3, np.array([250.0, 20.0])
FOCAL = 1400.0  # px of the crop


class Clip:
    """Random parameters, and the vertices [n, D, 3] in the OpenCV camera by the reference."""

    def __init__(self, count: int = COUNT, neck: bool = False) -> None:
        rng = np.random.default_rng(2)
        self.identity = rng.normal(0, 0.5, 300).astype(np.float32)
        self.expression = rng.normal(0, 0.7, (count, 100)).astype(np.float32)
        self.jaw = np.abs(rng.normal(0, 0.1, (count, 3))).astype(np.float32)
        self.neck = rng.normal(0, 0.2, (count, 3)).astype(np.float32) * neck
        self.eyes = rng.normal(0, 0.2, (count, 2, 3)).astype(np.float32)
        self.rotation = rng.normal(0, 0.2, (count, 3)).astype(np.float32)
        self.translation = rng.normal(0, 0.02, (count, 3)).astype(np.float32)

    def posed(self, frame: int, root: bool) -> np.ndarray:
        turns = {"neck": self.neck[frame], "jaw": self.jaw[frame], "eyes": self.eyes[frame]}
        turns["root"] = self.rotation[frame] if root else np.zeros(3)
        return FAKE.vertices(self.identity, self.expression[frame], **turns)

    def metrical(self, folder: Path, **changed: np.ndarray) -> np.ndarray:
        """Writes checkpoint/*.frame; X_view = X R + t with x left, y up, z forward; returns OpenCV vertices."""
        (folder / "checkpoint").mkdir(parents=True)
        facing = Rotation.from_euler("y", np.pi)
        turned, camera = facing * Rotation.from_rotvec(self.rotation), []
        for frame in range(len(self.jaw)):
            view, t = turned[frame].as_matrix(), self.translation[frame] + np.float32([0, 0, 0.8])
            flame = {
                "shape": self.identity,
                "exp": self.expression[frame],
                "jaw": six(Rotation.from_rotvec(self.jaw[frame])),
                "eyes": six(Rotation.from_rotvec(self.eyes[frame])).ravel(),
                "eyelids": np.zeros(2),
            } | changed
            place = {"R": six(Rotation.from_matrix(view.T)), "t": t, "fl": [FOCAL / 256], "pp": [0.02, -0.03]}
            write_frame(folder / f"checkpoint/{frame:05d}.frame", flame, place, CROP, frame)
            camera.append((self.posed(frame, root=False) @ view.T + t) * [-1, -1, 1])
        return np.array(camera)

    def vhap(self, folder: Path) -> np.ndarray:
        """Writes tracked_flame_params_30.npz (and an older one); camera of OpenGL at z = 1; OpenCV vertices."""
        folder.mkdir(parents=True)
        data = {
            "rotation": self.rotation, "translation": self.translation, "neck_pose": self.neck, "jaw_pose": self.jaw,
            "eyes_pose": self.eyes.reshape(-1, 6), "shape": self.identity, "expr": self.expression,
            "focal_length": np.float32([FOCAL / 512]), "image_size": np.array(CROP[::-1]),
            "static_offset": np.zeros((1, 5143, 3), np.float32), "timestep_id": np.arange(len(self.jaw)),
        }  # fmt: skip
        np.savez(folder / "tracked_flame_params_30.npz", **data)
        np.savez(folder / "tracked_flame_params_0.npz", **(data | {"expr": 0 * self.expression}))
        world = [self.posed(frame, root=True) + self.translation[frame] for frame in range(len(self.jaw))]
        return (np.array(world) - [0, 0, 1]) * [1, -1, -1]


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> HeadModel:
    folder = tmp_path_factory.mktemp("flame")
    return read_flame(FAKE.write(folder), folder / "mediapipe_landmark_embedding.npz")


def frames_at(time: np.ndarray) -> Frames:
    count = len(time)
    zeros = np.zeros(count, np.uint8)
    box = np.zeros((count, 4), np.float32)
    return Frames(time, np.ones(count, bool), zeros, ("ok",), zeros.astype(np.int32), box)


def landmarks_of(head: HeadModel, camera: np.ndarray, time: np.ndarray, principal: np.ndarray) -> Landmarks:
    """What a perfect landmarker sees of the vertices in the whole video, of which the tracker saw a crop."""
    embedding = head.landmark_embedding
    points = np.einsum("lc,nlcx->nlx", embedding.barycentric, camera[:, head.faces[embedding.triangles]])
    seen = np.zeros((len(time), POINTS, 3), np.float32)
    crop = FOCAL * points[..., :2] / points[..., 2:] + principal
    seen[:, embedding.landmarks, :2] = SCALE * crop + CORNER
    ones = np.ones(len(time), np.float32)
    return Landmarks(time, seen, ones, np.zeros((len(time), 52), np.float32), BLENDSHAPE_NAMES, SIZE)


PRINCIPAL = {
    "metrical": np.array([256 - 0.02 * 256, 256 + 0.03 * 256]) - 0.5,
    "vhap": np.array([255.5, 255.5]),
}


def in_camera(track: Track, head: HeadModel) -> np.ndarray:
    vertices = head.vertices(
        track.identity, track.expression, jaw=track.jaw, neck=track.neck, eyes=track.eyes
    )
    matrix = Rotation.from_rotvec(track.rotation).as_matrix()
    return vertices @ matrix.transpose(0, 2, 1) + track.translation[:, None]


@pytest.mark.parametrize("source", ["metrical", "vhap"])
def test_round_trip(head: HeadModel, tmp_path: Path, source: str) -> None:
    clip, time = Clip(neck=source == "vhap"), np.arange(COUNT) / 30
    camera = getattr(clip, source)(tmp_path / "out")
    landmarks = landmarks_of(head, camera, time, PRINCIPAL[source])
    track = read_track_of(tmp_path / "out", head, frames_at(time), landmarks)
    assert np.abs(in_camera(track, head) - camera).max() < 1e-6
    assert track.focal == pytest.approx(SCALE * FOCAL, rel=1e-4)
    np.testing.assert_allclose(track.principal, SCALE * PRINCIPAL[source] + CORNER, atol=0.2)
    assert track.valid.all() and track.reprojection_px.max() < 0.05 and track.confidence.min() > 0.5
    assert track.head == f"flame2023@{head.sha256}" and track.size == SIZE
    gaps = head.lip_gap_mm(head.vertices(track.identity, track.expression, jaw=track.jaw))
    np.testing.assert_allclose(track.lip_gap_mm, gaps, atol=1e-3)


def test_the_motion_is_free_of_head_and_neck(head: HeadModel, tmp_path: Path) -> None:
    clip, time = Clip(neck=True), np.arange(COUNT) / 30
    clip.expression[:], clip.jaw[:], clip.eyes[:] = 0, 0, 0
    camera = clip.vhap(tmp_path / "out")
    frames = frames_at(time)
    track = read_track_of(tmp_path / "out", head, frames, landmarks_of(head, camera, time, PRINCIPAL["vhap"]))
    flat = np.linalg.qr(np.random.default_rng(0).normal(size=(head.template.size, 4)))[0].T
    base = BaseFace(head.template, head.faces, flat.reshape(4, -1, 3).astype(np.float32))
    motion, _ = register(track, frames.segment, head, base)
    assert np.abs(motion.coefficients).max() < 1e-6


def test_25_frames_a_second_are_brought_onto_the_videos(head: HeadModel, tmp_path: Path) -> None:
    clip, time = Clip(count=26), np.arange(31) / 30
    camera = clip.metrical(tmp_path / "out")
    nearest = camera[np.rint(time * 25).astype(int)]
    landmarks = landmarks_of(head, nearest, time, PRINCIPAL["metrical"])
    track = read_track_of(tmp_path / "out", head, frames_at(time), landmarks)
    both = [(5 * k, 6 * k) for k in range(6)]  # at 0, 0.2, 0.4 .. s both have a frame
    seen = in_camera(track, head)
    for theirs, ours in both:
        assert np.abs(seen[ours] - camera[theirs]).max() < 1e-5


def test_a_frame_without_a_face_is_left_out(head: HeadModel, tmp_path: Path) -> None:
    clip, time = Clip(), np.arange(COUNT) / 30
    landmarks = landmarks_of(head, clip.vhap(tmp_path / "out"), time, PRINCIPAL["vhap"])
    landmarks.points[4] = np.nan
    track = read_track_of(tmp_path / "out", head, frames_at(time), landmarks)
    assert np.flatnonzero(~track.valid).tolist() == [4] and track.confidence[4] == 0
    assert np.isfinite(track.reprojection_px).all()


def test_placement_takes_no_notice_of_wrong_points() -> None:
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, 500, (6, 40, 2))
    seen = 1.7 * pixels + [30, -20]
    seen[:, ::3] += rng.uniform(50, 200, seen[:, ::3].shape)
    scale, shift = placement(pixels, seen)
    assert scale == pytest.approx(1.7, rel=0.01) and np.abs(shift - [30, -20]).max() < 4


def test_six_numbers_are_a_rotation() -> None:
    turn = Rotation.random(5, rng=np.random.default_rng(1))
    np.testing.assert_allclose(matrix_of_6d(3 * six(turn)), turn.as_matrix(), atol=1e-12)


def test_six_zeros_are_none(head: HeadModel, tmp_path: Path) -> None:
    assert np.isnan(matrix_of_6d(np.zeros((1, 6)))).all()
    clip = Clip(count=2)
    clip.metrical(tmp_path, jaw=np.zeros(6))
    assert "flame.jaw holds what is no rotation" in refused(tmp_path, head)


def refused(folder: Path, head: HeadModel) -> str:
    with pytest.raises(UserError) as caught:
        read_tracked(folder, head)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_wrong_folders_are_refused_in_one_line(head: HeadModel, tmp_path: Path) -> None:
    clip = Clip(count=3)
    clip.metrical(tmp_path / "metrical")
    clip.vhap(tmp_path / "vhap")
    assert "by --head" in refused(tmp_path / "vhap", load_head())
    assert "no such folder" in refused(tmp_path / "absent", head)
    assert "holds neither" in refused(tmp_path, head)
    path = tmp_path / "metrical/checkpoint/00001.frame"
    content = path.read_bytes()
    path.unlink()
    assert "have gaps" in refused(tmp_path / "metrical", head)
    path.write_bytes(content[:900])
    assert "not a .frame file" in refused(tmp_path / "metrical", head)
    write_frame(path, {"exp": np.zeros(50)}, {"R": np.zeros(6)}, CROP, 1)
    assert "missing or no numbers" in refused(tmp_path / "metrical", head)
    path.write_bytes(content)
    path.rename(path.with_name("\N{SUPERSCRIPT ONE}.frame"))
    assert "have gaps" in refused(tmp_path / "metrical", head)
    path = tmp_path / "vhap/tracked_flame_params_30.npz"
    data = dict(np.load(path))
    np.savez(path, **(data | {"expr": data["expr"][:, :50]}))
    assert "expr is (3, 50)" in refused(tmp_path / "vhap", head)
    np.savez(path, **(data | {"rotation": np.full((3, 3), np.nan)}))
    assert "rotation" in refused(tmp_path / "vhap", head)
    del data["focal_length"]
    np.savez(path, **data)
    assert "lacks focal_length" in refused(tmp_path / "vhap", head)


def test_a_wrong_folder_is_told_before_the_long_work(tmp_path: Path) -> None:
    write_video(tmp_path / "talk.mp4", moving(10), np.arange(10) / 25)
    FAKE.write(tmp_path)
    (tmp_path / "out").mkdir()
    tracked = Settings(tracked=str(tmp_path / "out"))
    with pytest.raises(UserError, match="by --head"):
        personalize_video(tmp_path / "talk.mp4", tmp_path / "run", tracked)
    with pytest.raises(UserError, match="holds neither"):
        headed = dataclasses.replace(tracked, head=str(tmp_path / "flame2023.pkl"))
        personalize_video(tmp_path / "talk.mp4", tmp_path / "run", headed)
    assert not (tmp_path / "run").exists()


def test_the_stage_takes_the_place_of_three() -> None:
    assert [stage.name for stage in TRACKED_STAGES] == [
        stage.name for stage in STAGES if stage.name not in ("camera", "track")
    ]
    assert output_paths(TRACKED_STAGES[2]) == output_paths(STAGES[4])


def test_another_videos_tracking_is_refused(head: HeadModel, tmp_path: Path) -> None:
    clip, time = Clip(), np.arange(COUNT) / 30
    landmarks = landmarks_of(head, clip.vhap(tmp_path / "out"), time, PRINCIPAL["vhap"])
    with pytest.raises(UserError, match="12 tracked frames, but the video has 90"):
        read_track_of(tmp_path / "out", head, frames_at(np.arange(90) / 30), landmarks)
    rng = np.random.default_rng(0)
    landmarks.points[..., :2] = rng.uniform(0, 700, landmarks.points[..., :2].shape)
    with pytest.raises(UserError, match="do not lie on this video's"):
        read_track_of(tmp_path / "out", head, frames_at(time), landmarks)
