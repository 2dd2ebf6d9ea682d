"""Maximum causal entropy IRL of irl-maxent: `python -m ... PROBLEM.npz STEPS`."""

import sys

import irl_maxent.maxent as maxent
import numpy as np
from irl_maxent.optimizer import Constant, Sga
from irl_maxent.trajectory import Trajectory

from benchmarks.serving import serve_from_command_line

# It names what numpy has not had since 1.24.
np.float = float  # noqa: NPY001

EXACT = 1e-9
"""Change at which its iterations end."""

problem = dict(np.load(sys.argv[1]))
state, action, mask = (problem[name] for name in ("state", "action", "mask"))
transition = np.moveaxis(problem["transition"], 1, 2).copy()
states = len(transition)
goal = states - 1
# Nothing follows the end of an episode.
transition[goal] = 0.0
shown = [
    Trajectory(list(zip(s[m], a[m], [*s[m][1:], end], strict=True)))
    for s, a, m, end in zip(state, action, mask, problem["last"], strict=True)
]
initial = maxent.initial_probabilities_from_trajectories(states, shown)


def train(steps: int) -> np.ndarray:
    """The reward `[S]` after so many steps of gradient ascent."""
    return maxent.irl_causal(
        transition,
        np.eye(states),
        [goal],
        shown,
        # The steps after these have no length, which ends the loop.
        Sga(lr=lambda step: float(problem["rate"]) * (step < steps)),
        Constant(float(problem["first"])),
        1.0,
        eps=0.0,
        eps_svf=EXACT,
        eps_lap=EXACT,
    )


def facts() -> dict:
    """Visits of the soft-optimal policy, `[S]`, and the log likelihood of the demonstrations."""
    reward = train(int(sys.argv[-1]))
    policy = maxent.local_causal_action_probabilities(transition, [goal], reward, 1.0, EXACT)
    visits = maxent.expected_svf_from_policy(transition, initial, [goal], policy, EXACT)
    visits[goal] = 0.0
    likelihood = np.log(policy[state[mask], action[mask]]).sum() / len(state)
    return {"visitation": visits.tolist(), "log_likelihood": likelihood}


serve_from_command_line(train, facts)
