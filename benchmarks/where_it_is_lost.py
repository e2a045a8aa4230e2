"""Where is a planner's return lost under delay? One part of its decision at a time is replaced by the truth.

    python benchmarks/where_it_is_lost.py RUN --dataset medium.npz --actor BC_RUN --delays 4 8 --json lost.json

RUN is a SAID agent that learned from the dataset, at delays up to the largest of --delays.

SAID                     as it is: if its present is inpainted, present and decision are decoded together
decoded present, age 0   the planner again, asked without delay on the present that it decoded
true present, age 0      the same on the true present: what is still lost is not lost to the delay
true states since        all states up to the present are told (needs a planner with extra_state_probability)
data, decoded present    the action that the data has at the state nearest to the decoded present
data, true present       the same at the true present
actor, decoded present   --actor, a policy without delay
actor, true present      the same
actor, present off by x  the same, with noise of x standard deviations on every entry: what an error of that size costs
2 held, 4 held           SAID's plan, executed for so many steps before it plans anew

Beside each return stand, over all steps played, the error of the decoded present and the distance of the task's state
to the nearest state of the data. Both are root mean squares over the entries of a state, in standard deviations of the
data. The last row, "data", is the distance of the data's own states to those of other trajectories. Large distances
tell that the agent has left what the planner knows; large errors, that the planner does not know where the task is.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from measure import print_table, progress, resumed
from motivation import OldObservation, load_agent
from what_diffusion_buys import make_env

from sb3_said import SAID
from sb3_said.delays.space import KEYS, UNDELAYED
from sb3_said.evaluation import confidence_interval, rollout
from sb3_said.files.atomic import write_json
from sb3_said.offline import Dataset, load_dataset
from sb3_said.offline.belief import BeliefOnly
from sb3_said.replay.windows import mean_and_deviation
from sb3_said.zoo.arguments import explained
from sb3_said.zoo.runs import origin

PRESENTS = "presents"  # key of the true states s_{t-D..t}
HELD = (2, 4)
OFF_BY = (0.05, 0.1, 0.2, 0.4)  # standard deviations of the data


class ShowPresents(gym.Wrapper[Any, Any, Any, Any]):
    """Adds the true states s_{t-D..t}, (D + 1, obs_dim), to the observations; s_0 stands for states before it."""

    def _add(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {**observation, PRESENTS: np.array(self.states, np.float32)}

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(**kwargs)
        self.states = [info[UNDELAYED]] * (len(observation["action_history"]) + 1)
        return self._add(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.states = [*self.states[1:], info[UNDELAYED]]
        return self._add(observation), reward, terminated, truncated, info


class Neighbours:
    """The states of a dataset, to find the nearest of them; distances in standard deviations of their entries."""

    def __init__(self, data: Dataset):
        states = th.as_tensor(data.states)
        self.scale = mean_and_deviation(states)[1]
        self.states, self.actions = states / self.scale, th.as_tensor(data.actions)
        self.squares = (self.states**2).sum(1)
        self.trajectory = th.as_tensor(np.repeat(np.arange(len(data.lengths)), data.lengths))

    def nearest(self, states: th.Tensor, but: th.Tensor | None = None) -> tuple[th.Tensor, th.Tensor]:
        """Return the distance to the nearest state, root mean square over entries, and its row: (B,) each.

        :param states: (B, obs_dim)
        :param but: (B,) a trajectory for each state, which is not searched
        """
        z = states / self.scale
        squares = self.squares - 2 * z @ self.states.T  # (B, M), less the squares of z
        if but is not None:
            squares[but[:, None] == self.trajectory] = th.inf
        least, row = squares.min(1)
        return ((least + (z**2).sum(1)).clamp(min=0) / z.shape[1]).sqrt(), row


class Step:
    """What is known at one step of B episodes, and what the planner makes of it."""

    def __init__(self, said: SAID, observation: dict[str, np.ndarray]):
        self.planner = said.policy.planner
        self.state, self.history, delay, self.truth = (th.as_tensor(observation[key]) for key in (*KEYS, PRESENTS))
        self.delay = delay[:, 0].long()

    @property
    def true(self) -> th.Tensor:
        return self.truth[:, -1]

    @cached_property
    def plan(self) -> Any:
        return self.planner.plan(self.state, self.history, self.delay, temperature=0.0)

    def at_age_0(self, present: th.Tensor) -> th.Tensor:
        nothing_since = th.zeros_like(self.history), th.zeros_like(self.delay)
        return self.planner.plan(present, *nothing_since, temperature=0.0).action

    def told(self) -> th.Tensor:
        known = th.ones(self.truth.shape[0], self.truth.shape[1] - 1)
        extra = {"state_history": self.truth[:, 1:], "state_known": known}
        return self.planner.plan(self.state, self.history, self.delay, temperature=0.0, **extra).action


Decide = Callable[[Step], th.Tensor]


class Player:
    """Decides by a function of what is known, and keeps count of errors and distances.

    :param decide: returns actions in [-1, 1], (B, act_dim)
    """

    def __init__(self, said: SAID, decide: Decide, data: Neighbours):
        self.said, self.decide, self.data = said, decide, data
        self.errors: list[th.Tensor] = []
        self.distances: list[th.Tensor] = []

    @th.no_grad()
    def predict(self, observation: dict[str, np.ndarray], state: Any = None, **_: Any) -> tuple[np.ndarray, Any]:
        step = Step(self.said, observation)
        self.errors.append((((step.plan.present - step.true) / self.data.scale) ** 2).mean(1))
        self.distances.append(self.data.nearest(step.true)[0] ** 2)
        return self.said.policy.unscale_action(self.decide(step).numpy()), state

    def found(self, returns: np.ndarray) -> dict[str, Any]:
        roots = {
            name: float(th.cat(squares).mean().sqrt())
            for name, squares in (("present_error", self.errors), ("distance", self.distances))
        }
        return {"returns": returns.tolist(), **roots}


class Held(Player):
    """Executes ``n_held`` actions of a plan before it plans anew; all its episodes begin together."""

    def __init__(self, said: SAID, n_held: int, data: Neighbours):
        super().__init__(said, self.next_action, data)
        self.n_held, self.left = n_held, [th.empty(0)]

    @th.no_grad()
    def predict(self, observation: dict[str, np.ndarray], state: Any = None, **_: Any) -> tuple[np.ndarray, Any]:
        if len(self.left[0]) != len(observation["observation"]):  # an episode has ended
            self.left = [th.empty(0)]
        return super().predict(observation, state)

    def next_action(self, step: Step) -> th.Tensor:
        if len(self.left[0]) == 0:
            of_plan = step.delay[:, None] + th.arange(self.n_held)  # (B, n)
            actions = step.plan.actions[:, 0]  # (B, L, act_dim)
            self.left = list(actions[th.arange(len(actions))[:, None], of_plan].unbind(1))
        now, self.left = self.left[0], [*self.left[1:], th.empty(0)]
        return now


def players(said: SAID, data: Neighbours, actor: Any) -> dict[str, Player]:
    """Return the players by name."""

    def acts(present: th.Tensor) -> th.Tensor:
        n, parts = len(present), (present.numpy(), np.zeros((len(present), 0, data.actions.shape[1])))
        now = dict(zip(KEYS, (*parts, np.zeros((n, 1))), strict=True))
        action = BeliefOnly(OldObservation(0), actor).predict(now, deterministic=True)[0]
        return th.as_tensor(actor.policy.scale_action(action))

    decide: dict[str, Decide] = {
        "SAID": lambda step: step.plan.action,
        "decoded present, age 0": lambda step: step.at_age_0(step.plan.present),
        "true present, age 0": lambda step: step.at_age_0(step.true),
        "data, decoded present": lambda step: data.actions[data.nearest(step.plan.present)[1]],
        "data, true present": lambda step: data.actions[data.nearest(step.true)[1]],
    }
    if said.policy.planner.config.extra_state_probability > 0:
        decide["true states since"] = Step.told
    if actor is not None:
        decide["actor, decoded present"] = lambda step: acts(step.plan.present)
        decide["actor, true present"] = lambda step: acts(step.true)
        for x in OFF_BY:
            decide[f"actor, present off by {x}"] = lambda step, x=x: acts(
                step.true + x * data.scale * th.randn_like(step.true)
            )
    made = {name: Player(said, how, data) for name, how in decide.items()}
    return made | {f"{n} held": Held(said, n, data) for n in HELD}


def main(argv: list[str] | None = None) -> dict[str, Any]:
    """Play, print, write, and return the numbers."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("run", type=Path, metavar="RUN")
    p.add_argument("--dataset", nargs="+", required=True, help="what it learned from: ids of Minari datasets, or files")
    p.add_argument("--actor", help="run folder or .zip of an agent of the task without delay")
    p.add_argument("--delays", type=int, nargs="+", default=[4, 8])
    p.add_argument("--episodes", type=int, default=10, help="of each row and delay, side by side")
    p.add_argument("--eval-seed", type=int, default=10_000, help="reset seed of the first episode")
    p.add_argument("--seed", type=int, default=0, help="of noise, and of states that are compared")
    p.add_argument("--num-threads", type=int, default=1)
    p.add_argument("--json", type=Path, required=True, help="file of the numbers, read and written")
    args = p.parse_args(argv)
    th.set_num_threads(args.num_threads)
    with explained(p):
        run = load_agent(args.run)
        actor = None if args.actor is None else load_agent(args.actor).model
    said: Any = run.model
    if not isinstance(said, SAID):
        p.error(f"{args.run} is a {type(said).__name__}; give a SAID agent.")
    settings: dict[str, Any] = {"run": str(args.run), "trained_steps": said.num_timesteps}
    settings |= {name: getattr(args, name) for name in ("dataset", "actor", "episodes", "eval_seed", "seed")}
    document = resumed(p, args.json, settings, delays={})
    task = gym.make(said.task or "")
    with explained(p):
        data = load_dataset(args.dataset, task.observation_space, task.action_space, said.task, progress_bar=True)
    neighbours = Neighbours(data)

    def task_of(delay: int) -> gym.Env[Any, Any]:
        return ShowPresents(make_env(said, delay))

    for delay in args.delays:
        rows = document["delays"].setdefault(str(delay), {})
        for name, player in players(said, neighbours, actor).items():
            if name not in rows:
                th.manual_seed(args.seed)
                progress(f"{name} plays {args.episodes} episodes at delay {delay}")
                played = rollout(player, partial(task_of, delay), args.episodes, args.eval_seed, args.episodes)
                rows[name] = player.found(played.returns)
                document["origin"] = origin(run)
                write_json(args.json, document)
    drawn = th.as_tensor(np.random.default_rng(args.seed).choice(len(data), min(2_000, len(data)), replace=False))
    parts = [
        neighbours.nearest(neighbours.states[i] * neighbours.scale, neighbours.trajectory[i]) for i in drawn.split(50)
    ]
    document["data_distance"] = float((th.cat([part[0] for part in parts]) ** 2).mean().sqrt())
    write_json(args.json, document)
    show(document)
    return document


def show(document: dict[str, Any]) -> None:
    """Print a Markdown table for each delay."""
    for delay, rows in document["delays"].items():
        cells = [
            (name, str(confidence_interval(row["returns"])), f"{row['present_error']:.3f}", f"{row['distance']:.3f}")
            for name, row in rows.items()
        ]
        cells.append(("data", "", "", f"{document['data_distance']:.3f}"))
        header = (f"delay {delay}", "return", "error of the present", "distance to the data")
        print()
        print_table([dict(zip(header, row, strict=True)) for row in cells])


if __name__ == "__main__":
    main()
