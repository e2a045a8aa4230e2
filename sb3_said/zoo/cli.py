"""The command ``sb3-said``."""

from __future__ import annotations

import importlib
import sys

USAGE = """\
usage: sb3-said COMMAND ...

  train        train SAID or one of its baselines on a delayed task
  evaluate     measure a trained agent: mean return over seeded episodes, and how long a decision takes
  enjoy        watch a trained agent, in a window or as a video
  over-delays  play trained agents under several delays: a table and a plot of return over delay
  tune         search the planner's depth, temperature, denoising steps and choice factor for a trained run
  decide       set how a trained agent decides: temperature, candidates, denoising steps, choice factor
  card         write a model card for an agent's file, from what was measured of it
  collect      let trained agents play, and log it as a dataset to learn from
  export       write a distilled student as an ONNX file, for computers without PyTorch

sb3-said COMMAND --help shows the options of a command, with examples. A first try,
of a few minutes (five on two slow cores):

  sb3-said train --algo said --env Pendulum-v1 --delay 2 --preset smoke --seed 1
  sb3-said evaluate logs/said/Pendulum-v1-delay2-seed1_1
"""
COMMANDS = ("train", "evaluate", "enjoy", "over-delays", "tune", "decide", "card", "collect", "export")


def main() -> None:
    """Run the command that the first word names."""
    name, rest = (sys.argv[1:2] or ["--help"])[0], sys.argv[2:]
    if name in ("-h", "--help"):
        print(USAGE, end="")
        return
    if name not in COMMANDS:
        sys.exit(f"{USAGE}\nsb3-said: error: there is no command {name!r}, expected one of {', '.join(COMMANDS)}.")
    sys.argv = [f"sb3-said {name}", *rest]
    run(name)


def run(name: str) -> None:
    """Run a command on this process's arguments, or end with what it lacks."""
    try:
        command = importlib.import_module(f"sb3_said.zoo.{name.replace('-', '_')}")
    except KeyboardInterrupt:  # the import takes seconds
        print("\nInterrupted.", file=sys.stderr)
        sys.exit(130)
    except ModuleNotFoundError as error:
        missing = str(error.name).partition(".")[0]
        if missing == "sb3_said":
            raise
        sys.exit(f'{missing} is missing, which sb3-said {name} needs: pip install "sb3_said[zoo]"')
    command.main()
