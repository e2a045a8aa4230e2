"""The examples for robots run, with stand-ins for what only a robot's machine has."""

from __future__ import annotations

import importlib.util
import os
import queue
import signal
import sys
import threading
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from recorder import Recorder, plan_of
from small_task import Drift

from sb3_said.realtime import ControlLoop

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
TASK = Drift()


class Model(Recorder):
    """Stands in for a model in another process."""

    def __init__(self, load: Any = None):
        super().__init__(TASK, 4)
        self.load, self.is_closed = load, False

    def __enter__(self) -> Model:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.is_closed = True


def module(name: str, **names: Any) -> ModuleType:
    made = ModuleType(name)
    vars(made).update(names)
    return made


def load(name: str, monkeypatch: pytest.MonkeyPatch, *stand_ins: ModuleType) -> Any:
    for stand_in in stand_ins:
        monkeypatch.setitem(sys.modules, stand_in.__name__, stand_in)
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    if hasattr(made, "ModelProcess"):
        monkeypatch.setattr(made, "ModelProcess", Model)
    return made


class Node:
    """What the example uses of rclpy's."""

    given: dict[str, Any] = {}

    def __init__(self, name: str):
        self.published: dict[str, list[Any]] = {}
        self.subscribed: dict[str, Any] = {}
        self.timers: dict[float, Any] = {}
        self.logged: list[str] = []
        self.is_destroyed = False

    def declare_parameter(self, name: str, default: Any) -> Any:
        return SimpleNamespace(value=self.given.get(name, default))

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        self.published[topic] = []
        return SimpleNamespace(publish=lambda message: self.published[topic].append(message.data))

    def create_subscription(self, kind: Any, topic: str, callback: Any, depth: int) -> None:
        self.subscribed[topic] = callback

    def create_timer(self, period: float, callback: Any, clock: Any) -> None:
        assert clock.clock_type == "steady"
        self.timers[period] = callback

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=time.time_ns()))

    def get_logger(self) -> Any:
        def log(text: str, throttle_duration_sec: float = 0.0) -> None:
            self.logged.append(text)

        return SimpleNamespace(error=log, warning=log, info=log)

    def destroy_node(self) -> None:
        self.is_destroyed = True


def joint_state(position: Any, velocity: Any, stamp: int) -> Any:
    return SimpleNamespace(position=position, velocity=velocity, header=SimpleNamespace(stamp=stamp))


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> Any:
    rclpy = module(
        "rclpy", init=lambda signal_handler_options: None, shutdown=lambda: None, spin=lambda node: None, nodes=[]
    )
    message = lambda data: SimpleNamespace(data=data)  # noqa: E731
    topics = {"action_topic": "/arm", "observation_topic": "/joints"}
    monkeypatch.setattr(Node, "given", {"period": 0.5, "safe_action": [-1.0], "agent": "a.zip", **topics})
    example = load(
        "ros2_node",
        monkeypatch,
        rclpy,
        module("rclpy.node", Node=Node),
        module("rclpy.clock", Clock=SimpleNamespace, ClockType=SimpleNamespace(STEADY_TIME="steady")),
        module("rclpy.signals", SignalHandlerOptions=SimpleNamespace(NO="no")),
        module("rclpy.time", Time=SimpleNamespace(from_msg=lambda stamp: SimpleNamespace(nanoseconds=stamp))),
        module("sensor_msgs"),
        module("sensor_msgs.msg", JointState=object),
        module("std_msgs"),
        module("std_msgs.msg", Float64MultiArray=message, String=message),
    )
    before = signal.getsignal(signal.SIGTERM)
    yield example
    signal.signal(signal.SIGTERM, before)


def test_the_ros_node_observes_acts_and_tells_that_it_lives(ros: Any) -> None:
    node = ros.ControlNode()
    assert node.model.load.args == ("a.zip",) and node.loop.period == 0.5
    now = time.time_ns()
    node.subscribed["/joints"](joint_state([0.5], [0.25], now - 10_000_000))
    assert node.loop.wait(60)
    node.timers[0.5]()
    np.testing.assert_array_equal(node.model.asked[-1]["observation"], np.float32([0.5, 0.25]))
    assert node.published["/arm"] == [[float(plan_of(node.model.asked[-1], TASK.action_space, 1)[0, 0])]]
    assert 0.01 <= time.monotonic() - node.captured < 60
    for is_frozen, age in ((True, 1), (True, 2), (False, 0)):
        time.sleep(0.0 if is_frozen else 0.3)  # more than half a period
        stamp = now - 10_000_000 if is_frozen else time.time_ns()
        node.subscribed["/joints"](joint_state([0.5], [0.25], stamp))
        assert node.loop._ledger.age == age
        if age:
            node.timers[0.5]()
    node.subscribed["/joints"](joint_state([np.nan], [0.25], time.time_ns()))
    assert "Observation dropped" in node.logged[0] and "finite" in node.logged[0]
    node.subscribed["/joints"](joint_state([0.5], [0.25], time.time_ns() + 60_000_000_000))
    assert "taken as 0" in node.logged[1] and node.captured <= time.monotonic() and node.loop._ledger.age == 0
    node.subscribed["/joints"](joint_state([0.75], [0.25], 0))
    assert "no stamp" in node.logged[2] and node.loop._ledger.observation[0] == 0.5
    node.timers[1.0]()
    assert "steps 3" in node.published["~/heartbeat"][0] and "stale 2" in node.published["~/heartbeat"][0]
    node.stop()


