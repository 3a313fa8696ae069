# SPDX-License-Identifier: Apache-2.0
"""What spoils valid input in numbered ways, and what gives thousands of them to a reader.

`make fuzz` gives each class 100000 inputs and prints what became of them; the suite gives 200. An
input follows from its number alone, so that one can be looked at again: FUZZ=1 FUZZ_FIRST=number.
"""

from __future__ import annotations

import os
import random
import resource
import struct
import time
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.smoothing import SmoothingOptions
from deep_nrsfm_ros.messages.decoding import InputType
from deep_nrsfm_ros.messages.options import InputOptions
from deep_nrsfm_ros.messages.pipeline import Pipeline
from deep_nrsfm_ros.messages.serialised import MessageReader
from deep_nrsfm_ros.messages.stamps import Moment
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser

INPUTS = int(os.environ.get("FUZZ", "200"))
FIRST = int(os.environ.get("FUZZ_FIRST", "0"))
LONG = INPUTS > 1000
SHOWN_EVERY = 10_000
MOST_FAULTS = 10  # after which a class is given up
MB = 2**20
NAMES = ("left", "right", "up", "front", "tip", "tail")
P = len(NAMES)
LAYOUT = KeypointLayout("thing", NAMES, (("left", "right"),), (NAMES[:4],), ("up", "tip"))
SIZES = (
    *(0, 1, 2, 3, 4, 5, P, P + 1, 16, 100, -1, -7, 255, 65535),
    *(2**31 - 1, 2**31, 2**32 - 1, 2**63),
)
NUMBERS = (0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 1e-45, 1e9, 3e38, 1e308, -1e30)
WORDS = ("", "x", "y", "confidence", "a" * 300, "é\ud800", "../..", "\0", "%s{}", "nan", "1e999")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let the long form take its time."""
    for item in items:
        if LONG and "fuzz" in item.fixturenames:  # type: ignore[attr-defined]
            item.add_marker(pytest.mark.timeout(0))


class Spoiler(random.Random):
    """Spoils what is valid, in a way that follows from its seed."""

    sizes, numbers, words = SIZES, NUMBERS, WORDS

    def spoil_bytes(self, data: bytes) -> bytes:
        """Return bytes cut off, lengthened, with bits flipped, runs replaced or parts moved."""
        spoilt = bytearray(data)
        for _ in range(self.choice((1, 1, 1, 2, 5, 30))):
            at, run = self.randrange(len(spoilt) + 1), self.choice((1, 1, 2, 4, 8, 40))
            what = self.randrange(6)
            if what == 0:
                del spoilt[at:]
            elif what == 1:
                spoilt[at : at + run] = self.randbytes(run)
            elif what == 2:
                spoilt[at : at + 4] = struct.pack("<q", self.choice(SIZES) % 2**32)[:4]
            elif what == 3:
                spoilt[at:at] = self.randbytes(run)
            elif what == 4:
                del spoilt[at : at + run]
            elif at < len(spoilt):
                spoilt[at] ^= 1 << self.randrange(8)
        return bytes(spoilt)

    def spoil_text(self, text: bytes, bits: tuple[bytes, ...]) -> bytes:
        """Return text with some of the bits put into it, its bytes spoilt every other time."""
        text = self.spoil_bytes(text) if self.random() < 0.5 else text
        for _ in range(self.randrange(4)):
            at = self.randrange(len(text) + 1)
            text = text[:at] + self.choice(bits) + text[at:]
        return text

    def spoil(self, value: Any) -> None:
        """Change a loose message, or parsed JSON, in a few places."""
        for _ in range(self.choice((1, 1, 2, 3, 6))):
            container, key = self.choice(_places(value))
            container[key] = self.anything(container[key])

    def anything(self, old: Any) -> Any:
        """Return something in the place of `old`: often alike, sometimes of another type."""
        if self.random() < 0.15:
            return self.choice((None, [], {}, "x", 1.5, -1, True, b"\0", object()))
        if isinstance(old, bool):
            return not old
        if isinstance(old, int):
            return self.choice(SIZES)
        if isinstance(old, float):
            return self.choice(NUMBERS)
        if isinstance(old, str):
            return self.choice(WORDS)
        if isinstance(old, np.ndarray):
            return self._array(old)
        if isinstance(old, list):
            return self.choice(([], old[1:], old * 2, old[::-1], old[:1] * 300))
        return None

    def _array(self, old: np.ndarray) -> np.ndarray:
        """Return another array of the type of `old`."""
        if old.dtype == np.uint8:
            return np.frombuffer(self.spoil_bytes(old.tobytes()), np.uint8)
        sizes = (0, 1, max(old.size - 1, 0), old.size + 1, old.size, 5000)
        new = np.resize(old, self.choice(sizes))
        with np.errstate(all="ignore"):  # NaN as a whole number
            for _ in range(self.randrange(1 + min(len(new), 4))):
                new[self.randrange(len(new))] = np.float64(self.choice(NUMBERS)).astype(old.dtype)
        return new


def _places(value: Any) -> list[tuple[Any, Any]]:
    """Return every (container, key) inside a loose message."""
    if isinstance(value, SimpleNamespace):
        own: list[tuple[Any, Any]] = [(value.__dict__, name) for name in value.__dict__]
    elif isinstance(value, list):
        own = [(value, i) for i in range(len(value))]
    elif isinstance(value, dict):
        own = [(value, key) for key in value]
    else:
        return []
    return own + [place for container, key in own for place in _places(container[key])]


class Bench:
    """A model of `layout`, and pipelines that lift with it."""

    layout = LAYOUT

    def __init__(self) -> None:
        network = initialise(Architecture(widths=(8, 4)), P, np.random.default_rng(0))
        self.model = Model("thing", network, LAYOUT, Normaliser(), np.eye(3, dtype=np.float32))

    def pipeline(self, model: Model | None = None, quick: bool = False) -> Pipeline:
        """Return a pipeline; `quick`: that lifts only once, as is."""
        inputs = InputOptions(image_width=640, image_height=480)
        plain = LiftingOptions(correction="none", refill=0, test_time_rotations=1)
        lifting = plain if quick else LiftingOptions()
        return Pipeline(model or self.model, None, inputs, lifting, SmoothingOptions())

    @staticmethod
    def lift(
        pipeline: Pipeline, message: Any, input_type: InputType, intrinsics: Any = None
    ) -> Lifted:
        _, seen = pipeline.read(b"", MessageReader(input_type, lambda _: message))
        if not len(seen.confidence):
            raise ValueError("no object, which is no error and no answer either")
        names = ("one",) * len(seen.confidence)
        return pipeline.lift(seen, intrinsics, names, "topic", Moment(0.0))[0]

    @classmethod
    def loose(cls, value: Any) -> Any:
        """Return a message whose fields take anything."""
        if hasattr(value, "__dataclass_fields__"):
            fields = value.__dataclass_fields__
            return SimpleNamespace(**{name: cls.loose(getattr(value, name)) for name in fields})
        if isinstance(value, SimpleNamespace):
            return SimpleNamespace(**{k: cls.loose(v) for k, v in value.__dict__.items()})
        return [cls.loose(item) for item in value] if isinstance(value, list) else value


@pytest.fixture
def bench() -> Bench:
    """Return a model and what lifts with it."""
    return Bench()


Fuzz = Callable[..., None]


@pytest.fixture
def fuzz(capsys: pytest.CaptureFixture[str]) -> Fuzz:
    """Return what gives a reader its inputs and holds it to the promise.

    fuzz(name, one): `one` takes a Spoiler and returns in a word what became of its input. Anything
    that it raises is a fault. `touched`: memory that is asked for is touched, too.
    """

    def run(name: str, one: Callable[[Spoiler], str], touched: bool = True) -> None:
        outcomes, faults, began = Counter[str](), list[str](), time.monotonic()
        slowest = 0.0
        with _memory() as grown:
            for number in range(FIRST, FIRST + INPUTS):
                before = time.thread_time()
                try:
                    outcomes[one(Spoiler(number))] += 1
                except Exception as problem:
                    faults.append(f"input {number} of {name}: {problem!r}")
                    if len(faults) == MOST_FAULTS or not LONG:
                        raise AssertionError("\n".join(faults)) from problem
                slowest = max(slowest, time.thread_time() - before)
                done = number + 1 - FIRST
                if LONG and (done % SHOWN_EVERY == 0 or done == INPUTS):
                    said = ", ".join(f"{n} {what}" for what, n in outcomes.most_common())
                    with capsys.disabled():
                        print(
                            f"\n{name}: {done} of {INPUTS} inputs in "
                            f"{time.monotonic() - began:.0f} s: {said}, {len(faults)} raised; "
                            f"slowest {slowest:.2f} s of CPU time; memory grew by "
                            f"{grown()[1]:.0f} MB",
                            end="",
                            flush=True,
                        )
        asked, resident = grown()
        assert not faults, "\n".join(faults)
        assert len(outcomes) > 1 or INPUTS < 100
        assert max(asked if touched else 0, resident) < 100

    return run


@contextmanager
def _memory() -> Iterator[Callable[[], tuple[float, float]]]:
    """Yield what tells the MB that were asked for at most (0 in the long form) and are resident."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    asked = 0.0

    def grown() -> tuple[float, float]:
        now = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        peak = tracemalloc.get_traced_memory()[1] / MB if tracemalloc.is_tracing() else asked
        return peak, (now - before) / 1024

    if not LONG:  # it takes long
        tracemalloc.start()
        tracemalloc.reset_peak()  # of a class that failed before
    try:
        yield grown
        asked = grown()[0]
    finally:
        tracemalloc.stop()
