# SPDX-License-Identifier: Apache-2.0
"""Demos that run at the same time have DDS domains of their own."""

from __future__ import annotations

from contextlib import ExitStack

import pytest

from deep_nrsfm_ros.commands.demo import domain


def test_no_two_have_one_domain(monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as taken:
        numbers = [taken.enter_context(domain.own_domain()) for _ in range(3)]
        assert len(set(numbers)) == 3 and set(numbers) <= set(range(1, 102))
        monkeypatch.setattr(domain, "_DOMAINS", numbers)
        with pytest.raises(OSError, match="all DDS domains"):
            taken.enter_context(domain.own_domain())
    with domain.own_domain() as number:
        assert number in numbers
