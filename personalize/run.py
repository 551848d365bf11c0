"""The run folder: what `personalize VIDEO` leaves behind. One typed reader and writer per file in it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from model.files import write_npz
from personalize.errors import UserError
from personalize.files import read_npz, sha256_file, write_json
from personalize.settings import Settings
from personalize.shots import Frames
from tracker.feature_tracks import FeatureTracks
from tracker.occlusion import Appearance
from tracker.refine import Refined
from tracker.track import Bundle, Camera, Landmarks, Track

SCHEMA = 1
VIDEO_KEYS = {"name": str, "path": str, "sha256": str}
STAGE_KEYS = {"key": str, "seconds": (int, float), "outputs": dict}


def tool_version() -> str:
    """Version of the installed package."""
    return version("personalize")


def _is_run(state: Any) -> bool:
    """Whether this is what a run.json of this version holds."""
    if not isinstance(state, dict) or state.get("schema") != SCHEMA:
        return False
    parts = all(isinstance(state.get(key), dict) for key in ("video", "settings", "stages"))
    if not parts or not _holds(state["video"], VIDEO_KEYS):
        return False
    return all(isinstance(entry, dict) and _holds(entry, STAGE_KEYS) for entry in state["stages"].values())


def _holds(entry: dict[str, Any], kinds: dict[str, Any]) -> bool:
    """Whether there are values of these kinds under these keys."""
    return all(isinstance(entry.get(key), kind) for key, kind in kinds.items())


class RunFolder:
    """A folder with a `run.json`: the video it belongs to, the settings, and one entry per finished stage."""

    def __init__(self, path: Path, state: dict[str, Any]) -> None:
        self.path = path
        self._state = state

    @classmethod
    def create(cls, path: Path, video: Path) -> RunFolder:
        """Open the run folder of `video` at `path`, making it when it is not there.

        Raises UserError when the folder cannot be written, holds something else, or belongs to another video.
        """
        identity = {"name": video.name, "path": str(video.resolve()), "bytes": video.stat().st_size}
        identity["sha256"] = sha256_file(video)
        return cls._of(path, identity)

    def reread(self) -> RunFolder:
        """The folder as it is by now, when another process may have written to it; refuses what `create` does."""
        return self._of(self.path, self._state["video"])

    @classmethod
    def _of(cls, path: Path, identity: dict[str, Any]) -> RunFolder:
        """The folder at `path` as it is, or a new one. identity: what run.json says of the video."""
        if (path / "run.json").is_file():
            run = cls.open(path)
            if run.video_sha256 != identity["sha256"]:
                raise UserError(
                    f"{path}: holds the run of another video ({run._state['video']['name']}); "
                    "choose another folder with --out"
                )
            run._state["video"] = identity
            return run
        begun = {".lock", ".run.json.partial"}  # by one that was killed in its first moment
        if path.is_file() or (path.is_dir() and any(entry.name not in begun for entry in path.iterdir())):
            raise UserError(f"{path}: exists and is not a run folder; choose another with --out")
        return cls(path, {"schema": SCHEMA, "tool": "", "video": identity, "settings": {}, "stages": {}})

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """An existing run folder. Raises UserError when there is none."""
        try:
            state = json.loads((path / "run.json").read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise UserError(f"{path}: no run.json there; give a folder made by `personalize VIDEO`") from None
        except (OSError, ValueError) as error:
            raise UserError(
                f"{path}/run.json: cannot be read ({error}); delete the folder to begin anew"
            ) from None
        if not _is_run(state):
            raise UserError(
                f"{path}/run.json: not a run of this version of personalize; choose another --out"
            )
        return cls(path, state)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder for this process. Raises UserError when another process has it or it is not writable."""
        lock = FileLock(self.path / ".lock", timeout=0)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            lock.acquire()
        except Timeout:
            raise UserError(
                f"{self.path}: another personalize is working there; wait for it or use --out"
            ) from None
        except OSError as error:
            raise UserError(
                f"{self.path}: cannot be written ({error.strerror}); choose another with --out"
            ) from None
        try:
            yield
        finally:
            lock.release()

    @property
    def video_sha256(self) -> str:
        """Content hash of the video."""
        return str(self._state["video"]["sha256"])

    @property
    def video(self) -> Path:
        """Where the video was when the run was last started."""
        return Path(self._state["video"]["path"])

    @property
    def stages(self) -> dict[str, dict[str, Any]]:
        """Stage name -> state, key, seconds, outputs."""
        stages: dict[str, dict[str, Any]] = self._state["stages"]
        return stages

    def begin(self, settings: Settings) -> None:
        """Note the tool's version and the settings of the run that starts now."""
        self._state["tool"] = tool_version()
        self._state["settings"] = dataclasses.asdict(settings)
        self._save()

    def record(self, stage: str, entry: dict[str, Any]) -> None:
        """Write the entry of a finished stage."""
        self.stages[stage] = entry
        self._save()

    def _save(self) -> None:
        write_json(self.path / "run.json", self._state)

    def read_json(self, name: str) -> dict[str, Any]:
        """A JSON file of the run folder, by its relative name."""
        value: dict[str, Any] = json.loads((self.path / name).read_text(encoding="utf-8"))
        return value


