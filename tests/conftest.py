"""One thread for torch and BLAS, since on two busy cores more threads wait for each other; a cache of its own."""

import os

import pytest

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["OMP_WAIT_POLICY"] = "PASSIVE"


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Nothing is written into the user's cache, by commands that tests start neither."""
    os.environ["PERSONALIZE_CACHE"] = str(tmp_path_factory.mktemp("cache"))
