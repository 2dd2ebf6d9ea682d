import jax
import pytest

from cmedirl_jax.runs import train, validation
from cmedirl_jax.runs.cells import experts
from cmedirl_jax.runs.cluster.base import ALONE
from cmedirl_jax.runs.config import ExpertSettings, StudyConfig
from cmedirl_jax.runs.console import screen
from cmedirl_jax.runs.console.signals import Interruption
from cmedirl_jax.training.methods import METHODS


def slots(seeds_at_once, experts_trained, monkeypatch):
    """Room for the learners of a cell of 40 seeds, and for the experts."""
    config = StudyConfig(
        seeds=40, seeds_at_once=seeds_at_once, experts=ExpertSettings(seeds=experts_trained)
    )
    plan = validation.plan(config)
    session = train.session_of(plan, jax.devices()[:1], screen.console(), Interruption(), ALONE)
    of_experts = []
    monkeypatch.setattr(experts, "make_pool", lambda *args: of_experts.append(args[3].slots))
    train._train_experts(session, None, None)
    learners = session.compiled(METHODS["ddpg"], plan.settings, min(seeds_at_once or 40, 40)).slots
    return learners, *of_experts


@pytest.mark.parametrize(
    ("at_once", "experts_trained", "expected"),
    [
        (None, 16, (40, 40)),
        (None, 80, (80, 80)),
        (10, 10, (10, 10)),
        (10, 40, (10, 40)),
        (1000, 40, (40, 40)),
    ],
)
def test_a_block_of_learners_has_its_own_memory(at_once, experts_trained, expected, monkeypatch):
    assert slots(at_once, experts_trained, monkeypatch) == expected
