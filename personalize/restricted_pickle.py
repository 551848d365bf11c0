"""Reading a pickle that somebody else made, without executing anything: data sets and head models come as pickles.

A pickle is a program that calls whatever it names. Here every name it may use leads to an inert holder that only
keeps what it is given; the data is built from the holders afterwards, with lengths checked. So neither the file nor
numpy's own unpickling functions decide what runs, and no memory is taken that the file does not fill (of a sparse
matrix, which is made dense, none above a limit).
"""

from __future__ import annotations

import io
import math
import operator
import pickle
import re
import struct
from collections import OrderedDict
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from personalize.errors import UserError

LARGEST_PICKLE_BYTES = 2 << 30
LARGEST_SPARSE_BYTES = 256 << 20  # of a sparse matrix made dense in double precision
# Members and members of members of a tuple, as often as they are met: a key's hash meets them so often.
LARGEST_TUPLE = 1 << 16
DTYPE = re.compile(r"[<>|=]?[biufcSU]\d{1,6}")
# What a damaged or hostile file makes the interpreter of pickles, or the building after it, raise.
BROKEN = (
    pickle.UnpicklingError, ValueError, TypeError, LookupError, EOFError, AttributeError, ImportError,
    OverflowError, RecursionError, MemoryError, struct.error,
)  # fmt: skip


class _Sealed(type):
    """Classes that a pickle's BUILD cannot write to."""

    def __setattr__(cls, name: str, value: object) -> None:
        raise AttributeError(f"{cls.__name__} is sealed")


class _Held(metaclass=_Sealed):
    """Keeps the arguments and the state that a pickle gives one object."""

    __slots__ = ("args", "state")
    args: tuple[Any, ...]
    state: Any

    def __new__(cls, *args: Any) -> _Held:
        held = super().__new__(cls)
        held.args, held.state = args, None
        return held

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Array(_Held):
    """numpy's `_reconstruct(type, (0,), b"b")`; the state brings shape, dtype, order and bytes."""


class _Buffer(_Held):
    """numpy's `_frombuffer(bytes, dtype, shape, order)` of protocol 5."""


class _Scalar(_Held):
    """numpy's `scalar(dtype, bytes)`."""


class _DType(_Held):
    """`numpy.dtype(code, align, copy)`; the state brings the byte order."""


class _Encoded(_Held):
    """`_codecs.encode(text, "latin1")`, or `bytes()`: bytes in protocols that know none."""


class _Chumpy(_Held):
    """An array of the old autodiff package chumpy: its value stands in the state as `x`."""


class _Csc(_Held):
    """scipy's csc_matrix."""


class _Csr(_Held):
    """scipy's csr_matrix."""


class _Coo(_Held):
    """scipy's coo_matrix."""


class _Reconstructed(metaclass=_Sealed):
    """`copyreg._reconstructor(class, object, None)`: an object of protocols 0 and 1."""

    def __new__(cls, kind: Any, base: Any, state: Any) -> Any:
        if not (isinstance(kind, type) and issubclass(kind, _Held) and base is object and state is None):
            raise pickle.UnpicklingError("an object that is no plain one")
        return kind()


HOLDERS: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _DType,
    ("_codecs", "encode"): _Encoded,
    ("chumpy.ch", "Ch"): _Chumpy,
    ("collections", "OrderedDict"): OrderedDict,
}
for _module in ("numpy.core", "numpy._core"):
    HOLDERS[_module + ".multiarray", "_reconstruct"] = _Array
    HOLDERS[_module + ".multiarray", "scalar"] = _Scalar
    HOLDERS[_module + ".numeric", "_frombuffer"] = _Buffer
for _module in ("copyreg", "copy_reg"):
    HOLDERS[_module, "_reconstructor"] = _Reconstructed
for _module in ("builtins", "__builtin__"):
    HOLDERS |= {(_module, kind.__name__): kind for kind in (object, set, frozenset)}
    HOLDERS[_module, "bytes"] = _Encoded
