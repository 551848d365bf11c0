"""The stages of the pipeline: each reads typed files, calls one function, writes typed files."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

import tracker.landmark_bias
import tracker.landmarker
from model.speech import load_encoder
from personalize import run as files
from personalize.evaluation.evaluate import evaluate_run
from personalize.evaluation.report import write_report
from personalize.face_reading import read_face
from personalize.files import sha256_file, sha256_json, write_json
from personalize.finetune import finetune_run
from personalize.heads import head_assets, run_head
from personalize.ingest import ingest_video
from personalize.overlay import write_overlay
from personalize.pictures import FrameReader
from personalize.quality import cover_warnings, frame_reasons, lip_warnings, read_reasons, write_quality
from personalize.registration import register_run
from personalize.run import RunFolder
from personalize.settings import Settings
from personalize.sound import write_wav
from personalize.stage import VIDEO, Context, Stage
from personalize.subject_data import base_path
from personalize.tracked import read_track_of
from tracker.camera import estimate_camera
from tracker.confidence import bare, judge
from tracker.fit import fit_track
from tracker.refine import Refined, refine_track

JUDGED = ("refine/track.npz", "refine/quality.csv")
LANDMARKER_FILE = Path(tracker.landmarker.__file__).parent / "assets" / "face_landmarker.task"


@cache
def _asset_hash(path: Path) -> str:
    return sha256_file(path)


def speech_model_assets(settings: Settings) -> dict[str, str]:
    """The base model and the speech encoder, by content."""
    return {"base": _asset_hash(base_path(settings)), "encoder": load_encoder(settings.encoder).name}


def face_assets() -> dict[str, str]:
    """The network that reads faces, and what its points err by, by content."""
    return {
        "face_landmarker": _asset_hash(LANDMARKER_FILE),
        "landmark_bias": _asset_hash(tracker.landmark_bias.ASSET),
    }


class Ingest(Stage):
    """Video -> times, usable frames and why not, sound, split."""

    name, version, needs = "ingest", 16, (VIDEO,)
    makes = ("media.json", "frames.npz", "audio.wav", "split.json")

    def assets(self, settings: Settings) -> dict[str, str]:
        return face_assets()

    def make(self, context: Context, folder: Path) -> None:
        ingested = ingest_video(context.run.video, context.report.progress)
        for text in ingested.warnings:
            context.report.warn(text)
        write_json(folder / "media.json", {**ingested.media.as_json(), "warnings": ingested.warnings})
        files.write_frames(folder / "frames.npz", ingested.frames)
        write_wav(folder / "audio.wav", ingested.audio)
        write_json(folder / "split.json", ingested.split)

    def warnings(self, run: RunFolder) -> Sequence[str]:
        texts: list[str] = run.read_json("ingest/media.json")["warnings"]
        return texts


class LandmarkStage(Stage):
    """478 points and 52 scores on every frame that shows the face, what covers or blurs it, and rigid features."""

    name, version = "landmarks", 13
    needs, makes = (VIDEO, "ingest/frames.npz"), ("landmarks.npz", "appearance.npz", "features.npz")

    def assets(self, settings: Settings) -> dict[str, str]:
        return face_assets()

    def make(self, context: Context, folder: Path) -> None:
        frames = files.read_frames(context.run.path / "ingest/frames.npz")
        landmarks, appearance, features = read_face(context.run.video, frames, context.report.progress)
        files.write_landmarks(folder / "landmarks.npz", landmarks)
        files.write_appearance(folder / "appearance.npz", appearance)
        files.write_features(folder / "features.npz", features)


class CameraStage(Stage):
    """Focal length with its uncertainty, and rigid head poses."""

    name, version, reads = "camera", 15, ("focal_px", "distortion")
    needs = (
        *("ingest/media.json", "ingest/frames.npz", "landmarks/landmarks.npz"),
        "landmarks/features.npz",
    )
    makes = ("camera.json", "bundle.npz")

    def assets(self, settings: Settings) -> dict[str, str]:
        return head_assets(settings)

    def make(self, context: Context, folder: Path) -> None:
        root = context.run.path
        frames = files.read_frames(root / "ingest/frames.npz")
        camera, bundle = estimate_camera(
            files.read_landmarks(root / "landmarks/landmarks.npz"),
            files.read_features(root / "landmarks/features.npz"),
            run_head(context.settings),
            frames.seen,
            frames.segment,
            focal_given=context.settings.focal_px,
            distortion=context.settings.distortion,
            recorded_mm=context.run.read_json("ingest/media.json")["focal_mm"],
            progress=context.report.progress,
        )
        files.write_camera(folder, camera, bundle)


class TrackStage(Stage):
    """One identity, and expression, pose and gaze in every frame, jointly over the clip."""

    name, version = "track", 15
    needs = (
        *("ingest/frames.npz", "landmarks/landmarks.npz", "landmarks/appearance.npz"),
        *("camera/camera.json", "camera/bundle.npz"),
    )
    makes = ("track.npz",)

    def assets(self, settings: Settings) -> dict[str, str]:
        return head_assets(settings)

    def make(self, context: Context, folder: Path) -> None:
        root = context.run.path
        frames = files.read_frames(root / "ingest/frames.npz")
        camera, _ = files.read_camera(root / "camera")
        track = fit_track(
            files.read_landmarks(root / "landmarks/landmarks.npz"),
            camera,
            run_head(context.settings),
            frames.usable,
            frames.segment,
            context.report.progress,
            evidence=bare(files.read_appearance(root / "landmarks/appearance.npz")),
        )
        files.write_track(folder / "track.npz", track)


class Refine(Stage):
    """The track again, with the grey levels of the skin."""

    name, folder, version = "refine", "photometric", 32
    needs = (
        *(VIDEO, "ingest/frames.npz", "landmarks/landmarks.npz", "landmarks/appearance.npz"),
        *("camera/camera.json", "camera/bundle.npz", "track/track.npz"),
    )
    makes = ("track.npz", "deviation.npz")

    def assets(self, settings: Settings) -> dict[str, str]:
        return head_assets(settings)

    def make(self, context: Context, folder: Path) -> None:
        root = context.run.path
        refined = refine_track(
            files.read_track(root / "track/track.npz"),
            files.read_landmarks(root / "landmarks/landmarks.npz"),
            *files.read_camera(root / "camera"),
            run_head(context.settings),
            files.read_frames(root / "ingest/frames.npz").segment,
            lambda: FrameReader(context.run.video),
            context.report.progress,
            evidence=bare(files.read_appearance(root / "landmarks/appearance.npz")),
        )
        files.write_refined(folder, refined)
        for text in lip_warnings(refined):
            context.report.warn(text)

    def warnings(self, run: RunFolder) -> Sequence[str]:
        return lip_warnings(files.read_refined(run.path / self.folder))


class ReadTracked(Stage):
    """Another tracker's result in the place of ours: camera, track and refine in one."""

    name, folder, version = "refine", "photometric", 7
    needs = ("ingest/frames.npz", "landmarks/landmarks.npz")
    makes = Refine.makes

    def assets(self, settings: Settings) -> dict[str, str]:
        folder = Path(str(settings.tracked))
        files_of = sorted((*folder.glob("**/*.frame"), *folder.glob("tracked_flame_params*.npz")))
        return head_assets(settings) | {"tracked": sha256_json([sha256_file(path) for path in files_of])}

    def make(self, context: Context, folder: Path) -> None:
        root, settings = context.run.path, context.settings
        frames = files.read_frames(root / "ingest/frames.npz")
        landmarks = files.read_landmarks(root / "landmarks/landmarks.npz")
        track = read_track_of(Path(str(settings.tracked)), run_head(settings), frames, landmarks)
        nothing_compared = np.full((len(track.time), 2), np.nan, np.float32)
        files.write_refined(folder, Refined(track, nothing_compared))


