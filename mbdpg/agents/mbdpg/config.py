"""Settings of MBDPG."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mbdpg.agents.objectives import ActorValue, RewardWeights
from mbdpg.dynamics.fitting import Likelihood
from mbdpg.interfaces import require, require_settings


@dataclass(frozen=True)
class Config:
    """Settings of MBDPG; symbols are the paper's."""

    horizon: int = 5
    """Imagined steps H of value expansion and policy gradient; 0 learns from real steps alone, without a model."""
    gradient: Literal["full", "eq19"] = "full"
    """Policy gradient: Eq. 18 differentiated through imagined states and policy, or Eq. 19 as printed."""
    planning: Literal["deterministic", "stochastic"] = "deterministic"
    """Imagined states: the mixture's mean (Eq. 13), or a draw from it (Eq. 5, 12)."""
    discount: float = 0.99
    """Discount factor gamma per environment step."""
    batch_size: int = 64
    """Trajectories imagined, and real transitions learned from, per actor and critic update."""
    updates_per_step: float = 1.0
    """Actor and critic updates per environment step."""
    actor_learning_rate: float = 3e-4
    """Adam's step size for the actor."""
    critic_learning_rate: float = 3e-4
    """Adam's step size for the critics."""
    actor_clip: float = 10.0
    """Global norm to which the actor's gradient is clipped."""
    critic_clip: float = 1e6
    """Global norm to which the critics' gradient is clipped."""
    saturation_penalty: float = 1e-3
    """Weight of the mean square of the policy's output before its tanh."""
    beta: float = 1.0
    """Weight beta of imagined rewards in Eq. 18 at first, while returns are those of a random policy."""
    final_beta: float = 1.0
    """Weight beta once returns reach the reference return; in between it follows the return."""
    reward_weights: RewardWeights = "remaining"
    """Reward t weighs beta times: the value terms after it ("remaining"), or one ("uniform", as printed)."""
    first_value: int = 0
    """Imagined step at which the value terms of Eq. 18 begin: 1 as printed, 0 to teach the first action by Q too, H for
    the H-step return alone."""
    terminal_value: bool = True
    """Whether the actor climbs values (Eq. 18) or, as in Fig. 9c, the imagined rewards alone."""
    actor_value: ActorValue = "clipped"
    """What the actor climbs: the lesser of both critics' values (Eq. 17), or their mean, which is less pessimistic."""
    trace: float = 0.5
    """Lambda of the value expansion: 1 is Eq. 16, 0 one-step targets, in between longer expansions count less."""
    imagined_weight: float = 0.5
    """Weight of the critic's loss on imagined states beside that on real transitions."""
    huber_delta: float = 0.0
    """Critics' errors beyond it, in root mean squares of reward, count by size instead of square: for as large a share
    of the loss as the return is on its way to the reference return, none where there is no such; 0: all by square."""
    imagination_ratio: float = 0.0
    """Share of imagination that starts from the imagination buffer instead of the environment's."""
    imagination_depth: int = 20
    """Greatest number of imagined steps between a state in the imagination buffer and a real one."""
    target_update_rate: float = 0.01
    """Share of the online networks that the targets take over at each of their updates (Polyak); 1 copies them."""
    target_update_every: int = 1
    """Updates of the critics, those on real returns too, between two of the targets, the paper's C."""
    average_share: float = 0.05
    """Averages imagine (of the dynamics) and are evaluated (of the actor); they fade over this share of updates."""
    target_noise: float = 0.2
    """Standard deviation of the noise on target actions, which is clipped at 0.5."""
    exploration_std: float = 0.3
    """Standard deviation of the behavior policy, its mean over episodes, while returns are a random policy's."""
    final_exploration_std: float = 0.1
    """The same once returns reach the reference return; in between it follows the return."""
    exploration_color: float = 0.0
    """Noise of the behavior policy has power 1/f^color: 0 is white, 1 pink, correlated over many steps."""
    exploration_scatter: float = 1.0
    """Every episode's spread is drawn uniformly from within this share of its mean, from none to twice as much at 1."""
    groundings_per_step: float = 1.0
    """Updates of the critics on real steps alone per environment step."""
    grounding_length: int = 8
    """Consecutive real steps over which each takes returns."""
    grounding_batch_size: int = 32
    """Windows of --grounding-length steps in each of these updates."""
    grounding_tolerance: float = 0.3
    """A return goes on with weight e^(-d^2 / 2) past an action d times this (root mean square) from the policy's."""
    recent_steps: int = 0
    """Actor and critics learn from so many of the newest environment steps, the dynamics from all; 0: all from all."""
    recent_terminations: int = 0
    """With --recent-steps: the 50 steps before so many of the newest terminations stay, however old they are."""
    random_steps: int = 4000
    """Environment steps with uniformly random actions before learning starts."""
    fit_length: int = 5
    """Open-loop steps L that the dynamics are trained over."""
    burn_in: int = 1
    """Real steps that fill the memory before the step that training begins to predict, or imagination goes on from."""
    fit_batch_size: int = 64
    """Windows per dynamics update."""
    fits_per_step: float = 0.5
    """Dynamics updates per environment step."""
    pretraining_fits: int = 1000
    """Dynamics updates on the random steps before the first actor and critic update."""
    cloning_updates: int = 2000
    """Updates of actor and critics on demonstrations, if there are any, before other updates (Section 4.2)."""
    likelihood: Likelihood = "mixture"
    """Negative log-likelihood of the mixture itself, or Eq. 11 as printed."""
    mean_weight: float = 1.0
    """Weight of the square error of the mixture's mean in the dynamics loss."""
    dynamics_learning_rate: float = 3e-3
    """Adam's step size for the dynamics."""
    dynamics_clip: float = 10.0
    """Global norm to which the dynamics' gradient is clipped."""
    gaussians: int = 5
    """Components M of the mixture."""
    memory: int = 256
    """Width of the LSTM; 0 leaves it out, and with one Gaussian leaves three dense layers (Fig. 9a)."""
    width: int = 256
    """Width of each of the three dense layers of every network; rewards and ends have two of half as much."""

    def __post_init__(self) -> None:
        require_settings(
            self,
            positive=(
                *("batch_size", "updates_per_step", "actor_learning_rate", "critic_learning_rate"),
                *("actor_clip", "critic_clip", "target_update_every", "fit_length", "fit_batch_size", "fits_per_step"),
                *("grounding_length", "grounding_batch_size", "grounding_tolerance"),
                *("dynamics_learning_rate", "dynamics_clip", "gaussians", "width"),
            ),
            at_most={
                **{"discount": 1, "trace": 1, "imagination_ratio": 1, "target_update_rate": 1, "average_share": 1},
                **{"exploration_scatter": 1, "exploration_color": 2},
            },
        )
        require(
            0 <= self.first_value <= self.horizon,
            f"--first-value is {self.first_value}, expected 0 to the {self.horizon} imagined steps of --horizon",
        )
        climbs = self.terminal_value or (self.horizon > 0 and min(self.beta, self.final_beta) > 0)
        nothing = "without --terminal-value there is nothing to climb where --horizon, --beta or --final-beta is 0"
        require(climbs, nothing)
        given = f"--recent-terminations is {self.recent_terminations}, expected 0 where --recent-steps is 0"
        require(self.recent_steps > 0 or self.recent_terminations == 0, given)
        given = f"--imagination-ratio is {self.imagination_ratio}, expected 0 where --horizon is 0"
        require(self.horizon > 0 or self.imagination_ratio == 0, given)
