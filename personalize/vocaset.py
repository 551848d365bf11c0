"""VOCAset from a folder of its owner's, in either of its two layouts, one sentence at a time.

VOCA's training files:  data_verts.npy [N, D, 3] m, subj_seq_to_idx.pkl {subject: {sequence: {frame: row}}},
                        raw_audio_fixed.pkl {subject: {sequence: {"audio", "sample_rate"}}}, templates.pkl
FaceFormer's family:    vertices_npy/<subject>_<sentence>.npy [T, 3D] m, wav/<same>.wav, templates.pkl
Both hold 60 frames a second; templates.pkl is {subject: [D, 3] m}; FLAME_masks.pkl {region: vertices} may lie beside.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from functools import cached_property
from math import gcd
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import resample_poly

from model.motion import FPS
from model.speech import resample
from personalize.errors import UserError
from personalize.restricted_pickle import read_pickle
from personalize.sound import SPEECH_RATE, read_audio

F32 = NDArray[np.float32]

CAPTURE_FPS = 60
STRIDE = round(CAPTURE_FPS / FPS)
# The published split: 8 subjects to train, 2 to validate, 2 to test (FaceTalk_<these>_TA).
TRAIN, VAL, TEST = (
    tuple(f"FaceTalk_{number}_TA" for number in numbers.split())
    for numbers in (
        "170728_03272 170904_00128 170725_00137 170915_00223 170811_03274 170913_03279 170904_03276 170912_03278",
        "170811_03275 170908_03277",
        "170809_00138 170731_00024",
    )
)
# Of a subject's 40 sentences 20 are spoken by three subjects or more, and 20 by one or two; the published files order
# them so, and the FaceFormer family takes 21-40 as those not shared with training. Training subjects give all 40;
# validation and test subjects 21-40. Style adaptation learns a test subject from 18 of the others, chooses on the
# remaining 2, and is judged on the same 21-40.
ALL = range(1, 41)
UNSHARED = range(21, 41)
ADAPT_TRAIN, ADAPT_VAL = range(1, 19), range(19, 21)

TRAINING_FILES = ("data_verts.npy", "subj_seq_to_idx.pkl", "raw_audio_fixed.pkl", "templates.pkl")
SEQUENCE_FILES = ("vertices_npy", "wav", "templates.pkl")


class Vocaset(ABC):
    """Subjects, sentences, templates, motion and sound of a VOCAset folder; what the two layouts share."""

    def __init__(self, folder: Path) -> None:
        """Raises UserError where a file is missing or does not fit the others."""
        self.folder = folder
        self.templates: dict[str, F32] = {
            str(subject): _template(folder, subject, template)
            for subject, template in read_pickle(folder / "templates.pkl").items()
        }
        if len({template.shape for template in self.templates.values()}) != 1:
            raise UserError(
                f"{folder / 'templates.pkl'} holds no templates, or of different numbers of vertices"
            )
        self.vertex_count = len(next(iter(self.templates.values())))

    @cached_property
    def masks(self) -> dict[str, NDArray[np.int32]]:
        """Vertex indices by the name of the region, from FLAME_masks.pkl; empty without that file."""
        path = self.folder / "FLAME_masks.pkl"
        if not path.is_file():
            return {}
        masks = {str(name): np.asarray(index).ravel() for name, index in read_pickle(path).items()}
        for name, index in masks.items():
            if index.dtype.kind not in "iu" or not np.isin(index, np.arange(self.vertex_count)).all():
                raise UserError(f"{path}: {name} is not a list of vertices below {self.vertex_count}")
        return {name: index.astype(np.int32) for name, index in masks.items()}

    def sentences(self, subject: str) -> list[int]:
        """Numbers of the subject's sentences that have both motion and sound, ascending; some are missing."""
        return sorted(self._numbers(subject)) if subject in self.templates else []

    @abstractmethod
    def displacements(self, subject: str, sentence: int) -> F32:
        """[N, D, 3] m from the subject's template at n / 30 s."""

    @abstractmethod
    def audio(self, subject: str, sentence: int) -> F32:
        """Mono sound [S] at 16 kHz, -1..1, from the first frame of the motion on."""

    @abstractmethod
    def _numbers(self, subject: str) -> Iterable[int]:
        """Sentences that have both files."""


