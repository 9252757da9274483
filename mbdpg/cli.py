"""The command line: train, resume, evaluate, demonstrate."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from mbdpg import envs
from mbdpg.experiments import presets
from mbdpg.experiments.run import EnvOptions, RunConfig, load_policy, resume, train
from mbdpg.imitation.demonstrations import record
from mbdpg.interfaces import Environment, UserError, require
from mbdpg.networks.policy import NumpyPolicy
from mbdpg.reports.console import RunDisplay
from mbdpg.reports.curves import draw_curves
from mbdpg.reports.video import VideoWriter
from mbdpg.storage.run_folder import RunFolder
from mbdpg.training.evaluation import evaluate
from mbdpg.training.loop import Schedule

OVERVIEW = """usage: mbdpg VERB ...

Learn continuous control from few samples: model-based deterministic policy gradient (Gao et al. 2022) in JAX.

  mbdpg train ENV            learn a policy, for example: mbdpg train HalfCheetah-v5 --steps 50000
  mbdpg resume RUN           go on exactly where a run stopped
  mbdpg evaluate RUN         run the learned policy, for example: --episodes 10 --video out.mp4
  mbdpg demonstrate ENV      train an expert with TD3 and record its successful episodes

Every verb has its own --help. --debug shows tracebacks.
"""


@dataclass(frozen=True)
class RunOptions:
    """What is run."""

    algorithm: presets.Algorithm = "mbdpg"
    """Algorithm to train."""
    preset: presets.Preset = "default"
    """Settings that measured best, or those of the paper; flags given go before both."""
    seeds: tuple[int, ...] = (0,)
    """Random seeds; each is a run of its own, all in this process."""
    out: Path | None = None
    """Folder that gets one run folder per seed; by default runs/ENV-ALGORITHM-TIME."""
    demonstrations: str = "none"
    """File to begin from (see mbdpg demonstrate), `expert` to make one first, or `none`."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Resume:
    """Go on with a run, or with all runs in a folder, exactly where they stopped."""

    run: tyro.conf.Positional[Path]
    """Run folder, or a folder of run folders."""
    steps: int | None = None
    """Environment steps of the whole run, to make it longer than planned."""
    allow_import: bool = False
    """Allow the run's environment id to import code (module:Id)."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Evaluate:
    """Run a learned policy without exploration, and film it if asked to; no display is needed."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    episodes: int = 10
    """Number of episodes."""
    best: bool = False
    """Use the policy with the best evaluation in training instead of the latest."""
    video: Path | None = None
    """MP4 file to write the first episode to."""
    seed: int = 0
    """Decides the episodes."""
    allow_import: bool = False
    """Allow the run's environment id to import code (module:Id)."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Demonstrate:
    """Train an expert with TD3, or take one from a run, and record its successful episodes (Section 4.2)."""

    env: tyro.conf.Positional[str]
    """Gymnasium id."""
    out: Path
    """File to write, for example demonstrations.safetensors."""
    steps: int = 200_000
    """Environment steps of the expert's training."""
    expert: Path | None = None
    """Run folder of an expert that is trained already, by any algorithm."""
    episodes: int = 10
    """Successful episodes to record."""
    success_return: float | None = None
    """Least return of a success; by default what the environment is known to need."""
    seed: int = 0
    """Random seed of the expert and of its episodes."""
    env_options: tyro.conf.OmitArgPrefixes[EnvOptions] = field(default_factory=EnvOptions)
    debug: bool = False
    """Show the traceback of an error."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb; exits with 1 on an error that a person can mend, 2 on wrong usage, 128 + n on signal n."""
    args = list(sys.argv[1:] if arguments is None else arguments)
    verbs: dict[str, Callable[[list[str]], None]] = {
        "train": _train,
        "resume": lambda rest: _resume(_parse(Resume, "resume", rest)),
        "evaluate": lambda rest: _evaluate(_parse(Evaluate, "evaluate", rest)),
        "demonstrate": lambda rest: _demonstrate(_parse(Demonstrate, "demonstrate", rest)),
    }
    if not args or args[0] in ("-h", "--help"):
        print(OVERVIEW, end="")
        return
    try:
        require(args[0] in verbs, f"there is no verb {args[0]!r}; expected one of {', '.join(verbs)}")
        verbs[args[0]](args[1:])
    except KeyboardInterrupt:
        sys.exit(130)
    except UserError as error:
        if "--debug" in args:
            raise
        sys.exit(f"mbdpg: {error}")
    except Exception as error:
        if "--debug" in args:
            raise
        sys.exit(f"mbdpg: unexpected {type(error).__name__}: {_one_line(str(error))}; --debug shows where")


