"""What one seed's run writes into its folder: metrics, policies, checkpoints."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from mbdpg.interfaces import Metrics
from mbdpg.storage.array_file import write_array_file
from mbdpg.storage.checkpoint import Checkpoint, CheckpointWriter
from mbdpg.storage.metrics import MetricsLog
from mbdpg.storage.run_folder import RunFolder


class Recorder:
    """Writes one seed's run folder."""

    def __init__(self, folder: RunFolder, checkpoint: Checkpoint | None = None):
        facts = checkpoint.facts["recorder"] if checkpoint else {"offsets": None, "best": None}
        self._folder = folder.path
        self._offsets = facts["offsets"]
        self._checkpoints = CheckpointWriter(folder.path)
        self._policies = folder.path / "policy"
        self._best: float | None = facts["best"]

    @cached_property
    def _log(self) -> MetricsLog:
        """Opened with the first row, because that cuts off all rows after the checkpoint: nothing may fail then."""
        return MetricsLog(self._folder, offsets=self._offsets)

    def write(self, kind: str, env_steps: int, values: Metrics) -> None:
        self._log.write(kind, env_steps, values)

    def save_policy(self, arrays: dict[str, np.ndarray], env_steps: int, return_mean: float) -> None:
        facts = {"env_steps": env_steps, "return_mean": return_mean}
        write_array_file(self._policies / "latest.safetensors", "policy", arrays, facts)
        if np.isfinite(return_mean) and (self._best is None or return_mean > self._best):
            self._best = return_mean
            write_array_file(self._policies / "best.safetensors", "policy", arrays, facts)

    def save_checkpoint(
        self, env_steps: int, arrays: dict[str, np.ndarray], facts: dict[str, Any], replay: dict[str, np.ndarray]
    ) -> None:
        facts = facts | {"recorder": {"offsets": self._log.offsets(), "best": self._best}}
        self._checkpoints.save(env_steps=env_steps, arrays=arrays, facts=facts, replay=replay)

    def close(self) -> None:
        if "_log" in vars(self):  # else closing would be what opens it
            self._log.close()
