"""The reader of pickles: true data comes back whole, whatever wrote it, and nothing else gets anywhere."""

from __future__ import annotations

import base64
import builtins
import functools
import os
import pickle
import pickletools
import zlib
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from personalize.errors import UserError
from personalize.restricted_pickle import HOLDERS, read_pickle

# Written by Python 2.7.18 with numpy 1.16.6, scipy 1.2.3 and chumpy 0.69, protocols 0 and 2: v_template a chumpy
# array, f uint32, J_regressor csc diag(1, 2), bs_style and latin ("\\xe9") as bytes of old, audio int16 [-1, 200].
PYTHON_2 = (
    "eNqlU02P2yAQvc8fsS+NADtZR6rUlXpKDzk010oIY+LQJjYCvIr/fWewt8qmaVLtHkYC5oP3Ho+8cRx22VFF22XgBK5/nM06g7DL"
    "9hnobji5caF7bxan4Rit8l6NIL3RfReiH3QEV0A+1UHXTHlXQr5hEHdZnUH87pa45Sk2BcS5uImjM+BWkO+yocwAG7AAq5+wskAg"
    "nzPYbrebT9hFgfPqDWMJIWNXwa/24nKPGGrk8w1ht96E0HukWoHWvRvp7A2f3oNbI6OgLTIPTvlgFrgDDHlS0dszOM5AS1kPFiXp"
    "pIS+/mlICs5hiwy4gByFJRK2a6w2AS/kJbQoVXulDX8VR0Bskxj2Ugy++qgaM/tGRUUonm6jqK5R7KtLFOt3oJhjz778O8nY84zv"
    "pM7O2y6SC/HaJSMLynBQztDRhI3gOSEohcK6SA8pipuMRDkzQse1qOIHrEPw6iBDHI8Jy5J+TE1vKlYERQ2N7Wl3W1vxl7ZWXGgr"
    "/kPb/X4KXV286IuM5uTw6xKogkFLttWH6cce4OsBTzm0syeL5MmCLkIb/zJysja1lkkckruxPo7yBRN0vnxr8mDosyOB/OiKJ5xz"
    "zkDR5Cr12vQaxRq2aZJxpmuC7Dta0riSEYCSp+KEoDFdAlCKVwA48ZaCZfFHwek51/DIdY/ikSvvJKs7SX6vk5fPs58WvwG7oYfv",
    "eNp1Uslu2zAQ1WI7Lu2mTpvu+65ejCLooYcCDdBbBPgQgMeCoCgmImotQ1KBfTDQHpzCf9Zf6a1/4I4sBa5QeIjRSNTwzZvH+e4t"
    "wA1od8qtysCj7m/qnomsTIv5WORajtNyahXXms8J01LkmbG6FJaAX2eRLK7/Qid0ltSNfp5CNwhdXP5lkxLbeSEJ9KhXfgid0MWU"
    "vSD0qftpMpmcrNE2j9Cx0YoOHTQX3UO3ER2cYN1zLY3JNfSFEQqpmYJrI8f4RdBZyq1WMwLX3v0AsoBBQPdUFishDQwTP9kyu14x"
    "85YJUlFXVPZ3UulfUUEanZhbDjdaaKMt2tnHBu1gJ9rI2difz3V0jhG1n/JZoVVm4WZ4RHvMJLyQcCv0Qu+S9rCHwmo4bBW9XRX1"
    "l8n+f1KViBcZZux8KuEO9aeRgbu0y8tY5XCvBXL/Hx2OGuYPdjLvrNe/Kg3IBbMyLXBWJDwUIqmnJCFfEgKPUPrHC3gS0CFexzfJ"
    "6iuCpys6YLHSds4ucAOeCcaiUuFQZYwRI3GSnn+FF9Sd8eUpvKQdprDlVxM6YrEsZBYblmfVq4HXC3iDYBv0WGYI/naF51qNBZvG"
    "cPSSgxV977Rsq3wd+k0cNfHwuNKwHP8FQH7ysg==",
)


def written(tmp_path: Path, content: bytes) -> Path:
    path = tmp_path / "data.pkl"
    path.write_bytes(content)
    return path


