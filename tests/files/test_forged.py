"""Forged and foreign files are refused before anything of them runs: no pickle, no code, no oversized network."""

import io
import os
import pickle
import pickletools
import resource
import zipfile

import numpy as np
import pytest
import torch as th
from saving import forge, make_policy, make_sac, same
from stable_baselines3 import SAC
from stable_baselines3.sac.policies import SACPolicy

from sb3_said import SAID, DelayedSAC, StableSAC
from sb3_said.files.archive import SavedFileError, load_metadata, load_tree
from sb3_said.sac.policies import DelayedSACPolicy


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (["arguments", "env"], "os:Pendulum-v1"),  # Gymnasium imports what stands before the colon
        (["arguments", "device"], "cpu"),
        (["arguments", "learn"], 1),
        (["arguments", "learning_rate"], {"@": ["os.system", "true"]}),
        (["arguments", "policy_class"], {"@": ["subprocess.Popen"]}),
        (["arguments", "policy_class"], {"@": ["torch.nn.ReLU"]}),
        (["arguments", "policy_kwargs"], {"net_arch": [8], "activation_fn": {"@": ["torch.nn.Module"]}}),
        (["arguments", "policy_kwargs"], {"evil": 1}),
        (["arguments", "policy_kwargs"], "net_arch"),
        (["arguments", "train_freq"], "x"),
        (["arguments", "buffer_size"], {}),
        (["arguments"], []),
        (["missing"], 3),
        (["spaces"], [{}, {}]),
        (["spaces"], [[1, 2], [3, 4]]),
        (["n_envs"], "two"),
        (["counters", "num_timesteps"], 1.5),
        (["counters", "trained_ages"], [[]]),
        (["counters", "predict"], 1),
        (["counters"], {}),
        (["parameters", "policy"], {}),
        (["parameters", "policy.__class__"], {}),
        (["parameters", "policy", "actor.mu.bias"], 0.0),
        (["parameters", "actor.optimizer", "__class__"], {}),
        (["variables"], {"log_ent_coef": 1.0}),
        (["variables", "learning_rate"], 1.0),
        (["variables", "log_ent_coef.__class__"], th.zeros(1)),  # would change torch.nn.Parameter
        (["parameters"], "/etc/passwd"),  # would be opened
        (["parameters", "actor.optimizer", 0, "exp_avg"], th.full((8, 3), th.nan)),
        (["parameters", "actor.optimizer", 0, "exp_avg"], th.zeros(8, 3, dtype=th.int32)),
        (["parameters", "actor.optimizer", 0, "exp_avg_sq"], -th.ones(8, 3)),
        (["parameters", "actor.optimizer", 0, "step"], th.tensor(-1.0)),
        (["parameters", "actor.optimizer", 0, "predict"], th.zeros(8, 3)),
        (["counters", "_n_updates"], -1),
        (["counters", "num_timesteps"], 10**30),
        (["counters", "_current_progress_remaining"], float("nan")),
        (["counters", "trained_ages"], [-1]),
        (["n_envs"], 10**9),
        (["spaces", 1], [np.array([np.nan], np.float32)] * 2),
        (["spaces", 1], [np.ones(1, np.float32), np.zeros(1, np.float32)]),
        (["spaces", 0], [np.zeros((10**9, 0), np.float32)] * 2),
        (["arguments", "gamma"], float("nan")),
        (["arguments", "gamma"], 2.0),
        (["arguments", "tau"], "0.5"),
        (["arguments", "use_sde"], 1),
        (["arguments", "buffer_size"], 10**12),
        (["arguments", "seed"], -1),
        (["arguments", "ent_coef"], "nan"),
        (["arguments", "train_freq"], (0, "step")),
        (["arguments", "learning_rate"], {"@": ["LinearSchedule", 1e-3, float("nan"), 1.0]}),
        (["arguments", "learning_rate"], {"@": ["FloatSchedule", {"@": ["torch.nn.ReLU"]}]}),
        (["arguments", "action_noise"], {"@": ["NormalActionNoise", 0.0, 1.0, "<U1000000000"]}),
        (["arguments", "action_noise"], {"@": ["NormalActionNoise", np.zeros(10**6), 1.0, "<f4"]}),
    ],
    ids=lambda value: str(value)[:40],
)
def test_forged_agents_are_refused(place, value, saved):
    forge(saved, place, value)
    with pytest.raises(SavedFileError, match="Cannot load"):
        DelayedSAC.load(saved, device="cpu")


@pytest.mark.parametrize(
    "policy_kwargs",
    [
        {"n_critics": 10**9},
        {"net_arch": [10**5] * 3},
        {"net_arch": [8] * 10**5},
        {"net_arch": {"pi": [8], "qf": [3000] * 50}},
    ],
    ids=lambda value: str(value)[:40],
)
def test_networks_are_no_larger_than_what_the_file_holds(policy_kwargs, saved, tmp_path):
    forge(saved, ["arguments", "policy_kwargs"], {"net_arch": [8]} | policy_kwargs)
    make_policy().save(tmp_path / "policy")
    forge(tmp_path / "policy", ["arguments"], {"net_arch": [8]} | policy_kwargs)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for load, path in ((DelayedSAC.load, saved), (DelayedSACPolicy.load, tmp_path / "policy")):
        with pytest.raises(SavedFileError, match=r"ask for larger networks than it holds|not enough memory"):
            load(path, device="cpu")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # KiB
    make_sac(policy_kwargs={"net_arch": [300, 300]})  # nothing is counted afterwards


