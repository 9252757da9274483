"""Two updates of TD3 and of SAC, ours and Stable-Baselines3's, from the same weights, batches and noise.

    .venv/bin/python benchmarks/one_update.py        # after `make setup-dev peers`

Prints how far apart 999 in 1,000 parameters of every array are afterwards, and the farthest of all, beside how far the
updates moved them. Adam's first steps have one size however small a gradient is, so where one is all but zero its
rounding decides the step.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

PEERS = Path(".venv-peers/bin/python")
OBSERVATION, ACTION, BATCH, UPDATES = 17, 6, 256, 2  # of which TD3 moves its actor and targets at the second


def compare(algorithm: str, peers: Path) -> str:
    """Take the same updates with both, and say what came of it."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from mbdpg.agents import sac, td3
    from mbdpg.experiments.presets import agent_config
    from mbdpg.interfaces import Batch, EnvSpec

    env = EnvSpec("HalfCheetah-v5", OBSERVATION, ACTION, episode_limit=1000, reference_return=None)
    config: Any = agent_config(algorithm, "paper")
    agent: Any = td3.TD3(config, env) if algorithm == "td3" else sac.SAC(config, env)
    keys = [jax.random.key(update) for update in range(UPDATES)]
    # TD3 draws at the next observation; SAC, in the peer's order, at this step's and then at the next one's.
    draws = [[key] if algorithm == "td3" else jax.random.split(key)[::-1] for key in keys]
    noise = [jax.random.normal(key, (BATCH, ACTION)) for own in draws for key in own]
    with tempfile.TemporaryDirectory() as place:
        given, found = Path(place) / "given.npz", Path(place) / "found.npz"
        np.savez(given, noise=np.stack(noise))
        subprocess.run([str(peers), __file__, "--peer", algorithm, str(given), str(found)], check=True)
        theirs = dict(np.load(found))

    def parameters(when: str) -> dict[str, Any]:
        """The peer's, by the names of ours."""

        def linear(name: str) -> dict[str, Any]:
            weight, bias = theirs[f"{when}/{name}.weight"], theirs[f"{when}/{name}.bias"]
            return {"weight": jnp.asarray(weight.T), "bias": jnp.asarray(bias)}

        def critics(name: str) -> list[dict[str, Any]]:
            layers = [[linear(f"{name}.qf{critic}.{layer}") for critic in (0, 1)] for layer in (0, 2, 4)]
            return [jax.tree.map(lambda *x: jnp.stack(x), *pair) for pair in layers]

        both = {"critics": critics("critic"), "target_critics": critics("critic_target")}
        if algorithm == "td3":
            names = {"actor": "actor", "target_actor": "actor_target"}
            return both | {own: [linear(f"{name}.mu.{layer}") for layer in (0, 2, 4)] for own, name in names.items()}
        layers = ("actor.latent_pi.0", "actor.latent_pi.2", "actor.mu", "actor.log_std")
        return both | {"actor": [linear(name) for name in layers]}

    def layers(state: Any) -> dict[str, Any]:
        """Ours, in the same order."""

        def of(mlp: Any) -> list[dict[str, Any]]:
            return [{"weight": layer.weight, "bias": layer.bias} for layer in (*mlp.hidden, mlp.output)]

        both = {"critics": of(state.critics.mlps), "target_critics": of(state.target_critics.mlps)}
        if algorithm == "td3":
            return both | {"actor": of(state.actor.mlp), "target_actor": of(state.target_actor.mlp)}
        spread = {"weight": state.actor.spread.weight, "bias": state.actor.spread.bias}
        return both | {"actor": [*of(state.actor.center.mlp), spread]}

    before, after = parameters("before"), parameters("after")
    state = agent.init(key=jax.random.key(9))
    state = eqx.tree_at(lambda s: jax.tree.leaves(layers(s)), state, jax.tree.leaves(before))
    batch = {name: jnp.asarray(theirs[f"batch/{name}"]) for name in Batch._fields if f"batch/{name}" in theirs}
    for update, key in enumerate(keys):
        now = jax.tree.map(lambda x, at=update: x[at, :, None], batch)
        state, _ = agent.update(state, Batch(**now, valid=jnp.ones((BATCH, 1))), key=key)
    reached = layers(state)
    if algorithm == "sac":
        reached["temperature"], after["temperature"] = state.log_temperature, theirs["after/temperature"]
        before["temperature"] = np.zeros(())

    def apart(left: Any, right: Any, share: float) -> float:
        return max(jax.tree.leaves(jax.tree.map(lambda a, b: float(np.quantile(np.abs(a - b), share)), left, right)))

    most, all_of_them, moved = apart(reached, after, 0.999), apart(reached, after, 1.0), apart(before, after, 1.0)
    return f"{algorithm}: 999 in 1,000 parameters within {most:.0e}, all within {all_of_them:.0e}, moved by {moved:.0e}"


