"""The paper's experiments as data: which runs each figure and table is made of, at three scales."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from mbdpg.agents import mbdpg
from mbdpg.dynamics.aggregation import Aggregation
from mbdpg.experiments.config import AgentConfig, EnvOptions, RunConfig
from mbdpg.experiments.presets import PAPER_EPISODE_LIMIT, Preset, agent_config
from mbdpg.training.loop import Schedule

BOX2D = ("BipedalWalker-v3", "LunarLanderContinuous-v3")
MUJOCO = ("HalfCheetah-v5", "Hopper-v5", "Ant-v5")
ANT_OBSERVATION = 27
"""Without contact forces, as in MBPO's and PETS' comparisons; the paper does not say."""

PAPER_HOURS = {
    "td3": (4.5, 4.9, 3.9, 3.1, 3.7),
    "sac": (5.9, 6.1, 4.9, 4.2, 4.9),
    "mbdpg as published": (6.5, 6.2, 7.6, 6.7, 10.4),
    "pets": (14.2, 13.8, 20.2, 10.2, 25.2),
    "mbpo": (10.4, 9.8, 17.2, 10.1, 21.6),
}
"""Table 1: hours for 200,000 steps of training and test on BOX2D's and MUJOCO's tasks, in older versions; by label of
the runs. All on one GPU, an Nvidia "RTX TITAN XP"."""

RECORDED = "HalfCheetah-v5"
"""The task of Fig. 6 and 7, which the paper does not name; that of 9a is the other ablations'."""

FAR: dict[str, Any] = {"fit_length": 10, "burn_in": 5, "dynamics_learning_rate": 1e-3}
"""How dynamics learn that are to predict far ahead: over the paper's L = 10 steps, after five real ones. The default's
L = 5 is for H = 5. How often agents fit them stays the default's."""

ScaleName = Literal["smoke", "quick", "paper"]


@dataclass(frozen=True)
class Scale:
    """How much of everything a study takes."""

    seeds: tuple[int, ...]
    schedule: Schedule
    expert_steps: int
    """Of the TD3 run whose successes MBDPG starts from."""
    recorded_steps: int
    """Of the TD3 run whose replay dynamics models learn from."""
    model_updates: int
    """Of each of them."""
    rivals: Preset
    ablated: str = "BipedalWalker-v3"
    """The task of Fig. 8 and 9, the paper's by default."""
    horizons: dict[str, Any] = field(default_factory=dict)
    """Settings of the agents of Fig. 8a."""
    tiny: dict[str, Any] = field(default_factory=dict)
    """Settings of every agent that has them."""
    success_share: float = 1.0
    """Least return of an expert's success, as a share of the return at which the task counts as solved."""

    def shrunk(self, agent: AgentConfig, settings: Mapping[str, Any] = MappingProxyType({})) -> Any:
        """The agent's config with those of `tiny` that it knows, and with `settings`, which go over them."""
        known = {field.name for field in dataclasses.fields(agent)}
        return dataclasses.replace(agent, **({n: v for n, v in self.tiny.items() if n in known} | dict(settings)))


SCALES: dict[ScaleName, Scale] = {
    # Minutes. Nothing is learned: it shows that all parts fit together.
    "smoke": Scale(
        seeds=(0,),
        schedule=Schedule(steps=400, evaluate_every=200, evaluation_episodes=1, log_every=200, checkpoint_every=200),
        expert_steps=400,
        recorded_steps=8000,
        model_updates=20,
        rivals="default",
        tiny={
            **{"random_steps": 200, "width": 16, "memory": 16, "batch_size": 8, "fit_batch_size": 8},
            **{"pretraining_fits": 10, "cloning_updates": 10, "dynamics_width": 16},
            **{"population": 8, "plan_elites": 2, "updates_per_step": 0.1, "fits_per_step": 0.1},
        },
        success_share=-1e4,  # anything is one
        ablated="HalfCheetah-v5",  # whose episodes are long enough to test models on, whatever is learned
    ),
    # Hours on two cores.
    "quick": Scale(
        seeds=(0, 1),
        schedule=Schedule(steps=12_000, evaluate_every=1000, checkpoint_every=4000),
        expert_steps=200_000,
        recorded_steps=50_000,
        model_updates=1000,
        rivals="default",
        ablated="HalfCheetah-v5",  # nothing has begun to walk on two legs by 12,000 steps
        horizons={"batch_size": 16},  # with H = 200 half a second per update, and two with 64
        success_share=0.5,  # of which 200,000 steps of TD3 are capable
    ),
    "paper": Scale(
        seeds=(0, 1, 2, 3, 4),
        schedule=Schedule(steps=200_000),
        expert_steps=1_000_000,
        recorded_steps=50_000,
        model_updates=3000,
        rivals="paper",
    ),
}


