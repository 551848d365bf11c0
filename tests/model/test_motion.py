"""Motion files: both layouts, and one clear line for everything that can be wrong with them."""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from model import motion as module
from model.motion import Motion, MotionError, principal_modes
from tests.model import talker


@pytest.fixture
def motion() -> Motion:
    valid = np.ones(40, bool)
    valid[3] = False
    return Motion(
        fps=30.0,
        start_s=0.25,
        template=np.random.default_rng(0).random((talker.D, 3)).astype(np.float32),
        faces=talker.FACES,
        basis=talker.basis(),
        coefficients=talker.sequence(40, 0).coefficients,
        valid=valid,
        provenance={"synthetic": True, "seed": 1},
    )


@pytest.fixture
def path(motion: Motion, tmp_path: Path) -> Path:
    motion.save(tmp_path / "motion.npz")
    return tmp_path / "motion.npz"


def rewritten(path: Path, drop: str = "", **arrays: Any) -> None:
    """The same file with something else in it."""
    with np.load(path) as stream:
        old = {name: stream[name] for name in stream.files if name != drop}
    np.savez(path, **(old | arrays))


def test_round_trip_in_basis_form(motion: Motion, path: Path) -> None:
    loaded = Motion.load(path)
    for name in ("template", "faces", "basis", "coefficients", "valid"):
        assert np.array_equal(getattr(loaded, name), getattr(motion, name))
    assert (loaded.fps, loaded.start_s, loaded.provenance) == (30.0, 0.25, motion.provenance)
    assert [entry.name for entry in path.parent.iterdir()] == ["motion.npz"]


def test_displacements_become_basis_form(motion: Motion, path: Path) -> None:
    rewritten(path, drop="basis", displacements=motion.displacements())
    rewritten(path, drop="coefficients")
    loaded = Motion.load(path)
    assert len(loaded.basis) <= talker.K
    flat = loaded.basis.reshape(len(loaded.basis), -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(len(flat)), atol=1e-5)
    error = loaded.displacements() - motion.displacements()
    assert np.sqrt((error**2).sum(-1).mean()) <= module.BASIS_ERROR_M


def test_displacements_of_some_vertices(motion: Motion) -> None:
    np.testing.assert_allclose(
        motion.displacements(np.array([4, 2])), motion.displacements()[:, [4, 2]], atol=1e-8
    )


def test_still_motion_has_one_mode() -> None:
    basis, coefficients = principal_modes(np.zeros((5, 4, 3), np.float32))
    assert basis.shape == (1, 4, 3) and not coefficients.any()


@pytest.mark.parametrize("missing", ["fps", "template", "faces", "coefficients", "basis", "valid"])
def test_missing_arrays(path: Path, missing: str) -> None:
    rewritten(path, drop=missing)
    with pytest.raises(MotionError, match=f"no motion file: .*{missing}"):
        Motion.load(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"coefficients": np.zeros((40, 9))}, "coefficients has shape"),
        ({"valid": np.ones(39, bool)}, "valid has shape"),
        ({"template": np.zeros((talker.D, 2))}, "template has shape"),
        ({"template": np.array(1.0)}, "template has shape"),
        ({"faces": np.array(1)}, "faces has shape"),
        ({"template": np.zeros((talker.D + 1, 3))}, "shape"),
        ({"faces": np.full((5, 3), talker.D)}, "vertices that do not exist"),
        ({"faces": np.full((5, 3), -1)}, "vertices that do not exist"),
        ({"faces": np.zeros((5, 3))}, "its mesh is not the one"),
        ({"fps": 0.0}, "fps 0.0"),
        ({"start_s": np.nan}, "start_s nan"),
        ({"coefficients": np.full((40, talker.K), np.nan)}, "not finite"),
        ({"fps": "fast"}, "no motion file"),
        ({"provenance": "{"}, "no motion file"),
        ({"provenance": "[" * 100_000}, "no motion file"),
        ({"provenance": "[]"}, "provenance is no JSON object"),
        ({"provenance": "3"}, "provenance is no JSON object"),
        ({"provenance": '{"av_offset_s": "late"}'}, "av_offset_s 'late' in the provenance"),
        ({"provenance": '{"av_offset_of": 1}'}, "av_offset_of in the provenance is no list"),
        ({"provenance": '{"av_offset_s": NaN}'}, "av_offset_s nan in the provenance"),
        ({"basis": np.zeros((0, talker.D, 3)), "coefficients": np.zeros((40, 0))}, "basis is empty"),
        ({"coefficients": np.zeros((0, talker.K)), "valid": np.ones(0, bool)}, "coefficients is empty"),
        ({"template": np.full((talker.D, 3), np.nan)}, "not finite"),
        ({"coefficients": np.full((40, talker.K), 1e30)}, r"vertices move by \d\S+ m"),
    ],
)
def test_arrays_that_do_not_fit(path: Path, changes: dict[str, Any], message: str) -> None:
    rewritten(path, **changes)
    with pytest.raises(MotionError, match=message) as caught:
        Motion.load(path)
    assert "\n" not in str(caught.value)


def test_invalid_frames_may_hold_anything(motion: Motion, path: Path) -> None:
    coefficients = motion.coefficients.copy()
    coefficients[3] = np.nan
    replace(motion, coefficients=coefficients).save(path)
    assert np.isnan(Motion.load(path).coefficients[3]).all()


def test_displacements_of_invalid_frames_may_hold_anything(motion: Motion, path: Path) -> None:
    displacements, valid = motion.displacements(), motion.valid.copy()
    frame = np.flatnonzero(valid)[0]
    displacements[frame], valid[frame] = np.nan, False
    rewritten(path, drop="basis", displacements=displacements, valid=valid)
    rewritten(path, drop="coefficients")
    found = Motion.load(path).displacements()
    np.testing.assert_allclose(found[valid], motion.displacements()[valid], atol=1e-4)
    rewritten(path, valid=motion.valid)
    with pytest.raises(MotionError, match="displacements that are not finite"):
        Motion.load(path)


def test_a_sound_of_whose_delay_nothing_is_told_is_not_late(motion: Motion) -> None:
    assert replace(motion, provenance={"av_offset_of": ["a"]}).sound_offset_s("a") == 0.0


def test_missing_truncated_and_foreign_files(path: Path) -> None:
    with pytest.raises(MotionError, match="there is no file"):
        Motion.load(path.with_name("nothing.npz"))
    content = path.read_bytes()
    for wrong in (content[: len(content) // 2], b"", b"not an archive" * 100):
        path.write_bytes(wrong)
        with pytest.raises(MotionError, match="not a readable motion file"):
            Motion.load(path)


def test_a_damaged_byte_in_a_compressed_file_gets_one_line(path: Path) -> None:
    with np.load(path, allow_pickle=False) as archive:
        np.savez_compressed(path, **archive)
    content = path.read_bytes()
    for place in range(40, len(content), max(1, len(content) // 150)):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :])
        try:
            Motion.load(path)
        except MotionError as error:
            assert "\n" not in str(error)


def test_pickles_are_refused(path: Path) -> None:
    rewritten(path, provenance=np.array([{"a": 1}], dtype=object))
    with pytest.raises(MotionError, match="provenance"):
        Motion.load(path)


def test_sizes_are_checked_before_anything_is_allocated(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LARGEST_MOTION_BYTES", 1000)
    with pytest.raises(MotionError, match="GB of memory"):
        Motion.load(path)


def test_a_header_that_claims_more_than_its_entry_holds(path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("coefficients.npy", header.getvalue())
    with pytest.raises(MotionError, match="claims shape"):
        Motion.load(path)
