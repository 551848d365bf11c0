"""The landmarker's networks, opened by their runtime without its greeting."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

from ai_edge_litert.interpreter import Interpreter


def open_network(content: bytes, threads: int = 1) -> Interpreter:
    """A .tflite file's bytes -> its interpreter, with tensors allocated."""
    with _quiet():
        network = Interpreter(model_content=content, num_threads=threads)
        network.allocate_tensors()
    return network


@contextmanager
def _quiet() -> Iterator[None]:
    """Hold back what native code writes to stderr; it is shown if the block fails.

    The runtime says which of its own parts it uses, whatever its log level: a user takes that for a problem.
    """
    with tempfile.TemporaryFile() as held:
        stderr = os.dup(2)
        os.dup2(held.fileno(), 2)
        try:
            yield
        except BaseException:
            held.seek(0)
            os.write(stderr, held.read())
            raise
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
