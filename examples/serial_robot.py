"""A robot on a serial port: python serial_robot.py agent.zip /dev/ttyACM0 0.02

In each control step the robot reads its sensors and sends a line "N x1 x2 ...": the number of the command executed in
the step before, and its state. Then it executes the newest "N a1 a2 ..." received. N counts from the port's opening."""

import sys
import threading
from functools import partial

import serial  # pip install pyserial

from sb3_said import SAID
from sb3_said.realtime import ControlLoop, ModelProcess, ticks


def listen(port, loop, line=b""):
    while port.is_open:
        try:
            line += port.readline()  # part of a line if the robot is silent for a second
            if line.endswith(b"\n"):
                (number, *state), line = line.split(), b""
                loop.observe([float(x) for x in state], n_executed=int(number))
        except (ValueError, TypeError) as error:  # a disturbed line, a sensor that fails, or the port is being closed
            print(f"Nothing observed: {error}", file=sys.stderr)


def main(agent, device, period):
    with ModelProcess(partial(SAID.load, agent, device="cpu")) as model, ControlLoop(model, period) as loop:
        with serial.Serial(device, 115200, timeout=1, write_timeout=1) as port:
            threading.Thread(target=listen, args=(port, loop), daemon=True).start()
            try:
                for _ in ticks(period):
                    port.write(f"{loop.n_sent + 1} {' '.join(map(str, loop.act()))}\n".encode())
            finally:  # Ctrl-C, or no answer for too long
                port.write(f"{loop.n_sent + 1} {' '.join(map(str, loop.safe_action))}\n".encode())
                print(loop.statistics())


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