for _name, _kind in (("csc", _Csc), ("csr", _Csr), ("coo", _Coo)):
    for _module in ("scipy.sparse.", "scipy.sparse._"):
        HOLDERS[_module + _name, _name + "_matrix"] = _kind


def read_pickle(path: Path) -> dict[Any, Any]:
    """The dictionary in a pickle of any protocol, of Python 2 (text as latin1) or 3, numpy 1 or 2.

    It may hold numbers, text, containers, numpy arrays and scalars of numbers or text, scipy.sparse csc, csr and
    coo matrices, and chumpy arrays (as numpy's). Arrays are views of the file's bytes, mostly read-only. Raises
    UserError, in one line, for a missing, too large or damaged file, and for one that names any other class.
    """
    if not path.is_file():
        raise UserError(f"there is no file {path}")
    if path.stat().st_size > LARGEST_PICKLE_BYTES:
        raise UserError(
            f"{path} is larger than {LARGEST_PICKLE_BYTES >> 30} GB, the most that is read of a pickle"
        )
    return build_pickle(path, path.read_bytes())


def build_pickle(path: Path, content: bytes) -> dict[Any, Any]:
    """The same of a pickle's bytes, which are found in the file `path`."""
    try:
        value = _Builder().build(_Unpickler(path, content).load())
    except BROKEN as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise UserError(f"{path} is not a readable pickle ({reason}); get the file again") from error
    if not isinstance(value, dict):
        raise UserError(
            f"{path} holds a {type(value).__name__}, and a dictionary is needed; is it another file?"
        )
    return value


def _weighing(load: Any) -> Any:
    """An opcode that leaves a tuple on the stack, and has it weighed."""

    def loaded(unpickler: Any) -> None:
        load(unpickler)
        unpickler.weigh(unpickler.stack[-1])

    return loaded


class _Unpickler(pickle._Unpickler):
    """Finds holders, and nothing else.

    The library's interpreter in Python, not the one in C: that one allocates what an opcode claims before it looks
    whether the file has it (its memo up to the largest place named: 32 GB for nine bytes). The bulk of our files is
    array bytes, which cost no more here.
    """

    read: Any
    append: Any

    def __init__(self, path: Path, content: bytes) -> None:
        super().__init__(io.BytesIO(content), encoding="latin1")
        self._path = path
        # Of tuples that hold tuples: by id, how many members all in all, and the tuple, which keeps its id its own.
        self._weights: dict[int, tuple[int, Any]] = {}

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in HOLDERS:
            raise UserError(
                f"{self._path} names {module}.{name}, which is no plain data; it is refused, and nothing of it was run"
            )
        return HOLDERS[module, name]

    def load_bytearray(self) -> None:
        """Opcode BYTEARRAY8 without claiming its memory first."""
        length = int.from_bytes(self.read(8), "little")
        content = self.read(min(length, LARGEST_PICKLE_BYTES))
        if len(content) != length:
            raise EOFError(f"{length} bytes announced, {len(content)} there")
        self.append(bytearray(content))

    def weigh(self, made: tuple[Any, ...]) -> None:
        """Refuse a tuple of tuples of tuples .., a few bytes each, that takes for ever to be hashed as a key."""
        if not any(isinstance(member, tuple) for member in made):
            return
        weight = len(made) + sum(
            self._weights.get(id(member), (len(member),))[0] for member in made if isinstance(member, tuple)
        )
        if weight > LARGEST_TUPLE:
            raise ValueError("tuples nested too deep")
        self._weights[id(made)] = weight, made

    dispatch: ClassVar[Any] = pickle._Unpickler.dispatch | {pickle.BYTEARRAY8[0]: load_bytearray}
    for _code in (pickle.TUPLE, pickle.TUPLE1, pickle.TUPLE2, pickle.TUPLE3):
        dispatch[_code[0]] = _weighing(dispatch[_code[0]])


