"""`personalize train`: a base model from VOCAset, by the paper's protocol, or from a folder of tracked motions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from model.checkpoint import Checkpoint, is_checkpoint
from model.dataset import Sequence, Standardization
from model.denoiser import Architecture
from model.errors import ModelError
from model.finetuning import choose_checkpoint
from model.motion import FPS, Motion, MotionError
from model.motion_basis import MotionBasis, motion_basis
from model.processes import joined
from model.speech import SpeechEncoder, load_encoder
from model.speech_windows import SpeechError
from model.trainer import Trainer
from model.training_config import TrainingConfig, available_device
from personalize.animation import read_speech
from personalize.corpus import Corpus, check_parts, tested, there
from personalize.errors import UserError
from personalize.files import sha256_file, sha256_json, write_text
from personalize.mouth import mouth_regions
from personalize.protocol import compare_systems
from personalize.reporter import Reporter
from personalize.run import tool_version
from personalize.subject_data import BASE_CHECKPOINT, speech_features
from personalize.vocaset import TRAIN, open_vocaset

F32 = NDArray[np.float32]

CHUNK_FRAMES = 256  # of one motion, decoded together
VOCASET_FILES = ("*.npy", "*.pkl", "vertices_npy/*.npy", "wav/*.wav")  # of both layouts


@dataclass(frozen=True)
class TrainSettings:
    """Options of `personalize train`.

    encoder: folder or hub name of a speech encoder, None for the embedded one. device: `cpu` or `cuda`.
    """

    iterations: int = 140_000
    seed: int = 0
    encoder: str | None = None
    architecture: Architecture = "conv"
    device: str = "cpu"


def train_on_vocaset(
    folder: Path, mesh: Path, out: Path, adapt: list[str], settings: TrainSettings, report: Reporter
) -> dict[str, Any]:
    """Train on the training subjects and write `out`; then the paper's tables for the test subjects `adapt`.

    adapt: [] for both. mesh: a .ply or .obj of the data's topology, for its faces. `<out>.work/` holds what a
    continuation needs. Of several processes (`torchrun`) all train the base model, and the first does the rest.

    Returns {"checkpoint", "modes", "held", "systems"}; held: share of the squared displacement that the basis holds;
    systems: see `compare_systems`. Raises UserError, in one line, for whatever the user can mend.
    """
    with _mendable("--device"):
        available_device(settings.device)  # asked now, not after all sound was read
    with _mendable(folder), joined(settings.device) as (rank, device):
        data = open_vocaset(folder)
        faces = read_faces(mesh, data.vertex_count)
        names, speakers = tested(data, adapt), there(data, TRAIN)
        check_parts(data, report)
        speech = load_encoder(settings.encoder)
        files = [mesh, *(path for pattern in VOCASET_FILES for path in folder.glob(pattern))]
        work = _work_folder(out, _training_key(settings, speech, files), files, first=rank == 0)
        with report.stage("basis"):
            spoken = [(name, number) for name in speakers for number in data.sentences(name)]
            motion = motion_basis(
                lambda: (data.displacements(*place) for place in spoken), seed=settings.seed
            )
        corpus = Corpus(data, motion, speech)
        with report.stage("speech"):
            train, val = corpus.training(report.progress), corpus.validation()
        template = np.mean(list(data.templates.values()), axis=0).astype(np.float32)
        untrained = Checkpoint.initial(
            kind="base",
            encoder=corpus.encoder.name,
            styles=tuple(speakers),
            basis=motion.basis,
            template=template,
            faces=faces,
            standardization=Standardization.of(train),
            regions=mouth_regions(template, motion, data.masks),
            seed=settings.seed,
            architecture=settings.architecture,
            provenance=_provenance("VOCAset", settings),
        )
        config = TrainingConfig(iterations=settings.iterations, seed=settings.seed, device=device)
        base = _trained(untrained, train, val, work / "base", _of_many(config), report)
    result = {"checkpoint": str(out), "modes": len(motion.basis), "held": motion.held}
    if rank > 0:
        return result
    with _mendable(folder):
        base.save(out)
        subjects = [corpus.subject(name, len(speakers)) for name in names]
        systems = compare_systems(base, train, subjects, work, config, report)
    return result | {"systems": systems}


def train_on_motions(folder: Path, out: Path, settings: TrainSettings, report: Reporter) -> dict[str, Any]:
    """Train on every `NAME.npz` (a Motion at 30 fps) of `folder` with its `NAME.wav`, one style each; write `out`.

    Returns {"checkpoint", "modes", "held"}. Raises UserError, in one line, for whatever the user can mend.
    """
    with _mendable("--device"):
        available_device(settings.device)  # asked now, not after all sound was read
    with _mendable(folder), joined(settings.device) as (rank, device):
        motions, speech = _read_motions(folder), load_encoder(settings.encoder)
        files = [folder / f"{name}.{kind}" for name in motions for kind in ("npz", "wav")]
        work = _work_folder(out, _training_key(settings, speech, files), files, first=rank == 0)
        first = next(iter(motions.values()))
        with report.stage("basis"):
            basis = motion_basis(
                lambda: (part for m in motions.values() for part in _decoded(m)), seed=settings.seed
            )
        with report.stage("speech"):
            sequences = [
                _motion_sequence(motion, basis, folder / f"{name}.wav", speech, style)
                for style, (name, motion) in enumerate(motions.items())
            ]
        embedded = Checkpoint.load(BASE_CHECKPOINT)
        same = embedded.topology == first.topology
        untrained = Checkpoint.initial(
            kind="base",
            encoder=speech.name,
            styles=tuple(motions),
            basis=basis.basis,
            template=first.template,
            faces=first.faces,
            standardization=Standardization.of(sequences),
            regions=embedded.regions if same else mouth_regions(first.template, basis, {}),
            seed=settings.seed,
            architecture=settings.architecture,
            provenance=_provenance("tracked motions", settings),
        )
        config = TrainingConfig(iterations=settings.iterations, seed=settings.seed, device=device)
        base = _trained(untrained, sequences, [], work / "base", _of_many(config), report)
    if rank == 0:
        base.save(out)
    return {"checkpoint": str(out), "modes": len(basis.basis), "held": basis.held}


def read_faces(mesh: Path, vertex_count: int) -> NDArray[np.int32]:
    """Triangles [F, 3] of a .ply or .obj with D vertices, in the file's own order of them. Raises UserError."""
    if mesh.suffix.lower() not in (".ply", ".obj") or not mesh.is_file():
        raise UserError(
            f"{mesh}: a mesh (.ply or .obj) of the data's topology is needed, e.g. FLAME_sample.ply"
        )
    try:
        loaded = trimesh.load(mesh, process=False, force="mesh", skip_materials=True, maintain_order=True)
        faces = np.asarray(loaded.faces, np.int32).reshape(-1, 3)
        found = len(loaded.vertices)
    except Exception as error:  # whatever a parser of foreign text meets in a broken file
        raise UserError(
            f"{mesh} is not a readable mesh ({' '.join(str(error).split())[:120]}); get it again"
        ) from error
    if found != vertex_count or len(faces) == 0 or not 0 <= faces.min() <= faces.max() < found:
        raise UserError(
            f"{mesh} has {found} vertices and {len(faces)} triangles, and the data {vertex_count} vertices:"
            " give a mesh of the data's topology, e.g. FLAME_sample.ply"
        )
    return faces