def _train(args: list[str]) -> None:
    chosen = {flag: _peek(args, flag) for flag in ("algorithm", "preset")}
    algorithm: Any = chosen["algorithm"] or "mbdpg"
    preset: Any = chosen["preset"] or "default"
    agent = presets.agent_config(algorithm, preset)
    paper = preset == "paper"
    flat = tyro.conf.OmitArgPrefixes
    options = EnvOptions(max_episode_steps=presets.PAPER_EPISODE_LIMIT if paper else None)
    command = dataclasses.make_dataclass(
        "Train",
        [
            ("env", tyro.conf.Positional[str]),
            ("run", flat[RunOptions], field(default_factory=RunOptions)),
            ("schedule", flat[Schedule], field(default=Schedule(**(presets.PAPER_SCHEDULE if paper else {})))),
            ("env_options", flat[EnvOptions], field(default=options)),
            ("agent", flat[type(agent)], field(default=agent)),
        ],
        frozen=True,
    )
    command.__doc__ = "Learn a policy for a Gymnasium environment.\n\nenv: Gymnasium id, as in HalfCheetah-v5."
    flags = _parse(command, "train", args)
    config = RunConfig(flags.env, algorithm, flags.agent, flags.schedule, flags.env_options)
    stamp = time.strftime("%Y%m%d-%H%M%S")
    out = flags.run.out or Path("runs") / f"{flags.env.replace(':', '-').replace('/', '-')}-{algorithm}-{stamp}"
    if flags.run.demonstrations == "expert":
        file = out / "demonstrations.safetensors"
        _demonstrate(Demonstrate(flags.env, file, seed=flags.run.seeds[0], env_options=flags.env_options))
        config = dataclasses.replace(config, demonstrations=str(file))
    elif flags.run.demonstrations != "none":
        config = dataclasses.replace(config, demonstrations=flags.run.demonstrations)
    with _stoppable() as should_stop, RunDisplay(config.schedule.steps) as display:
        runs = train(config, seeds=flags.run.seeds, out=out, on_update=display, should_stop=should_stop)
        _stopped(should_stop, out)
    picture = out / "learning-curve.png"
    draw_curves({algorithm: runs}, picture, title=config.env)
    print(f"done: {out}, learning curve in {picture}")
    print(f"next: mbdpg evaluate {runs[0]} --episodes 10 --video {out / 'policy.mp4'}")


def _resume(flags: Resume) -> None:
    runs = [flags.run]
    if not (flags.run / "config.json").exists() and flags.run.is_dir():
        runs = sorted(path.parent for path in flags.run.glob("seed-*/config.json")) or runs
    with _stoppable() as should_stop:
        for run in runs:
            with contextlib.ExitStack() as stack:
                display: list[RunDisplay] = []

                def start(config: RunConfig, env_steps: int, stack: Any = stack, display: Any = display) -> None:
                    display.append(stack.enter_context(RunDisplay(config.schedule.steps, done=env_steps)))

                resume(
                    run,
                    steps=flags.steps,
                    allow_import=flags.allow_import,
                    on_start=start,
                    on_update=lambda update, display=display: display[0](update),
                    should_stop=should_stop,
                )
            _stopped(should_stop, flags.run)
            print(f"done: {run}")


def _evaluate(flags: Evaluate) -> None:
    require(flags.episodes >= 1, f"--episodes is {flags.episodes}, expected at least 1")
    folder = RunFolder.open(flags.run)
    config = RunConfig.from_json(folder.config)
    require(not folder.config.get("custom_env"), f"{flags.run} trained an environment made in code: use mbdpg.evaluate")
    # Nobody but the person at the keyboard may decide that code is imported.
    options = dataclasses.replace(config.env_options, allow_import=flags.allow_import)
    policy = load_policy(flags.run, best=flags.best)
    seeds = [envs.episode_seed(flags.seed, "video", i) for i in range(flags.episodes)]
    env = dataclasses.replace(config, env_options=options).make_env(render=flags.video is not None)
    _check_sizes(policy, flags.run, env)
    returns, lengths = [], []
    for episode, seed in enumerate(seeds):
        with contextlib.ExitStack() as stack:
            film = None
            if flags.video is not None and episode == 0:
                film = stack.enter_context(VideoWriter(flags.video))
            outcome = evaluate(env, policy, [seed], on_frame=film)
        returns += outcome.returns
        lengths += outcome.lengths
        if outcome.returns:
            print(f"episode {episode}: return {outcome.returns[0]:.1f}, {outcome.lengths[0]} steps")
    env.close()
    require(len(returns) > 0, f"{config.env} failed in every episode (see above): mend it, then evaluate again")
    print(
        f"{len(returns)} episodes: return {np.mean(returns):.1f} ± {np.std(returns):.1f}, {np.mean(lengths):.0f} steps"
    )
    if flags.video is not None:
        print(f"video of the first episode in {flags.video}")


