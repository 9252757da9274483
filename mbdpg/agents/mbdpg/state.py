"""What MBDPG's learning changes."""

from __future__ import annotations

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from mbdpg.dynamics.imagination import ImaginationBuffer
from mbdpg.dynamics.mixture import MixtureDynamics, Scales
from mbdpg.networks.critic import Critics
from mbdpg.networks.normalizer import Normalizer
from mbdpg.networks.policy import Policy


class State(eqx.Module):
    """Everything that learning changes."""

    dynamics: MixtureDynamics
    actor: Policy
    critics: Critics
    target_actor: Policy
    target_critics: Critics
    dynamics_optimizer: Any
    actor_optimizer: Any
    critic_optimizer: Any
    normalizer: Normalizer
    scales: Scales
    return_scale: Float[Array, ""]
    """Reward that counts as one unit of value."""
    imagined: ImaginationBuffer
    beta: Float[Array, ""]
    std: Float[Array, ""]
    """Of the behavior policy."""
    critic_steps: Float[Array, ""]
    """Critic updates so far."""