def _of_many(config: TrainingConfig) -> TrainingConfig:
    """Without what holds fine-tuning back from learning one minute by heart: measured for that, the paper's else."""
    return replace(config, feature_dropout=0.0, weight_decay=0.0)


def _trained(
    untrained: Checkpoint,
    train: list[Sequence],
    val: list[Sequence],
    work: Path,
    config: TrainingConfig,
    report: Reporter,
) -> Checkpoint:
    """Train to the end; the checkpoint that is best on validation, or without validation the last.

    Nobody's style fits those who validate: all candidates speak in that of the last training subject.
    """
    trainer = Trainer(untrained, train, work, config)
    with report.stage("training"):
        candidates = trainer.train(report.progress)
    if not val:
        return trainer.checkpoint()
    with report.stage("choice"):
        return choose_checkpoint(candidates, val, config.seed)[0]


def _read_motions(folder: Path) -> dict[str, Motion]:
    """Motions by name, of one topology, each with its sound. Raises UserError."""
    motions = {path.stem: Motion.load(path) for path in sorted(folder.glob("*.npz"))}
    if not motions:
        raise UserError(
            f"{folder} has no NAME.npz with a NAME.wav beside it; give a folder of tracked motions"
        )
    topology = next(iter(motions.values())).topology
    for name, motion in motions.items():
        if motion.topology != topology or motion.fps != FPS:
            raise UserError(
                f"{folder / name}.npz: all motions must be of one topology and at {FPS:.0f} frames a second"
            )
        if not (folder / f"{name}.wav").is_file():
            raise UserError(f"{folder / name}.npz has no sound: {name}.wav is missing")
    return motions


