"""A learned reward without this library: `python examples/reward_without_the_library.py r_d`.

`cmedirl reward RUN --export r_d` wrote the folder; numpy alone reads it.
"""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np


def function_of(folder, name):
    """The function of a file of Python in the folder."""
    spec = importlib.util.spec_from_file_location(name, Path(folder) / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return getattr(module, name)


def main(folder, draws=10_000):
    """Which of many random actions r_D pays best, at random observations: `[draws]` means."""
    card = json.loads((Path(folder) / "card.json").read_text())
    reward, rng = function_of(folder, "reward"), np.random.default_rng(0)
    spaces = [card["observation"], card["action"]]
    drawn = [rng.uniform(s["low"], s["high"], (draws, len(s["low"]))) for s in spaces]
    observation, action = np.asarray(drawn[0], np.float32), np.asarray(drawn[1], np.float32)
    paid = reward(observation, action)
    print(f"{card['task']}: r_D is {paid.mean():.3f} on average, {paid.std():.3f} its deviation")
    best = np.argmax(paid)
    print(f"It pays {paid[best]:.3f} for {action[best]} at {observation[best]}")
    return paid


if __name__ == "__main__":
    main(sys.argv[1])