@pytest.mark.parametrize("value", [np.nan, np.inf, "float64", "shape"])
def test_parameters_are_looked_at_before_they_are_taken(value, trained, saved):
    weight = trained.actor.mu.weight.detach()
    changed = {"float64": weight.double(), "shape": weight[None]}.get(value)
    place = ["parameters", "policy", "actor.mu.weight"]
    forge(saved, place, th.full_like(weight, value) if changed is None else changed)
    other = make_sac(seed=5)
    before = {name: value.clone() for name, value in other.policy.state_dict().items()}
    with pytest.raises(SavedFileError, match=r"'policy' does not fit: actor\.mu\.weight"):
        other.set_parameters(saved)
    assert same(before, dict(other.policy.state_dict()))


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (["arguments"], {"net_arch": {"@": ["os.system"]}}, "names 'os.system'"),
        (["arguments"], {"evil": 1}, "damaged"),
        (["spaces"], [], "damaged"),
        (["state_dict"], {}, "it lacks"),
        (["state_dict", "actor"], {"@": ["torch.nn.ReLU"]}, "unknown"),
    ],
    ids=str,
)
def test_forged_policies_are_refused(place, value, message, tmp_path):
    make_policy().save(tmp_path / "policy")
    forge(tmp_path / "policy", place, value)
    with pytest.raises(SavedFileError, match=f"(?s)Cannot load.*{message}"):
        DelayedSACPolicy.load(tmp_path / "policy")


class Bomb:
    """Unpickling it creates a file."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def test_loading_never_unpickles(trained, saved, monkeypatch):
    def boom(*args, **kwargs):
        raise AssertionError("something was unpickled")

    DelayedSAC.load(saved, device="cpu")  # reads, once, what types its constructor declares
    for name in ("load", "loads", "Unpickler", "_Unpickler"):
        monkeypatch.setattr(pickle, name, boom)
    monkeypatch.setattr(th, "load", boom)
    monkeypatch.setattr("cloudpickle.loads", boom)
    monkeypatch.setattr("builtins.eval", boom)
    loaded = DelayedSAC.load(saved, device="cpu")
    make_sac().set_parameters(saved)
    assert same(trained.get_parameters(), loaded.get_parameters())
    file = io.BytesIO()
    make_policy().save(file)
    DelayedSACPolicy.load(file, device="cpu")


def test_no_member_is_a_pickle(saved):
    with zipfile.ZipFile(saved) as archive:
        names = archive.namelist()
        assert set(names) == {"tree.json", *(f"{index}.npy" for index in range(len(names) - 1))}
        for name in names:
            with pytest.raises(ValueError):
                list(pickletools.genops(archive.read(name)))


def test_pickles_and_files_of_sb3_are_refused_and_not_run(tmp_path):
    target = tmp_path / "harm"
    with open(tmp_path / "raw.zip", "wb") as file:
        pickle.dump(Bomb(target), file)
    th.save({"a": Bomb(target)}, tmp_path / "torch.zip")
    th.save({"a": Bomb(target)}, tmp_path / "old_torch.zip", _use_new_zipfile_serialization=False)
    model = make_sac(cls=SAC)
    SACPolicy.save(model.policy, tmp_path / "policy.zip")
    model.tensorboard_log = Bomb(target)
    model.save(tmp_path / "agent.zip")
    for name in ("raw.zip", "torch.zip", "old_torch.zip", "policy.zip", "agent.zip"):
        for load in (DelayedSAC.load, load_tree, make_sac().set_parameters, DelayedSACPolicy.load):
            with pytest.raises(
                SavedFileError, match=r"a pickle.*runs whatever code.*SAC\.load\(path\).*get_parameters\(\)\)"
            ):
                load(tmp_path / name)
    assert not target.exists()
    trusted = SAC.load(tmp_path / "agent.zip", device="cpu")  # the bomb works: the refusal is what held it back
    assert target.exists()
    ours, other = make_sac(seed=5), make_sac(seed=6)
    ours.set_parameters(trusted.get_parameters())  # as the refusal says
    other.set_parameters(trusted.get_parameters())
    assert same(ours.get_parameters(), trusted.get_parameters())
    assert same(dict(other.policy.state_dict()), dict(trusted.policy.state_dict()))
    obs = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    for cls in (StableSAC, SAID):
        steadier = make_sac(cls=cls, seed=7, normalise_states=False, scale_rewards=False)
        steadier.set_parameters(trusted.get_parameters(), exact_match=False)
        np.testing.assert_allclose(
            *(model.predict(obs, deterministic=True)[0] for model in (steadier, trusted)), rtol=1e-4, atol=1e-5
        )


@pytest.mark.parametrize("task", ["module:Task-v0", {"a": 1}, 3])
def test_a_task_that_would_import_a_module_is_none(task, tmp_path):
    model = make_sac().learn(20)
    model.task = task
    model.save(tmp_path / "agent.zip")
    assert load_metadata(tmp_path / "agent.zip")["metadata"] == {"task": task, "reads_normalized": False}
    assert DelayedSAC.load(tmp_path / "agent.zip", device="cpu").task is None
