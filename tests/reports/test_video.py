"""An MP4 of an episode."""

from __future__ import annotations

import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from mbdpg.interfaces import UserError
from mbdpg.reports.video import VideoWriter


def frames(count: int, height: int = 64, width: int = 48) -> list[np.ndarray]:
    """From black to white."""
    return [np.full((height, width, 3), 255 * i // max(count - 1, 1), np.uint8) for i in range(count)]


def told(path: Path) -> str:
    """What ffmpeg says of a file."""
    program = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-i", path]
    return subprocess.run(program, capture_output=True, text=True, check=False).stderr


@pytest.mark.parametrize(("height", "width"), [(64, 48), (50, 70)])
def test_a_video_has_the_frames_that_were_given_in_their_order_and_size(
    tmp_path: Path, height: int, width: int
) -> None:
    path = tmp_path / "new" / "film.mp4"
    with VideoWriter(path, frames_per_second=25.0) as film:
        for frame in frames(10, height, width):
            film(frame)
    assert f"{width}x{height}" in (said := told(path)) and " 25 fps" in said
    program = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(program, capture_output=True, check=True).stdout
    found = np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)
    np.testing.assert_allclose(found.mean((1, 2, 3)), [frame.mean() for frame in frames(10)], atol=4)


def test_a_video_can_be_played_where_only_the_common_pixel_format_is_known(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "film.mp4", frames_per_second=50.0) as film:
        for frame in frames(3):
            film(frame)
    said = told(tmp_path / "film.mp4")
    assert "h264" in said and "yuv420p" in said


@pytest.mark.parametrize("name", ["film", "film.gif", "film.MP4x"])
def test_another_ending_is_refused_before_anything_is_written(tmp_path: Path, name: str) -> None:
    with pytest.raises(UserError, match=rf"^--video is .*{name}, expected a name that ends in \.mp4$"):
        VideoWriter(tmp_path / name, frames_per_second=50.0)
    assert list(tmp_path.iterdir()) == []


def test_where_no_file_can_be_written_one_line_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write .*film.mp4") as caught:
        VideoWriter(tmp_path / "file" / "film.mp4", frames_per_second=50.0)
    assert "\n" not in str(caught.value)
