# SPDX-License-Identifier: Apache-2.0
"""Stands in for the training command: speaks its protocol and behaves as its model is named.

Its model is a copy of the one beside the first bag.
"""

import argparse
import json
import os
import shutil
import signal
import sys
import threading
import time
from pathlib import Path


def say(state: str, **values: object) -> None:
    """Print one line of progress."""
    print(json.dumps({"state": state, **values}), flush=True)


def main() -> None:
    """Train on nothing."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--json-progress", action="store_true", required=True)
    config = json.loads(parser.parse_args().config.read_text())
    behaviour = config["output"]["name"]
    stop = threading.Event()
    if behaviour == "deaf":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    else:
        signal.signal(signal.SIGTERM, lambda *_: stop.set())
        threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), daemon=True).start()
    print("a line that is no progress")
    if behaviour == "doubtful":
        say("curating", message="warning: 60 frames are few")
        time.sleep(0.5)  # the latched topic keeps the newest status alone
    print("[" * 50_000)
    say("training", step=1, steps=2, loss=0.5, niceness=os.nice(0), session=os.getsid(0))
    if behaviour == "crash":
        raise RuntimeError("the dictionary caught fire")
    if behaviour == "refuse":
        say("failed", message="topic /nowhere is not in the bag")
        sys.exit(2)
    if behaviour == "mute":
        os._exit(0)
    if behaviour == "deaf":
        time.sleep(1000)
    if behaviour == "wait":
        stop.wait()
        say("cancelled", message="kept the best of 1 step", model="best.safetensors")
        sys.exit(130)
    model = "new.safetensors"
    if config["data"]["bags"]:
        folder = Path(config["output"]["folder"])
        model = str(
            shutil.copy(
                f"{config['data']['bags'][0]}.safetensors", folder / f"{behaviour}.safetensors"
            )
        )
    judgement = behaviour if behaviour in ("doubtful", "as_good", "alone") else "better"
    say("finished", message="done", model=model, step=2, steps=2, judgement=judgement)
    if behaviour == "doubtful":
        sys.exit(3)  # its data looked wrong


if __name__ == "__main__":
    main()
