"""The demo's film and its truth are made once, and again where they are damaged."""

from pathlib import Path
from unittest.mock import Mock

import pytest

from personalize import demo


@pytest.mark.parametrize(
    ("film", "truth"),
    [(None, None), (b"film", b""), (b"film", b"garbage"), (b"film", b"PK\x03\x04"), (None, b"x")],
)
def test_a_film_without_its_truth_is_rendered_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, film: bytes | None, truth: bytes | None
) -> None:
    for name, content in (("demo_0.mp4", film), ("demo_0.truth.npz", truth)):
        if content is not None:
            (tmp_path / name).write_bytes(content)
    monkeypatch.setattr(demo, "render_demo", rendered := Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        demo.run_demo(tmp_path, 10, 0)
    assert rendered.called
