"""What every test runs under: CPU, one thread per native library, strict JAX, shapes and types checked at each call."""

import os

# Before JAX and NumPy are imported. Inherited by the programs that tests start; set from outside, a value stays.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame opens no window
os.environ.setdefault("MPLBACKEND", "agg")
for library in ("OMP", "OPENBLAS", "MKL"):  # pytest-xdist already uses every core
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")  # compiling is most of what small networks cost

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