@dataclass(frozen=True)
class Cell:
    """Runs that differ in nothing but their seed."""

    label: str
    config: RunConfig
    demonstrated: bool = False
    """Whether they start from an expert's successes."""

    @property
    def folder(self) -> Path:
        """Where they lie in a folder of studies, which share them."""
        return Path(self.config.env) / self.label.replace(" ", "-")


@dataclass(frozen=True)
class Model:
    """A kind of dynamics model, trained on recorded steps."""

    label: str
    env: str
    agent: mbdpg.Config
    aggregation: Aggregation = "none"
    members: int = 1


@dataclass(frozen=True)
class Panel:
    """One set of axes: learning curves, or errors of models over imagined steps."""

    title: str
    cells: tuple[Cell, ...] = ()
    models: tuple[Model, ...] = ()
    published_hours: dict[str, float] = field(default_factory=dict)
    """The paper's, by label of the cells."""


@dataclass(frozen=True)
class Study:
    """A figure or table of the paper."""

    name: str
    claim: str
    """What the paper says of it."""
    panels: tuple[Panel, ...]
    as_hours: bool = False
    """A table of wall-clock time instead of curves."""


def study(name: StudyName, scale: ScaleName) -> Study:
    """What a figure or table is made of at a scale."""
    return _STUDIES[name](SCALES[scale])


def _cell(
    scale: Scale,
    env: str,
    label: str = "mbdpg",
    algorithm: str = "mbdpg",
    *,
    preset: str = "default",
    demonstrated: bool = False,
    **settings: Any,
) -> Cell:
    """Runs of an algorithm, from demonstrations or not, with some settings other than the preset's."""
    agent = agent_config(algorithm, preset, env)
    size = ANT_OBSERVATION if env.startswith("Ant") else None
    options = EnvOptions(max_episode_steps=PAPER_EPISODE_LIMIT, observation_size=size)
    return Cell(label, RunConfig(env, scale.shrunk(agent, settings), scale.schedule, options), demonstrated)


def _panels(tasks: Sequence[str], scale: Scale) -> tuple[Panel, ...]:
    def cells(env: str) -> tuple[Cell, ...]:
        rivals = (_cell(scale, env, name, name, preset=scale.rivals) for name in ("td3", "sac", "pets", "mbpo"))
        paper = _cell(scale, env, "mbdpg as published", preset="paper", demonstrated=True)
        return _cell(scale, env), paper, *rivals

    return tuple(Panel(env, cells(env)) for env in tasks)


def _figure_4(scale: Scale) -> Study:
    claim = (
        "MBDPG learns faster than its rivals. On BipedalWalker it is near its best at 50,000 steps; TD3 is still "
        "converging at 200,000."
    )
    return Study("figure-4", claim, _panels(BOX2D, scale))


def _figure_5(scale: Scale) -> Study:
    claim = (
        "On Hopper MBDPG is several times better than MBPO and SAC at equal steps; on Ant it learns and PETS does not."
    )
    return Study("figure-5", claim, _panels(MUJOCO, scale))


