"""MBDPG's update of actor and critics written in eager torch, as a peer of ours for speed.

It computes the same and is written as one would write it: its actor and its critics each go through the critics and
back, where ours share one way (`Critics.with_slopes`).

Runs in the environment that `make peers` builds, which has no mbdpg; benchmarks/side_by_side.py calls it and checks
that it computes the same. Parameters have the names of our checkpoints. Settings are those of `mbdpg benchmark`: the
full gradient, deterministic imagination, lambda-returns, no target noise.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

Parameters = dict[str, Tensor]


def mlp(p: Parameters, name: str, x: Tensor) -> Tensor:
    """Hidden layers of Linear, LayerNorm and ELU, then a Linear output; twin critics have a leading axis of two."""
    layers = sum(key.startswith(f"{name}/hidden/") and key.endswith("weight") for key in p)
    for i in range(layers):
        x = linear(p, f"{name}/hidden/{i}", x)
        scale, offset = (p[f"{name}/norms/{i}/{part}"] for part in ("scale", "offset"))
        if scale.ndim == 1:
            x = functional.layer_norm(x, scale.shape, scale, offset)
        else:
            x = functional.layer_norm(x, scale.shape[-1:]) * scale[:, None] + offset[:, None]
        x = functional.elu(x)
    return linear(p, f"{name}/output", x)


def linear(p: Parameters, name: str, x: Tensor) -> Tensor:
    """Affine map of the last axis."""
    weight, bias = p[f"{name}/weight"], p[f"{name}/bias"]
    if weight.ndim == 2:
        return torch.addmm(bias, x, weight)
    return torch.baddbmm(bias[:, None], x, weight)


class Agent:
    """Networks, targets and optimizers."""

    def __init__(self, arrays: dict[str, np.ndarray], settings: dict[str, float]):
        self.settings = settings
        self.p = {name: torch.as_tensor(value) for name, value in arrays.items()}
        self.actor, self.critics = (
            [name for name in self.p if name.startswith(part)] for part in ("actor/", "critics/")
        )
        for name in (*self.actor, *self.critics):
            self.p[name].requires_grad_(True)
        self.optimizers = tuple(
            torch.optim.Adam([self.p[name] for name in names], lr=settings[f"{part}_learning_rate"])
            for part, names in (("actor", self.actor), ("critic", self.critics))
        )

    def remember(self, hidden: Tensor, cell: Tensor, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The LSTM's next state."""
        gates = linear(self.p, "average_dynamics/lstm", torch.cat([observation, action, hidden], -1))
        write, forget, candidate, read = gates.chunk(4, -1)
        cell = torch.sigmoid(forget) * cell + torch.sigmoid(write) * torch.tanh(candidate)
        return torch.sigmoid(read) * torch.tanh(cell), cell

    def policy(self, observation: Tensor, name: str = "actor") -> tuple[Tensor, Tensor]:
        """Actions, and what tanh was taken of."""
        unbounded = mlp(self.p, f"{name}/mlp", observation)
        return torch.tanh(unbounded), unbounded

    def values(self, observation: Tensor, action: Tensor, name: str = "critics") -> Tensor:
        """Both critics' values of rows."""
        pair = torch.cat([observation, action], -1)
        return mlp(self.p, f"{name}/mlps", pair.expand(2, *pair.shape))[..., 0]

    def imagine(self, observation: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, ...]:
        """Observations and actions (H + 1), rewards and continuations (H), by the mixture's mean."""
        s, horizon = self.settings, int(self.settings["horizon"])
        gaussians, size = int(s["gaussians"]), observation.shape[-1]
        delta_scale = self.p["scales/delta"]
        observations, actions, rewards, continues = [observation], [self.policy(observation)[0]], [], []
        for _ in range(horizon):
            action = actions[-1]
            hidden, cell = self.remember(hidden, cell, observation, action)
            out = mlp(self.p, "average_dynamics/trunk", torch.cat([observation, action, hidden], -1))
            weights = torch.softmax(out[:, gaussians * size :], -1)
            means = out[:, : gaussians * size].reshape(-1, gaussians, size)
            delta = (weights[..., None] * means).sum(-2)
            outcome = mlp(
                self.p, "average_dynamics/outcome_network", torch.cat([observation, action, delta, hidden], -1)
            )
            alive = torch.sigmoid(outcome[:, 2])
            rewards.append(
                alive * outcome[:, 0] * self.p["scales/reward"]
                + (1 - alive) * outcome[:, 1] * self.p["scales/terminal_reward"]
            )
            continues.append(alive)
            after = observation + delta * delta_scale
            inside = after.clamp(-10.0, 10.0)
            observation = inside + torch.tanh(after - inside)
            observations.append(observation)
            actions.append(self.policy(observation)[0])
        return tuple(torch.stack(x) for x in (observations, actions, rewards, continues))

    def improve(self, window: Parameters) -> dict[str, float]:
        """One update of actor and critics after a batch of windows in normalized units."""
        s, horizon = self.settings, int(self.settings["horizon"])
        discount, trace = s["discount"], s["trace"]
        with torch.no_grad():
            batch, size = window["observation"].shape[0], int(s["memory"])
            hidden = cell = torch.zeros(batch, size)
            for t in range(window["observation"].shape[1]):
                hidden, cell = self.remember(hidden, cell, window["observation"][:, t], window["action"][:, t])
                hidden, cell = (x * window["valid"][:, t, None] for x in (hidden, cell))
            start = window["next_observation"][:, -1]
            weight = 1.0 - window["terminated"][:, -1]
        for name in self.critics:
            self.p[name].requires_grad_(False)
        observations, actions, rewards, continues = self.imagine(start, hidden, cell)
        survival = torch.cat([torch.ones(1, batch), torch.cumprod(continues, 0)])
        flat = observations.flatten(0, 1), actions.flatten(0, 1)
        values = self.values(*flat).reshape(2, horizon + 1, batch).min(0).values
        powers = discount ** torch.arange(horizon + 1)[:, None] * survival
        remaining = horizon - torch.arange(horizon)
        beta = s["beta"] + (s["final_beta"] - s["beta"]) * self.p["progress"]
        objective = beta * (remaining[:, None] * powers[:-1] * rewards).sum(0) + (powers * values).sum(0)
        objective = objective / (horizon + 1)
        count = weight.sum().clamp(min=1.0)
        mean = (objective * weight).sum() / count
        scale = ((objective.abs() * weight).sum() / count).clamp(min=1.0).detach()
        saturation = (self.policy(start)[1].square().mean(-1) * weight).sum() / count
        loss = s["saturation_penalty"] * saturation - mean / scale
        gradients = torch.autograd.grad(loss, [self.p[name] for name in self.actor])
        with torch.no_grad():
            observations, actions, rewards, continues, survival = (
                x.detach() for x in (observations, actions, rewards, continues, survival)
            )
            seen = observations.flatten(0, 1)
            target_action = self.policy(seen, "target_actor")[0]
            later = self.values(seen, target_action, "target_critics").min(0).values.reshape(horizon + 1, batch)
            target, targets = later[-1], []
            for t in reversed(range(horizon)):
                target = rewards[t] + discount * continues[t] * ((1 - trace) * later[t + 1] + trace * target)
                targets.append(target)
            expanded = torch.stack(targets[::-1])
            reward = window["reward"][:, -1] * self.p["scales/reward"]
            reward = reward + window["terminal_reward"][:, -1] * self.p["scales/terminal_reward"]
            real_target = reward + discount * weight * ((1 - trace) * later[0] + trace * expanded[0])
        for name in self.critics:
            self.p[name].requires_grad_(True)
        real = self.values(window["observation"][:, -1], window["action"][:, -1])
        along = self.values(observations[:-1].flatten(0, 1), actions[:-1].flatten(0, 1)).reshape(2, horizon, batch)
        weights = survival[:-1] * weight
        critic_loss = (real - real_target).square().sum() / batch
        imagined_loss = ((along - expanded).square() * weights).sum() / weights.sum().clamp(min=1.0)
        critic_loss = critic_loss + s["imagined_weight"] * imagined_loss
        critic_gradients = torch.autograd.grad(critic_loss, [self.p[name] for name in self.critics])
        critic_norm = self._step(1, self.critics, critic_gradients, s["critic_clip"])
        with torch.no_grad():
            for name in (*self.critics, *self.actor):  # before the actor's step, as in ours
                self.p[f"target_{name}"].lerp_(self.p[name], s["target_update_rate"])
        actor_norm = self._step(0, self.actor, gradients, s["actor_clip"])
        norms = {"critic/grad_norm": critic_norm.item(), "actor/grad_norm": actor_norm.item()}
        return norms | {"critic/loss": critic_loss.item(), "actor/objective": mean.item()}

    def _step(self, which: int, names: list[str], gradients: tuple[Tensor, ...], clip: float) -> Tensor:
        """One step of Adam; returns the gradients' norm before it is clipped."""
        for name, gradient in zip(names, gradients, strict=True):
            self.p[name].grad = gradient
        norm = torch.nn.utils.clip_grad_norm_([self.p[name] for name in names], clip)
        self.optimizers[which].step()
        with torch.no_grad():  # ours evaluates a running average of the actor
            if which == 0:
                for name in names:
                    self.p[f"average_{name}"].lerp_(self.p[name], 0.01)
        return norm


def main() -> None:
    """Read parameters and a batch, take updates, write what the first one gave and how long the others took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("given", type=Path)
    parser.add_argument("--updates", type=int, default=20)
    parser.add_argument("--threads", type=int, default=2)
    flags = parser.parse_args()
    torch.set_num_threads(flags.threads)
    given = dict(np.load(flags.given))
    settings = json.loads(given.pop("settings").tobytes())
    window = {name: torch.as_tensor(given.pop(f"window/{name}")) for name in json.loads(given.pop("names").tobytes())}
    agent = Agent(given, settings)
    first = agent.improve(window)
    parameters = {name: float(agent.p[name].detach().double().norm()) for name in (*agent.actor, *agent.critics)}
    seconds = []
    for _ in range(flags.updates):
        began = time.perf_counter()
        agent.improve(window)
        seconds.append(time.perf_counter() - began)
    print(json.dumps({"ms": 1e3 * float(np.median(seconds)), "first": first, "norms": parameters}))


if __name__ == "__main__":
    main()
