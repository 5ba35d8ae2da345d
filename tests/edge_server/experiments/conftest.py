"""Rendered frames of these tests stay out of the user's own cache."""

import pytest


@pytest.fixture(scope="session")
def frame_cache(tmp_path_factory: pytest.TempPathFactory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def own_cache(frame_cache, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(frame_cache))
