# SPDX-License-Identifier: Apache-2.0
"""Draw the animation of the README from the clip that comes with the package.

    python -m docs.draw_animation

Left: what a camera saw, with the 2D keypoints of the detector. Right: the person lifted from that
camera alone, on the floor, with the ground truth in grey, while the viewer goes to and fro.
"""

from __future__ import annotations

from pathlib import Path

from deep_nrsfm_ros.commands.demo.first_look import lift_view, read_model, stage_of
from deep_nrsfm_ros.data.clip import read_clip
from deep_nrsfm_ros.data.pose2sim import RATE
from deep_nrsfm_ros.reporting.stage_image import animation_frames, save_animation

PATH = Path(__file__).parent / "pictures" / "demo.webp"
_CAMERA = 1  # "cam02"
_HEIGHT = 400  # pixels
_TURN = 0.9  # radians to each side
_SLOWER = 1.6  # times the time that it took


def main() -> None:
    """Write the animation."""
    model, clip = read_model("human", Path("demo_output")), read_clip()
    stage = stage_of(clip, model, [lift_view(view, model) for view in clip.session.views])
    images = list(animation_frames(stage, stage.views[_CAMERA], _HEIGHT, _TURN))
    PATH.parent.mkdir(exist_ok=True)
    save_animation(images, PATH, _SLOWER * stage.step / RATE)
    print(f"{PATH}: {PATH.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
