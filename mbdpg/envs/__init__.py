"""Where Gymnasium ends: everything past this package sees `mbdpg.interfaces.Environment` alone."""

from mbdpg.envs.make import (
    MakeGymnasium as MakeGymnasium,
    current_id as current_id,
    episode_seed as episode_seed,
    make as make,
    wrap as wrap,
)
from mbdpg.envs.wrappers import GymnasiumEnvironment as GymnasiumEnvironment