def peer(algorithm: str, given: Path, found: Path) -> None:
    """Take the updates with Stable-Baselines3, and write parameters before and after, and the batches."""
    import gymnasium
    import torch
    from peers import make_agent
    from stable_baselines3.common.logger import Logger
    from stable_baselines3.common.type_aliases import ReplayBufferSamples

    class Spaces(gymnasium.Env):  # type: ignore[misc]
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATION,))
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION,))

    noise, rng = list(torch.as_tensor(np.load(given)["noise"])), np.random.default_rng(0)

    def rsample(self: torch.distributions.Normal, sample_shape: Any = ()) -> torch.Tensor:
        return self.loc + self.scale * noise.pop(0)

    def normal_(self: torch.Tensor, mean: float, std: float) -> torch.Tensor:
        return self.copy_(mean + std * noise.pop(0))

    torch.distributions.Normal.rsample = rsample
    agent: Any = make_agent(algorithm, Spaces(), 0, None)
    agent.set_logger(Logger(folder=None, output_formats=[]))
    with torch.no_grad():  # targets that differ from what they follow
        for parameter in agent.critic_target.parameters():
            parameter += 0.01 * torch.randn_like(parameter)
    shapes = {"observation": (OBSERVATION,), "action": (ACTION,), "reward": (), "next_observation": (OBSERVATION,)}
    batch = {name: rng.normal(size=(UPDATES, BATCH, *shape)).astype(np.float32) for name, shape in shapes.items()}
    batch["action"] = np.tanh(batch["action"])
    batch["terminated"] = (rng.uniform(size=(UPDATES, BATCH)) < 0.1).astype(np.float32)
    draws = iter(range(UPDATES))

    def sample(*_: Any, **__: Any) -> ReplayBufferSamples:
        at = next(draws)
        now = {name: torch.as_tensor(value[at]) for name, value in batch.items()}
        ends, rewards = now["terminated"][:, None], now["reward"][:, None]
        return ReplayBufferSamples(now["observation"], now["action"], now["next_observation"], ends, rewards)

    agent.replay_buffer.sample = sample

    def state(when: str) -> dict[str, np.ndarray]:
        return {f"{when}/{name}": value.detach().numpy().copy() for name, value in agent.policy.state_dict().items()}

    before = state("before")
    torch.Tensor.normal_ = normal_  # TD3's draws; networks and targets have had theirs
    agent.train(gradient_steps=UPDATES, batch_size=BATCH)
    assert not noise, "the peer drew less than ours"
    after = state("after")
    if algorithm == "sac":
        after["after/temperature"] = agent.log_ent_coef.detach().numpy()[0]
    np.savez(found, **before, **after, **{f"batch/{name}": value for name, value in batch.items()})


def main() -> None:
    """Compare, or be the peer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers", type=Path, default=PEERS, help="the interpreter that has Stable-Baselines3")
    parser.add_argument("--peer", nargs=3, help=argparse.SUPPRESS)
    flags = parser.parse_args()
    if flags.peer:
        peer(flags.peer[0], *map(Path, flags.peer[1:]))
        return
    for algorithm in ("td3", "sac"):
        print(compare(algorithm, flags.peers))


if __name__ == "__main__":
    main()
