"""Sample-efficient continuous control: model-based deterministic policy gradient (Gao et al. 2022) in JAX."""

from mbdpg.agents.mbdpg import Config as MBDPGConfig
from mbdpg.agents.mbpo import Config as MBPOConfig
from mbdpg.agents.pets import Config as PETSConfig
from mbdpg.agents.sac import Config as SACConfig
from mbdpg.agents.td3 import Config as TD3Config
from mbdpg.api import evaluate as evaluate, load_policy as load_policy, resume as resume, train as train
from mbdpg.experiments.presets import agent_config as agent_config
from mbdpg.interfaces import UserError as UserError
from mbdpg.training.evaluation import Evaluation as Evaluation
from mbdpg.training.loop import Schedule as Schedule, Update as Update

__version__ = "0.1.0"
__all__ = [
    "Evaluation",
    "MBDPGConfig",
    "MBPOConfig",
    "PETSConfig",
    "SACConfig",
    "Schedule",
    "TD3Config",
    "Update",
    "UserError",
    "agent_config",
    "evaluate",
    "load_policy",
    "resume",
    "train",
]
