"""Recordings of a GPU's work, on a CPU: what they are recorded on, who shares them, and what they keep alive."""

import contextlib
import gc
import threading
import weakref

import pytest
import torch as th

from sb3_said.planner import graphs
from sb3_said.planner.graphs import EAGER_CALLS, Recording

GPU = th.device("cuda:1")


class Graph:
    """A graph whose replay is the function itself, which the test hands over."""

    replayed = staticmethod(lambda: None)

    def register_generator_state(self, generator):
        pass

    def replay(self):
        Graph.replayed()


@pytest.fixture
def cuda(monkeypatch):
    """Let the calls of torch.cuda do nothing but note where they were asked to."""
    noted = []

    @contextlib.contextmanager
    def context(name, *given, **options):
        noted.append((name, *given, *options.items()))
        yield

    class Stream:
        def __init__(self, device):
            noted.append(("made", device))

        def wait_stream(self, other):
            pass

    monkeypatch.setattr("torch.cuda.CUDAGraph", Graph)
    monkeypatch.setattr("torch.cuda.Stream", Stream)
    monkeypatch.setattr("torch.cuda.current_stream", lambda device: Stream(device))
    for name in ("device", "stream", "graph"):
        monkeypatch.setattr(
            f"torch.cuda.{name}", lambda *given, _name=name, **options: context(_name, *given, **options)
        )
    graphs._side_stream.cache_clear()
    yield noted
    graphs._side_stream.cache_clear()


def test_all_is_done_on_the_recordings_gpu_and_one_stream_of_it(cuda):
    stream = graphs._side_stream(GPU)
    recording = Recording(GPU)
    for _ in range(EAGER_CALLS + 2):
        recording(lambda x: (x + 1,), th.zeros(1))
    devices = [note[1] for note in cuda if note[0] == "device"]
    assert devices == [GPU] * (EAGER_CALLS + 2)
    streams = [note[1] for note in cuda if note[0] == "stream"]
    assert streams == [stream] * EAGER_CALLS  # libraries keep memory for each stream
    (recorded,) = (note for note in cuda if note[0] == "graph")
    assert ("stream", stream) in recorded and ("capture_error_mode", "thread_local") in recorded


def test_threads_that_share_a_recording_have_each_its_own_answer(cuda, monkeypatch):
    recording, first, second_asks = Recording(GPU), threading.Event(), threading.Event()
    for _ in range(EAGER_CALLS + 1):
        recording(lambda x: (x + 1,), th.zeros(1))

    def replayed():
        if not first.is_set():
            first.set()
            second_asks.wait(0.5)  # the other thread now waits, or has put its input in the place of this one's
        recording.outputs[0].copy_(recording.inputs[0] + 1)

    monkeypatch.setattr(Graph, "replayed", staticmethod(replayed))
    found = {}

    def ask(x):
        found[x] = float(recording(lambda x: (x + 1,), th.tensor([x]))[0])

    one = threading.Thread(target=ask, args=(10.0,))
    one.start()
    assert first.wait(5)
    two = threading.Thread(target=ask, args=(20.0,))
    two.start()
    two.join(0.2)
    second_asks.set()
    one.join()
    two.join()
    assert found == {10.0: 11.0, 20.0: 21.0}


def test_a_recording_does_not_keep_whom_it_belongs_to(cuda):
    class Trainer:
        def __init__(self):
            self.recording = Recording(GPU)
            for _ in range(EAGER_CALLS + 2):
                self.recording(self.update, th.zeros(1))

        def update(self, x):
            return (x + 1,)

    gc.disable()
    try:
        trainer = Trainer()
        there = weakref.ref(trainer)
        del trainer
        assert there() is None
    finally:
        gc.enable()