def _demonstrate(flags: Demonstrate) -> None:
    require(flags.episodes >= 1, f"--episodes is {flags.episodes}, expected at least 1")
    config = RunConfig(
        flags.env, "td3", presets.agent_config("td3", "default"), _expert_schedule(flags.steps), flags.env_options
    )
    env = config.make_env()
    success = flags.success_return if flags.success_return is not None else env.spec.reference_return
    if success is None:
        raise UserError(f"nobody knows what a success in {flags.env} is; say so with --success-return")
    run, expert_steps = flags.expert, 0
    if run is None:
        out = flags.out.with_suffix("") if flags.out.suffix else flags.out.with_name(flags.out.name + "-expert")
        with _stoppable() as should_stop, RunDisplay(flags.steps) as display:
            run = train(config, seeds=[flags.seed], out=out, on_update=display, should_stop=should_stop)[0]
            _stopped(should_stop, run, f"then mbdpg demonstrate {flags.env} --out {flags.out} --expert {run}")
    expert_steps = _steps_learned(run)
    policy = load_policy(run, best=True)
    _check_sizes(policy, run, env)
    found = record(
        env,
        policy,
        episodes=flags.episodes,
        success_return=success,
        expert_env_steps=expert_steps,
        seed=flags.seed,
    )
    env.close()
    found.save(flags.out)
    returns = found.facts["returns"]
    print(
        f"{len(returns)} successful episodes of {found.facts['tried']} (mean return {np.mean(returns):.1f}) in {flags.out}; "
        f"they cost {found.expert_env_steps} environment steps"
    )


def _check_sizes(policy: NumpyPolicy, run: Path, env: Environment) -> None:
    found, wanted = (policy.observation_size, policy.action_size), (env.spec.observation_size, env.spec.action_size)
    require(
        found == wanted,
        f"the policy of {run} has {found[0]} observation and {found[1]} action entries, but {env.spec.id} has "
        f"{wanted[0]} and {wanted[1]}; expected a run of {env.spec.id}",
    )


def _expert_schedule(steps: int) -> Schedule:
    return Schedule(steps=steps, evaluate_every=10_000)


def _steps_learned(run: Path) -> int:
    """Environment steps in a run's newest policy file."""
    from mbdpg.storage.array_file import read_array_file

    return int(read_array_file(run / "policy" / "latest.safetensors", "policy")[1]["env_steps"])


def _parse(kind: type[Any], verb: str, args: list[str]) -> Any:
    """Parse a verb's flags; wrong usage is one line and status 2."""
    stderr = io.StringIO()
    try:
        with contextlib.redirect_stderr(stderr):
            return tyro.cli(kind, prog=f"mbdpg {verb}", args=args, description=kind.__doc__)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        print(f"mbdpg {verb}: {_usage_error(stderr.getvalue())}", file=sys.stderr)
        sys.exit(2)


def _usage_error(text: str) -> str:
    """Tyro's boxed explanation as one line."""
    lines = [re.sub(r"[╭╮╰╯│─]+", " ", re.sub(r"\x1b\[[0-9;]*m", "", line)).strip() for line in text.splitlines()]
    return _one_line(" ".join(line for line in lines if line))


def _one_line(text: str) -> str:
    return re.sub(r"\s+", " ", text).strip()[:500]


def _peek(args: Sequence[str], flag: str) -> str | None:
    """A flag's value before the rest can be parsed, because the rest depends on it."""
    found = None
    for position, arg in enumerate(args):
        if arg == f"--{flag}" and position + 1 < len(args):
            found = args[position + 1]  # of several the last holds, as for the other flags
        elif arg.startswith(f"--{flag}="):
            found = arg.split("=", 1)[1]
    return found


@contextlib.contextmanager
def _stoppable() -> Iterator[Callable[[], int]]:
    """Yield a function that returns the number of the signal that asked to stop, 0 for none; a second one ends at once."""
    received: list[int] = []

    def handle(number: int, frame: object) -> None:
        if received:
            os._exit(128 + number)
        received.append(number)
        print("mbdpg: saving, then stopping; once more to stop at once, from the last checkpoint", file=sys.stderr)

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: received[0] if received else 0
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _stopped(should_stop: Callable[[], int], run: Path, then: str = "") -> None:
    """If a signal stopped the run, say how to go on and exit as a process does that it killed."""
    if number := should_stop():
        print(f"mbdpg: saved; go on with: mbdpg resume {run}{' ' + then if then else ''}", file=sys.stderr)
        sys.exit(128 + number)


if __name__ == "__main__":
    main()
