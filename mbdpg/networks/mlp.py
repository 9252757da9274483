"""Dense layers: the building block of every network here.

Modules act on the last axis and accept any leading axes, so one definition serves a sample, a batch and a window.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


def elu(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Exponential linear unit, the paper's activation (Section 5.1).

    `exp(min(x, 0)) - 1` and not `expm1`: XLA vectorizes the former on CPU, at half the time.
    """
    return jnp.where(x > 0, x, jnp.exp(jnp.minimum(x, 0.0)) - 1.0)


def matrix_product(
    x: Float[Array, "*batch inputs"], weight: Float[Array, "*stack inputs outputs"]
) -> Float[Array, "*batch outputs"]:
    """Product with one matrix or a stack of them, of float32 forwards and backwards on every device.

    A GPU's default rounds what it multiplies to ten bits, and imagination feeds errors back.
    """
    return jnp.matmul(x, weight, precision="float32")


class Linear(eqx.Module):
    """Affine map of the last axis, `x @ weight + bias`."""

    weight: Float[Array, "inputs outputs"]
    bias: Float[Array, " outputs"]

    def __init__(self, inputs: int, outputs: int, *, scale: float = 1.0, uniform: bool = False, key: PRNGKeyArray):
        """Draw weights with standard deviation `scale / sqrt(inputs)`; biases are zero.

        The paper's N(0, 1) would give a 256-wide layer pre-activations of standard deviation 16, which saturates
        every gate and the policy's tanh (docs/deviations.md). `uniform` is PyTorch's start, with which TD3's authors
        published: weights and biases of up to 1 / sqrt(inputs), whatever the scale.
        """
        spread = 1.0 / math.sqrt(inputs)
        if uniform:
            weight_key, bias_key = jax.random.split(key)
            self.weight = jax.random.uniform(weight_key, (inputs, outputs), minval=-spread, maxval=spread)
            self.bias = jax.random.uniform(bias_key, (outputs,), minval=-spread, maxval=spread)
        else:
            self.weight = jax.random.normal(key, (inputs, outputs)) * (scale * spread)
            self.bias = jnp.zeros(outputs)

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        return matrix_product(x, self.weight) + _along(self.bias, x)


class NormalizedELU(eqx.Module):
    """Zero mean and unit variance over the last axis, scale and offset (LayerNorm, Ba et al. 2016), then ELU."""

    scale: Float[Array, " features"]
    offset: Float[Array, " features"]

    def __init__(self, features: int):
        self.scale = jnp.ones(features)
        self.offset = jnp.zeros(features)

    def __call__(self, x: Float[Array, "*batch features"]) -> Float[Array, "*batch features"]:
        return _normalized_elu(x, self.scale, self.offset)


class LayerSlopes(NamedTuple):
    """Of one hidden layer, row by row: what it saw, and a scalar output's derivatives by what it made of that."""

    input: Float[Array, "row inputs"]
    normalized: Float[Array, "row width"]
    """Its products after LayerNorm, before scale and offset."""
    by_product: Float[Array, "row width"]
    """By the Linear layer's output."""
    by_activation_input: Float[Array, "row width"]
    """By what ELU is taken of."""


class Slopes(NamedTuple):
    """A scalar network's outputs and, row by row, their derivatives: one way back through it for any weights."""

    output: Float[Array, " row"]
    by_input: Float[Array, "row inputs"]
    hidden: tuple[LayerSlopes, ...]
    features: Float[Array, "row width"]


