import importlib.metadata

import pytest

from cmedirl_jax.runs.loggers import registry


def test_unknown_loggers_are_refused_by_name():
    with pytest.raises(
        ValueError, match=r"^unknown logger 'x'; there are: csv, tensorboard, wandb$"
    ):
        registry.check(["csv", "x"])


@pytest.mark.parametrize("name", ["tensorboard", "wandb"])
def test_a_logger_whose_package_is_missing_is_refused_before_the_run(name, monkeypatch):
    def missing(package):
        raise importlib.metadata.PackageNotFoundError(package)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    registry.check(["csv"])
    expected = rf"^{name} is not installed: python -m pip install {name}$"
    with pytest.raises(ValueError, match=expected):
        registry.check(["csv", name])