def test_the_ros_node_sends_nothing_to_a_robot_without_stamps(ros: Any) -> None:
    node = ros.ControlNode()
    node.subscribed["/joints"](joint_state([0.5], [0.25], 0))
    node.timers[0.5]()
    assert node.published["/arm"] == [] and "no stamp" in node.logged[0]
    node.stop()


@pytest.mark.parametrize("end", ["SIGTERM", "Ctrl-C", "error"])
def test_the_ros_node_ends_with_the_safe_action(end: str, ros: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = []

    def spin(node: Any) -> None:
        nodes.append(node)
        node.timers[0.5]()  # sends nothing yet
        assert node.published["/arm"] == []
        node.subscribed["/joints"](joint_state([np.nan], [0.0], time.time_ns()))
        node.timers[0.5]()  # the robot speaks, if nonsense
        if end == "SIGTERM":
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(60)
        raise KeyboardInterrupt if end == "Ctrl-C" else RuntimeError("spin")

    monkeypatch.setattr(ros.rclpy, "spin", spin)
    if end == "Ctrl-C":
        ros.main()
    else:
        with pytest.raises(SystemExit if end == "SIGTERM" else RuntimeError):
            ros.main()
    (node,) = nodes
    assert node.published["/arm"] == [[-1.0], [-1.0]] and node.is_destroyed and node.model.is_closed
    with pytest.raises(RuntimeError, match="closed"):
        node.loop.act()


class Port:
    """A robot at the other end of a serial port, which executes each command when it comes."""

    opened: list[Port] = []

    def __init__(self, device: str, baud: int, timeout: float, write_timeout: float):
        assert min(timeout, write_timeout) > 0
        self.device, self.commands, self.is_open = device, [], True
        self.lines: queue.Queue[bytes] = queue.Queue()
        for line in (b"", b"gar bage\n", b"", b"0 1.0 0.", b"", b"25\n"):  # silent for a while, once in a line
            self.lines.put(line)
        self.opened.append(self)

    def __enter__(self) -> Port:
        return self

    def __exit__(self, *_: object) -> None:
        self.is_open = False
        self.lines.put(b"")

    def readline(self) -> bytes:
        return self.lines.get()

    def write(self, line: bytes) -> None:
        number, action = line.split()
        self.commands.append((int(number), float(action)))
        if len(self.commands) == 20:
            raise KeyboardInterrupt
        self.lines.put(b"%d %f 0.5\n" % (int(number), 0.1 * int(number)))


def test_the_serial_robot(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    example = load("serial_robot", monkeypatch, module("serial", Serial=Port))
    assert len((EXAMPLES / "serial_robot.py").read_text().splitlines()) <= 40
    observed, observe = [], ControlLoop.observe

    def noting(loop: ControlLoop, state: list[float], n_executed: int) -> None:
        observed.append((n_executed, state))
        observe(loop, state, n_executed=n_executed)

    monkeypatch.setattr(ControlLoop, "observe", noting)
    with pytest.raises(KeyboardInterrupt):
        example.main("agent.zip", "/dev/robot", 0.01)
    (port,) = Port.opened
    assert port.device == "/dev/robot" and [number for number, _ in port.commands] == [*range(1, 21), 21]
    assert port.commands[-1] == (21, 0.0) and len({action for _, action in port.commands}) > 1
    assert observed[0] == (0, [1.0, 0.25])
    shown = capsys.readouterr()
    assert "steps 20" in shown.out and "b'bage'" in shown.err and "unpack" not in shown.err  # silence
    listener = next((thread for thread in threading.enumerate() if "listen" in thread.name), None)
    if listener is not None:
        listener.join(30)
        assert not listener.is_alive()


class Interface:
    """An interface as rtgym documents it, in front of a small task."""

    def __init__(self) -> None:
        self.task, self.sent = Drift(length=8), []

    def reset(self, seed: Any = None, options: Any = None) -> Any:
        state, info = self.task.reset(seed=0)
        self.answer = (list(state[:, None]), 0.0, False, {})
        return self.answer[0], info

    def send_control(self, control: Any) -> None:
        self.sent.append(control)
        state, reward, terminated, truncated, info = self.task.step(control)
        self.answer = list(state[:, None]), reward, terminated or truncated, info

    def get_obs_rew_terminated_info(self) -> Any:
        return self.answer

    def get_default_action(self) -> Any:
        return np.zeros(1, np.float32)


@pytest.mark.parametrize(("n_steps", "total"), [(100, 8), (5, 5)])
def test_an_rtgym_interface_is_played(n_steps: int, total: int, monkeypatch: pytest.MonkeyPatch) -> None:
    example = load("rtgym_task", monkeypatch)
    interface, model = Interface(), Model()
    with ControlLoop(model, 0.01) as loop:
        model.asked.clear()
        assert example.play(interface, loop, n_steps) == total
    assert len(interface.sent) == total + 1 and interface.sent[-1] == 0
    np.testing.assert_array_equal(model.asked[0]["observation"], Drift().reset(seed=0)[0])
    assert loop.statistics().waiting_steps == 0