class Calls:
    """What an attacker's object says when it is pickled."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.reduced = (function, arguments)

    def __reduce__(self) -> tuple[Any, ...]:
        return self.reduced


@pytest.mark.parametrize("protocol", range(6))
def test_what_data_sets_hold_comes_back(tmp_path: Path, protocol: int) -> None:
    rng = np.random.default_rng(0)
    shared = rng.standard_normal((3, 2))
    dense = sparse.random(5, 7, 0.4, random_state=1)
    data = {
        "arrays": [
            shared,
            np.asfortranarray(shared),
            shared[::2],
            np.zeros((0, 3), "f4"),
            np.array(7, ">i2"),
        ],
        "text": np.array(["a", "bcd"]),
        "bools": np.array([True, False]),
        "scalars": (np.float32(1.5), np.int64(-3), 2**70, 1.5, None, True, "é", b"\xff"),
        "matrices": [dense.tocsc(), dense.tocsr(), dense.tocoo()],
        "sets": {"a": {1, 2}, "b": frozenset({3})},
        "ordered": OrderedDict(first=1, second=2),
        5: {0: 10, 1: 11},
    }
    read = read_pickle(written(tmp_path, pickle.dumps(data, protocol)))
    for ours, theirs in zip(read["arrays"], data["arrays"], strict=True):
        assert ours.dtype == theirs.dtype and np.array_equal(ours, theirs)
    assert read["text"].tolist() == ["a", "bcd"] and read["bools"].tolist() == [True, False]
    assert read["scalars"] == data["scalars"]
    for ours, theirs in zip(read["matrices"], data["matrices"], strict=True):
        assert type(ours) is type(theirs) and np.array_equal(ours.toarray(), theirs.toarray())
    for key in ("sets", "ordered", 5):
        assert read[key] == data[key]


@pytest.mark.parametrize("protocol", [2, 5])
def test_modules_of_numpy_1_and_old_scipy(tmp_path: Path, protocol: int) -> None:
    data = {"x": np.arange(4.0), "s": np.float32(2), "m": sparse.csc_matrix(np.eye(2))}
    content = pickle.dumps(data, protocol)
    for new, old in ((b"numpy._core", b"numpy.core"), (b"scipy.sparse._csc", b"scipy.sparse.csc")):
        content = renamed(content, new.decode(), old.decode())
    read = read_pickle(written(tmp_path, content))
    assert (
        read["x"].tolist() == [0, 1, 2, 3]
        and read["s"] == 2
        and read["m"].toarray().tolist() == [[1, 0], [0, 1]]
    )


def renamed(content: bytes, new: str, old: str) -> bytes:
    """The pickle with another module's name, unframed, since lengths change."""
    opcodes, pieces = list(pickletools.genops(content)), []
    for (opcode, argument, start), (_, _, end) in zip(
        opcodes, [*opcodes[1:], (None, None, None)], strict=True
    ):
        piece = content[start:end]
        if isinstance(argument, str) and argument.startswith(new) and opcode.name == "SHORT_BINUNICODE":
            name = argument.replace(new, old).encode()
            piece = piece[:1] + bytes([len(name)]) + name
        elif opcode.name == "GLOBAL":
            piece = piece.replace(new.encode(), old.encode())
        pieces += [piece] if opcode.name != "FRAME" else []
    return b"".join(pieces)


@pytest.mark.parametrize("content", PYTHON_2)
def test_python_2_and_chumpy(tmp_path: Path, content: str) -> None:
    read = read_pickle(written(tmp_path, zlib.decompress(base64.b64decode(content))))
    assert type(read["v_template"]) is np.ndarray
    assert read["v_template"].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert read["f"].dtype == np.uint32 and read["f"].tolist() == [[0, 1, 2]]
    assert read["J_regressor"].toarray().tolist() == [[1, 0], [0, 2]]
    assert read["audio"].tolist() == [-1, 200]
    assert (read["bs_style"], read["latin"]) == ("lbs", "\xe9")


