"""Write the student of a trained SAID agent as an ONNX file, for computers without PyTorch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_said import SAID
from sb3_said.files.normalization import load_normalization
from sb3_said.said.export import export
from sb3_said.zoo.arguments import TRUST, explained, make_parser
from sb3_said.zoo.decide import load_said
from sb3_said.zoo.folder import find_agent, find_normalization

EPILOG = f"""\
examples:
  # in Python, once: model.distill(); model.save("agent.zip")
  sb3-said export agent.zip agent.onnx

The file answers observations as DelayedObservationWrapper gives them: what VecNormalize has learned of them is in it,
from the file that training leaves beside the agent. On the robot, sb3_said.realtime.OnnxModel reads
it for a control loop, with onnxruntime and without PyTorch.
{TRUST}
"""


def main(argv: list[str] | None = None) -> None:
    parser = make_parser(__doc__, EPILOG)
    parser.add_argument("agent", type=Path, metavar="RUN_OR_ZIP", help="run folder of a training, or an agent's .zip")
    parser.add_argument("output", type=Path, metavar="ONNX", help="file to write")
    args = parser.parse_args(argv)
    with explained(parser):
        model, statistics = load_said(args.agent), find_normalization(*find_agent(args.agent))
        normalization = None
        if statistics is not None:
            normalization = load_normalization(statistics, DummyVecEnv([lambda: SpacesAlone(model)]))
        export(model, args.output, normalization)
    print(f"Wrote {args.output}")
    if model.reads_normalized and normalization is None:
        print("Its observations are those that VecNormalize had normalised, and no statistics are beside the agent: "
              "normalise them first.")  # fmt: skip


class SpacesAlone(gym.Env[Any, Any]):
    """The spaces of an agent: SB3 asks no more of an environment before it reads statistics of observations."""

    def __init__(self, model: SAID) -> None:
        self.observation_space, self.action_space = model.observation_space, model.action_space