class Judge(Stage):
    """The refined track with its confidence lowered by what the pictures tell, and which frames are used."""

    name, folder, version, reads = "judge", "refine", 3, ("min_confidence",)
    needs = (
        *("ingest/frames.npz", "landmarks/appearance.npz"),
        *("photometric/track.npz", "photometric/deviation.npz"),
    )
    makes = ("track.npz", "quality.csv")

    def make(self, context: Context, folder: Path) -> None:
        root = context.run.path
        refined = files.read_refined(root / "photometric")
        appearance = files.read_appearance(root / "landmarks/appearance.npz")
        judged, doubts = judge(refined.track, appearance, refined.deviation)
        frames = files.read_frames(root / "ingest/frames.npz")
        files.write_track(folder / "track.npz", judged)
        reasons = frame_reasons(frames, judged, doubts, context.settings.min_confidence)
        write_quality(folder / "quality.csv", judged, reasons, refined.deviation[:, 0])
        for text in cover_warnings(np.array(reasons)):
            context.report.warn(text)

    def warnings(self, run: RunFolder) -> Sequence[str]:
        return cover_warnings(read_reasons(run.path / "refine/quality.csv"))


class Overlay(Stage):
    """The track over the video, to check by eye."""

    name, version, reads = "overlay", 6, ("overlay",)
    needs = (VIDEO, "landmarks/landmarks.npz", *JUDGED)
    makes, products = ("contact_sheet.png", "preview.mp4"), ("overlay.mp4",)

    def assets(self, settings: Settings) -> dict[str, str]:
        return head_assets(settings)

    def make(self, context: Context, folder: Path) -> None:
        settings = context.settings
        write_overlay(context.run, run_head(settings), settings.overlay, folder, context.report.progress)


