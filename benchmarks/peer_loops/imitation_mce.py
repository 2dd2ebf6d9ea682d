"""Maximum causal entropy IRL of imitation: `python -m ... PROBLEM.npz STEPS`."""

import sys

import numpy as np
import torch
from imitation.algorithms import mce_irl
from imitation.rewards.reward_nets import RewardNet
from seals.base_envs import TabularModelPOMDP

from benchmarks.serving import serve_from_command_line

problem = dict(np.load(sys.argv[1]))
transition, state, action = (problem[name] for name in ("transition", "state", "action"))
states, horizon = len(transition), state.shape[1]
env = TabularModelPOMDP(
    transition_matrix=transition,
    observation_matrix=np.eye(states),
    reward_matrix=np.zeros(states),
    horizon=horizon,
    initial_state_dist=np.bincount(state[:, 0], minlength=states) / len(state),
)
visited = np.bincount(state.ravel(), minlength=states) / len(state)
occupancy_measures = mce_irl.mce_occupancy_measures


class TableReward(RewardNet):
    """A number for each state, in double precision."""

    def __init__(self):
        """From zeros."""
        super().__init__(env.observation_space, env.action_space, normalize_images=False)
        self.table = torch.nn.Parameter(torch.zeros(states, dtype=torch.float64))

    def forward(self, state, action, next_state, done):
        """`[S, S]` one-hot to `[S]`."""
        return state @ self.table


def train(steps: int, demonstrated: np.ndarray) -> np.ndarray:
    """The reward `[S]` after so many steps of gradient ascent."""
    reward = TableReward()
    trainer = mce_irl.MCEIRL(
        demonstrated,
        env,
        reward,
        np.random.default_rng(0),
        optimizer_cls=torch.optim.SGD,
        optimizer_kwargs={"lr": float(problem["rate"])},
        # It would end earlier.
        linf_eps=0.0,
        grad_l2_eps=0.0,
        log_interval=None,
    )
    trainer.train(steps)
    return reward.table.detach().numpy()


def judged(reward: np.ndarray) -> dict:
    """Visits of the soft-optimal policy, `[S]`, and the log likelihood of the demonstrations."""
    _, _, policy = mce_irl.mce_partition_fh(env, reward=reward)
    visits, _ = occupancy_measures(env, pi=policy, reward=reward)
    chosen = policy[np.arange(horizon), state, action]
    likelihood = np.log(chosen).sum() / len(state)
    return {"visitation": visits[:-1].sum(axis=0).tolist(), "log_likelihood": likelihood}


def without_the_last_state(*args, **kwargs):
    """Its visits, less those after the last action, for which no policy is paid."""
    visits, cumulated = occupancy_measures(*args, **kwargs)
    return visits, cumulated - visits[-1]


def facts() -> dict:
    """What it learns as it is, and where its gradient counts what its policy is paid for."""
    after = visited + np.bincount(problem["last"], minlength=states) / len(state)
    steps = int(sys.argv[-1])
    as_it_is = judged(train(steps, after))
    mce_irl.mce_occupancy_measures = without_the_last_state
    alike = judged(train(steps, visited))
    mce_irl.mce_occupancy_measures = occupancy_measures
    return {**alike, "as_it_is": as_it_is}


serve_from_command_line(lambda steps: train(steps, visited), facts)
