"""Which seed is in which slot of the compiled programs, so that finished seeds cost nothing.

A program steps the first groups of slots on every device. The running seeds are kept in those
groups, evenly over the devices; they change their slots only where that saves a group.
"""

import numpy as np


class Slots:
    """The slots of one cell.

    Attributes:
        seed: `[slots]`, the seed in each slot; numbers from `seeds` on mean an idle slot.
        seeds: how many seeds there are.
        group: slots that are stepped together on a device.
        devices: devices that share the slots, each a block of equal size.
    """

    def __init__(self, slots: int, seeds: int, group: int, devices: int):
        """Deal `seeds` seeds to `slots` slots, a multiple of `group * devices`."""
        self.seeds, self.group, self.devices = seeds, group, devices
        self.seed = np.arange(slots)
        self.seed = self.seed[self._dealt(self.seed < seeds)]

    @property
    def of_seed(self) -> np.ndarray:
        """`[seeds]`, the slot of each seed."""
        return np.argsort(self.seed)[: self.seeds]

    def groups(self, active: np.ndarray) -> int:
        """Groups that each device must step to reach every seed of `active` `[seeds]` bool."""
        return self._groups(self._slots_of(active))

    def pack(self, active: np.ndarray) -> np.ndarray | None:
        """Bring the seeds of `active` to the front if that saves a group.

        Returns:
            `[slots]`, where slot i takes the seed of slot move[i]; None if no seed has to move.
        """
        slots = self._slots_of(active)
        move = self._dealt(slots)
        if self._groups(slots[move]) == self._groups(slots):
            return None
        self.seed = self.seed[move]
        return move

    def _slots_of(self, active: np.ndarray) -> np.ndarray:
        slots = np.zeros(self.seed.size, bool)
        slots[self.of_seed[active]] = True
        return slots

    def _groups(self, slots: np.ndarray) -> int:
        used = [np.flatnonzero(block) for block in np.split(slots, self.devices)]
        return max(-(-(int(block[-1]) + 1) // self.group) if block.size else 0 for block in used)

    def _dealt(self, slots: np.ndarray) -> np.ndarray:
        """An order of the slots with those of `slots` in front on each device, evenly dealt."""
        shares = np.array_split(np.flatnonzero(slots), self.devices)
        idle = np.flatnonzero(~slots)
        blocks = []
        for share in shares:
            free = slots.size // self.devices - share.size
            blocks += [share, idle[:free]]
            idle = idle[free:]
        return np.concatenate(blocks)
