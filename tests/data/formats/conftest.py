"""Datasets of Minari's that tests make lie in a folder of their own."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def minaris_folder(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        yield
