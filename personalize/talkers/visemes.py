"""What each phone asks of the face: ARKit weights, and how firmly it asks."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

# Apple's 52 names, in the order of its documentation.
# fmt: off
ARKIT_NAMES = (
    "eyeBlinkLeft", "eyeLookDownLeft", "eyeLookInLeft", "eyeLookOutLeft", "eyeLookUpLeft", "eyeSquintLeft",
    "eyeWideLeft", "eyeBlinkRight", "eyeLookDownRight", "eyeLookInRight", "eyeLookOutRight",
    "eyeLookUpRight", "eyeSquintRight", "eyeWideRight", "jawForward", "jawLeft", "jawRight", "jawOpen",
    "mouthClose", "mouthFunnel", "mouthPucker", "mouthLeft", "mouthRight", "mouthSmileLeft",
    "mouthSmileRight", "mouthFrownLeft", "mouthFrownRight", "mouthDimpleLeft", "mouthDimpleRight",
    "mouthStretchLeft", "mouthStretchRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower",
    "mouthShrugUpper", "mouthPressLeft", "mouthPressRight", "mouthLowerDownLeft", "mouthLowerDownRight",
    "mouthUpperUpLeft", "mouthUpperUpRight", "browDownLeft", "browDownRight", "browInnerUp",
    "browOuterUpLeft", "browOuterUpRight", "cheekPuff", "cheekSquintLeft", "cheekSquintRight",
    "noseSneerLeft", "noseSneerRight", "tongueOut",
)
# fmt: on

# Channels that speech drives; those of a pair share one target. `seal` is lip contact, 0 apart to 1 shut.
CHANNELS = (
    "jawOpen",
    "seal",
    "mouthFunnel",
    "mouthPucker",
    "mouthStretch",
    "mouthSmile",
    "mouthLowerDown",
    "mouthUpperUp",
    "mouthRollLower",
    "mouthShrugUpper",
    "mouthPress",
    "jawForward",
)
SILENCE = "SIL"


@dataclass(frozen=True)
class Phone:
    """A phone in time. name: ARPAbet without stress, upper case, `SIL` for silence. start, end: s."""

    name: str
    start: float
    end: float


@dataclass(frozen=True)
class Viseme:
    """Targets by channel (the others are asked to be 0), and how firmly the phone asks for each.

    firm: dominance of the channels that the phone is made with; `soft` that of all others, which therefore take
    the neighbours' values (coarticulation).
    """

    targets: dict[str, float]
    firm: float = 1.0
    soft: float = 0.35


def _vowel(jaw: float, **targets: float) -> Viseme:
    return Viseme({"jawOpen": jaw, **targets}, firm=1.0, soft=0.6)


_OPEN = _vowel(0.32, mouthLowerDown=0.18, mouthUpperUp=0.08)
_SPREAD = _vowel(0.12, mouthStretch=0.30, mouthSmile=0.18, mouthLowerDown=0.26, mouthUpperUp=0.12)
_ROUND = _vowel(0.08, mouthPucker=0.62, mouthFunnel=0.14)
_MID = _vowel(0.24, mouthStretch=0.16, mouthLowerDown=0.22, mouthUpperUp=0.08)
_BACK = _vowel(0.26, mouthFunnel=0.26, mouthPucker=0.18, mouthLowerDown=0.10)
_BILABIAL = Viseme({"jawOpen": 0.10, "seal": 1.0, "mouthPress": 0.06}, firm=3.0, soft=0.25)
_LABIODENTAL = Viseme({"jawOpen": 0.08, "mouthRollLower": 0.45, "mouthUpperUp": 0.16}, firm=2.2, soft=0.3)
_ALVEOLAR = Viseme({"jawOpen": 0.12, "mouthLowerDown": 0.16}, firm=0.9, soft=0.3)
_SIBILANT = Viseme(
    {"jawOpen": 0.05, "mouthStretch": 0.16, "mouthLowerDown": 0.26, "mouthUpperUp": 0.12}, 1.5, 0.3
)
_PALATAL = Viseme(
    {"jawOpen": 0.07, "mouthFunnel": 0.36, "mouthPucker": 0.16, "mouthShrugUpper": 0.12, "jawForward": 0.15},
    firm=1.5,
    soft=0.4,
)
_VELAR = Viseme({"jawOpen": 0.18, "mouthLowerDown": 0.10}, firm=0.6, soft=0.15)
_DENTAL = Viseme({"jawOpen": 0.15, "mouthLowerDown": 0.20, "mouthUpperUp": 0.10}, firm=1.0, soft=0.3)

# A phone is one viseme, or the two ends of a glide.
VISEMES: dict[str, tuple[Viseme, ...]] = {
    **dict.fromkeys(("P", "B", "M"), (_BILABIAL,)),
    **dict.fromkeys(("F", "V"), (_LABIODENTAL,)),
    **dict.fromkeys(("TH", "DH"), (_DENTAL,)),
    **dict.fromkeys(("T", "D", "N", "DX", "EN"), (_ALVEOLAR,)),
    **dict.fromkeys(("S", "Z"), (_SIBILANT,)),
    **dict.fromkeys(("SH", "ZH", "CH", "JH"), (_PALATAL,)),
    **dict.fromkeys(("K", "G", "NG"), (_VELAR,)),
    "L": (Viseme({"jawOpen": 0.19, "mouthLowerDown": 0.14}, firm=0.8, soft=0.25),),
    "R": (Viseme({"jawOpen": 0.12, "mouthPucker": 0.30, "mouthFunnel": 0.16}, firm=1.0, soft=0.4),),
    "W": (Viseme({"jawOpen": 0.07, "mouthPucker": 0.72, "mouthFunnel": 0.08}, firm=1.8, soft=0.5),),
    "Y": (Viseme({"jawOpen": 0.09, "mouthStretch": 0.24, "mouthSmile": 0.14}, firm=0.8, soft=0.4),),
    "HH": (Viseme({"jawOpen": 0.16}, firm=0.3, soft=0.05),),
    "AA": (_OPEN,),
    "AE": (_vowel(0.30, mouthStretch=0.22, mouthLowerDown=0.28, mouthUpperUp=0.14, mouthSmile=0.06),),
    **dict.fromkeys(("AH", "AX"), (_vowel(0.22, mouthLowerDown=0.14, mouthUpperUp=0.05),)),
    "AO": (_BACK,),
    "AW": (_OPEN, _ROUND),
    "AY": (_OPEN, _SPREAD),
    "EH": (_MID,),
    "ER": (_vowel(0.16, mouthPucker=0.26, mouthFunnel=0.16),),
    "EY": (_MID, _SPREAD),
    "IH": (_vowel(0.17, mouthStretch=0.16, mouthSmile=0.08, mouthLowerDown=0.20, mouthUpperUp=0.06),),
    "IY": (_SPREAD,),
    "OW": (_BACK, _ROUND),
    "OY": (_BACK, _SPREAD),
    "UH": (_vowel(0.16, mouthPucker=0.36, mouthFunnel=0.14),),
    "UW": (_ROUND,),
    SILENCE: (Viseme({}, firm=0.0, soft=0.7),),
}
VOWELS = frozenset(
    ("AA", "AE", "AH", "AO", "AW", "AX", "AY", "EH", "ER", "EY", "IH", "IY", "OW", "OY", "UH", "UW")
)
BILABIALS = frozenset(("P", "B", "M"))


def load_phones(path: Path) -> list[Phone]:
    """Phones of a JSON list of {"phone", "start", "end"}. Raises ValueError on a phone that is not known."""
    phones = [Phone(entry["phone"], entry["start"], entry["end"]) for entry in json.loads(path.read_text())]
    unknown = sorted({phone.name for phone in phones} - VISEMES.keys())
    if unknown:
        raise ValueError(
            f"{path}: unknown phones {', '.join(unknown)}; known are {', '.join(sorted(VISEMES))}"
        )
    return phones
