"""Settings of agents and of the loop: impossible ones are refused, and none is without effect."""

import ast
import dataclasses
from pathlib import Path
from typing import Any

import pytest

import mbdpg
from mbdpg.agents import mbdpg as model_based, mbpo, pets, sac, td3
from mbdpg.interfaces import UserError, as_flag
from mbdpg.training.loop import Schedule

PACKAGE = Path(mbdpg.__file__).parent
COMPOSED = PACKAGE / "experiments" / "run.py"

SHARES = [("discount", 1.01), ("discount", -0.1), ("discount", float("nan")), ("target_update_rate", 2.0)]
SHARES += [("exploration_scatter", 1.5)]
IMPOSSIBLE = [
    *((model_based.Config, name, value) for name, value in SHARES),
    *((config, name, value) for config in (td3.Config, sac.Config, mbpo.Config) for name, value in SHARES),
    (model_based.Config, "horizon", -1),
    (model_based.Config, "first_value", 6),
    (model_based.Config, "batch_size", -1),
    (model_based.Config, "trace", -0.1),
    (model_based.Config, "average_share", 1.5),
    (model_based.Config, "imagination_ratio", 1.5),
    (model_based.Config, "recent_terminations", 20),  # of no use without --recent-steps
    (model_based.Config, "target_update_every", 0),
    (model_based.Config, "actor_learning_rate", 0.0),
    (model_based.Config, "critic_learning_rate", float("inf")),
    (model_based.Config, "actor_clip", 0.0),
    (model_based.Config, "beta", -1.0),
    (model_based.Config, "exploration_std", float("nan")),
    (model_based.Config, "exploration_color", 2.5),
    (td3.Config, "exploration_color", float("nan")),
    (model_based.Config, "burn_in", -1),
    (model_based.Config, "fit_length", 0),
    (model_based.Config, "gaussians", 0),
    (model_based.Config, "saturation_penalty", -1e-3),
    (td3.Config, "policy_delay", 0),
    (td3.Config, "updates_per_step", 1e12),
    (model_based.Config, "critic_learning_rate", 1e30),
    (td3.Config, "target_noise", -0.1),
    (td3.Config, "width", 0),
    (td3.Config, "layers", 0),
    (sac.Config, "layers", 0),
    (sac.Config, "learning_rate", 0.0),
    (sac.Config, "entropy_per_action", float("inf")),
    (pets.Config, "horizon", 0),
    (pets.Config, "smoothing", 1.1),
    (pets.Config, "discount", 1.01),
    (pets.Config, "plan_elites", 151),
    (mbpo.Config, "real_share", 1.5),
    (mbpo.Config, "elites", 8),
    (mbpo.Config, "rollout_length", 0),
    (mbpo.Config, "lengthen_from", 150_000),
]


@pytest.mark.parametrize(("config", "name", "value"), IMPOSSIBLE)
def test_an_impossible_setting_is_refused_by_its_flags_name(config: type, name: str, value: float) -> None:
    with pytest.raises(UserError, match="--" + name.replace("_", "-")):
        config(**{name: value})


@pytest.mark.parametrize(
    ("name", "value", "typed"),
    [("plain", False, ["--no-plain"]), ("plain", True, ["--plain"]), ("batch_size", 3, ["--batch-size", "3"])],
)
def test_a_setting_is_said_as_train_takes_it(name: str, value: Any, typed: list[str]) -> None:
    assert as_flag(name, value) == typed


@pytest.mark.parametrize("values", [{"steps": 0}, {"steps": 120}, {"cycle": 0}, {"evaluation_episodes": 0}])
def test_an_impossible_schedule_is_refused(values: dict[str, int]) -> None:
    with pytest.raises(UserError, match="--" + next(iter(values)).replace("_", "-")):
        Schedule(**values)


def unread(config: type, files: list[Path], owners: set[str]) -> set[str]:
    """Fields that are nowhere read as an attribute of something with one of these names."""
    read = {
        node.attr
        for path in files
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute)
        and isinstance(node.ctx, ast.Load)
        and (getattr(node.value, "id", None) in owners or getattr(node.value, "attr", None) in owners)
    }
    return {field.name for field in dataclasses.fields(config)} - read


@pytest.mark.parametrize(
    ("config", "files", "owners"),
    [
        (
            model_based.Config,
            [*sorted((PACKAGE / "agents" / "mbdpg").glob("*.py")), COMPOSED],
            {"c", "config", "agent"},
        ),
        (td3.Config, [PACKAGE / "agents" / "td3.py", COMPOSED], {"c", "config", "agent"}),
        (sac.Config, [PACKAGE / "agents" / "sac.py", COMPOSED], {"c", "config", "agent"}),
        (
            mbpo.Config,
            [*((PACKAGE / "agents" / f"{name}.py") for name in ("sac", "mbpo")), COMPOSED],
            {"c", "config", "agent"},
        ),
        (pets.Config, [PACKAGE / "agents" / "pets.py", COMPOSED], {"c", "config", "agent"}),
        (Schedule, [PACKAGE / "training" / "loop.py"], {"schedule", "_schedule"}),
    ],
    ids=["mbdpg", "td3", "sac", "mbpo", "pets", "schedule"],
)
def test_every_setting_is_read(config: type, files: list[Path], owners: set[str]) -> None:
    assert not unread(config, files, owners)


def test_the_rule_above_sees(tmp_path: Path) -> None:
    code = tmp_path / "loop.py"
    code.write_text("self.schedule.steps\nschedule.cycle\nother.log_every\nself.schedule.checkpoint_every = 3\n")
    names = {field.name for field in dataclasses.fields(Schedule)}
    assert unread(Schedule, [code], {"schedule"}) == names - {"steps", "cycle"}
