"""No test of this folder reads or fills the user's cache of rendered frames."""

import pytest


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXIL_CACHE", str(tmp_path / "cache"))