class _Builder:
    """Plain data from holders: each object once, however often it is referred to."""

    def __init__(self) -> None:
        self._built: dict[int, Any] = {}
        self._encoded = 0

    def build(self, value: Any) -> Any:
        """The value with every holder in it replaced; containers are new."""
        if isinstance(value, (str, bytes, bytearray, int, float, complex, type(None))):
            return value
        if id(value) in self._built:
            return self._built[id(value)]
        if isinstance(value, dict):
            entries = self._built[id(value)] = {}
            entries |= {self.build(key): self.build(item) for key, item in dict.items(value)}
            return entries
        if isinstance(value, list):
            items = self._built[id(value)] = []
            items += [self.build(item) for item in value]
            return items
        if isinstance(value, (tuple, set, frozenset)):
            built: Any = type(value)(self.build(item) for item in value)
        else:
            built = self._object(value)
        self._built[id(value)] = built
        return built

    def _object(self, held: Any) -> Any:
        if isinstance(held, _Array):
            shape, dtype, fortran, raw = self.build(held.state)[-4:]
            return _view(self._bytes(raw), dtype, shape, "F" if fortran else "C")
        if isinstance(held, _Buffer):
            raw, dtype, shape, order = self.build(held.args)
            return _view(self._bytes(raw), dtype, shape, order)
        if isinstance(held, _Scalar):
            dtype, raw = self.build(held.args)
            return _view(self._bytes(raw), dtype, (), "C")[()]
        if isinstance(held, _DType):
            return _dtype(held.args[0], held.state)
        if isinstance(held, _Encoded):
            return self._bytes(*held.args or ("",))
        if isinstance(held, _Chumpy):
            return np.asarray(self.build(held.state)["x"])
        if isinstance(held, (_Csc, _Csr, _Coo)):
            return _matrix(type(held), self.build(held.state))
        raise pickle.UnpicklingError(f"a {type(held).__name__} that is no data")

    def _bytes(self, content: bytes | bytearray | str, encoding: str = "latin1") -> bytes | bytearray:
        """The content as bytes. Text is copied, and could be referred to often: in all as much as a file may hold."""
        if isinstance(content, (bytes, bytearray)):
            return content
        self._encoded += len(content)
        if encoding != "latin1" or self._encoded > LARGEST_PICKLE_BYTES:
            raise ValueError(f"text encoded as {encoding}, {self._encoded} bytes in all")
        return content.encode("latin1")


def _dtype(code: str, state: Any) -> np.dtype[Any]:
    """Numbers and text only: no objects, no records."""
    if not DTYPE.fullmatch(code):
        raise ValueError(f"array of type {code!r}; only numbers and text are read")
    dtype = np.dtype(code)
    return dtype if state is None else dtype.newbyteorder(state[1])


def _view(
    content: bytes | bytearray, dtype: np.dtype[Any], shape: tuple[int, ...], order: Any
) -> NDArray[Any]:
    """An array over the bytes, which must be exactly as many as the shape needs."""
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(content):
        raise ValueError(f"an array of shape {shape} of {dtype} cannot be {len(content)} bytes long")
    return np.ndarray(shape, dtype, buffer=content, order=order)


def _matrix(kind: type, state: dict[str, Any]) -> Any:
    """The sparse matrix of scipy's own state, its size and indices checked: whoever reads it makes it dense."""
    data, shape = state["data"], state["_shape"]
    rows, columns = (operator.index(size) for size in shape)
    if min(rows, columns) < 0 or rows * columns * 8 > LARGEST_SPARSE_BYTES:
        raise ValueError(f"a sparse matrix of shape {rows, columns} is none of a head's")
    if kind is _Coo:
        coords = state["coords"] if "coords" in state else (state["row"], state["col"])
        return sparse.coo_matrix((data, coords), shape=shape)
    build = sparse.csc_matrix if kind is _Csc else sparse.csr_matrix
    matrix = build((data, state["indices"], state["indptr"]), shape=shape)
    matrix.check_format(full_check=True)
    return matrix
