"""How fast REMNet trains here: this package's learner beside torch's own operators, in one run."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import torch

from uwb_mitigation.model.architecture import Remnet
from uwb_mitigation.training import parallel
from uwb_mitigation.training.fitting import single_thread
from uwb_mitigation.training.learner import Learner, ModuleLearner, learner
from uwb_mitigation.training.networks import RemnetModule
from uwb_mitigation.training.options import FitOptions

PAPER_SAMPLES = 36_023
PAPER_EPOCHS = 30

_STEPS = 25
_BATCHES = 100


@dataclass(frozen=True, slots=True)
class Speed:
    """Samples a second.

    Attributes:
        torch_module: `RemnetModule` with torch's gradients, one process of one thread.
        learner: `RemnetLearner`, likewise. Both by the best of their rounds, which alternate.
        torch_module_cpu, learner_cpu: samples a second of processor time, over all rounds; a busy machine hardly
            changes these.
        together: sum over `processes` processes that train at once, by wall clock.
    """

    torch_module: float
    learner: float
    torch_module_cpu: float
    learner_cpu: float
    together: float
    processes: int

    @property
    def ratio(self) -> float:
        """Learner to module, of processor time."""
        return self.learner_cpu / self.torch_module_cpu


def measure(
    samples: int = 157,
    batch: int = 32,
    rounds: int = 8,
    processes: int = 2,
    on_progress: Callable[[float], None] = lambda share: None,
) -> Speed:
    """Time training steps on random data, forward, backward and update."""
    shape, options = Remnet(samples), FitOptions(batch=batch, weight_decay=0.0)
    with single_thread(0):
        rivals = (ModuleLearner(RemnetModule(shape, options.dropout), options), learner(shape, options))
        clocks = [_Clock(rival, samples, batch) for rival in rivals]
        for clock in clocks:
            clock.run()
            clock.forget()
        for number in range(rounds):
            for clock in clocks:
                clock.run()
            on_progress((number + 1) / (rounds + 1))
    together = _together(samples, batch, 4 * rounds, processes)
    on_progress(1.0)
    plain, fast = clocks
    return Speed(plain.best, fast.best, plain.per_cpu_second, fast.per_cpu_second, together, processes)


@dataclass(slots=True)
class _Clock:
    rival: Learner
    samples: int
    batch: int
    best: float = 0.0
    _trained: int = 0
    _cpu_s: float = 0.0
    _data: list[tuple[torch.Tensor, torch.Tensor]] = field(default_factory=list)

    def __post_init__(self) -> None:
        inputs, targets = torch.rand(_BATCHES, self.batch, self.samples), torch.randn(_BATCHES, self.batch)
        self._data = list(zip(inputs, targets, strict=True))

    def run(self) -> None:
        wall, cpu = time.perf_counter(), time.thread_time()
        for inputs, targets in self._data[:_STEPS]:
            self.rival.step(inputs, targets)
        self._cpu_s += time.thread_time() - cpu
        self._trained += _STEPS * self.batch
        self.best = max(self.best, _STEPS * self.batch / (time.perf_counter() - wall))

    def forget(self) -> None:
        self.best, self._trained, self._cpu_s = 0.0, 0, 0.0

    @property
    def per_cpu_second(self) -> float:
        return self._trained / self._cpu_s


@dataclass(frozen=True, slots=True)
class _Shift:
    """Trains for a number of rounds once every process is up."""

    samples: int
    batch: int
    rounds: int

    def __call__(self, job: int, advance: Callable[[float], None]) -> None:
        shape, options = Remnet(self.samples), FitOptions(batch=self.batch, weight_decay=0.0)
        with single_thread(job):
            clock = _Clock(learner(shape, options), self.samples, self.batch)
            clock.run()
            clock.forget()
            begun = time.perf_counter()
            for _ in range(self.rounds):
                clock.run()
            advance(self.rounds * _STEPS * self.batch / (time.perf_counter() - begun))


def _together(samples: int, batch: int, rounds: int, processes: int) -> float:
    rates: list[float] = [0.0]
    parallel.each(_Shift(samples, batch, rounds), list(range(processes)), processes, rates.append)
    return rates[-1]