def test_shared_and_endless_structures_stay_so(tmp_path: Path) -> None:
    loop: dict[str, Any] = {"list": [1]}
    loop["self"], loop["same"] = loop, loop["list"]
    read = read_pickle(written(tmp_path, pickle.dumps(loop)))
    assert read["self"] is read and read["same"] is read["list"]
    laughs: list[Any] = ["ha"]
    for _ in range(60):
        laughs = [laughs, laughs]  # 2^60 when written out
    assert "laughs" in read_pickle(written(tmp_path, pickle.dumps({"laughs": laughs})))


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize(
    ("function", "name"),
    [
        (os.system, r"(posix|nt)\.system"),
        (builtins.eval, r"(builtins|__builtin__)\.eval"),
        (functools.partial, r"functools\.partial"),
        (builtins.getattr, r"(builtins|__builtin__)\.getattr"),
        (builtins.bytearray, r"(builtins|__builtin__)\.bytearray"),
        (np.fromfile, r"numpy\.?\w*\.fromfile"),
        (np.load, r"numpy\.?\w*\.load"),
        (sparse.load_npz, r"load_npz"),
        (Path, r"pathlib\.Path"),
    ],
)
def test_everything_else_is_refused_by_name(tmp_path: Path, function: Any, name: str, protocol: int) -> None:
    mark = tmp_path / "ran"
    path = written(tmp_path, pickle.dumps({"x": [Calls(function, f"touch {mark}")]}, protocol))
    with pytest.raises(UserError, match=name) as caught:
        read_pickle(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    assert not mark.exists()


def test_calls_inside_calls_are_refused(tmp_path: Path) -> None:
    inner = Calls(os.system, "true")
    for outer in (Calls(set, [inner]), Calls(OrderedDict, [("a", inner)]), Calls(np.dtype, inner)):
        with pytest.raises(UserError, match=r"\.system"):
            read_pickle(written(tmp_path, pickle.dumps({"x": outer})))


@pytest.mark.parametrize("name", sorted(HOLDERS))
def test_the_holders_cannot_be_changed(tmp_path: Path, name: tuple[str, str]) -> None:
    """BUILD with slot state writes attributes: on a class it would outlive the file."""
    content = f"\x80\x02c{name[0]}\n{name[1]}\n(N}}X\x08\x00\x00\x00__call__K\x01stb.".encode()
    before = HOLDERS[name].__dict__.copy()
    with pytest.raises(UserError, match="not a readable pickle"):
        read_pickle(written(tmp_path, content))
    assert HOLDERS[name].__dict__ == before


def array_claiming(shape: bytes, code: bytes = b"U\x02f8") -> bytes:
    """A Python-2 pickle of {"x": array} with another shape or type than its eight bytes have."""
    head = b"\x80\x02}U\x01xcnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R(K\x01"
    dtype = (
        b"cnumpy\ndtype\n" + code + b"K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    )
    return head + shape + dtype + b"\x89U\x08" + bytes(8) + b"tbs."


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"not a pickle",
        pickle.dumps({"x": np.zeros(100)})[:-200],
        array_claiming(b"\x8a\x06\x00\x00\x00\x00\x00\x01\x85"),  # (2^40,)
        array_claiming(b"J\xff\xff\xff\xff\x85"),  # (-1,)
        array_claiming(b"K\x01\x85", b"U\x01O"),  # of objects
        b"\x80\x05\x96" + (1 << 40).to_bytes(8, "little") + b".",  # a bytearray of 1 TB
        b"\x80\x04\x8e" + (1 << 40).to_bytes(8, "little") + b".",  # bytes of 1 TB
        b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b".",  # lists 100 000 deep
        pickle.dumps({"x": Calls(object)}),
        pickle.dumps({"x": Calls(bytes, 1 << 40)}),
        pickle.dumps({"x": np.ndarray}),
        pickle.dumps({"x": np.array([None])}),
        pickle.dumps({"x": sparse.csc_matrix(np.eye(3))}).replace(b"indptr", b"indpts"),
    ],
)
def test_damaged_and_hostile_files_get_one_line(tmp_path: Path, content: bytes) -> None:
    path = written(tmp_path, content)
    with pytest.raises(UserError, match=r"not a readable pickle|is needed") as caught:
        read_pickle(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_a_memo_place_costs_nothing(tmp_path: Path) -> None:
    """The interpreter in C takes 32 GB for this."""
    assert read_pickle(written(tmp_path, b"\x80\x02}r\xff\xff\xff\x7f.")) == {}


@pytest.mark.parametrize("holder", ["key", "member"])
def test_tuples_of_tuples_are_refused_before_they_are_hashed(tmp_path: Path, holder: str) -> None:
    nested: Any = (1, 2)
    for _ in range(200):  # 2^200 members, in 2 kB
        nested = (nested, nested)
    chain = pickle.dumps(nested, protocol=2)[:-1]
    content = (
        chain
        + (pickle.NONE + pickle.SETITEM if holder == "key" else pickle.TUPLE1 + pickle.APPEND)
        + pickle.STOP
    )
    start = pickle.PROTO + b"\x02" + (pickle.EMPTY_DICT if holder == "key" else pickle.EMPTY_LIST)
    with pytest.raises(UserError, match="tuples nested too deep"):
        read_pickle(written(tmp_path, start + content[2:]))


def test_indices_out_of_range_are_found(tmp_path: Path) -> None:
    matrix = sparse.csr_matrix(np.eye(3))
    matrix.indices[1] = 77
    with pytest.raises(UserError, match="indices"):
        read_pickle(written(tmp_path, pickle.dumps({"m": matrix})))


@pytest.mark.parametrize("kind", [sparse.coo_matrix, sparse.csc_matrix, sparse.csr_matrix])
def test_a_sparse_matrix_that_would_fill_the_memory_is_refused(tmp_path: Path, kind: type) -> None:
    with pytest.raises(UserError, match=r"not a readable pickle.*shape \(200000, 200000\)"):
        read_pickle(written(tmp_path, pickle.dumps({"m": kind((200_000, 200_000))})))


def test_missing_large_and_other_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="there is no file"):
        read_pickle(tmp_path / "none.pkl")
    with pytest.raises(UserError, match="holds a list"):
        read_pickle(written(tmp_path, pickle.dumps([1])))
    monkeypatch.setattr("personalize.restricted_pickle.LARGEST_PICKLE_BYTES", 10)
    with pytest.raises(UserError, match="larger than"):
        read_pickle(written(tmp_path, pickle.dumps({"x": "long enough"})))
