"""Which seed lies in which lane of the compiled programs: seeds that have ended cost nothing.

A program steps the first groups of lanes on every device, as many as it is told. The seeds that
still run are kept in front, dealt evenly over the devices; they move only where that saves a group.
"""

import numpy as np


class Lanes:
    """The lanes of one cell.

    Attributes:
        seed: `[lanes]`, the seed in each lane; those from `seeds` on stand for none.
        seeds: how many seeds there are.
        group: lanes that are stepped together on a device.
        devices: devices that share the lanes, each a block of equal size.
    """

    def __init__(self, lanes: int, seeds: int, group: int, devices: int):
        """Deal `seeds` seeds to `lanes` lanes, a multiple of `group * devices`."""
        self.seeds, self.group, self.devices = seeds, group, devices
        self.seed = np.arange(lanes)
        self.seed = self.seed[self._dealt(self.seed < seeds)]

    @property
    def of_seed(self) -> np.ndarray:
        """`[seeds]`, the lane of each seed."""
        return np.argsort(self.seed)[: self.seeds]

    def groups(self, active: np.ndarray) -> int:
        """Groups that each device must step to reach every seed of `active` `[seeds]` bool."""
        return self._groups(self._lanes_of(active))

    def pack(self, active: np.ndarray) -> np.ndarray | None:
        """Bring the seeds of `active` to the front if that saves a group.

        Returns:
            The move, `[lanes]`: lane i takes over what was in lane move[i]. None if there is none.
        """
        lanes = self._lanes_of(active)
        move = self._dealt(lanes)
        if self._groups(lanes[move]) == self._groups(lanes):
            return None
        self.seed = self.seed[move]
        return move

    def _lanes_of(self, active: np.ndarray) -> np.ndarray:
        lanes = np.zeros(self.seed.size, bool)
        lanes[self.of_seed[active]] = True
        return lanes

    def _groups(self, lanes: np.ndarray) -> int:
        used = [np.flatnonzero(block) for block in np.split(lanes, self.devices)]
        return max(-(-(int(block[-1]) + 1) // self.group) if block.size else 0 for block in used)

    def _dealt(self, lanes: np.ndarray) -> np.ndarray:
        """An order of the lanes with those of `lanes` in front on each device, evenly dealt."""
        shares = np.array_split(np.flatnonzero(lanes), self.devices)
        idle = np.flatnonzero(~lanes)
        blocks = []
        for share in shares:
            free = lanes.size // self.devices - share.size
            blocks += [share, idle[:free]]
            idle = idle[free:]
        return np.concatenate(blocks)
