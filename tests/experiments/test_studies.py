"""The paper's studies as data: complete, and safe to share a folder."""

from __future__ import annotations

from typing import Any, get_args

import pytest

from mbdpg.agents import mbdpg
from mbdpg.experiments.presets import agent_config
from mbdpg.experiments.studies import FAR, SCALES, ScaleName, StudyName, study

NAMES, SCALE_NAMES = get_args(StudyName), get_args(ScaleName)


def settings(name: Any, panel: int, field: str) -> list[Any]:
    return [getattr(cell.config.agent, field) for cell in study(name, "paper").panels[panel].cells]


@pytest.mark.parametrize("scale", SCALE_NAMES)
def test_studies_of_a_scale_can_share_their_folder(scale: Any) -> None:
    runs: dict[Any, Any] = {}
    models: dict[Any, Any] = {}
    for name in NAMES:
        for panel in study(name, scale).panels:
            assert bool(panel.cells) != bool(panel.models)
            labels = [part.label for part in (*panel.cells, *panel.models)]
            assert len(set(labels)) == len(labels) > 1
            for cell in panel.cells:
                assert runs.setdefault(cell.folder, cell) == cell
            for model in panel.models:
                assert models.setdefault((model.env, model.label), model) == model
    assert len({str(folder).lower() for folder in runs}) == len(runs)


def test_they_are_the_papers() -> None:
    scale = SCALES["paper"]
    assert len(scale.seeds) == 5 and scale.schedule.steps == 200_000
    tasks = {panel.title for name in ("figure-4", "figure-5") for panel in study(name, "paper").panels}
    assert tasks == {panel.title for panel in study("table-1", "paper").panels} and len(tasks) == 5
    for panel in (*study("figure-4", "paper").panels, *study("figure-5", "paper").panels):
        algorithms = [cell.config.algorithm for cell in panel.cells]
        assert algorithms == ["mbdpg", "mbdpg", "td3", "sac", "pets", "mbpo"]
        for cell, preset in zip(panel.cells, ("default", *["paper"] * 5), strict=True):
            assert cell.config.agent == agent_config(cell.config.algorithm, preset, panel.title)
            assert cell.config.env_options.max_episode_steps == 1000
    assert settings("figure-8", 0, "horizon") == [1, 5, 10, 20, 50, 200]
    assert settings("figure-8", 1, "target_update_every") == [1, 3, 5, 10]
    assert set(settings("figure-8", 1, "target_update_rate")) == {1.0}
    sizes, lengths = study("figure-7", "paper").panels
    assert [model.agent.gaussians for model in sizes.models] == [1, 3, 5, 7, 9]
    assert {model.agent.fit_length for model in sizes.models} == {50}
    assert [model.agent.fit_length for model in lengths.models] == [1, 5, 10, 20, 50]
    assert [model.members for model in study("figure-6", "paper").panels[0].models] == [1, 5, 5, 1]


def test_the_claim_of_figure_4_is_what_the_paper_says_of_td3() -> None:
    """It had TD3 near its best at 200,000 steps."""
    assert study("figure-4", "paper").claim.endswith("TD3 is still converging at 200,000.")


def test_table_1_has_the_papers_hours_beside_the_measured_ones() -> None:
    table = study("table-1", "quick")
    hours = {panel.title: panel.published_hours for panel in table.panels}
    for panel in table.panels:
        assert panel.published_hours.keys() < {cell.label for cell in panel.cells}
    assert hours["Ant-v5"]["pets"] == 25.2 and hours["LunarLanderContinuous-v3"]["mbdpg as published"] == 6.2
    for name, label in (("MBDPG", "mbdpg as published"), ("PETS", "pets"), ("MBPO", "mbpo")):
        times = [own[label] / own["td3"] for own in hours.values()]
        assert f"{name} {min(times):.1f} to {max(times):.1f}" in table.claim


def test_an_ablation_changes_one_thing() -> None:
    dynamics, demonstrations, values, model = study("figure-9", "paper").panels
    whole, plain = (model.agent for model in dynamics.models)
    assert {model.env for model in dynamics.models} == {cell.config.env for cell in demonstrations.cells}
    assert whole == mbdpg.Config(**FAR) and (plain.gaussians, plain.memory) == (1, 0)
    whole, other = demonstrations.cells
    assert whole.config == other.config and (whole.demonstrated, other.demonstrated) == (False, True)
    for panel, field, value in ((values, "terminal_value", False), (model, "horizon", 0)):
        left, right = (vars(cell.config.agent) for cell in panel.cells)
        assert {name for name in left if left[name] != right[name]} == {field} and right[field] == value
