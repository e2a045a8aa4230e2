"""Write the student of a trained SAID agent as an ONNX file, for computers without PyTorch."""

from __future__ import annotations

from pathlib import Path

from sb3_said.said.export import export
from sb3_said.zoo.arguments import TRUST, explained, make_parser
from sb3_said.zoo.decide import load_said
from sb3_said.zoo.folder import find_agent, find_normalization

EPILOG = f"""\
examples:
  # in Python, once: model.distill(); model.save("agent.zip")
  sb3-said export agent.zip agent.onnx

The file answers observations as DelayedObservationWrapper gives them. On the robot, sb3_said.realtime.OnnxModel reads
it for a control loop, with onnxruntime and without PyTorch.
{TRUST}
"""


def main(argv: list[str] | None = None) -> None:
    parser = make_parser(__doc__, EPILOG)
    parser.add_argument("agent", type=Path, metavar="RUN_OR_ZIP", help="run folder of a training, or an agent's .zip")
    parser.add_argument("output", type=Path, metavar="ONNX", help="file to write")
    args = parser.parse_args(argv)
    with explained(parser):
        export(load_said(args.agent), args.output)
        statistics = find_normalization(*find_agent(args.agent))
    print(f"Wrote {args.output}")
    if statistics is not None:
        print(f"Its observations are those normalised by {statistics}: normalise them first.")