class TrainingFiles(Vocaset):
    """VOCA's own training files; the vertices stay on disk, memory-mapped."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._vertices = _mapped(folder / "data_verts.npy", (None, self.vertex_count, 3))
        self._rows = _by_sentence(folder / "subj_seq_to_idx.pkl")
        self._sounds = _by_sentence(folder / "raw_audio_fixed.pkl")

    def displacements(self, subject: str, sentence: int) -> F32:
        """See Vocaset; a frame that the index lacks is interpolated."""
        row_of: Mapping[int, int] = self._rows[subject][sentence]
        try:
            frames = np.array(sorted(row_of), np.int64)
            frames, rows = frames - frames[0], [row_of[frame] for frame in frames.tolist()]
            if min(rows) < 0 or frames[-1] > 2 * len(rows):
                raise IndexError("rows below 0, or most frames missing")
            vertices = np.asarray(self._vertices[rows], np.float32).reshape(len(rows), -1)
        except (LookupError, TypeError, ValueError) as error:
            raise UserError(
                f"{self.folder / 'subj_seq_to_idx.pkl'}: the rows of {subject}, sentence {sentence}, do not fit"
                f" data_verts.npy ({' '.join(str(error).split())}); get both files from the same place"
            ) from error
        _check_finite(vertices, self.folder / "data_verts.npy")
        # Counted in captured frames, so that every second one is taken as it is.
        at = np.arange(0, frames[-1] + 1, STRIDE, dtype=np.float64)
        vertices = resample(vertices, frames.astype(np.float64), at)
        return vertices.reshape(len(at), -1, 3) - self.templates[subject]

    def audio(self, subject: str, sentence: int) -> F32:
        """See Vocaset."""
        try:
            sound = self._sounds[subject][sentence]
            samples, rate = np.asarray(sound["audio"]).ravel(), int(sound["sample_rate"])
            scale = 1.0 if samples.dtype.kind == "f" else 32768.0
            if not 8_000 <= rate <= 192_000:
                raise ValueError(f"sample rate {rate}")
            divisor = gcd(SPEECH_RATE, rate)
            resampled = resample_poly(samples / scale, SPEECH_RATE // divisor, rate // divisor)
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(
                f"{self.folder / 'raw_audio_fixed.pkl'}: the sound of {subject}, sentence {sentence}, is not"
                f' {{"audio", "sample_rate"}} ({" ".join(str(error).split())})'
            ) from error
        return resampled.astype(np.float32)

    def _numbers(self, subject: str) -> Iterable[int]:
        return self._rows.get(subject, {}).keys() & self._sounds.get(subject, {}).keys()


class SequenceFiles(Vocaset):
    """A file for each sentence's vertices and one for its sound, as the FaceFormer family has them."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._files: dict[str, dict[int, Path]] = {}
        for path in sorted((folder / "vertices_npy").glob("*_*.npy")):
            subject, name = path.stem.rsplit("_", 1)
            number = _sentence_number(name)
            if number is not None and self._sound(path).is_file():
                self._files.setdefault(subject, {})[number] = path

    def displacements(self, subject: str, sentence: int) -> F32:
        """See Vocaset."""
        vertices = _mapped(self._files[subject][sentence], (None, 3 * self.vertex_count))
        taken = np.asarray(vertices[::STRIDE], np.float32)
        _check_finite(taken, self._files[subject][sentence])
        return taken.reshape(len(taken), self.vertex_count, 3) - self.templates[subject]

    def audio(self, subject: str, sentence: int) -> F32:
        """See Vocaset."""
        return read_audio(self._sound(self._files[subject][sentence]))[0]

    def _numbers(self, subject: str) -> Iterable[int]:
        return self._files.get(subject, {})

    def _sound(self, vertices: Path) -> Path:
        return self.folder / "wav" / f"{vertices.stem}.wav"


def _check_finite(vertices: F32, path: Path) -> None:
    if not vertices.size or not np.isfinite(vertices).all():
        raise UserError(f"{path}: holds no vertices, or some that are not finite; get it again")


def open_vocaset(folder: Path) -> Vocaset:
    """The data set in `folder`. Raises UserError, saying what is missing, where it is in neither layout."""
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder}; give the folder of VOCAset")
    for layout, files in ((TrainingFiles, TRAINING_FILES), (SequenceFiles, SEQUENCE_FILES)):
        if all((folder / name).exists() for name in files):
            return layout(folder)
    raise UserError(
        f"{folder} is not VOCAset: it needs {', '.join(TRAINING_FILES)} (VOCA's training files),"
        f" or {', '.join(SEQUENCE_FILES)} (one file a sentence)"
    )


def _sentence_number(name: object) -> int | None:
    """The last two digits of a sequence's name, e.g. 7 of sentence07."""
    digits = re.search(r"(\d\d)$", str(name))
    return int(digits[1]) if digits else None


def _by_sentence(path: Path) -> dict[str, dict[int, Any]]:
    """{subject: {sequence name: value}} -> {subject: {sentence number: value}}."""
    table = {}
    for subject, sequences in read_pickle(path).items():
        if not isinstance(sequences, Mapping):
            raise UserError(f"{path} is not {{subject: {{sequence: …}}}}; get the file again")
        numbered = {_sentence_number(name): value for name, value in sequences.items() if value}
        table[str(subject)] = {number: value for number, value in numbered.items() if number is not None}
    return table


def _template(folder: Path, subject: Any, template: Any) -> F32:
    """[D, 3] m."""
    array = np.asarray(template)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind != "f" or not np.isfinite(array).all():
        raise UserError(f"{folder / 'templates.pkl'}: the template of {subject} is not a finite [D, 3] array")
    return array.astype(np.float32)


def _mapped(path: Path, shape: tuple[int | None, ...]) -> NDArray[np.floating]:
    """A memory-mapped array of floats whose shape agrees where it is given."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"{path} is not a readable .npy file ({' '.join(str(error).split())})") from error
    agrees = array.ndim == len(shape) and all(b in (None, a) for a, b in zip(array.shape, shape))
    if not agrees or array.dtype.kind != "f":
        wanted = ", ".join("N" if size is None else str(size) for size in shape)
        raise UserError(
            f"{path} holds {array.dtype} of shape {array.shape}, and [{wanted}] floats fit templates.pkl;"
            " get both files from the same place"
        )
    return array