def write_frames(path: Path, frames: Frames) -> None:
    """`ingest/frames.npz`; its keys are those of `Frames`."""
    arrays = {name: np.asarray(value) for name, value in vars(frames).items()}
    write_npz(path, **arrays)


def read_frames(path: Path) -> Frames:
    """Inverse of `write_frames`."""
    data: dict[str, Any] = read_npz(path)
    data["reasons"] = tuple(str(name) for name in data["reasons"])
    return Frames(**data)


def write_landmarks(path: Path, landmarks: Landmarks) -> None:
    """`landmarks/landmarks.npz`."""
    write_npz(path, **{name: np.asarray(value) for name, value in vars(landmarks).items()})


def read_landmarks(path: Path) -> Landmarks:
    """Inverse of `write_landmarks`."""
    data: dict[str, Any] = read_npz(path)
    data["blendshape_names"] = tuple(str(name) for name in data["blendshape_names"])
    data["size"] = (int(data["size"][0]), int(data["size"][1]))
    return Landmarks(**data)


def write_appearance(path: Path, appearance: Appearance) -> None:
    """`landmarks/appearance.npz`."""
    write_npz(path, **vars(appearance))


def read_appearance(path: Path) -> Appearance:
    """Inverse of `write_appearance`."""
    data: dict[str, Any] = read_npz(path)
    return Appearance(**data)


def write_features(path: Path, features: FeatureTracks) -> None:
    """`landmarks/features.npz`."""
    write_npz(path, **vars(features))


def read_features(path: Path) -> FeatureTracks:
    """Inverse of `write_features`."""
    data: dict[str, Any] = read_npz(path)
    return FeatureTracks(**data)


def write_refined(folder: Path, refined: Refined) -> None:
    """`photometric/track.npz` and `photometric/deviation.npz`."""
    write_track(folder / "track.npz", refined.track)
    told = {name: np.asarray(value) for name, value in vars(refined).items() if name != "track"}
    write_npz(folder / "deviation.npz", **told)


def read_refined(folder: Path) -> Refined:
    """Inverse of `write_refined`."""
    told = read_npz(folder / "deviation.npz")
    numbers = {name: float(told.pop(name)) for name in ("like_lips", "fineness")}
    return Refined(read_track(folder / "track.npz"), told["deviation"], **numbers)


def write_camera(folder: Path, camera: Camera, bundle: Bundle) -> None:
    """`camera/camera.json` and `camera/bundle.npz`."""
    told = dataclasses.asdict(camera)
    write_npz(folder / "bundle.npz", zoom=told.pop("zoom"), **vars(bundle))
    write_json(folder / "camera.json", told)


def read_camera(folder: Path) -> tuple[Camera, Bundle]:
    """Inverse of `write_camera`."""
    data = json.loads((folder / "camera.json").read_text(encoding="utf-8"))
    for name in ("principal_px", "distortion", "size"):
        data[name] = tuple(data[name])
    arrays: dict[str, Any] = read_npz(folder / "bundle.npz")
    return Camera(**data, zoom=arrays.pop("zoom")), Bundle(**arrays)


def write_track(path: Path, track: Track) -> None:
    """`track.npz`."""
    write_npz(path, **{name: np.asarray(value) for name, value in vars(track).items()})


def read_track(path: Path) -> Track:
    """Inverse of `write_track`."""
    data: dict[str, Any] = read_npz(path)
    data["focal"], data["head"] = float(data["focal"]), str(data["head"])
    data["size"] = (int(data["size"][0]), int(data["size"][1]))
    return Track(**data)
