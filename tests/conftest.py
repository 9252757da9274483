"""What every test runs under: CPU, one thread per native library, strict JAX, shapes and types checked at each call."""

import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

# Before JAX and NumPy are imported. Inherited by the programs that tests start; set from outside, a value stays.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "2")  # several seeds are learned on both
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame opens no window
os.environ.setdefault("MPLBACKEND", "agg")
for library in ("OMP", "OPENBLAS", "MKL"):  # pytest-xdist already uses every core
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

# Compiling is most of what small networks cost; without fusion emitters a large program takes half the time.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")

from jaxtyping import install_import_hook

# Before any test imports mbdpg. The "tower": as for mypy, an int is a float.
install_import_hook("mbdpg", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")

import jax
import optax
import pytest

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

corrected = optax.tree.bias_correction


def bias_correction(*args, **kwargs):
    """Adam's `decay ** step` has an integer step (optax 0.2.8): the one promotion that is not ours to mend."""
    with jax.numpy_dtype_promotion("standard"):
        return corrected(*args, **kwargs)


optax.tree.bias_correction = bias_correction


@pytest.fixture
def key() -> jax.Array:
    return jax.random.key(0)


ROOT = Path(__file__).resolve().parent.parent
EVERY_100 = ("--evaluate-every", "100", "--evaluation-episodes", "1", "--log-every", "100", "--checkpoint-every", "100")
SMALL = ("--width", "8", "--batch-size", "8", "--random-steps", "100", *EVERY_100)
FLAGS = {
    "td3": ("--algorithm", "td3", *SMALL),
    "sac": ("--algorithm", "sac", *SMALL),
    "pets": (
        *("--algorithm", "pets", "--random-steps", "100", *EVERY_100, "--dynamics-width", "8", "--fit-batch-size", "8"),
        *("--pretraining-fits", "10", "--horizon", "2", "--population", "4", "--plan-elites", "2"),
    ),
    "mbpo": (
        *("--algorithm", "mbpo", *SMALL, "--dynamics-width", "8", "--fit-batch-size", "8", "--pretraining-fits", "10"),
        *("--rollouts-per-step", "2", "--imagine-every", "50", "--retained-steps", "100"),
    ),
    "mbdpg": (
        *("--algorithm", "mbdpg", *SMALL, "--memory", "8", "--gaussians", "2", "--horizon", "2", "--burn-in", "2"),
        *("--fit-length", "2", "--fit-batch-size", "8", "--pretraining-fits", "10"),
    ),
}

Mbdpg = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture(scope="session")
def mbdpg_command(tmp_path_factory: pytest.TempPathFactory) -> Mbdpg:
    """Starts `python -m mbdpg ...`; what one such program compiles, the next ones find."""
    cache = tmp_path_factory.getbasetemp() / "compiled"
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
    }

    def start(*arguments: str | Path, **variables: str | None) -> "subprocess.Popen[str]":
        changed = {name: value for name, value in (environment | variables).items() if value is not None}
        return subprocess.Popen(
            [sys.executable, "-m", "mbdpg", *map(str, arguments)],
            cwd=cache.parent,  # where nothing of the checkout is found by accident
            env=changed,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )

    return start


@pytest.fixture(scope="session")
def trained(mbdpg_command: Mbdpg, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run of 400 steps of TD3 on Pendulum-v1; not to be changed."""
    out = tmp_path_factory.mktemp("trained")
    program = mbdpg_command("train", "Pendulum-v1", *FLAGS["td3"], "--steps", "400", "--out", out)
    stdout, stderr = program.communicate()
    assert program.returncode == 0, stderr
    assert f"next: mbdpg evaluate {out / 'seed-0'}" in stdout
    return out / "seed-0"


@pytest.fixture(scope="session")
def flags() -> dict[str, tuple[str, ...]]:
    """The smallest run of each algorithm that has everything in it; --steps is missing."""
    return FLAGS


@pytest.fixture(scope="session")
def toy() -> ModuleType:
    """The module toy.py beside this file."""
    spec = importlib.util.spec_from_file_location("toy", Path(__file__).parent / "toy.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules["toy"] = module  # where dataclasses look for it
    spec.loader.exec_module(module)
    return module
