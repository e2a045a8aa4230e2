"""Load hostile variants in this process, which is to run nothing else, and say what each did.

All 2,000, in two minutes: ``PYTHONPATH=.:tests/support python tests/support/hostile_run.py``. With ``10`` every tenth,
with ``0 734`` number 734 alone. Each must load as the same agent or raise ``SavedFileError``,
within 5 s and 1 GB, and run no code, open no file and set no attribute. A sealed one may be another agent, since
whoever writes a file decides what it holds; its answers are finite or refused.
"""

import contextlib
import io
import json
import re
import resource
import signal
import sys
import time
import warnings
from collections import Counter

import numpy as np
import torch as th
from hostile_files import N_VARIANTS, variant
from saving import same
from small_agent import make, observe
from small_task import delayed
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

from sb3_said import SAID, DelayedSAC
from sb3_said.files.archive import SavedFileError, save_tree
from sb3_said.files.checkpoint import restore_training, training_state
from sb3_said.files.random_states import random_state, restore_random_state
from sb3_said.said.policies import SAIDPolicy

SECONDS, BYTES = 5.0, 2**30
HARMFUL = ("exec", "open", "import", "os.", "subprocess.", "pickle.", "socket.", "ctypes.", "shutil.")
WATCHED = {base for cls in (SAID, SAIDPolicy, th.nn.Parameter, th.optim.Adam, EvalCallback) for base in cls.__mro__}


class Slow(BaseException):
    """Not an Exception, which loading would turn into its own error."""


class Cases:
    """The saved files, how each is loaded, and what it answers."""

    def __init__(self):
        small = {"policy_kwargs": {"net_arch": [8]}, "buffer_size": 60}
        noise = NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))
        sac = make(cls=DelayedSAC, learning_rate=LinearSchedule(1e-3, 1e-4, 1.0), action_noise=noise, **small).learn(40)
        said = make(planner_kwargs={"n_candidates": 3}, **small).learn(40)
        self.empty = make(cls=DelayedSAC, **small)
        self.resumed, self.callback = self.run()
        self.resumed.learn(40, self.callback)
        self.random = random_state()
        self.observations = observe(3)
        self.files = {}
        for name, save in {
            "agent": sac.save,
            "SAID": said.save,
            "policy": said.policy.save,
            "replay": sac.save_replay_buffer,
            "checkpoint": lambda file: save_tree(file, training_state(self.resumed, self.callback)),
        }.items():
            save(file := io.BytesIO())
            self.files[name] = file.getvalue()

    def run(self):
        env = VecNormalize(make_vec_env(delayed), norm_obs_keys=["observation"])
        model = make(env, DelayedSAC, policy_kwargs={"net_arch": [8]}, buffer_size=60)
        evaluation = VecNormalize(make_vec_env(delayed), norm_obs_keys=["observation"], training=False)
        return model, EvalCallback(evaluation, n_eval_episodes=1, eval_freq=20, verbose=0)

    def load(self, name, content):
        file = io.BytesIO(content)
        if name == "agent":
            return DelayedSAC.load(file, device="cpu")
        if name == "SAID":
            return SAID.load(file, device="cpu")
        if name == "policy":
            return SAIDPolicy.load(file, device="cpu")
        if name == "replay":
            self.empty.load_replay_buffer(file)
            return self.empty
        restore_training(self.resumed, file, self.callback)
        return self.resumed

    def answers(self, name, loaded):
        """Return what the variant decides, and draw on all of it: finite numbers or a ValueError."""
        if name == "replay":
            return loaded.replay_buffer.state_dict(), draws(loaded)
        if name == "checkpoint":
            after = random_state()
            drawn = [np.random.normal(size=3), th.randn(3), th.randn(3, dtype=th.float64), draws(loaded)]
            return {**training_state(loaded, self.callback), "random": after}, drawn
        actions = [loaded.predict(self.observations, deterministic=True)[0]]
        if hasattr(policy := getattr(loaded, "policy", loaded), "answering"):
            with policy.answering("expert"):
                actions.append(loaded.predict(self.observations, deterministic=True)[0])
        rates = [loaded.lr_schedule(x) for x in (1, 0.5, 0)] if hasattr(loaded, "learning_rate") else []
        return actions, [*actions, np.array(rates)]