class MLP(eqx.Module):
    """Hidden layers of Linear and NormalizedELU, or of Linear and ReLU; then a Linear output."""

    hidden: tuple[Linear, ...]
    norms: tuple[NormalizedELU, ...]
    """None of them in a plain network."""
    output: Linear

    def __init__(
        self,
        inputs: int,
        widths: Sequence[int],
        outputs: int,
        *,
        output_scale: float = 1.0,
        plain: bool = False,
        key: PRNGKeyArray,
    ):
        """Build the layers; `output_scale` 0 makes the network start as the constant zero.

        `plain` is with ReLU, and with PyTorch's start in every layer.
        """
        sizes = [inputs, *widths]
        keys = jax.random.split(key, len(sizes))
        layers = zip(sizes, widths, keys[:-1], strict=False)
        self.hidden = tuple(Linear(a, b, uniform=plain, key=k) for a, b, k in layers)
        self.norms = () if plain else tuple(NormalizedELU(width) for width in widths)
        self.output = Linear(sizes[-1], outputs, scale=output_scale, uniform=plain, key=keys[-1])

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        return self.output(self.features(x))

    def features(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch width"]:
        """The last hidden layer's activations."""
        if not self.norms:
            for linear in self.hidden:
                x = jax.nn.relu(linear(x))
            return x
        for linear, norm in zip(self.hidden, self.norms, strict=True):
            x = norm(linear(x))
        return x

    def slopes(self, x: Float[Array, "row inputs"]) -> Slopes:
        """The output at every row and its derivatives, of a network with norms and one output."""
        inputs, saved = [x], []
        for linear, norm in zip(self.hidden, self.norms, strict=True):
            y, own = _normalize_and_activate(linear(inputs[-1]), norm.scale, norm.offset)
            inputs.append(y)
            saved.append(own)
        *inputs, features = inputs
        slope = jnp.broadcast_to(self.output.weight[:, 0], features.shape)
        hidden = []
        for linear, before, own in zip(self.hidden[::-1], inputs[::-1], saved[::-1], strict=True):
            by_product, by_activation_input = _row_derivatives(own, slope)
            hidden.append(LayerSlopes(before, own.normalized, by_product, by_activation_input))
            slope = matrix_product(by_product, linear.weight.T)
        return Slopes(self.output(features)[:, 0], slope, tuple(hidden[::-1]), features)

    def weighted_gradient(self, slopes: Slopes, weights: Float[Array, " row"]) -> MLP:
        """The derivative of the outputs' weighted sum by every parameter."""
        hidden, norms = [], []
        for layer in slopes.hidden:
            by_product, by_activation_input = (
                slope * weights[:, None] for slope in (layer.by_product, layer.by_activation_input)
            )
            hidden.append((matrix_product(layer.input.T, by_product), jnp.sum(by_product, axis=0)))
            by_scale = jnp.sum(by_activation_input * layer.normalized, axis=0)
            norms.append((by_scale, jnp.sum(by_activation_input, axis=0)))
        output = matrix_product(slopes.features.T, weights[:, None]), jnp.sum(weights)[None]
        return jax.tree.unflatten(jax.tree.structure(self), jax.tree.leaves((hidden, norms, output)))


def _along(vector: Float[Array, " features"], like: Array) -> Array:
    """Give a feature vector the rank of `like`: ranks are promoted explicitly throughout (a silent one hides bugs)."""
    return vector.reshape((1,) * (like.ndim - 1) + vector.shape)


class _Saved(NamedTuple):
    """What the derivative of LayerNorm and ELU needs of them."""

    normalized: Float[Array, "*batch features"]
    rate: Float[Array, "*batch 1"]
    """One over the standard deviation."""
    scale: Float[Array, " features"]
    output: Float[Array, "*batch features"]


def _normalize_and_activate(x: Array, scale: Array, offset: Array) -> tuple[Array, _Saved]:
    """ELU(z * scale + offset), z = (x - mean) / sqrt(variance + 1e-5) over the last axis."""
    centred = x - jnp.mean(x, axis=-1, keepdims=True)
    rate = jax.lax.rsqrt(jnp.mean(jnp.square(centred), axis=-1, keepdims=True) + 1e-5)
    normalized = centred * rate
    y = elu(normalized * _along(scale, x) + _along(offset, x))
    return y, _Saved(normalized, rate, scale, y)


@jax.custom_vjp
def _normalized_elu(x: Array, scale: Array, offset: Array) -> Array:
    """Both, with one derivative of its own: XLA would write, and read again, twice as many arrays of x's size."""
    return _normalize_and_activate(x, scale, offset)[0]


def _row_derivatives(saved: _Saved, gradient: Array) -> tuple[Array, Array]:
    """From the derivative by the output: those by x and by u = z * scale + offset, which ELU is taken of.

    With g the derivative by z: that by x is (g - mean(g) - z mean(g z)) / std.
    """
    by_u = gradient * jnp.minimum(saved.output + 1.0, 1.0)  # the slope of ELU is exp(u) = output + 1 below zero, else 1
    by_z = by_u * _along(saved.scale, by_u)
    along = jnp.mean(by_z * saved.normalized, axis=-1, keepdims=True)
    return saved.rate * (by_z - jnp.mean(by_z, axis=-1, keepdims=True) - saved.normalized * along), by_u


def _derivative(saved: _Saved, gradient: Array) -> tuple[Array, Array, Array]:
    by_x, by_u = _row_derivatives(saved, gradient)
    batch = tuple(range(by_u.ndim - 1))
    return by_x, jnp.sum(by_u * saved.normalized, axis=batch), jnp.sum(by_u, axis=batch)


_normalized_elu.defvjp(_normalize_and_activate, _derivative)
