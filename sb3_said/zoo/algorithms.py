"""What each name of ``--algo`` is, for rl_zoo3 as for our own commands."""

from __future__ import annotations

from rl_zoo3 import ALGOS

from sb3_said import SAID, DelayedSAC, StableSAC
from sb3_said.offline import BC, DQL

#: A class, and the flags that make it so.
ALGORITHMS: dict[str, tuple[type[DelayedSAC], dict[str, bool]]] = {
    "said": (SAID, {}),
    "sac": (DelayedSAC, {"augment_state": False, "delay_reconciled_critic": False}),
    "sa": (DelayedSAC, {"augment_state": True, "delay_reconciled_critic": False}),
    "dr": (DelayedSAC, {"augment_state": False, "delay_reconciled_critic": True}),
    "sadr": (DelayedSAC, {"augment_state": True, "delay_reconciled_critic": True}),
    "stable": (StableSAC, {}),
    "bc": (BC, {}),
    "dql": (DQL, {}),
}
ALGOS.update({name: cls for name, (cls, _) in ALGORITHMS.items()})

#: Hyper-parameters that are dicts of settings, merged entry by entry.
NESTED = sorted({name for cls, _ in ALGORITHMS.values() for name in cls.settings_arguments})
