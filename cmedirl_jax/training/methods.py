"""The methods, each one line of composition."""

from typing import NamedTuple

from cmedirl_jax.irl.shaping import Shaping
from cmedirl_jax.registries import Registry
from cmedirl_jax.tabular import imitation
from cmedirl_jax.training.reward_sources import REWARDS, RewardSource


class Method(NamedTuple):
    """A method as a composition of the library's parts.

    Attributes:
        name: as the command line and the tables write it.
        description: in a line.
        hot_start: whether actor and critic start from the demonstrations (Eq. 11). With
            `schedule.cloning` the actor also goes on imitating them, for a while or throughout.
        reward: where r_D comes from, a name in `REWARDS`; None for a method without.
        shaping: how r_D joins r_e, unless the settings say otherwise.
        interacts: whether DDPG learns in the environment; if not, the method's policy is its
            hot-started actor, or the likeliest action of the tabular reward's soft-optimal policy.
        label: of its curve in figures; None: its name.
    """

    name: str
    description: str
    hot_start: bool = False
    reward: str | None = None
    shaping: Shaping = "additive"
    interacts: bool = True
    label: str | None = None

    @property
    def source(self) -> RewardSource | None:
        """Where r_D comes from; ValueError for an unknown name."""
        return None if self.reward is None else REWARDS[self.reward]

    @property
    def learns_reward(self) -> bool:
        """Whether r_D is learned while DDPG learns."""
        return self.source is not None and self.source.sampling is not None

    @property
    def tabular(self) -> imitation.Kind | None:
        """Kind of a reward by dynamic programming, or None."""
        return None if self.source is None else self.source.tabular

    @property
    def uses_demonstrations(self) -> bool:
        """Whether the method reads demonstrations at all."""
        return self.hot_start or self.learns_reward or self.tabular is not None


_METHODS = (
    # The four that the paper names.
    Method("ddpg", "DDPG on the environment's reward, no demonstrations", label="DDPG"),
    Method("hs-ddpg", "DDPG hot-started, then cloning that fades", hot_start=True, label="HS-DDPG"),
    Method("me-ddpg", "DDPG on r_D + r_e", reward="maxent", label="ME-DDPG"),
    Method("hs-me-ddpg", "both (Algorithm 2)", True, "maxent", label="HS-ME-DDPG"),
    # Comparators.
    Method(
        "bc",
        "supervised learning: the hot start alone",
        hot_start=True,
        interacts=False,
        label="behaviour cloning",
    ),
    Method("irl-only", "DDPG on r_D alone", reward="maxent", shaping="alone", label="$r_D$ alone"),
    Method(
        "gail",
        "DDPG on a discriminator's reward alone",
        reward="gail",
        shaping="alone",
        label="GAIL",
    ),
    # With a model: the original maximum-entropy IRL.
    Method(
        "tabular-me-ddpg",
        "r_D + r_e, r_D of deep-maxent-irl",
        reward="tabular-deep",
        label="tabular ME-DDPG",
    ),
    Method(
        "maxent-irl",
        "by a model, linear",
        reward="tabular-linear",
        interacts=False,
        label="MaxEnt IRL",
    ),
    Method(
        "deep-maxent-irl",
        "by a model, deep",
        reward="tabular-deep",
        interacts=False,
        label="deep MaxEnt IRL",
    ),
    # Controls.
    Method(
        "ddpg-plus-constant",
        "control: r_e + constant",
        reward="plus-constant",
        label="DDPG, $r_e + c$",
    ),
    Method(
        "ddpg-minus-constant",
        "control: r_e - constant",
        reward="minus-constant",
        label="DDPG, $r_e - c$",
    ),
    Method(
        "random-reward",
        "control: r_e + a frozen random r_D",
        reward="random",
        label="DDPG, random $r_D$",
    ),
)

METHODS: Registry[Method] = Registry("method", {method.name: method for method in _METHODS})
"""Maps each name to its method."""

PAPER_METHODS = ("ddpg", "hs-ddpg", "me-ddpg", "hs-me-ddpg")
"""The four that the paper names."""
