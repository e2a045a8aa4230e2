"""Watch a trained agent, in a window or as a video."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from sb3_said.files.atomic import check_writable
from sb3_said.sac import DelayedSAC
from sb3_said.zoo.arguments import TRUST, add_run, check_positive, explained, make_parser, read_delay
from sb3_said.zoo.runs import ANSWERS, LoadedRun, answering, load_run, longest_delay

EPILOG = f"""\
examples:
  # three episodes in a window
  sb3-said enjoy logs/said/Hopper-v5-delay4-seed1_1 --episodes 3

  # a video at real speed, on a machine without a display
  sb3-said enjoy logs/said/Hopper-v5-delay4-seed1_1 --record hopper.mp4

  # left the same agent told that every observation is new, right as it is: what ignoring the delay costs
  sb3-said enjoy agents/hopper.zip --delay 8 --beside-ignorant --size 240 --record hopper.gif --fps 12

  # the expert from the same starts, as a GIF
  sb3-said enjoy logs/said/Hopper-v5-delay4-seed1_1 --answer expert --record hopper_expert.gif

Videos need the extra sb3_said[video]. Without a display, MuJoCo draws through EGL; MUJOCO_GL=osmesa draws in software.
{TRUST}
"""


class CannotDraw(ImportError):
    """The task cannot be drawn on this machine.

    :param cause: what the graphics library said; MuJoCo's and pygame's backends each fail in their own way
    """

    def __init__(self, cause: Exception):
        super().__init__(
            f"The task could not be drawn (MUJOCO_GL={os.environ.get('MUJOCO_GL', 'unset')}): {cause!r}\n"
            "MuJoCo needs a GL library; on Debian or Ubuntu: apt-get install libegl1 libgl1-mesa-dri and "
            "MUJOCO_GL=egl, or apt-get install libosmesa6 and MUJOCO_GL=osmesa. Other tasks may need pygame."
        )


class Video:
    """Writes a task to an mp4 or a GIF that plays in real time: steps between its frames are left out.

    :param path: ending in .mp4 or .gif
    :param fps: frames a second, at most one for each control step
    """

    def __init__(self, path: Path, fps: int):
        self.path = path
        self.fps: float = fps
        self.frames = 0
        self._steps = 0
        self._writer: Any = None

    def on_step(self, env: gym.Env[Any, Any]) -> None:
        """Take a frame, if one is due.

        :raises CannotDraw: without a working graphics library
        :raises ValueError: where the task draws no frames, by its metadata or by what it returns
        """
        rate = env.metadata.get("render_fps") or self.fps  # control steps a second
        self.fps = min(self.fps, rate)
        if self.path.suffix == ".gif":  # a GIF counts in hundredths of a second
            self.fps = 100 / math.ceil(100 / self.fps - 1e-9)
        due = self._steps * self.fps / rate + 1e-9
        self._steps += 1
        if due < self.frames:
            return
        if self.frames == 0:
            if "rgb_array" not in (modes := env.metadata.get("render_modes", ["rgb_array"])):
                raise ValueError(f"'rgb_array' is none of the render_modes in the task's metadata: {modes}.")
            follow(env)
        try:
            frame: Any = env.render()
        except Exception as error:
            if isinstance(error, (ImportError, OSError)) or hasattr(getattr(env, "unwrapped", None), "mujoco_renderer"):
                raise CannotDraw(error) from error
            raise  # a fault of the task's own
        if np.ndim(frame) != 3:
            raise ValueError(
                f"render() of the task returned {type(frame).__name__}, expected a frame, (height, width, 3) of uint8."
            )
        self.append(frame)

    def append(self, frame: np.ndarray) -> None:
        """Write a frame, (height, width, 3) of uint8."""
        if self._writer is None:
            self._open()
        self._writer.append_data(frame)
        self.frames += 1

    def _open(self) -> None:
        import imageio

        self.path.parent.mkdir(parents=True, exist_ok=True)
        is_gif = self.path.suffix == ".gif"
        how = {"mode": "I", "duration": 1000 / self.fps, "loop": 0} if is_gif else {"fps": self.fps}
        self._writer = imageio.get_writer(self.path, **how)

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()


class SideBySide(Video):
    """A video of pairs of plays from one start, the first on the left. The shorter one keeps its last frame, darker."""

    def __init__(self, path: Path, fps: int):
        super().__init__(path, fps)
        self._plays: list[list[np.ndarray]] = []
        self._n_written = 0

    def begin(self) -> None:
        """Begin the next play: the steps that follow belong to it."""
        if len(self._plays) == 2:
            self._write()
        self._plays.append([])
        self.frames = self._steps = 0

    def append(self, frame: np.ndarray) -> None:
        self._plays[-1].append(frame)
        self.frames += 1

    def _write(self) -> None:
        """Write the pair that is held."""
        length = max((len(frames) for frames in self._plays), default=0)
        padded = [frames + [frames[-1] // 2] * (length - len(frames)) for frames in self._plays if frames]
        for pair in zip(*padded, strict=True):
            super().append(np.concatenate(pair, axis=1))
        self._n_written += length
        self._plays = []

    def close(self) -> None:
        is_pair = len(self._plays) == 2 and all(self._plays)
        if is_pair or not self._n_written:  # a play without its pair has another size than pairs
            self._write()
        self.frames = self._n_written
        super().close()


def follow(env: gym.Env[Any, Any]) -> None:
    """Use a MuJoCo task's own tracking camera: the default one stays behind while the robot runs away."""
    renderer = getattr(getattr(env, "unwrapped", None), "mujoco_renderer", None)
    if renderer is not None and renderer.camera_id in (None, -1):
        import mujoco

        renderer.camera_id = mujoco.mj_name2id(renderer.model, mujoco.mjtObj.mjOBJ_CAMERA, "track")  # -1: has none