def draws(model):
    np.random.seed(0)
    batch = model.replay_buffer.sample(8)
    return [*batch.observations.values(), *batch.next_observations.values(), batch.actions, batch.rewards, batch.dones]


def is_finite(tree):
    if isinstance(tree, (list, tuple)):
        return all(map(is_finite, tree))
    return bool(np.isfinite(np.asarray(tree)).all())


def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


class Watch:
    """What happens while it listens: harmful events, time, and the changes that stay."""

    def __init__(self):
        self.before = {cls: dict(vars(cls)) for cls in WATCHED}
        self.events, self.listens = [], False
        sys.addaudithook(self.hear)
        signal.signal(signal.SIGALRM, self.ring)

    def hear(self, event, arguments):
        if self.listens and event.startswith(HARMFUL):
            self.events.append(f"{event} {arguments!s:.60}")

    def ring(self, *_):
        raise Slow

    @contextlib.contextmanager
    def listening(self):
        self.events.clear()
        self.peak, start = peak(), time.perf_counter()
        signal.setitimer(signal.ITIMER_REAL, 4 * SECONDS)
        self.listens = True
        try:
            yield
        finally:
            self.listens = False
            signal.setitimer(signal.ITIMER_REAL, 0)
            self.seconds, self.grown = time.perf_counter() - start, peak() - self.peak

    def fault(self):
        if self.events:
            return f"ran {self.events[:3]}"
        if changed := [cls.__name__ for cls in WATCHED if dict(vars(cls)) != self.before[cls]]:
            return f"changed the classes {changed}"
        if self.seconds > SECONDS or self.grown > BYTES:
            return f"{self.seconds:.1f} s, {self.grown / 2**20:.0f} MiB"
        return ""


def judge(cases, honest, watch, name, sealed, content):
    """Load one variant, and return what came of it and what is wrong with that, or nothing."""
    try:
        with watch.listening():
            loaded = cases.load(name, content)
    except SavedFileError as error:
        says = "Cannot load" in str(error) and len(str(error)) < 2000
        return "refused", "" if says else f"an error that says little or too much: {error!s:.80}"
    except (Exception, Slow) as error:
        return "failed", f"{type(error).__name__}: {error!s:.200}"
    decided, attributes = honest[name]
    if set(vars(loaded)) != attributes:
        return "set", f"attributes {set(vars(loaded)) ^ attributes}"
    try:
        now, drawn = cases.answers(name, loaded)
    except ValueError as error:
        is_said = sealed and re.search("(answer|returned) NaN|invalid values", str(error))
        return "answer refused", "" if is_said else f"ValueError: {error!s:.200}"
    if not is_finite(drawn):
        return "answered", "what is not finite"
    if same(now, decided):
        return "the same", ""
    return "another", "" if sealed else "another agent"


def limit_memory():
    """Let a claim that slips through end this process, and not the machine."""
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as statm:
        base = int(statm.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (base + 4 * BYTES, hard))


def main(step=1, first=0):
    th.set_num_threads(1)
    warnings.simplefilter("ignore")
    cases, honest = Cases(), {}
    for name in [*cases.files] * 2:  # twice: what is imported late is imported
        loaded = cases.load(name, cases.files[name])
        honest[name] = cases.answers(name, loaded)[0], set(vars(loaded))
    str(th.zeros(1))  # imports modules
    watch, outcomes, failures, longest = Watch(), Counter(), [], 0.0
    limit_memory()
    for index in range(first, N_VARIANTS if step else first + 1, step or 1):
        name, sealed, what, content = variant(cases.files, index)
        kind = "sealed" if sealed else "damaged"
        print(f"\r{index}", end="", file=sys.stderr, flush=True)  # the last words of a process that crashes
        restore_random_state(cases.random)
        outcome, fault = judge(cases, honest, watch, name, sealed, content)
        longest = max(longest, watch.seconds)
        outcomes[f"{kind}: {outcome}"] += 1
        if fault := fault or watch.fault():
            failures.append(f"{index} {name} {kind} {what}: {fault}")
    restore_random_state(cases.random)
    for name, content in cases.files.items():
        if not same(cases.answers(name, cases.load(name, content))[0], honest[name][0]):
            failures.append(f"the honest {name} is another after all this")
    print(json.dumps({"outcomes": outcomes, "failures": failures, "seconds": longest, "memory": peak()}, indent=1))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
