"""What tests of the pictures share."""

import pytest

from tests.support import runs


@pytest.fixture(scope="session")
def untrained_run(tmp_path_factory):
    """A run's folder, which no test changes for the others."""
    folder = tmp_path_factory.mktemp("run")
    runs.save(folder)
    return folder
