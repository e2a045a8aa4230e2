"""A ROS 2 node that controls joints with an agent:

    python ros2_node.py --ros-args -p agent:=agent.zip -p period:=0.02 -p action_topic:=/arm_controller/commands

It subscribes to ``sensor_msgs/JointState`` and observes [positions, velocities] in the order of the message. It
publishes ``std_msgs/Float64MultiArray``, as the forward_command_controller of ros2_control takes it. Every second it
publishes what its loop has counted; a watchdog should stop the robot where this heartbeat ends. On SIGTERM, Ctrl-C and
errors it publishes the safe action.
"""

from __future__ import annotations

import signal
import sys
import time
from functools import partial
from typing import Any

import numpy as np
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String

from sb3_said import SAID
from sb3_said.realtime import ControlLoop, ModelProcess

EVERY_SECOND = {"throttle_duration_sec": 1.0}  # a message is logged at most once a second


class ControlNode(Node):
    """Feeds a control loop from one topic, and publishes its actions to another."""

    def __init__(self) -> None:
        super().__init__("sb3_said")
        period = self.parameter("period", 0.02)
        self.model = ModelProcess(partial(SAID.load, self.parameter("agent", "agent.zip"), device="cpu"))
        self.loop = ControlLoop(
            self.model,
            period,
            action_delay=self.parameter("action_delay", 0.0),  # seconds from publishing to effect
            hold_steps=self.parameter("hold_steps", 5),
            safe_action=self.parameter("safe_action", [0.0] * self.model.action_space.shape[0]),
            safe_steps=self.parameter("safe_steps", 100),
        )
        self.stamp, self.captured = None, 0.0
        self.actions = self.create_publisher(Float64MultiArray, self.parameter("action_topic", "/commands"), 1)
        self.heartbeat = self.create_publisher(String, "~/heartbeat", 1)
        self.create_subscription(JointState, self.parameter("observation_topic", "/joint_states"), self.observe, 1)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # a clock that nobody sets
        self.create_timer(period, self.act, clock=steady)
        self.create_timer(1.0, self.beat, clock=steady)

    def parameter(self, name: str, default: Any) -> Any:
        return self.declare_parameter(name, default).value

    def observe(self, message: JointState) -> None:
        """Tell the loop when the message was captured, on the loop's clock. A frozen sensor keeps its stamp."""
        stamp, log = Time.from_msg(message.header.stamp).nanoseconds, self.get_logger()
        if stamp == 0:
            log.error("Observation dropped: it has no stamp; set header.stamp where it is captured", **EVERY_SECOND)
            return
        if stamp != self.stamp:
            age = 1e-9 * (self.get_clock().now().nanoseconds - stamp)
            if age < 0:
                log.warning(f"Observation of the age {age:.6f} s, taken as 0: synchronise the clocks", **EVERY_SECOND)
            self.stamp, self.captured = stamp, time.monotonic() - max(age, 0.0)
        try:
            self.loop.observe([*message.position, *message.velocity], self.captured)
        except ValueError as error:
            log.error(f"Observation dropped: {error}", **EVERY_SECOND)

    def act(self) -> None:
        if self.stamp is not None:  # until the robot speaks, nothing is sent
            self.publish(self.loop.act())

    def beat(self) -> None:
        self.heartbeat.publish(String(data=str(self.loop.statistics())))

    def publish(self, action: np.ndarray) -> None:
        self.actions.publish(Float64MultiArray(data=[float(x) for x in action]))

    def stop(self) -> None:
        """Leave the robot with the safe action."""
        self.publish(self.loop.safe_action)
        self.get_logger().info(str(self.loop.statistics()))
        self.loop.close()
        self.model.close()


def main() -> None:
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # rclpy's own would close the publishers first
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    node = ControlNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.stop()
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