class Registration(Stage):
    """Track -> Motion in the base model's topology, 30 fps, with the sound's offset."""

    name, version = "registration", 4
    needs = ("ingest/frames.npz", "ingest/audio.wav", *JUDGED)
    makes = ("motion.npz", "registration.json")

    def assets(self, settings: Settings) -> dict[str, str]:
        return head_assets(settings) | {"base": _asset_hash(base_path(settings))}

    def make(self, context: Context, folder: Path) -> None:
        register_run(context.run, context.settings, folder, context.report)


class Finetune(Stage):
    """Motion + speech -> the subject's checkpoint."""

    name, version, reads, resumes = "finetune", 8, ("iterations", "seed", "device"), True
    needs = (
        "ingest/audio.wav",
        "ingest/split.json",
        "registration/motion.npz",
        "registration/registration.json",
    )
    makes, products = ("log.csv", "guidance.json"), ("checkpoint.safetensors",)

    def assets(self, settings: Settings) -> dict[str, str]:
        return speech_model_assets(settings)

    def make(self, context: Context, folder: Path) -> None:
        finetune_run(context.run, context.settings, folder, context.report)


class Evaluate(Stage):
    """Metrics on the test split, one clip beside its reference, the report."""

    name, folder, version, reads = "evaluate", "evaluation", 5, ("seed", "overlay", "tracked")
    needs = (
        *(VIDEO, *Finetune.needs, "checkpoint.safetensors", "finetune/guidance.json", "finetune/log.csv"),
        *("overlay/preview.mp4", "overlay/contact_sheet.png", *JUDGED),
        *("ingest/media.json", "landmarks/landmarks.npz"),
        *("photometric/track.npz", "photometric/deviation.npz"),
    )
    makes, products = ("metrics.json", "samples/test.mp4", "samples/test.npz"), ("report.html",)

    def assets(self, settings: Settings) -> dict[str, str]:
        return speech_model_assets(settings)

    def make(self, context: Context, folder: Path) -> None:
        evaluation = evaluate_run(context.run, context.settings, folder, context.report)
        write_report(context.run, evaluation, context.settings, folder)
