"""Parts of the face by name, as shares of vertices."""

from dataclasses import replace

import numpy as np
import pytest

from model.checkpoint import Checkpoint
from personalize.errors import UserError
from personalize.regions import kept_share
from personalize.subject_data import BASE_CHECKPOINT


@pytest.fixture(scope="module")
def base() -> Checkpoint:
    return Checkpoint.load(BASE_CHECKPOINT)


def test_what_is_named_is_kept_or_made_anew_wholly(base: Checkpoint) -> None:
    kept = kept_share(base, ("eyelids", "forehead"), (), 0.0)
    remade = kept_share(base, (), ("eyelids", "forehead"), 0.0)
    named = np.union1d(base.regions["eyelids"], base.regions["forehead"])
    assert kept is not None and remade is not None and kept.dtype == np.float32
    assert np.array_equal(np.flatnonzero(kept), named) and set(np.unique(kept)) == {0, 1}
    assert np.array_equal(kept + remade, np.ones(len(base.template)))
    assert kept_share(base, (), (), 0.01) is None


def test_the_border_falls_along_the_surface(base: Checkpoint) -> None:
    """On a strip of points 1 mm apart the share falls by a tenth a point; what is not connected stays free."""
    strip = np.array([[0.001 * i, 0, 0] for i in range(30)] + [[0, 1e-4, 0]] * 3, np.float32)
    faces = np.array([[i, i + 1, i] for i in range(29)] + [[30, 31, 32]], np.int32)
    toy = replace(base, template=strip, faces=faces, regions={"end": np.array([0, 1], np.int32)})
    share = kept_share(toy, ("end",), (), 0.01)
    assert share is not None
    np.testing.assert_allclose(share[:12], [1, *np.arange(10, -1, -1) / 10], atol=1e-5)
    assert not share[12:].any()


def test_unknown_and_contradicting_names_are_refused(base: Checkpoint) -> None:
    with pytest.raises(UserError, match=r"'nose'.*eyelids, eyes.*lips"):
        kept_share(base, ("nose",), (), 0.0)
    with pytest.raises(UserError, match="one of them"):
        kept_share(base, ("lips",), ("eyes",), 0.0)
