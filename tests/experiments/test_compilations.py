"""XLA's compiled programs: kept where nobody else writes, or not at all."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from mbdpg.experiments import compilations


class JaxConfig(dict):
    """What JAX is told."""

    jax_compilation_cache_dir: str | None = None
    update = dict.__setitem__  # type: ignore[assignment]  # as of a setting, not of a mapping


@pytest.fixture
def jax_config(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> JaxConfig:
    config = JaxConfig()
    monkeypatch.setattr(compilations, "jax", SimpleNamespace(config=config))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return config


def test_compiled_programs_are_kept_where_nobody_else_writes(
    jax_config: JaxConfig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    compilations.keep_compilations()
    first = Path(jax_config["jax_compilation_cache_dir"])
    assert first.parent == tmp_path / "mbdpg" and first.stat().st_mode & 0o777 == 0o700
    compilations.keep_compilations()
    assert Path(jax_config["jax_compilation_cache_dir"]) == first
    monkeypatch.setattr(compilations, "describe_machine", lambda: {"cpu": "another"})
    compilations.keep_compilations()
    assert Path(jax_config["jax_compilation_cache_dir"]) != first


def test_compiled_programs_stay_where_jax_was_told_to_keep_them(jax_config: JaxConfig, tmp_path: Path) -> None:
    jax_config.jax_compilation_cache_dir = "elsewhere"
    compilations.keep_compilations()
    assert not jax_config and not list(tmp_path.iterdir())


@pytest.mark.parametrize("obstacle", ["file", "link"])
def test_without_a_folder_of_ones_own_everything_is_compiled_anew(
    jax_config: JaxConfig, tmp_path: Path, obstacle: str
) -> None:
    compilations.keep_compilations()
    folder = Path(jax_config.pop("jax_compilation_cache_dir"))
    jax_config.clear()
    folder.rmdir()
    if obstacle == "file":
        folder.write_text("")
    else:
        (tmp_path / "theirs").mkdir()
        folder.symlink_to(tmp_path / "theirs")
    compilations.keep_compilations()
    assert not jax_config
