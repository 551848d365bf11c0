"""Small data sets in exactly the two layouts of VOCAset, made of two sheets that part like lips."""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from personalize.sound import write_wav

FPS = 60
RATE = 22_000  # of raw_audio_fixed.pkl
FLAME = (251, 10, 3)  # columns, rows of a sheet and loose vertices that make FLAME's 5 023
SMALL = (13, 7, 0)

Sentences = dict[str, list[int]]


def head(columns: int, rows: int, loose: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [D, 3] m and triangles of an upper and a lower sheet that touch at y = 0, and loose vertices behind."""
    x, y = np.meshgrid(np.linspace(-0.06, 0.06, columns), np.linspace(0.0005, 0.05, rows))
    sheet = np.stack([x, y, 0.1 - 8 * x**2], axis=-1).reshape(-1, 3)
    behind = np.array([0.0, 0.0, -0.1]) + 0.01 * np.eye(3)[:loose]
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    quads = (
        np.stack([first, first + 1, first + columns], 1),
        np.stack([first + 1, first + columns + 1, first + columns], 1),
    )
    faces = np.concatenate(quads)
    below = faces[:, ::-1] + len(sheet)
    return np.concatenate([sheet, sheet * [1, -1, 1], behind]), np.concatenate([faces, below])


@dataclass(frozen=True)
class Take:
    """One sentence: vertices [T, D, 3] m at 60 fps, sound [S] -1..1 at 22 kHz, as loud as the mouth is open."""

    vertices: np.ndarray
    audio: np.ndarray


class FakeVocaset:
    """Everything there is of some subjects, to be written in either layout."""

    def __init__(self, sentences: Sentences, size: tuple[int, int, int] = SMALL, frames: int = 72) -> None:
        mean, self.faces = head(*size)
        self.mean = mean
        self.templates = {
            name: mean + np.random.default_rng(row).normal(0, 2e-4, 3) for row, name in enumerate(sentences)
        }
        self.takes = {
            (name, number): self._take(name, number, row, frames)
            for row, (name, numbers) in enumerate(sentences.items())
            for number in numbers
        }

    def _take(self, name: str, number: int, row: int, frames: int) -> Take:
        rng = np.random.default_rng((row, number))
        time = np.arange(frames) / FPS
        rate, phase = rng.uniform(2, 4), rng.uniform(0, 6)

        def opening(at: np.ndarray) -> np.ndarray:
            return np.sin(np.pi * rate * at + phase) ** 2

        near = np.exp(-np.abs(self.mean[:, 1]) / 0.02) * np.exp(-((self.mean[:, 0] / 0.03) ** 2))
        down = np.where(self.mean[:, 1] < 0, -1.0, 0.15) * near * (0.008 + 0.002 * row)
        wide = np.outer(np.cos(2 * time + phase), near * self.mean[:, 0] * 0.1)
        moved = np.zeros((frames, len(self.mean), 3))
        moved[..., 1] = np.outer(opening(time), down)
        moved[..., 0] = wide
        moved += rng.normal(0, 2e-5, moved.shape)
        samples = np.arange(int(frames / FPS * RATE)) / RATE
        audio = 0.5 * opening(samples) * np.sin(2 * np.pi * (180 + 20 * row) * samples)
        return Take(
            (self.templates[name] + moved).astype(np.float32),
            audio + 0.01 * rng.standard_normal(len(samples)),
        )

    def write_mesh(self, path: Path) -> Path:
        """The mesh that VOCAset does not hold."""
        trimesh.Trimesh(self.mean, self.faces, process=False).export(path)
        return path

    def write_training_files(self, folder: Path) -> Path:
        """VOCA's own: rows of one sentence lie together, frames are counted from 0, sound is int16."""
        folder.mkdir()
        rows: dict[str, dict[str, dict[int, int]]] = {name: {} for name in self.templates}
        sounds: dict[str, dict[str, dict[str, object]]] = {name: {} for name in self.templates}
        pieces, count = [], 0
        for (name, number), take in self.takes.items():
            key = f"sentence{number:02d}"
            rows[name][key] = {frame: count + frame for frame in range(len(take.vertices))}
            pcm = np.round(take.audio * 32767).astype(np.int16)
            sounds[name][key] = {"audio": pcm, "sample_rate": RATE}
            pieces.append(take.vertices)
            count += len(take.vertices)
        np.save(folder / "data_verts.npy", np.concatenate(pieces))
        self.pickle(folder / "subj_seq_to_idx.pkl", rows)
        self.pickle(folder / "raw_audio_fixed.pkl", sounds)
        self.pickle(folder / "templates.pkl", self.templates)
        return folder

    def write_sequence_files(self, folder: Path) -> Path:
        """FaceFormer's: a file a sentence, vertices flat; with the masks of FLAME."""
        for name in ("vertices_npy", "wav"):
            (folder / name).mkdir(parents=True)
        for (name, number), take in self.takes.items():
            stem = f"{name}_sentence{number:02d}"
            np.save(folder / "vertices_npy" / f"{stem}.npy", take.vertices.reshape(len(take.vertices), -1))
            write_wav(folder / "wav" / f"{stem}.wav", take.audio.astype(np.float32), RATE)
        self.pickle(folder / "templates.pkl", self.templates)
        near = (np.abs(self.mean[:, 1]) < 0.012) & (np.abs(self.mean[:, 0]) < 0.03)
        self.pickle(folder / "FLAME_masks.pkl", {"lips": np.flatnonzero(near), "neck": np.zeros(0, int)})
        return folder

    @staticmethod
    def pickle(path: Path, value: object) -> None:
        """As Python 2 wrote them: protocol 2."""
        path.write_bytes(pickle.dumps(value, 2))
