"""Model-based deterministic policy gradient, Algorithm 1 of Gao et al. 2022."""

from mbdpg.agents.mbdpg.agent import MBDPG as MBDPG
from mbdpg.agents.mbdpg.config import Config as Config
from mbdpg.agents.mbdpg.state import State as State
