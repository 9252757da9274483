"""The command line."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from mbdpg.interfaces import UserError, one_line, require
from mbdpg.storage.run_folder import describe_machine

VERBS = ("train", "resume", "evaluate", "demonstrate", "reproduce", "sweep", "report", "benchmark")
"""Each is a function in a file of its name, read when it is called for: none waits for what another needs."""

OVERVIEW = """usage: mbdpg VERB ...

Learn continuous control from few samples: model-based deterministic policy gradient (Gao et al. 2022) in JAX.

  mbdpg train ENV            learn a policy, for example: mbdpg train HalfCheetah-v5 --steps 50000
  mbdpg resume RUN           go on exactly where a run stopped
  mbdpg evaluate RUN         run the learned policy, for example: --episodes 10 --video out.mp4
  mbdpg demonstrate ENV      train an expert with TD3 and record its successful episodes
  mbdpg reproduce STUDY      run and draw one of the paper's figures or tables
  mbdpg sweep ENV            search for settings, for example: --search horizon=1:20
  mbdpg report RUN...        compare runs: tables with intervals; --out report.html for curves and more
  mbdpg benchmark            measure on this machine: updates, acting, starting, memory

Every verb has its own --help; --debug shows tracebacks. mbdpg --version prints the versions that matter.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb; exits with 1 on an error that a person can mend, 2 on wrong usage, 128 + n on signal n."""
    args = list(sys.argv[1:] if arguments is None else arguments)
    if not args or args[0] in ("-h", "--help"):
        print(OVERVIEW, end="")
        return
    if args[0] == "--version":
        here = describe_machine()
        versions = here["versions"] | {"python": here["python"]}
        print(", ".join(f"{name} {version}" for name, version in versions.items() if version))
        return
    try:
        require(args[0] in VERBS, f"there is no verb {args[0]!r}; expected one of {', '.join(VERBS)}")
        getattr(importlib.import_module(f"mbdpg.cli.{args[0]}"), args[0])(args[1:])
    except BrokenPipeError:  # whoever read our output has seen enough
        sys.stderr.close()
        sys.exit(1)
    except KeyboardInterrupt:  # where there is nothing to save
        sys.exit(130)
    except Exception as error:
        if "--debug" in args:
            raise
        if isinstance(error, UserError):
            sys.exit(f"mbdpg: {one_line(str(error))}")
        if isinstance(error, MemoryError) or "Out of memory" in str(error):  # the latter XLA's
            sys.exit(
                "mbdpg: this machine has not enough memory for it; lower its largest width, batch, count or horizon"
            )
        sys.exit(f"mbdpg: unexpected {type(error).__name__}: {one_line(str(error))}; --debug shows where")
