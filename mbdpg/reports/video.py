"""A video of a policy, with an ffmpeg that comes with the package; no display is needed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import imageio
import numpy as np

from mbdpg.interfaces import UserError, require


class VideoWriter:
    """Writes frames to an MP4 file. Use it in a `with` block and call it with every frame."""

    def __init__(self, path: Path, *, frames_per_second: float):
        """Open `path` for writing.

        Raises:
            UserError: its ending is not .mp4, or it cannot be written.
        """
        require(path.suffix == ".mp4", f"--video is {path}, expected a name that ends in .mp4")
        # Otherwise ffmpeg is started by a fork, which may deadlock beside JAX's threads.
        os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.open("ab").close()  # ffmpeg writes the file itself, where it lies
            self._writer: Any = imageio.get_writer(
                path, fps=frames_per_second, macro_block_size=2, ffmpeg_log_level="error"
            )
        except OSError as error:
            raise UserError(f"cannot write {path}: {error.strerror or error}") from error

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, *reason: object) -> None:
        self._writer.close()

    def __call__(self, frame: np.ndarray) -> None:
        """Append an RGB frame of shape (height, width, 3), uint8."""
        self._writer.append_data(frame)
