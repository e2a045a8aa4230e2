"""Control loops of robots: they take observations and answers when these come, and send an action every period."""

from sb3_said.realtime.ledger import NoAnswer
from sb3_said.realtime.loop import ControlLoop
from sb3_said.realtime.looped import LoopedModel
from sb3_said.realtime.onnx import OnnxModel
from sb3_said.realtime.process import ModelProcess
from sb3_said.realtime.statistics import LoopStatistics
from sb3_said.realtime.ticks import ticks

__all__ = ["ControlLoop", "LoopStatistics", "LoopedModel", "ModelProcess", "NoAnswer", "OnnxModel", "ticks"]
