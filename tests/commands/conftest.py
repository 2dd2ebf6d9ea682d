import pytest

from cmedirl_jax.data.formats import tables
from tests.support import pools


@pytest.fixture
def table(tmp_path):
    """Three scripted episodes of the car as a CSV file."""
    tables.write_table(tmp_path / "pool.csv", pools.scripted(3))
    return tmp_path / "pool.csv"
