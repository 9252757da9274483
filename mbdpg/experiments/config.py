"""Everything that decides a run, but for its seed."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from mbdpg import envs
from mbdpg.agents import mbdpg, mbpo, pets, sac, td3
from mbdpg.interfaces import EnvSpec, UserError, require
from mbdpg.storage.run_folder import RunFolder
from mbdpg.training.loop import Schedule

AgentConfig = mbdpg.Config | td3.Config | sac.Config | pets.Config | mbpo.Config

Algorithm = Literal["mbdpg", "td3", "sac", "pets", "mbpo"]

CONFIGS: dict[str, type[AgentConfig]] = {
    "mbdpg": mbdpg.Config,
    "td3": td3.Config,
    "sac": sac.Config,
    "pets": pets.Config,
    "mbpo": mbpo.Config,
}
"""By the name of the algorithm that they are settings of."""


@dataclass(frozen=True)
class EnvOptions:
    """How the environment is made."""

    max_episode_steps: int | None = None
    """Steps after which an episode is truncated, instead of the environment's own limit."""
    observation_size: int | None = None
    """27 or 105, for Ant-v5: without or with contact forces."""
    reference_return: float | None = None
    """Return at which the task is solved, for exploration, beta and Huber's share to follow; by default what is known
    of it."""
    allow_import: bool = False
    """Allow an id of the form module:Id, which imports and so runs that module's code."""

    def __post_init__(self) -> None:
        given = self.reference_return
        require(given is None or math.isfinite(given), f"--reference-return is {given}, expected a finite number")

    def override(self, spec: EnvSpec) -> EnvSpec:
        """What an environment, one made in code too, tells of itself, with the reference return that is given."""
        given = self.reference_return
        return spec if given is None else dataclasses.replace(spec, reference_return=given)


@dataclass(frozen=True)
class RunConfig:
    """Everything that decides a run, but for its seed."""

    env: str
    """Gymnasium id, or a name for an environment made in code."""
    agent: AgentConfig = field(default_factory=mbdpg.Config)
    """Its type says which algorithm."""
    schedule: Schedule = field(default_factory=Schedule)
    env_options: EnvOptions = field(default_factory=EnvOptions)
    demonstrations: str | None = None
    """File of demonstrations to begin with."""

    @property
    def algorithm(self) -> str:
        """Its name."""
        return next(name for name, config in CONFIGS.items() if type(self.agent) is config)

    def to_json(self) -> dict[str, Any]:
        """What `from_json` reads."""
        return {"algorithm": self.algorithm} | dataclasses.asdict(self)

    def make_env(self, *, render: bool = False) -> envs.GymnasiumEnvironment:
        """The environment, from Gymnasium's registry."""
        options = self.env_options
        env = envs.make(
            self.env,
            render=render,
            max_episode_steps=options.max_episode_steps,
            observation_size=options.observation_size,
            allow_import=options.allow_import,
        )
        env.spec = options.override(env.spec)
        return env

    @classmethod
    def of(cls, run: RunFolder) -> RunConfig:
        """That of a run.

        Raises:
            UserError: as `from_json`; it names the run.
        """
        try:
            return cls.from_json(run.config)
        except UserError as error:
            raise UserError(f"{run.path} cannot be used: {error}") from error

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> RunConfig:
        """Read what a run's config.json holds.

        Raises:
            UserError: a field is unknown, missing or of the wrong type.
        """
        algorithm = data.get("algorithm")
        require(
            isinstance(algorithm, str) and algorithm in CONFIGS,
            f"config.json has algorithm {str(algorithm)[:40]!r}, expected {', '.join(CONFIGS)}",
        )
        demonstrations, env = data.get("demonstrations"), data.get("env")
        require(isinstance(env, str), "config.json does not say which environment the run is of")
        require(demonstrations is None or isinstance(demonstrations, str), "config.json has odd demonstrations")
        return cls(
            env=str(env),
            agent=_settings(CONFIGS[str(algorithm)], data.get("agent"), "agent"),
            schedule=_settings(Schedule, data.get("schedule"), "schedule"),
            env_options=_settings(EnvOptions, data.get("env_options"), "env_options"),
            demonstrations=demonstrations,
        )


_KINDS = {bool: "true or false", int: "a whole number", float: "a number"}


def _settings(kind: type[Any], data: Any, name: str) -> Any:
    """A config dataclass from JSON, refusing what it does not know and what has another type than its default."""
    known = {field.name: field.default for field in dataclasses.fields(kind)}
    types = {field.name: str(field.type) for field in dataclasses.fields(kind)}
    require(isinstance(data, dict), f"config.json has no {name}")
    require(
        data.keys() == known.keys(),
        f"config.json does not fit this version of mbdpg, but that of its commit: {name} differs in "
        f"{sorted(data.keys() ^ known.keys())[:5]}",
    )
    for key, default in known.items():
        value, number = data[key], (int, float)
        whole = default is None and "int" in types[key]
        unset = (int, type(None)) if whole else (*number, type(None))
        kinds = unset if default is None else number if isinstance(default, float) else type(default)
        fits = isinstance(value, kinds) and (isinstance(default, bool) or not isinstance(value, bool))
        kind_of = f"a {'whole ' * whole}number or null" if default is None else _KINDS.get(type(default), "text")
        require(fits, f"config.json has {name}.{key} = {json.dumps(value)[:40]}, expected {kind_of}")
    return kind(**data)
