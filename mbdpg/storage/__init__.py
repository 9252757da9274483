"""What a run leaves on disk. NumPy in, NumPy out; nothing read from a run is ever unpickled, evaluated or imported."""

from mbdpg.storage.checkpoint import Checkpoint, CheckpointWriter, load_checkpoint
from mbdpg.storage.metrics import MetricsLog, read_metrics
from mbdpg.storage.run_folder import RunFolder, describe_machine

__all__ = [
    "Checkpoint",
    "CheckpointWriter",
    "MetricsLog",
    "RunFolder",
    "describe_machine",
    "load_checkpoint",
    "read_metrics",
]
