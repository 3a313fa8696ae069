# SPDX-License-Identifier: Apache-2.0
"""Tests on several Pythons: `nox` runs the smoke set on each that there is, `nox -s full` all."""

from __future__ import annotations

import nox

PYTHONS = ["3.11", "3.12", "3.13"]
SMOKE = (
    *("test/test_configuration.py", "test/layouts", "test/kernel", "test/lifting"),
    *("--ignore=test/lifting/test_lifter.py", "test/data/test_clip.py"),  # it trains a network
)

nox.options.sessions = ["smoke"]
nox.options.error_on_missing_interpreters = False


@nox.session(python=PYTHONS)
def smoke(session: nox.Session) -> None:
    """Lift on a Python version, with the kernel, without ROS and torch."""
    tools = ("pytest", "pytest-timeout", "hypothesis", "scipy", "jsonschema", "setuptools")
    session.install("--editable", ".[hdf5,demo]", *tools)  # the tests import the source tree
    session.run("deep-nrsfm", "demo", "--output", session.create_tmp())
    session.run("pytest", "-q", "-p", "no:cacheprovider", *(session.posargs or SMOKE))


@nox.session(python=PYTHONS[0])
def full(session: nox.Session) -> None:
    """Run every check, by the Makefile."""
    session.run("make", "test", external=True)


@nox.session(python=PYTHONS[1])
def docs(session: nox.Session) -> None:
    """Build the documentation site and check its links."""
    session.install(".[docs]")
    session.run("sphinx-build", "-W", "-b", "html", "docs", "build/site")
    session.run("sphinx-build", "-b", "linkcheck", "docs", "build/linkcheck", success_codes=[0, 1])