def _table_1(scale: Scale) -> Study:
    claim = (
        "Hours per 200,000 steps on one GPU, as multiples of TD3's: MBDPG 1.3 to 2.8, PETS 2.8 to 6.8, MBPO 2.0 to 5.8."
    )
    panels = _panels((*BOX2D, *MUJOCO), scale)
    hours = [dict(zip(PAPER_HOURS, column, strict=True)) for column in zip(*PAPER_HOURS.values(), strict=True)]
    timed = (dataclasses.replace(panel, published_hours=own) for panel, own in zip(panels, hours, strict=True))
    return Study("table-1", claim, tuple(timed), as_hours=True)


def _model(
    scale: Scale, label: str, aggregation: Aggregation = "none", *, env: str = RECORDED, **settings: Any
) -> Model:
    agent = scale.shrunk(mbdpg.Config(), FAR | settings)
    members = 1 if aggregation == "none" else mbdpg.Config().gaussians
    return Model(label, env, agent, aggregation, members)


def _figure_6(scale: Scale) -> Study:
    claim = "A mixture balances bias and variance; bagging lowers only the variance, boosting only the bias."
    models = (
        _model(scale, "mixture"),
        _model(scale, "bagging", "bagging", gaussians=1),
        _model(scale, "boosting", "boosting", gaussians=1),
        _model(scale, "gaussians=1", gaussians=1),
    )
    return Study("figure-6", claim, (Panel(RECORDED, models=models),))


def _figure_7(scale: Scale) -> Study:
    claim = "More Gaussians help up to 5; longer training sequences up to L = 10, and L = 1 drifts off."
    longest = 50
    sizes = tuple(
        _model(scale, f"gaussians={count} fit_length={longest}", gaussians=count, fit_length=longest)
        for count in (1, 3, 5, 7, 9)
    )
    lengths = tuple(
        _model(scale, "mixture")
        if length == FAR["fit_length"]
        else _model(scale, f"gaussians=5 fit_length={length}", fit_length=length)
        for length in (1, 5, 10, 20, longest)
    )
    return Study("figure-7", claim, (Panel("Gaussians", models=sizes), Panel("training length L", models=lengths)))


def _figure_8(scale: Scale) -> Study:
    claim = "Longer horizons learn faster up to H = 20, and 200 still works; C = 3 is best, C = 1 not robust."
    far = FAR | scale.horizons
    horizons = tuple(
        _cell(scale, scale.ablated, f"mbdpg horizon={h}", horizon=h, **far) for h in (1, 5, 10, 20, 50, 200)
    )
    copies = tuple(
        _cell(scale, scale.ablated, f"mbdpg C={c}", target_update_rate=1.0, target_update_every=c)
        for c in (1, 3, 5, 10)
    )
    return Study("figure-8", claim, (Panel("horizon H", horizons), Panel("targets copied every C updates", copies)))


def _figure_9(scale: Scale) -> Study:
    claim = "A plain network drifts off within 200 steps; without demonstrations, values or model learning is slower."
    whole = _cell(scale, scale.ablated)
    ablated = (
        ("demonstrations", _cell(scale, scale.ablated, "mbdpg from demonstrations", demonstrated=True)),
        ("terminal value", _cell(scale, scale.ablated, "mbdpg without values", terminal_value=False)),
        ("model", _cell(scale, scale.ablated, "mbdpg without model", horizon=0)),
    )
    task = scale.ablated
    models = (_model(scale, "mixture", env=task), _model(scale, "plain network", env=task, gaussians=1, memory=0))
    curves = (Panel(title, (whole, cell)) for title, cell in ablated)
    return Study("figure-9", claim, (Panel("dynamics", models=models), *curves))


StudyName = Literal["figure-4", "figure-5", "table-1", "figure-6", "figure-7", "figure-8", "figure-9"]

_STUDIES: dict[StudyName, Callable[[Scale], Study]] = {
    "figure-4": _figure_4,
    "figure-5": _figure_5,
    "table-1": _table_1,
    "figure-6": _figure_6,
    "figure-7": _figure_7,
    "figure-8": _figure_8,
    "figure-9": _figure_9,
}