def check_can_record(path: Path) -> None:
    """Fail before an agent is loaded, and say what to install.

    :raises ValueError: for a file that is no video, and for a folder
    :raises OSError: where the file cannot be written
    :raises ImportError: without imageio
    """
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"--record takes a file ending in .mp4 or .gif, got {path}.")
    if any(find_spec(package) is None for package in ("imageio", "imageio_ffmpeg")):
        raise ImportError('Videos need imageio and imageio-ffmpeg: pip install "sb3_said[video]"')
    check_writable(path)


@contextmanager
def naming_libraries() -> Iterator[None]:
    """Say what to install if a task of MuJoCo cannot be made because the library that MUJOCO_GL names is missing."""
    try:
        yield
    except (ImportError, AttributeError, OSError) as error:
        try:
            import_module("mujoco")  # loads that library
        except Exception as cause:
            raise CannotDraw(cause) from error
        raise


def main(argv: list[str] | None = None) -> None:
    parser = make_parser(__doc__, EPILOG)
    add_run(parser, episodes=1)
    parser.add_argument("--record", type=Path, metavar="FILE", help="write a video (.mp4 or .gif) instead of a window")
    parser.add_argument("--fps", type=int, default=25, help="frames a second, at most one a step (default: 25)")
    parser.add_argument("--answer", choices=ANSWERS, help="who acts in a SAID agent (default: as it was saved)")
    parser.add_argument("--size", type=int, metavar="PIXELS", help="height and width of the picture, of MuJoCo tasks")
    parser.add_argument("--beside-ignorant", action="store_true", help="show, on the left, the same agent told that "
                        "every observation is new (with --record)")  # fmt: skip
    args = parser.parse_args(argv)
    displays = [name for name in ("DISPLAY", "WAYLAND_DISPLAY") if os.environ.get(name)]
    if sys.platform.startswith("linux") and not displays:
        if args.record is None:
            parser.error("there is no display here to open a window on: give --record FILE.mp4")
        os.environ.setdefault("MUJOCO_GL", "egl")
    with explained(parser):
        check_positive(args, "episodes", "fps", "num_threads", "size")
        th.set_num_threads(args.num_threads)
        video = None
        if args.record is not None:
            check_can_record(args.record)
            video = (SideBySide if args.beside_ignorant else Video)(args.record, args.fps)
        elif args.beside_ignorant:
            raise ValueError("--beside-ignorant makes a video of two plays: give --record FILE.gif, too.")
        drawn: dict[str, Any] = {"render_mode": "rgb_array" if video else "human"}
        if args.size is not None:
            drawn |= {"width": args.size, "height": args.size}
        played = {"algo": args.algo, "env_id": args.env, "delay": read_delay(args.delay), "device": args.device}
        with naming_libraries() if video else nullcontext():
            run = load_run(args.run, env_kwargs=drawn, gym_packages=args.gym_packages, answer=args.answer, **played)
        if args.beside_ignorant and not longest_delay(run.model):
            raise ValueError(f"--beside-ignorant needs an agent that is told an age; {args.run} knows no delay.")
        with answering(run.model, args.answer), closing(video) if video else nullcontext():
            if args.beside_ignorant and isinstance(run.model, DelayedSAC):
                run.model.check_ages([0])  # the age that it is told
            if not isinstance(video, SideBySide):
                show(run, args, video, args.seed, args.episodes)
            else:
                for seed in range(args.seed, args.seed + args.episodes):
                    for age_error in (-(longest_delay(run.model) or 0), 0):
                        video.begin()
                        show(run, args, video, seed, 1, age_error)
    if video:
        print(f"Wrote {args.record}: {video.frames} frames at {video.fps:g} a second")


def show(
    run: LoadedRun, args: argparse.Namespace, video: Video | None, seed: int, n_episodes: int, age_error: int = 0
) -> None:
    """Play episodes and print how each ended.

    :param seed: of the first one's reset
    :param age_error: control steps by which the age is told wrong
    """
    told = ", told that every observation is new" if age_error else ""
    run.play(
        n_episodes,
        seed,
        age_error=age_error,
        deterministic=not args.stochastic,
        on_step=video.on_step if video else None,
        on_episode=lambda i, ret, n: print(f"seed {seed + i}{told}: return {ret:,.1f} in {n} steps"),
    )