def _decoded(motion: Motion) -> Iterator[F32]:
    """Displacements [n, D, 3] m of the valid frames, chunk by chunk."""
    coefficients = motion.coefficients[motion.valid]
    for start in range(0, len(coefficients), CHUNK_FRAMES):
        yield replace(motion, coefficients=coefficients[start : start + CHUNK_FRAMES]).displacements()


def _motion_sequence(
    motion: Motion, basis: MotionBasis, sound: Path, encoder: SpeechEncoder, style: int
) -> Sequence:
    """The motion in the new basis, with its sound, which is as late as its run found it.

    Raises UserError where nothing is heard, or not to the end.
    """
    times = motion.start_s + np.arange(len(motion.valid)) / motion.fps
    read_speech(sound, times[-1])
    times += motion.sound_offset_s(sha256_file(sound))
    coefficients = motion.coefficients @ basis.coefficients(motion.basis)
    return Sequence(coefficients, speech_features(sound, times, encoder), motion.valid, style)


def _training_key(settings: TrainSettings, speech: SpeechEncoder, files: Iterable[Path]) -> str:
    """Hash of what decides the trained model, and its scores: the settings, the speech encoder and the data's files."""
    data = sorted((path.name, sha256_file(path)) for path in files)
    return sha256_json([settings.iterations, settings.seed, settings.architecture, speech.name, data])


def _work_folder(out: Path, key: str, files: Iterable[Path], first: bool) -> Path:
    """`<out>.work`, made, the training's key beside what a continuation needs.

    files: what is learned from. first: of several processes the one that writes. Raises UserError where the folder
    cannot be made, `out` is a folder, one of the files or anything but a checkpoint, or what was begun there is another
    training.
    """
    if out.is_dir():
        raise UserError(f"{out}: a folder; give --out the name of a file, as {out / 'model.safetensors'}")
    if out.resolve() in {path.resolve() for path in files}:
        raise UserError(f"{out}: is one of the files to learn from; choose another --out")
    if out.is_file() and not is_checkpoint(out):
        raise UserError(f"{out}: exists and is not a checkpoint; choose another --out")
    work = out.with_name(f"{out.name}.work")
    key_file = work / "key"
    try:
        work.mkdir(parents=True, exist_ok=True)
        # What ended before it made anything may be begun anew.
        begun = any(path.is_file() for path in work.glob("*/*"))
        other = begun and not (key_file.is_file() and key_file.read_bytes() == key.encode())
        if first and not other:
            write_text(key_file, key)
    except OSError as error:
        raise UserError(f"{work}: cannot be written ({error.strerror}); choose another --out") from None
    if other:
        raise UserError(
            f"{work}: holds a training with other settings or data; give another --out, or delete this folder"
        )
    return work


def _provenance(source: str, settings: TrainSettings) -> dict[str, Any]:
    return {
        "tool": "personalize",
        "version": tool_version(),
        "synthetic": False,
        "source": source,
        "iterations": settings.iterations,
        "seed": settings.seed,
    }


@contextmanager
def _mendable(given: Path | str) -> Iterator[None]:
    """What the packages below say of what the user gave, as the user's error."""
    try:
        yield
    except (ModelError, MotionError, SpeechError) as error:
        raise UserError(f"{given}: {error}") from error
