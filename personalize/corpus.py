"""The paper's parts of VOCAset as training sequences: base model, validation, and each test subject's 18/2/20."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.dataset import Sequence
from model.diffusion import Progress
from model.motion import FPS, principal_modes
from model.motion_basis import MotionBasis
from model.speech import SpeechEncoder
from personalize.errors import UserError
from personalize.protocol import Reference, Subject, speech_at
from personalize.reporter import Reporter
from personalize.sound import SPEECH_RATE
from personalize.vocaset import ADAPT_TRAIN, ADAPT_VAL, ALL, TEST, TRAIN, UNSHARED, VAL, Vocaset


@dataclass(frozen=True)
class Corpus:
    """VOCAset with what turns a sentence into a training sequence."""

    data: Vocaset
    motion: MotionBasis
    encoder: SpeechEncoder

    def training(self, progress: Progress) -> list[Sequence]:
        """All sentences of the training subjects; styles are numbered in the order of `there`."""
        names, sequences = there(self.data, TRAIN), []
        for style, name in enumerate(names):
            sequences += self._sequences(name, ALL, style)
            progress(style + 1, len(names))
        return sequences

    def validation(self) -> list[Sequence]:
        """The unshared sentences of the validation subjects, whose style nobody knows."""
        return [s for name in there(self.data, VAL) for s in self._sequences(name, UNSHARED, 0)]

    def subject(self, name: str, style: int) -> Subject:
        """A test subject's 18/2/20 sentences."""
        return Subject(
            name=name,
            template=self.data.templates[name],
            encoder=self.encoder,
            train=self._sequences(name, ADAPT_TRAIN, style),
            val=self._sequences(name, ADAPT_VAL, style),
            test=[self._reference(name, n, style) for n in self.data.sentences(name) if n in UNSHARED],
        )

    def _sequences(self, name: str, numbers: range, style: int) -> list[Sequence]:
        return [self._sequence(name, n, style) for n in self.data.sentences(name) if n in numbers]

    def _sequence(self, name: str, sentence: int, style: int) -> Sequence:
        """One sentence at 30 fps, as long as both its motion and its sound."""
        displacements, audio = self.data.displacements(name, sentence), self.data.audio(name, sentence)
        frames = min(len(displacements), int(len(audio) * FPS / SPEECH_RATE))
        if frames < 1:
            raise UserError(
                f"{self.data.folder}: {name}, sentence {sentence}, has no sound or no motion; get the data again"
            )
        coefficients = self.motion.coefficients(displacements[:frames])
        return Sequence(coefficients, speech_at(audio, frames, self.encoder), np.ones(frames, bool), style)

    def _reference(self, name: str, sentence: int, style: int) -> Reference:
        """One sentence to be judged on, with what the basis does not hold of it."""
        sequence = self._sequence(name, sentence, style)
        displacements = self.data.displacements(name, sentence)[: len(sequence.valid)]
        inside = np.tensordot(sequence.coefficients, self.motion.basis, axes=1)
        return Reference(sequence, *principal_modes(displacements - inside), self.data.audio(name, sentence))


def there(data: Vocaset, names: tuple[str, ...]) -> list[str]:
    """The subjects that the data has sentences of."""
    return [name for name in names if data.sentences(name)]


def check_parts(data: Vocaset, report: Reporter) -> None:
    """UserError where the data has nobody to train or to validate on; a warning for those that are missing."""
    for part, names in (("training", TRAIN), ("validation", VAL)):
        found = there(data, names)
        if not found:
            raise UserError(
                f"{data.folder} has none of the {part} subjects {', '.join(names)}; get the whole data"
            )
        if len(found) < len(names):
            missing = [name for name in names if name not in found]
            report.warn(f"{data.folder} lacks the {part} subjects {', '.join(missing)}")
    if not there(data, TEST):
        report.warn(f"{data.folder} has none of the test subjects {', '.join(TEST)}: the tables stay empty")


def tested(data: Vocaset, adapt: list[str]) -> list[str]:
    """The test subjects to adapt to; UserError where one is none, or has no sentences for a part."""
    for name in adapt:
        if name not in TEST:
            raise UserError(f"{name} is not a test subject of VOCAset; --adapt takes {' or '.join(TEST)}")
    chosen = adapt or there(data, TEST)
    for name in chosen:
        numbers = set(data.sentences(name))
        if not all(numbers & set(part) for part in (ADAPT_TRAIN, ADAPT_VAL, UNSHARED)):
            raise UserError(
                f"{data.folder}: {name} needs some of sentences 1-18, of 19-20, and of 21-40; get the whole data"
            )
    return chosen
